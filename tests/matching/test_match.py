from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.crs import WGS84, local_crs, transform
from probe2road.errors import CRSError, InputError, OptionError
from probe2road.fleet.contract import fleet_from_tables
from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.matching.match import Matches, MatchOptions, match, turn_counts
from probe2road.matching.models import PublishedModel, RouteModel
from probe2road.matching.network import build_states
from probe2road.matching.published import emission_table, transition
from probe2road.options import options_from_table
from sketches import UTM, fleet_of, graph_of, spaced


def driven(found: Matches) -> list[tuple[int, bool]]:
    return list(zip(found.steps["edge"].tolist(), found.steps["forward"].tolist(), strict=True))


CROSSING = [[(-200, 0), (0, 0)], [(0, 0), (200, 0)], [(0, -200), (0, 0)], [(0, 0), (0, 200)]]


@pytest.mark.parametrize("profile", ["fleet", "sparse", "published"])
@pytest.mark.parametrize(
    ("corners", "edges"),
    [
        ([(-190, 0), (190, 0)], [(0, True), (1, True)]),
        ([(190, 0), (-190, 0)], [(1, False), (0, False)]),
        ([(-190, 0), (0, 0), (0, 190)], [(0, True), (3, True)]),
        ([(0, -190), (0, 0), (-190, 0)], [(2, True), (0, False)]),
    ],
)
def test_every_turn_of_a_crossing(
    profile: str, corners: list[tuple[float, float]], edges: list[tuple[int, bool]]
) -> None:
    graph = graph_of(*CROSSING)
    found = match(graph, fleet_of(spaced(*corners) + 2.0), options=MatchOptions(profile=profile))
    assert driven(found) == edges
    turns = turn_counts(found, graph)
    centre = int(graph.edges["v"].iloc[0])
    assert turns.to_numpy().tolist() == [[edges[0][0], centre, edges[1][0], 1]]
    assert found.fixes["edge"].notna().all()


def test_steps_say_where_a_traversal_begins_and_ends() -> None:
    graph = graph_of(*CROSSING)
    found = match(graph, fleet_of(spaced((-190, 0), (190, 0))))
    assert found.steps[["entered", "left"]].to_numpy().tolist() == [[False, True], [True, False]]
    assert found.steps["via_node"].isna().tolist() == [True, False]
    assert found.steps["t_first"].iloc[0] == found.fixes["t"].iloc[0]
    assert found.steps["t_last"].iloc[1] == found.fixes["t"].iloc[-1]
    assert list(found.fixes) == ["trace_id", "t", "edge", "offset", "at", "distance", "forward", "reason"]
    assert [str(found.fixes[column].dtype) for column in ("edge", "forward", "reason")] == [
        "Int64",
        "boolean",
        "category",
    ]


def test_offsets_run_from_u_whichever_way_the_edge_is_driven() -> None:
    graph = graph_of([(0, 0), (100, 0)])
    for xy in ([(20, 1), (50, 1), (80, 1)], [(80, 1), (50, 1), (20, 1)]):
        found = match(graph, fleet_of(xy))
        assert found.fixes["offset"].tolist() == [x for x, _ in xy]
        assert found.fixes["at"].tolist() == [x / 100 for x, _ in xy]
        assert found.fixes["distance"].tolist() == [1.0, 1.0, 1.0]
        assert found.fixes["forward"].eq(xy[0][0] == 20).all()


@pytest.mark.parametrize("side", [0.0, 12.0])
def test_parallel_carriageways_are_told_apart(side: float) -> None:
    graph = graph_of([(0, 0), (800, 0)], [(800, 12), (0, 12)])
    rng = np.random.default_rng(0)
    xy = spaced((10, side), (790, side), spacing=15.0)
    found = match(graph, fleet_of(xy + rng.normal(0, 2.0, xy.shape)))
    assert found.fixes["edge"].eq(0 if side == 0 else 1).all()


def test_oneway_closes_the_other_way() -> None:
    lines = [[(0, 0), (400, 0)], [(0, 6), (400, 6)]]
    graph = graph_from_lines(lines, crs=UTM, attributes=pd.DataFrame({"oneway": ["-1", "yes"]}))
    xy = spaced((10, 2), (390, 2))
    assert driven(match(graph, fleet_of(xy))) == [(1, True)]
    assert driven(match(graph, fleet_of(xy), options=MatchOptions(respect_oneway=False))) == [(0, True)]


def test_the_heading_column_tells_a_standing_vehicle_from_the_cross_street() -> None:
    graph = graph_of(*CROSSING)
    for heading, edge in ((90.0, {0}), (0.0, {2})):
        found = match(graph, fleet_of([(-2.0, -2.0)] * 3, heading=heading))
        assert set(found.fixes["edge"]) == edge
        assert found.fixes["forward"].all()


def stacked_roads() -> RoadGraph:
    """Two roads 1 km long, 4 m apart in plan and 7 m in height, which start level and 60 m apart."""
    x = np.array([0.0, 200, 400, 600, 1000])
    lower = np.stack([x, [30, 30, 0, 0, 0], [0, 0, 0, 0, 0]], axis=1)
    upper = np.stack([x, [-30, -30, -4, -4, -4], [0, 0, 7, 7, 7]], axis=1)
    return graph_of(lower, upper)


@pytest.mark.parametrize("drift", [-9.0, 0.0, 9.0])
@pytest.mark.parametrize("height", [0.0, 7.0])
def test_altitude_tells_stacked_roads_apart_whatever_the_bias(height: float, drift: float) -> None:
    graph = stacked_roads()
    rng = np.random.default_rng(1)
    x = np.arange(410.0, 990.0, 15.0)
    xy = np.stack([x, np.full(len(x), -2.0)], axis=1) + rng.normal(0, 2.0, (len(x), 2))
    before = np.stack([np.arange(0.0, 190.0, 15.0), np.full(13, 30.0 if height == 0 else -30.0)], axis=1)
    # The roads are level and agree about the altitude before they meet: the bias is learnt there.
    places = np.concatenate([before, xy])
    z = np.concatenate([np.zeros(len(before)), np.full(len(x), height)]) + drift + rng.normal(0, 0.7, len(places))
    found = match(graph, fleet_of(places, z=z))
    assert found.fixes["edge"].eq(0 if height == 0 else 1).mean() > 0.95


def test_short_edges_between_fixes_are_on_the_path() -> None:
    x = [0.0, 50.0, 53.0, 54.0, 56.0, 60.0, 160.0]
    graph = graph_of(*([(a, 0), (b, 0)] for a, b in pairwise(x)))
    found = match(graph, fleet_of(spaced((5, 1), (155, 1), spacing=25.0)))
    assert [edge for edge, _ in driven(found)] == [0, 1, 2, 3, 4, 5]
    assert found.steps["t_first"].isna().tolist() == [False, True, True, False, True, False]
    assert turn_counts(found, graph)["count"].tolist() == [1] * 5


def test_loops_and_parallel_edges_are_distinguished() -> None:
    ring = [(100, 0), (150, 50), (200, 0), (150, -50), (100, 0)]
    lines = [[(0, 0), (100, 0)], ring, [(0, 0), (50, 40), (100, 0)]]
    graph = graph_of(*lines)
    found = match(
        graph, fleet_of(spaced((5, 4), (50, 40), (100, 0), (150, 50), (200, 0), (150, -50), (100, 0), (10, 0)))
    )
    assert driven(found) == [(2, True), (1, True), (0, False)]
    node = int(graph.edges["v"].iloc[0])
    assert turn_counts(found, graph).to_numpy().tolist() == [[1, node, 0, 1], [2, node, 1, 1]]


def test_weights_decide_between_equal_ways() -> None:
    lines = [[(-100, 0), (0, 0)], [(0, 0), (50, 3), (100, 0)], [(0, 0), (50, -3), (100, 0)], [(100, 0), (200, 0)]]
    graph = graph_of(*lines)
    trace = fleet_of(spaced((-90, 0), (190, 0)))
    for dear in (1, 2):
        weights = pd.Series(1.0, index=graph.edges.index)
        weights[dear] = 0.1
        assert driven(match(graph, trace, edge_weights=weights))[1] == (3 - dear, True)
    with pytest.raises(InputError, match=r"edge_weights: 2 of 4 edges have no positive weight \(edge 1: nan\)"):
        match(graph, trace, edge_weights=pd.Series([1.0, np.nan, 0.0, 1.0]))


def test_a_stretch_off_the_network_parts_the_path() -> None:
    graph = graph_of([(0, 0), (300, 0)], [(300, 0), (900, 0)])
    found = match(graph, fleet_of(spaced((10, 0), (290, 0), (290, 300), (500, 300), (500, 0), (890, 0))))
    assert found.steps["part"].tolist() == [0, 1]
    assert found.steps["entered"].tolist() == [False, False]
    assert found.fixes["reason"].dropna().isin(["no edge within 60 m", "edges near, but none fits"]).all()
    assert found.fixes["edge"].isna().sum() > 40
    assert turn_counts(found, graph).empty


def test_a_fix_near_an_edge_that_it_does_not_drive_says_so() -> None:
    """A trace that runs along the edge, jumps 50 m off it, and back: near all the time, matched at both ends."""
    places = spaced((10, 0), (590, 0))
    places[20:40, 1] = 59.0
    found = match(graph_of([(0, 0), (600, 0)]), fleet_of(places), options=MatchOptions(profile="fleet"))
    missed = found.fixes["edge"].isna()
    assert missed.sum() >= 10
    assert found.fixes["reason"][missed].eq("edges near, but none fits").all()


def test_a_trace_without_an_edge_near() -> None:
    graph = graph_of([(0, 0), (100, 0)])
    for profile, words in (("fleet", "within 60 m"), ("sparse", "within 80 m"), ("published", "within 150 m")):
        found = match(graph, fleet_of(spaced((0, 900), (100, 900))), options=MatchOptions(profile=profile))
        assert found.fixes["edge"].isna().all()
        assert found.fixes["reason"].eq(f"no edge {words}").all()
        assert found.steps.empty
        assert turn_counts(found, graph).empty


@pytest.mark.parametrize("profile", ["auto", "published"])
def test_an_empty_graph_matches_nothing(profile: str) -> None:
    found = match(empty_graph(UTM), fleet_of([(0, 0), (9, 0)]), options=MatchOptions(profile=profile))
    assert found.fixes["reason"].tolist() == ["the graph has no edges"] * 2
    assert found.steps.empty


@pytest.mark.parametrize("profile", ["auto", "sparse", "published"])
def test_a_trace_of_one_fix(profile: str) -> None:
    graph = graph_of([(0, 0), (100, 0)])
    found = match(graph, fleet_of([(30, 5)]), options=MatchOptions(profile=profile))
    assert found.fixes[["edge", "offset", "distance"]].to_numpy().tolist() == [[0, 30.0, 5.0]]
    assert driven(found) == [(0, True)]


@pytest.mark.parametrize("profile", ["fleet", "sparse", "published"])
def test_edges_without_length_are_passed(profile: str) -> None:
    nodes = gpd.GeoDataFrame(geometry=shapely.points([(0, 0), (100, 0), (100, 0), (200, 0)]), crs=UTM)
    lines = shapely.linestrings([[(0, 0), (100, 0)], [(100, 0), (100, 0)], [(100, 0), (200, 0)]])
    edges = gpd.GeoDataFrame({"u": [0, 1, 2], "v": [1, 2, 3]}, geometry=lines, crs=UTM)
    graph = RoadGraph(nodes, finish_edges(edges), empty_turns())
    found = match(graph, fleet_of(spaced((5, 1), (195, 1), spacing=5.0)), options=MatchOptions(profile=profile))
    edge = [edge for edge, _ in driven(found)]
    assert edge == [0, 1, 2] or profile == "published"  # which passes one state for each observation
    assert {edge[0], edge[-1]} == {0, 2}


def test_missing_altitudes_change_nothing() -> None:
    graph = stacked_roads()
    xy = spaced((10, 30), (190, 30))
    plain = match(graph, fleet_of(xy))
    for z in (np.nan, np.where(np.arange(len(xy)) % 2, np.nan, 0.0)):
        assert match(graph, fleet_of(xy, z=z)).fixes.equals(plain.fixes)


def test_another_crs_is_refused() -> None:
    graph = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32617")
    with pytest.raises(CRSError, match=r"the traces are in WGS 84 / UTM zone 16N, the graph is in .* 17N; reproject"):
        match(graph, fleet_of([(0, 0), (9, 0)]))


def test_turns_on_another_graph_are_refused() -> None:
    graph = graph_of(*CROSSING)
    found = match(graph, fleet_of(spaced((-190, 0), (190, 0))))
    with pytest.raises(InputError, match="edge 1 of the matches is not in the graph"):
        turn_counts(found, graph_of(*CROSSING[:1]))


def test_auto_takes_the_profile_of_the_interval() -> None:
    graph = graph_of(*CROSSING)
    xy = spaced((-190, 3), (190, 3), spacing=20.0)
    for interval, profile in ((4.0, "fleet"), (6.0, "sparse")):
        trace = fleet_of(xy, interval=interval)
        chosen = match(graph, trace, options=MatchOptions(profile=profile))
        assert match(graph, trace).fixes.equals(chosen.fixes)


def test_traces_of_both_profiles_in_one_fleet_keep_their_order() -> None:
    graph = graph_of(*CROSSING)
    parts = []
    for number in range(6):
        xy = spaced((-190, 3), (190, 3), spacing=20.0)
        step = 10.0 if number % 2 else 1.0
        parts.append(pd.DataFrame({"trace_id": number, "t": step * np.arange(len(xy)), "x": xy[:, 0], "y": xy[:, 1]}))
    table = pd.concat(parts, ignore_index=True)
    found = match(graph, fleet_from_tables(table, crs=UTM, keep_crs=True))
    assert found.fixes["trace_id"].tolist() == table["trace_id"].tolist()
    assert found.steps["trace_id"].tolist() == np.repeat(np.arange(6), 2).tolist()
    assert found.steps["position"].tolist() == [0, 1] * 6
    assert found.fixes["edge"].tolist() == [int(x > 0) for x in table["x"]]


def test_published_emission() -> None:
    table = emission_table(PublishedModel())
    assert table[[0, 10, 25, 50, 100, 116, 149]].round(4).tolist() == [
        0.5,
        0.4207,
        0.3085,
        0.1587,
        0.0228,
        0.0102,
        0.0014,
    ]
    assert len(table) == 150


def test_published_transitions() -> None:
    lines = [[(-9, 0), (0, 0)], [(0, 0), (9, 0)], [(0, 0), (0, 9)], [(9, 0), (19, 0)]]
    states = build_states(graph_of(*lines))
    weight = np.array([1.0, 1.0, 0.1, 1.0])
    onward = 1 - 0.5 - 1e-5
    assert transition(states, weight, 0, 0) == 0.5
    assert transition(states, weight, 0, 2) == pytest.approx(onward / 2.1)
    assert transition(states, weight, 0, 4) == pytest.approx(onward * 0.1 / 2.1)
    assert transition(states, weight, 0, 1) == 1e-5  # three edges leave the node
    assert transition(states, weight, 2, 6) == pytest.approx(onward / 2)  # the reverse edge has its share
    assert transition(states, weight, 2, 3) == 0.0  # two edges leave the node: no turning back in a chain
    assert transition(states, weight, 6, 7) == 1e-5  # dead end
    assert transition(states, weight, 0, 6) == 0.0


def brute_force(states_xy: list[tuple[float, float]], graph: RoadGraph, model: PublishedModel) -> list[int]:
    """Viterbi over all states with full matrices, straight from the definition; -1 is unknown."""
    states = build_states(graph)
    n = len(states.head)
    weight = np.ones(n // 2)
    matrix = np.zeros((n + 1, n + 1))
    for before in range(n):
        for after in range(n):
            matrix[before, after] = transition(states, weight, before, after, model)
    matrix[:n, n], matrix[n, :n], matrix[n, n] = model.leave, model.enter / n, model.stay_unknown
    table = emission_table(model)
    probability, back = np.eye(n + 1)[n], []
    for x, y in states_xy:
        metres = np.floor(graph.edges.distance(shapely.Point(x, y)).to_numpy()).astype(int)
        emission = np.repeat(np.append(table, np.zeros(10**4))[metres], 2)
        reached = probability[:, None] * matrix
        back.append(reached.argmax(axis=0))
        probability = reached.max(axis=0) * np.append(emission, model.unknown)
        probability /= probability.sum()
    path = [int(probability.argmax())]
    for column in back[:0:-1]:
        path.append(int(column[path[-1]]))
    return [-1 if state == n else state for state in reversed(path)]


@pytest.mark.parametrize("seed", range(5))
def test_published_equals_viterbi_over_full_matrices(seed: int) -> None:
    rng = np.random.default_rng(seed)
    graph = graph_of(*CROSSING, [(0, 200), (200, 200)], [(200, 200), (200, 0)])
    corners = rng.choice(np.array([(-190, 0), (0, 0), (200, 0), (200, 200), (0, 190), (0, -190)]), 4, replace=False)
    xy = spaced(*map(tuple, corners), spacing=9.0)
    xy = xy + np.cumsum(rng.normal(0, 3.0, xy.shape), axis=0)
    xy = xy[: 1 + int(np.argmax(np.append(np.hypot(*np.diff(xy, axis=0).T) > 10.0, True)))]  # no interpolated fixes
    model = PublishedModel(memory=1000)
    found = match(graph, fleet_of(xy), options=MatchOptions(profile="published", published=model))
    state = 2 * found.fixes["edge"] + (~found.fixes["forward"]).astype("Int64")
    assert state.fillna(-1).tolist() == brute_force([tuple(place) for place in xy], graph, model)


def test_published_decides_with_bounded_memory() -> None:
    graph = graph_of(*CROSSING)
    xy = spaced((-190, 4), (0, 4), (4, 190))
    long, short = (
        match(graph, fleet_of(xy), options=MatchOptions(profile="published", published=PublishedModel(memory=memory)))
        for memory in (300, 25)
    )
    assert driven(long) == driven(short) == [(0, True), (3, True)]


def test_options_come_from_tables_and_are_checked() -> None:
    options = options_from_table({"profile": "fleet", "fleet": {"sigma": 7}}, MatchOptions)
    assert options.fleet.sigma == 7.0
    with pytest.raises(OptionError, match="profile is 'quick'; use auto, fleet, sparse or published"):
        MatchOptions(profile="quick")
    with pytest.raises(OptionError, match="RouteModel: sigma is 0; use a number above 0"):
        RouteModel(sigma=0)
    with pytest.raises(OptionError, match="PublishedModel: stay is 2; use a number of at least 0 and at most 1"):
        PublishedModel(stay=2)


DATA = (
    Path(os.environ.get("PROBE2ROAD_DATA", Path(__file__).parents[3] / "shared" / "data")) / "mapmatching" / "kubicka"
)


@pytest.mark.skipif(not DATA.is_dir(), reason="the Kubicka tracks are absent; set PROBE2ROAD_DATA")
@pytest.mark.parametrize("interval", [1, 5, 15])
def test_a_real_track_follows_its_true_route(interval: int) -> None:
    folder = DATA / "00000045"  # 10 km, not among the tracks that parameters were chosen on
    nodes, arcs, track, route = (
        np.loadtxt(folder / f"{folder.name}.{kind}", ndmin=2) for kind in ("nodes", "arcs", "track", "route")
    )
    crs = local_crs(nodes[:, 0], nodes[:, 1])
    xy = np.stack(transform(nodes[:, 0], nodes[:, 1], WGS84, crs), axis=1)
    ends = np.unique(np.sort(arcs.astype(int), axis=1), axis=0)
    graph = graph_from_lines(shapely.linestrings(xy[ends]), crs=crs, snap=0.0)
    table = pd.DataFrame({"trace_id": 0, "t": track[:, 2], "x": track[:, 0], "y": track[:, 1]})[::interval]
    found = match(graph, fleet_from_tables(table, crs="EPSG:4326", target_crs=crs))
    numbers = {(int(u), int(v)): edge for edge, (u, v) in enumerate(ends)}
    true = [numbers[min(u, v), max(u, v)] for u, v in arcs[route[:, 0].astype(int)].astype(int).tolist()]
    wrong = set(true) ^ set(found.steps["edge"])
    length = graph.edges["length"]
    assert length[list(wrong)].sum() < 0.02 * length[true].sum()


def test_a_stray_fix_is_left_out_and_its_passage_stays_one() -> None:
    graph = graph_of([(0, 0), (500, 0)])
    table = pd.DataFrame({"trace_id": 1, "t": [*range(10), 10.4, *range(12, 20)], "y": 1.0})
    table["x"] = 20.0 * table["t"]
    straight = match(graph, fleet_from_tables(table.drop(index=10), crs=UTM, keep_crs=True))
    table.loc[10, "y"] = 320.0
    found = match(graph, fleet_from_tables(table, crs=UTM, keep_crs=True))
    assert found.steps[["edge", "part"]].to_numpy().tolist() == [[0, 0]]
    assert found.fixes["reason"].dropna().to_dict() == {10: "could not have been driven to"}
    pd.testing.assert_frame_equal(found.fixes.drop(index=10).reset_index(drop=True), straight.fixes)


def test_a_graph_elsewhere_is_told_with_both_extents(caplog: pytest.LogCaptureFixture) -> None:
    graph = graph_of([(446000, 4636000), (446500, 4636000)])
    table = pd.DataFrame({"trace_id": 1, "t": range(9), "x": 446000.0 + 10 * np.arange(9), "y": 4736000.0})
    match(graph, fleet_from_tables(table, crs=UTM))
    assert "no fix of 9 is matched: the graph is at -87.65" in caplog.text
