from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import shapely
from numpy.typing import NDArray

from probe2road.errors import CRSError, InputError, OptionError, OutputError
from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.graph.check import check_graph
from probe2road.graph.direction import driving_direction, oneway_probabilities
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.matching.frame import edge_lines, frame, smooth_stations, stations_along
from probe2road.matching.match import match
from probe2road.refinement.evidence import (
    EVIDENCE_COLUMNS,
    EvidenceOptions,
    add_evidence,
    drive_numbers,
)
from probe2road.refinement.heights import HeightOptions
from probe2road.simulation.drawn.generate import generate_interchange
from probe2road.simulation.fleet_simulation import simulate
from sketches import UTM, graph_of, spaced

TEE = [[(0, 0), (200, 0)], [(200, 0), (400, 0)], [(200, 0), (200, 200)]]


def drive(*corners: tuple[float, ...], name: object = 1, start: str = "2024-01-01", **columns: object) -> pd.DataFrame:
    """Return fixes each 10 m and 1 s along a line, whose heights come with it."""
    table = pd.DataFrame(spaced(*corners, start=5.0), columns=["x", "y", "z"][: len(corners[0])])
    times = pd.Timestamp(start, tz="UTC") + pd.to_timedelta(np.arange(len(table)), "s")
    return table.assign(trace_id=name, t=times, **columns)


def fleet(*drives: pd.DataFrame) -> Fleet:
    return fleet_from_tables(pd.concat(drives, ignore_index=True), crs=UTM, keep_crs=True)


def known(graph: RoadGraph, data: Fleet, **options: Any) -> RoadGraph:
    return add_evidence(graph, data, match(graph, data), options=EvidenceOptions(**options))


@pytest.fixture
def tee() -> RoadGraph:
    return graph_of(*TEE)


def test_counts_turns_and_speed(tee: RoadGraph) -> None:
    straight = [drive((0, -2), (400, -2), name=f"a{k}") for k in range(3)]
    turning = [drive((198, 200), (198, 2), (0, 2), name="b")]
    found = known(tee, fleet(*straight, *turning))
    assert found.edges["support"].tolist() == [4, 3, 1]
    assert found.edges["forward"].tolist() == [3, 3, 0]
    assert found.edges["backward"].tolist() == [1, 0, 1]
    assert found.turns.to_numpy().tolist() == [[0, 1, 1, 3], [2, 1, 0, 1]]
    assert found.edges["speed"].tolist() == pytest.approx([10.0, 10.0, 10.0])
    assert found.edges["vehicle_support"].isna().all()
    check_graph(found)


def test_a_glimpse_of_an_edge_is_no_support(tee: RoadGraph) -> None:
    found = known(tee, fleet(drive((0, 0), (212, 0))))
    assert found.edges["support"].tolist() == [1, 0, 0]


def test_nobody_drove(tee: RoadGraph) -> None:
    found = known(tee, fleet(drive((0, 900), (400, 900))))
    assert found.edges[["support", "forward", "backward"]].to_numpy().tolist() == [[0, 0, 0]] * 3
    assert found.edges[["oneway", "oneway_confidence", "speed", "spread", "height_spread"]].isna().all(axis=None)
    assert found.turns.empty


def test_a_trace_cut_in_two_is_one_drive_of_one_vehicle(tee: RoadGraph) -> None:
    parts = [
        drive((0, 0), (100, 0), name=1, start="2024-01-01 08:00:00", vehicle_id="A"),
        drive((100, 0), (200, 0), name=2, start="2024-01-01 08:00:10", vehicle_id="A"),
        drive((0, 0), (200, 0), name=3, start="2024-01-02 08:00:00", vehicle_id="A"),
        drive((0, 0), (200, 0), name=4, start="2024-01-01 08:00:00", vehicle_id="B"),
    ]
    data = fleet(*parts)
    assert drive_numbers(data).tolist() == [0, 0, 1, 2]
    first = known(tee, data).edges.iloc[0]
    assert (first["support"], first["drive_support"], first["vehicle_support"]) == (4, 3, 2)


def test_traces_without_a_clock_are_drives_of_their_own() -> None:
    table = drive((0, 0), (100, 0), vehicle_id="A").drop(columns="t")
    data = fleet(table, table.assign(trace_id=2))
    assert drive_numbers(data).tolist() == [0, 1]


@pytest.mark.parametrize(
    ("forward", "backward", "expected"), [(12, 0, "yes"), (0, 12, "-1"), (40, 1, "yes"), (6, 6, "no"), (2, 0, None)]
)
def test_oneway_in_the_words_of_openstreetmap(forward: int, backward: int, expected: str | None) -> None:
    graph = graph_of(*TEE[:1])
    there = [drive((0, 0), (200, 0), name=k) for k in range(forward)]
    back = [drive((200, 0), (0, 0), name=100 + k) for k in range(backward)]
    found = known(graph, fleet(*there, *back)).edges
    assert found["oneway"].isna()[0] if expected is None else found["oneway"][0] == expected
    assert driving_direction(found).tolist() == [{"yes": 1, "-1": -1}.get(str(expected), 0)]


def test_more_drives_the_same_way_are_more_certain() -> None:
    count = np.arange(1.0, 30.0)
    certainty = oneway_probabilities(count, 0 * count)[:, 0]
    assert (np.diff(certainty) > 0).all()
    assert certainty[-1] > 0.98


def test_a_sign_outranks_traffic() -> None:
    graph = graph_of(*TEE[:1])
    graph = replace(graph, edges=graph.edges.assign(oneway="no"))
    found = known(graph, fleet(*(drive((0, 0), (200, 0), name=k) for k in range(20)))).edges
    assert found["oneway"].tolist() == ["no"]
    assert found["oneway_confidence"][0] < 0.05


def test_profile_of_a_bridge_from_traces_with_biases() -> None:
    def height(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return 100.0 + 6.0 * np.exp(-(((x - 500.0) / 150.0) ** 2))

    rng = np.random.default_rng(0)
    graph = graph_of([(0, 0), (1000, 0)])
    drives = []
    for k in range(30):
        table = drive((0, 0), (1000, 0), name=k)
        noise = rng.normal(0, 3.0) + rng.normal(0, 0.2, len(table))
        drives.append(table.assign(z=height(table["x"].to_numpy()) + noise))
    found = known(graph, fleet(*drives), heights=HeightOptions(reach=50.0))
    place = edge_lines(found)
    x = np.linspace(0, 1000, 101)
    z = place.at(np.zeros(101, np.int64), x)[0][:, 2]
    error = z - height(x)
    assert abs(error.mean()) < 1.0  # the mean of 30 biases of 3 m
    assert (error - error.mean()).std() < 0.25
    assert 5 < len(found.edges.geometry[0].coords) < 60
    assert found.edges["height_spread"][0] == pytest.approx(0.2, abs=0.1)
    assert found.edges["length"][0] == pytest.approx(found.edges.geometry[0].length)


def test_heights_meet_at_a_node_but_not_on_different_levels() -> None:
    lines = [[(0, 0), (200, 0)], [(200, 0), (400, 0)], [(200, -200), (200, 0)]]
    graph = graph_of(*lines)
    flat = [drive((0, 0, 0.0), (200, 0, 0.0), name=k) for k in range(5)]
    flat += [drive((200, 0, 0.6), (400, 0, 0.6), name=10 + k) for k in range(5)]
    found = known(graph, fleet(*flat))
    ends = [found.edges.geometry[0].coords[-1][2], found.edges.geometry[1].coords[0][2]]
    assert ends[0] == pytest.approx(ends[1])
    high = [drive((200, 0, 7.0), (400, 0, 7.0), name=20 + k) for k in range(5)]
    found = known(graph, fleet(*flat[:5], *high))
    assert found.edges.geometry[1].coords[0][2] - found.edges.geometry[0].coords[-1][2] > 5.0
    assert not found.edges.geometry[2].has_z  # nobody drove it


def test_fleet_without_heights_leaves_those_of_the_graph() -> None:
    graph = graph_of([(0, 0, 5.0), (200, 0, 6.0)])
    data = fleet(drive((0, 0), (200, 0)))
    assert known(graph, data).edges.geometry[0].equals_exact(graph.edges.geometry[0])


@pytest.mark.parametrize("suffix", ["gpkg", "parquet", "geojson"])
def test_every_format_holds_the_evidence(tee: RoadGraph, suffix: str, tmp_path: Path) -> None:
    straight = [drive((0, 0, 3.0), (400, 0, 5.0), name=k, vehicle_id="AB"[k % 2]) for k in range(12)]
    found = known(tee, fleet(*straight))
    write_graph(found, tmp_path / f"roads.{suffix}")
    back = read_graph(tmp_path / f"roads.{suffix}").to_crs(UTM)
    for column in EVIDENCE_COLUMNS:
        ours, theirs = found.edges[column], back.edges[column]
        assert ours.isna().tolist() == theirs.isna().tolist(), column
        if column == "oneway":
            assert ours.dropna().tolist() == theirs.dropna().astype(str).tolist()
        else:
            assert theirs.dropna().to_numpy(float) == pytest.approx(ours.dropna().to_numpy(float), abs=1e-6)
    assert back.turns.to_numpy().tolist() == found.turns.to_numpy().tolist() == [[0, 1, 1, 12]]
    z, written = (shapely.get_coordinates(g.edges.geometry, include_z=True)[:, 2] for g in (found, back))
    assert written == pytest.approx(z, abs=1e-3, nan_ok=True)


def test_ids_do_not_leave(tee: RoadGraph, tmp_path: Path) -> None:
    found = known(tee, fleet(drive((0, 0), (400, 0))))
    assert not {"trace_id", "vehicle_id", "t"} & {*found.edges, *found.nodes, *found.turns}
    with pytest.raises(OutputError, match="drives"):
        write_graph(replace(found, edges=found.edges.assign(drives=1)), tmp_path / "roads.gpkg")


def test_inputs_are_not_changed(tee: RoadGraph) -> None:
    before = tee.edges.copy()
    known(tee, fleet(drive((0, 0, 1.0), (400, 0, 1.0))))
    pd.testing.assert_frame_equal(pd.DataFrame(tee.edges), pd.DataFrame(before))


def test_wrong_matches_and_crs_are_refused(tee: RoadGraph) -> None:
    data = fleet(drive((0, 0), (400, 0)))
    found = match(tee, data)
    with pytest.raises(InputError, match="the fleet has 20"):
        add_evidence(tee, fleet(drive((0, 0), (200, 0))), found)
    with pytest.raises(InputError, match="edge 1 of the matches is not in the graph"):
        add_evidence(graph_of(*TEE[:1]), data, found)
    with pytest.raises(CRSError):
        add_evidence(tee.to_crs("EPSG:32617"), data, found)


@pytest.mark.parametrize("wrong", [{"min_cover": -1.0}, {"max_interval": float("nan")}])
def test_options_out_of_range(wrong: dict[str, float]) -> None:
    with pytest.raises(OptionError, match=next(iter(wrong))):
        EvidenceOptions(**wrong)
    with pytest.raises(OptionError, match="sigma is 0"):
        HeightOptions(sigma=0.0)


def test_a_trace_lost_on_an_edge_traversed_it_once(tee: RoadGraph) -> None:
    first, second = drive((0, 0), (70, 0)), drive((130, 0), (200, 0), start="2024-01-01 00:00:13")
    aside = drive((70, 300), (130, 300), start="2024-01-01 00:00:07")
    data = fleet(first, aside, second)
    driven, _ = frame(tee, data, match(tee, data))
    assert driven.edge.tolist() == [0]
    assert (driven.low.tolist(), driven.high.tolist()) == ([5.0], [195.0])


def test_smoothing_levels_what_is_short_and_keeps_what_is_long() -> None:
    stations = stations_along(np.array([2000.0]), 10.0)
    short, long = (np.sin(2 * np.pi * stations.along / wave) for wave in (30.0, 600.0))
    smooth = smooth_stations(short + long, np.ones(len(short)), stations, reach=100.0, pull=1e-6)
    inner = slice(20, -20)
    assert np.abs(smooth - long)[inner].max() < 0.05


def test_counts_are_true_on_a_simulated_interchange() -> None:
    network = generate_interchange("diamond", rng=np.random.default_rng(4))
    result = simulate(network, preset="mixed", n_drives=40, seed=4)
    truth = result.reference
    flat = truth.edges.set_geometry(shapely.force_2d(truth.edges.geometry.to_numpy()), crs=truth.crs)
    graph = replace(truth, edges=flat.drop(columns="oneway").assign(support=pd.NA), turns=truth.turns.iloc[:0])
    found = known(graph, result.fleet)
    off = (found.edges["support"] - truth.edges["support"]).abs().to_numpy(float)
    assert (off == 0).mean() > 0.95
    decided = found.edges["oneway"].notna()
    right = ((found.edges["oneway"] != "no") == truth.edges["oneway"])[decided]
    assert right.mean() > 0.9  # a road that all 40 drives happened to pass the same way looks one-way
    driven = found.edges["support"].to_numpy(int) >= 4
    places = stations_along(edge_lines(truth).length, 20.0)
    z, true_z = (edge_lines(g).at(places.edge, places.along)[0][:, 2] for g in (found, truth))
    error = (z - true_z)[driven[places.edge]]
    assert np.abs(error - np.median(error)).mean() < 0.6
