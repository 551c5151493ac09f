from __future__ import annotations

import json
import os

import pandas as pd
import pytest
import shapely

from probe2road.benchmark.sets import recording as module
from probe2road.benchmark.sets.recording import record_fleet
from probe2road.benchmark.sets.residual import ResidualModel, align_drives
from probe2road.errors import OptionError, OutputError
from probe2road.io import atomic
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.fleet_writer import points_path
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.simulation.fleet_simulation import simulate, simulate_chunks
from probe2road.simulation.networks.network import network_from_sections

ALIGNED = ResidualModel()


class KilledError(Exception):
    """Stands for the end of the process."""


@pytest.fixture(autouse=True)
def small_portions(monkeypatch):
    monkeypatch.setattr(module, "_DRIVES", 3)


@pytest.fixture(scope="module")
def whole(fork):
    """The same fleet in memory."""
    return simulate(fork, n_drives=8, seed=4)


@pytest.fixture
def recorded(fork, tmp_path):
    return record_fleet(fork, tmp_path / "fleet", n_drives=8, seed=4, residual=ALIGNED)


def contents(recording):
    """Bytes of every file, but of the graph its tables: a GeoPackage holds the time it was written."""
    files = {path.name: path.read_bytes() for path in recording.files if path.suffix != ".gpkg"}
    graph = read_graph(recording.reference)
    return files, graph.edges.to_wkb().to_csv(), graph.turns.to_csv()


def test_files_hold_the_fleet_that_is_simulated_in_memory(fork, recorded, whole):
    fleet = read_fleet(recorded.drives, points_path(recorded.drives), target_crs=fork.crs)
    pd.testing.assert_frame_equal(fleet.traces[whole.fleet.traces.columns], whole.fleet.traces)
    pd.testing.assert_frame_equal(fleet.points[whole.fleet.points.columns], whole.fleet.points)
    assert fleet.crs == fork.crs
    assert pd.read_parquet(recorded.poses)["section"].equals(whole.poses["section"])
    assert pd.read_parquet(recorded.routes).equals(whole.routes)


def test_modelled_files_hold_what_an_alignment_leaves(fork, recorded, whole):
    fleet = read_fleet(recorded.modelled, points_path(recorded.modelled), target_crs=fork.crs)
    traces, points = align_drives(whole.fleet.traces, whole.fleet.points, whole.poses, ALIGNED, seed=4)
    pd.testing.assert_frame_equal(fleet.traces[traces.columns], traces)
    pd.testing.assert_frame_equal(fleet.points[points.columns], points)


def test_reference_has_the_true_drives_turns_and_heights(recorded, whole):
    graph = read_graph(recorded.reference)
    columns = ["support", "forward", "backward"]
    assert graph.edges[columns].to_numpy().tolist() == whole.reference.edges[columns].to_numpy().tolist()
    assert graph.turns.to_numpy().tolist() == whole.reference.turns.to_numpy().tolist()
    assert shapely.has_z(graph.edges.geometry.to_numpy()).all()
    assert int(graph.edges["support"].max()) == 8


def test_run_says_how_it_was_made(recorded):
    run = recorded.run
    assert (run["seed"], run["n_drives"], run["preset"]["name"]) == (4, 8, "mixed")
    assert run["counts"]["drives"] == 8
    assert run["counts"]["traces"] == len(pd.read_parquet(recorded.poses))
    assert "probe2road" in run["versions"]


def test_a_killed_run_goes_on_and_ends_the_same(fork, recorded, tmp_path, monkeypatch):
    drawn = []

    def dies(*arguments, **options):
        for chunk in simulate_chunks(*arguments, **options):
            if len(drawn) == 1:
                raise KilledError
            drawn.append(len(chunk.length))
            yield chunk

    folder = tmp_path / "killed"
    monkeypatch.setattr(module, "simulate_chunks", dies)
    with pytest.raises(KilledError):
        record_fleet(fork, folder, n_drives=8, seed=4, residual=ALIGNED)
    assert not (folder / "run.json").exists()
    resumed = []

    def counts(*arguments, **options):
        for chunk in simulate_chunks(*arguments, **options):
            resumed.append(len(chunk.length))
            yield chunk

    monkeypatch.setattr(module, "simulate_chunks", counts)
    again = record_fleet(fork, folder, n_drives=8, seed=4, residual=ALIGNED)
    assert (drawn, resumed) == ([3], [3, 2])
    assert contents(again) == contents(recorded)
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_a_run_killed_as_it_joins_ends_the_same(fork, recorded, tmp_path, monkeypatch):
    def dies(*arguments):
        raise KilledError

    folder = tmp_path / "killed"
    monkeypatch.setattr(module, "write_graph", dies)
    with pytest.raises(KilledError):
        record_fleet(fork, folder, n_drives=8, seed=4, residual=ALIGNED)
    monkeypatch.setattr(module, "write_graph", write_graph)
    left = f".poses.parquet.{atomic._HOST}-{10**8}-k1ll3d.p2r-part"  # of a process that cannot be alive
    (folder / left).mkdir()  # what a kill leaves in place of an exception
    assert contents(record_fleet(fork, folder, n_drives=8, seed=4, residual=ALIGNED)) == contents(recorded)
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


def test_a_complete_recording_is_taken_as_it_is(fork, recorded, monkeypatch):
    monkeypatch.setattr(module, "simulate_chunks", None)
    assert record_fleet(fork, recorded.folder, n_drives=8, seed=4, residual=ALIGNED) == recorded


def test_another_run_replaces_a_recording(fork, recorded):
    other = record_fleet(fork, recorded.folder, preset="phone", n_drives=2, seed=4)
    assert [path.name for path in other.files] == [
        *("drives.parquet", "poses.parquet", "reference.gpkg", "routes.parquet", "run.json"),
    ]
    assert read_fleet(other.drives).n_traces == 2


def test_two_recordings_do_not_work_in_one_folder(fork, recorded, tmp_path):
    refused = []

    def second(*_):
        with pytest.raises(OutputError, match=f"process {os.getpid()} on .* is working in this folder") as error:
            record_fleet(fork, tmp_path / "busy", n_drives=2, seed=5)
        refused.append(error)

    again = record_fleet(fork, tmp_path / "busy", n_drives=8, seed=4, residual=ALIGNED, progress=second)
    assert refused
    assert contents(again) == contents(recorded)
    assert sorted(again.folder.iterdir()) == again.files


def test_other_roads_are_another_run(recorded, monkeypatch):
    straight = network_from_sections([[(0, 0), (3000, 0)]], crs="EPSG:32616")
    record_fleet(straight, recorded.folder, n_drives=8, seed=4, residual=ALIGNED)
    assert len(read_graph(recorded.reference).edges) == 1


@pytest.mark.slow  # two processes start
def test_workers_change_nothing(fork, recorded, tmp_path):
    shared = record_fleet(fork, tmp_path / "shared", n_drives=8, seed=4, residual=ALIGNED, workers=2)
    assert contents(shared) == contents(recorded)


def test_kilometres_are_reached_and_reported(fork, tmp_path):
    seen = []
    made = record_fleet(fork, tmp_path, drive_km=40.0, seed=4, progress=lambda *state: seen.append(state))
    assert 40.0 <= made.run["counts"]["km"] < 45.0
    assert seen[-1] == ("km", 40, 40)


def test_a_folder_of_something_else_is_left_alone(fork, tmp_path):
    (tmp_path / "letters.txt").write_text("dear")
    with pytest.raises(OutputError, match="not empty and not a recording"):
        record_fleet(fork, tmp_path, n_drives=1)
    assert [path.name for path in tmp_path.iterdir()] == ["letters.txt"]


@pytest.mark.parametrize("amount", [{}, {"n_drives": 1, "drive_km": 1.0}, {"n_drives": 0}, {"drive_km": -1.0}])
def test_amount_is_given_once_and_positive(fork, tmp_path, amount):
    with pytest.raises(OptionError, match="give one, above 0"):
        record_fleet(fork, tmp_path / "x", **amount)
    assert not (tmp_path / "x").exists()


def test_run_file_is_plain_json(recorded):
    assert json.loads((recorded.folder / "run.json").read_text())["format"] == 2
