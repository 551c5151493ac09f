import copy
import errno
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import pytest

from probe2road import evaluate, read_fleet, read_graph, read_network, write_graph
from probe2road.errors import (
    CRSError,
    InputError,
    MissingExtraError,
    MissingFileError,
    OptionError,
    OutputError,
    Probe2RoadError,
    needs_extra,
)
from probe2road.segmentation.weights import read_weights
from sketches import graph_of


def test_a_missing_package_names_the_extra_to_install():
    message = r"this feature needs .* pip install 'probe2road\[train\]'"
    with pytest.raises(MissingExtraError, match=message) as caught, needs_extra("train", feature="this feature"):
        import no_such_package  # noqa: F401
    assert isinstance(caught.value.__cause__, ModuleNotFoundError)
    assert isinstance(caught.value, ImportError)


def test_a_broken_package_keeps_its_own_error():
    with pytest.raises(ImportError, match="libtorch") as caught, needs_extra("train", feature="this feature"):
        raise ImportError("libtorch.so: cannot open shared object file")
    assert not isinstance(caught.value, MissingExtraError)


@pytest.mark.parametrize("module", ["segmentation.losses"])
def test_a_module_of_an_extra_says_what_to_install(module):
    code = f"import sys; sys.modules['torch'] = None; import probe2road.{module}"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert "pip install 'probe2road[train]'" in run.stderr.splitlines()[-1]


def where_a_file_is_missing(path):
    read_graph(path)


@pytest.mark.parametrize(
    ("error", "builtin"),
    [
        (InputError, ValueError),
        (CRSError, ValueError),
        (OptionError, ValueError),
        (OutputError, OSError),
        (MissingFileError, FileNotFoundError),
        (MissingFileError, ValueError),
        (MissingFileError, InputError),
        (MissingExtraError, ImportError),
    ],
)
def test_an_error_is_also_the_one_of_python_that_says_the_same(error, builtin):
    with pytest.raises(builtin) as caught:
        raise error("is bad", where=Path("drives.csv"), fix="mend it")
    assert str(caught.value) == "drives.csv: is bad; mend it"
    assert caught.value.args == ("drives.csv: is bad; mend it",)


@pytest.mark.parametrize(
    "error", [Probe2RoadError, InputError, CRSError, OptionError, OutputError, MissingFileError, MissingExtraError]
)
@pytest.mark.parametrize("parts", [{}, {"where": Path("drives.csv")}, {"where": "row 3", "fix": "mend it"}])
def test_an_error_survives_the_way_between_processes(error, parts):
    sent = error("is bad", **parts)
    sent.add_note("in window 7")
    for came in (pickle.loads(pickle.dumps(sent)), copy.copy(sent)):
        assert type(came) is error
        assert str(came) == str(sent)
        assert (came.what, came.where, came.fix, came.__notes__) == (sent.what, sent.where, sent.fix, ["in window 7"])
        assert getattr(came, "filename", None) == getattr(sent, "filename", None)


def test_a_worker_process_sends_its_error_as_it_was_raised(tmp_path):
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        future = pool.submit(where_a_file_is_missing, tmp_path / "absent.gpkg")
        with pytest.raises(FileNotFoundError, match=r"absent\.gpkg: no such file; check the path") as caught:
            future.result()
    assert caught.value.errno == errno.ENOENT
    assert caught.value.filename == str(tmp_path / "absent.gpkg")


def test_users_of_other_libraries_catch_what_they_expect(tmp_path):
    graph = graph_of([(0, 0), (100, 0)])
    private = replace(graph, edges=graph.edges.assign(vehicle_id=1))
    for read in (read_fleet, read_graph, read_network, read_weights):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "absent.gpkg" if read is read_graph else tmp_path / "absent.csv")
    with pytest.raises(OSError, match=r"folder .* does not exist; create it first$"):
        write_graph(graph, tmp_path / "nowhere" / "roads.gpkg")
    with pytest.raises(OSError, match=r"^\S*roads\.gpkg: column 'vehicle_id' of the edges may identify drives; drop"):
        write_graph(private, tmp_path / "roads.gpkg")
    with pytest.raises(ValueError, match="there is no metric 'g'"):
        evaluate(graph, graph, metrics="g")


def test_a_crs_that_a_file_records_wrongly_is_named(tmp_path):
    path = tmp_path / "roads.geojson"
    write_graph(graph_of([(0, 0), (100, 0)]), path)
    path.write_text(path.read_text().replace("EPSG:32616", "EPSG:1"))
    with pytest.raises(CRSError, match="is not a coordinate reference system"):
        read_graph(path)
    path = tmp_path / "roads.osm"
    write_graph(graph_of([(0, 0), (100, 0)]), path)
    path.write_text(path.read_text().replace("EPSG:32616", "EPSG:1"))
    with pytest.raises(CRSError, match="is not a coordinate reference system"):
        read_graph(path)
