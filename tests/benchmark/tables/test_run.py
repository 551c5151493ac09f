import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from probe2road.benchmark.tables.cells import build_cell, score_cells
from probe2road.benchmark.tables.methods import METHODS, find_methods
from probe2road.benchmark.tables.run import run_benchmark
from probe2road.benchmark.tables.source import Source, choose_drives, make_fleet
from probe2road.cli.main import main
from probe2road.errors import InputError, OptionError
from probe2road.io.fleet_reader import read_fleet_files

NAME = "interchange-diamond-1"


@pytest.fixture(scope="module")
def tables(sets, tmp_path_factory):
    """What the command writes for two methods."""
    output = tmp_path_factory.mktemp("tables")
    words = ["benchmark", "run", sets, "--output", output, "--name", NAME, "--poses", "modelled"]
    with pytest.raises(SystemExit) as done:
        main([*map(str, words), "--method", "probe2road", "--method", "kde", "--quiet"])
    assert done.value.code in (None, 0)
    return output


def test_the_command_writes_tables_cells_and_pictures(tables):
    text = (tables / "index.md").read_text()
    for title in ("Table II", "Table III", "Table IV", "Table V", "Differences", "Further metrics"):
        assert f"## {title}" in text
    assert "KDE in three dimensions" in text
    assert (tables / f"place-{NAME}-1.png").read_bytes()[1:4] == b"PNG"
    with (tables / "cells.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["method"], row["stage"]) for row in rows] == [
        ("probe2road", "no post-processing"),
        ("probe2road", "gap filling"),
        ("probe2road", "full"),
        ("kde", "full"),
    ]
    config = json.loads(rows[2]["config"])
    assert config["dataset"] == NAME
    assert config["options"]["segmentation"]["segmenter"] == "network"
    assert config["weights"]
    assert float(rows[2]["geo_f1"]) > 0.8
    assert float(rows[2]["seconds"]) > 0


def test_a_second_run_builds_and_scores_nothing(sets, tables, monkeypatch):
    monkeypatch.setattr("probe2road.benchmark.tables.cells.measure", None)
    monkeypatch.setattr("probe2road.benchmark.tables.cells.score_graph", None)
    before = (tables / "cells.csv").read_text()
    run_benchmark(sets, tables, names=[NAME], methods=["probe2road", "kde"], poses="modelled")
    assert (tables / "cells.csv").read_text() == before


def test_other_options_are_built_anew(sets, tmp_path):

    source, method = Source(sets / NAME, tmp_path, "modelled"), METHODS["kde"]
    first = score_cells(source, method)[0]
    other = replace(method, options=replace(method.options, threshold=40.0))
    second = score_cells(source, other)[0]
    assert second.figures["km"] < first.figures["km"]
    assert not second.figures["resumed"]


def test_a_fleet_that_is_aligned_anew_is_built_anew(sets, tmp_path):
    shutil.copytree(sets / NAME, tmp_path / NAME)
    source, method = Source(tmp_path / NAME, tmp_path / "work"), METHODS["kde"]
    graphs = []
    for poses in ("modelled", "raw", "raw"):
        shutil.copy(replace(source, poses=poses).fleet_file, source.fleet_file)
        graphs.append((build_cell(source, method) / "graph.gpkg").stat().st_mtime_ns)
    assert graphs[0] < graphs[1] == graphs[2]


def test_fewer_drives_are_chosen_from_the_whole_fleet(sets, tmp_path):
    few = Source(sets / NAME, tmp_path, "raw", drives=1)
    make_fleet(few)
    some, all_ = (read_fleet_files(source.fleet_file) for source in (few, Source(sets / NAME, tmp_path, "raw")))
    assert 0 < some.n_traces < all_.n_traces
    assert set(some.traces["trace_id"]) < set(all_.traces["trace_id"])


def test_every_road_keeps_the_drives_it_can():
    rng = np.random.default_rng(3)
    routes = pd.DataFrame({"trace_id": np.repeat(np.arange(60), 5), "section": rng.integers(0, 12, 300)})
    routes = routes.drop_duplicates()
    available = routes.groupby("section")["trace_id"].nunique()
    for most in (1, 4, 100):
        chosen = choose_drives(routes, most, rng=np.random.default_rng(0))
        kept = routes[routes["trace_id"].isin(chosen)].groupby("section")["trace_id"].nunique()
        assert (kept >= np.minimum(available, most)).all()


def test_what_cannot_be_run_is_said_at_once(sets, tmp_path):
    with pytest.raises(OptionError, match="no method 'magic'"):
        find_methods(["magic"])
    with pytest.raises(OptionError, match="DeepMG has no weights"):
        find_methods(["deepmg"])
    with pytest.raises(OptionError, match="poses is 'perfect'"):
        Source(sets / NAME, tmp_path, "perfect")
    with pytest.raises(InputError, match=r"boston: there is no manifest.json"):
        run_benchmark(sets, tmp_path / "out", names=["boston"])
    assert not (tmp_path / "out").exists()
    assert [method.name for method in find_methods([], deepmg="weights.pt")] == list(METHODS)


def test_a_fleet_that_the_data_set_lacks_is_an_error(sets, tmp_path):
    source = Source(sets / NAME, tmp_path, "modelled")
    hidden = source.fleet_file.with_suffix(".hidden")
    source.fleet_file.rename(hidden)
    try:
        with pytest.raises(InputError, match="missing"):
            build_cell(source, METHODS["kde"])
    finally:
        hidden.rename(source.fleet_file)
