"""A disk that fails at the n-th write, flush or rename, for every n: one error of ours, and nothing half written."""

from __future__ import annotations

import errno
import itertools
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pandas as pd
import pytest

from probe2road.benchmark.sets.recording import Recording, record_fleet
from probe2road.draw.view import view
from probe2road.errors import OutputError
from probe2road.fleet.contract import fleet_from_tables
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.fleet_reader import read_fleet_files
from probe2road.io.fleet_writer import write_fleet
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.io.table_writer import write_table
from probe2road.run.stages import ROADS, WINDOW
from probe2road.run.workspace import open_workspace
from probe2road.simulation.networks.network import network_from_sections
from sketches import graph_of

OLD = graph_of([(0, 0), (100, 0)])
NEW = graph_of([(0, 0), (100, 0)], [(100, 0), (100, 90)], [(100, 0), (200, 0)])
SUFFIXES = (".gpkg", ".parquet", ".fgb", ".geojson", ".graphml", ".osm", ".osm.pbf")


@contextmanager
def failing(number: int, code: int, patch: pytest.MonkeyPatch) -> Iterator[Callable[[], int]]:
    """Fail the flush or rename of this number, and all that follow; gives how many there were."""
    count = itertools.count()
    seen = [0]

    def refusing(real: Callable[..., object]) -> Callable[..., object]:
        def call(*words: object, **options: object) -> object:
            seen[0] = next(count) + 1
            if seen[0] > number:
                raise OSError(code, os.strerror(code))
            return real(*words, **options)

        return call

    with patch.context() as patched:
        for place, name in ((os, "fsync"), (Path, "replace"), (Path, "write_text")):
            patched.setattr(place, name, refusing(getattr(place, name)))
        yield lambda: seen[0]


def assert_all_or_nothing(
    folder: Path, write: Callable[[Path], object], look: Callable[[Path], object], patch: pytest.MonkeyPatch, code: int
) -> int:
    """Fail every step in turn; what is read is old or new, and a plain error says why. Returns the number of steps."""
    before = look(folder)
    for number in itertools.count():
        with failing(number, code, patch) as steps:
            try:
                write(folder)
            except OutputError as error:
                assert os.strerror(code).lower()[:8] in str(error).lower() or "space" in str(error)  # noqa: PT017
            else:
                return steps()
        assert not list(folder.rglob(".*.p2r-part"))
        now = look(folder)
        if now != before:  # committed: the next writer or reader ends it
            assert not list(folder.rglob(".*.p2r-commit"))
            return number
    raise AssertionError


def state(graph: RoadGraph) -> tuple[int, int]:
    return len(graph.edges), len(graph.nodes)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_graph_is_old_or_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, code: int) -> None:
    path = tmp_path / f"roads{suffix}"
    write_graph(OLD, path)
    steps = assert_all_or_nothing(
        tmp_path, lambda _: write_graph(NEW, path), lambda _: state(read_graph(path)), monkeypatch, code
    )
    assert steps >= 2
    write_graph(NEW, path)
    assert state(read_graph(path)) == state(NEW)
    assert not list(tmp_path.glob(".*"))


def test_a_fleet_is_old_or_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fleet(n: int) -> object:
        table = pd.DataFrame({"trace_id": 1, "t": range(n), "x": 10.0 * pd.Series(range(n)), "y": 0.0})
        return fleet_from_tables(table, table.assign(kind="lane_marking"), crs="EPSG:32616", keep_crs=True)

    path = tmp_path / "drives.parquet"
    write_fleet(fleet(5), path)  # type: ignore[arg-type]

    def look(_: Path) -> tuple[int, int]:
        found = read_fleet_files(path)
        return len(found.traces), len(found.points)

    assert_all_or_nothing(tmp_path, lambda _: write_fleet(fleet(9), path), look, monkeypatch, errno.ENOSPC)  # type: ignore[arg-type]
    assert look(tmp_path) in {(5, 5), (9, 9)}


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_table_is_old_or_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str) -> None:
    path = tmp_path / f"matches{suffix}"
    write_table(pd.DataFrame({"edge": [1]}), path)
    before = path.read_bytes()
    table = pd.DataFrame({"edge": [1, 2]})
    assert_all_or_nothing(
        tmp_path, lambda _: write_table(table, path), lambda _: path.read_bytes() == before, monkeypatch, errno.ENOSPC
    )


def test_a_workspace_goes_on_after_any_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from probe2road.recipe import BuildOptions

    table = pd.DataFrame({"trace_id": 1, "t": range(5), "x": 10.0 * pd.Series(range(5)), "y": 4e6})
    fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)

    def work(folder: Path) -> None:
        with open_workspace(folder, fleet, BuildOptions()) as kept:
            kept.write_arrays(WINDOW, "0-0", probability=table[["x"]].to_numpy(float))
            kept.finish(ROADS, NEW)

    work(tmp_path)
    for number in range(40):
        with failing(number, errno.ENOSPC, monkeypatch):
            try:
                work(tmp_path)
            except OutputError as error:
                assert "no space left" in str(error)  # noqa: PT017
            else:
                break
        with open_workspace(tmp_path, fleet, BuildOptions()) as kept:
            found = kept.read_graph(ROADS)
            assert found is not None
            assert state(found) == state(NEW)
    assert number > 5
    assert not list(tmp_path.glob(".*"))


def test_a_recording_goes_on_after_any_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    network = network_from_sections([[(0, 0), (500, 0)]], crs="EPSG:32616")

    def record(folder: Path) -> Recording:
        return record_fleet(network, folder, n_drives=1, seed=3)

    whole = record(tmp_path / "whole")
    for number in itertools.count():
        with failing(number, errno.ENOSPC, monkeypatch):
            try:
                recording = record(tmp_path / "fails")
            except OutputError as error:
                assert "no space left" in str(error)  # noqa: PT017
            else:
                break
    assert number > 5
    names = [path.name for path in whole.files]
    assert sorted(path.name for path in recording.folder.iterdir()) == names
    for name in names:
        if not name.endswith(".gpkg"):
            assert (recording.folder / name).read_bytes() == (whole.folder / name).read_bytes(), name


@pytest.mark.parametrize("name", ["roads.html", "roads.png"])
def test_a_view_is_old_or_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    path = tmp_path / name
    view(OLD, path)
    before = path.read_bytes()
    assert_all_or_nothing(
        tmp_path, lambda _: view(NEW, path), lambda _: path.read_bytes() == before, monkeypatch, errno.EIO
    )


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let the system refuse files above a size, as it does on a full disk: whatever library writes them."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_that_the_system_cuts_short_is_refused_as_such(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"roads{suffix}"
    write_graph(OLD, path)
    before = state(read_graph(path))
    big = graph_of(*([(x, 0), (x + 1, 7 * x % 13), (x + 2, 0)] for x in range(0, 900, 2)))
    sizes = [0, 100, 4096, 12_000]
    for size in sizes:
        with largest_file(size):
            try:
                write_graph(big, path)
            except OutputError as error:
                assert "larger than is allowed" in str(error)  # noqa: PT017
            else:
                assert len(read_graph(path).edges) == len(big.edges)
                break
        assert state(read_graph(path)) == before
    assert not list(tmp_path.glob(".*"))
    if size == 0:
        pytest.fail("nothing was refused")
