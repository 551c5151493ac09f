from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.errors import OptionError
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.graph.splitting import split_edges
from probe2road.refinement.gaps.fill import GapOptions, fill_gaps, gap_weights, prune_gaps
from probe2road.refinement.gaps.stems import facing_stems
from sketches import UTM, graph_of


def links(graph: RoadGraph, **options: Any) -> list[list[tuple[float, float]]]:
    """Return the gap edges that are made, as rounded coordinates."""
    filled = fill_gaps(graph, options=GapOptions(**options))
    check_graph(filled)
    gap = filled.edges.geometry[filled.edges["origin"] == "gap"]
    return [sorted((round(x, 1), round(y, 1)) for x, y in line.coords) for line in gap]


def drives(edge: int, traces: int, *, entered: bool = True, left: bool = True) -> pd.DataFrame:
    return pd.DataFrame({"trace_id": range(traces), "edge": edge, "entered": entered, "left": left})


class TestDeadEnds:
    def test_interruption_is_closed_once(self) -> None:
        graph = graph_of([(0, 0), (100, 0)], [(140, 5), (200, 5)])
        assert links(graph) == [[(100, 0), (140, 5)]]

    def test_not_beyond_the_longest_link(self) -> None:
        graph = graph_of([(0, 0), (100, 0)], [(151, 0), (200, 0)])
        assert links(graph) == []
        assert links(graph, max_length=52.0) == [[(100, 0), (151, 0)]]

    def test_turn_is_limited_at_both_ends(self) -> None:
        # Ahead of the first end, but the second road would have to be left backwards.
        assert links(graph_of([(0, 0), (100, 0)], [(130, 30), (60, 30)])) == []
        assert links(graph_of([(0, 0), (100, 0)], [(115, 30), (115, 100)])) == [[(100, 0), (115, 30)]]

    def test_the_last_metres_do_not_decide_the_direction(self) -> None:
        hooked = graph_of([(0, 0), (98, 0), (99, 2)], [(130, 0), (200, 0)])
        assert links(hooked) == [[(99, 2), (130, 0)]]

    def test_two_interrupted_roads_that_cross_are_joined_across(self) -> None:
        graph = graph_of([(-90, 0), (-8, 0)], [(8, 0), (90, 0)], [(0, -90), (0, -8)], [(0, 8), (0, 90)])
        assert sorted(links(graph)) == [[(-8, 0), (8, 0)], [(0, -8), (0, 8)]]


class TestStraightOn:
    def test_side_street_reaches_the_middle_of_an_edge(self) -> None:
        filled = fill_gaps(graph_of([(0, 0), (100, 0)], [(50, -90), (50, -20)]))
        assert filled.degrees().tolist() == [1, 1, 1, 2, 3]
        assert filled.edges["length"].round(6).tolist() == [50, 70, 50, 20]
        assert filled.edges["origin"].tolist() == ["segmentation", "segmentation", "segmentation", "gap"]

    def test_hit_near_a_node_goes_to_the_node(self) -> None:
        graph = graph_of([(0, 0), (60, 0)], [(60, 0), (120, 0)], [(60, 0), (60, 90)], [(50, -90), (50, -20)])
        assert links(graph) == [[(50, -20), (60, 0)]]

    def test_first_hit_only(self) -> None:
        graph = graph_of([(-60, 0), (160, 0)], [(0, 10), (100, 10)], [(50, -90), (50, -20)])
        assert links(graph, beside=0.0) == [[(50, -20), (50, 0)]]

    def test_two_streets_that_meet_an_edge_opposite_each_other_share_a_node(self) -> None:
        graph = graph_of([(0, 0), (100, 0)], [(50, -90), (50, -20)], [(52, 90), (52, 20)])
        filled = fill_gaps(graph)
        check_graph(filled)
        assert filled.degrees().max() == 4

    def test_road_may_meet_itself_far_from_its_end(self) -> None:
        loop = graph_of([(0, 0), (200, 0), (200, 150), (60, 150), (60, 30)])
        assert links(loop) == [[(60, 0), (60, 30)]]


class TestEdgesBeside:
    ramp = ((0.0, 40.0), (100.0, 16.0), (160.0, 8.0))
    mainline = ((-100.0, 0.0), (400.0, 0.0))

    def test_ramp_is_led_into_the_mainline_ahead(self) -> None:
        ((start, stop),) = links(graph_of(self.mainline, self.ramp))
        assert start == (160, 8)
        assert stop[1] == 0
        assert 170 < stop[0] < 180

    def test_not_where_the_paper_is_followed(self) -> None:
        # Straight on, the ramp would reach the mainline after 60 m.
        assert links(graph_of(self.mainline, self.ramp), beside=0.0) == []

    def test_not_backwards(self) -> None:
        behind = ((-100.0, 0.0), (150.0, 0.0))
        assert links(graph_of(behind, self.ramp), max_turn=60.0) == []


class TestRestraint:
    def test_link_must_not_cross_an_edge(self) -> None:
        fence = [(120, -50), (120, 50)]
        made = links(graph_of([(0, 0), (100, 0)], [(140, 0), (200, 0)], fence))
        assert made == [[(100, 0), (120, 0)], [(120, 0), (140, 0)]]

    def test_edges_at_the_target_node_do_not_forbid_it(self) -> None:
        graph = graph_of([(0, 0), (100, 0)], [(120, 2), (120, 90)], [(120, 2), (90, -60)], [(120, 2), (220, -60)])
        assert links(graph) == [[(100, 0), (120, 2)]]

    def test_of_links_in_nearly_one_direction_the_shorter_is_made(self) -> None:
        graph = graph_of([(0, 0), (100, 0)], [(130, 4), (135, 90)], [(140, -100), (140, 40)])
        near, far = [(100, 0), (130, 4)], [(100, 0), (140, 0)]
        assert links(graph, beside=0.0) == [near]
        assert links(graph, beside=0.0, min_angle=5.0) == [near, far]

    def test_no_node_gets_more_links_than_allowed(self) -> None:
        spokes = [
            [(20 * np.cos(a), 20 * np.sin(a)), (90 * np.cos(a), 90 * np.sin(a))]
            for a in np.linspace(0, 2 * np.pi, 7)[:-1]
        ]
        for limit in (1, 2):
            filled = fill_gaps(graph_of(*spokes), options=GapOptions(max_links=limit))
            assert filled.degrees().max() <= 1 + limit


class TestShape:
    def test_nothing_to_do_returns_the_graph_itself(self) -> None:
        graph = graph_of([(0, 0), (100, 0)])
        assert fill_gaps(graph) is graph
        assert len(fill_gaps(empty_graph(UTM)).edges) == 0

    def test_heights_and_attributes_stay_with_the_parts(self) -> None:
        graph = graph_of([(0, 0, 10), (100, 0, 20)], [(50, -90, 0), (50, -20, 0)])
        graph = replace(graph, edges=graph.edges.assign(support=pd.array([7, 3], dtype="Int64"), name=["A", "B"]))
        filled = fill_gaps(graph)
        assert filled.edges["support"].tolist()[:3] == [7, 3, 7]
        assert filled.edges["name"].tolist()[:3] == ["A", "B", "A"]
        assert filled.edges.geometry[0].coords[-1] == (50, 0, 15)
        assert list(filled.edges.geometry[3].coords) == [(50, -20, 0), (50, 0, 15)]

    def test_turns_follow_the_parts(self) -> None:
        graph = graph_of([(0, 0), (100, 0)], [(100, 0), (150, 40)], [(50, -90), (50, -20)])
        graph = replace(graph, turns=pd.DataFrame({"from_edge": [0], "via_node": [1], "to_edge": [1], "count": [9]}))
        filled = fill_gaps(graph)
        check_graph(filled)
        assert filled.turns.to_numpy().tolist() == [[3, 1, 1, 9]]

    def test_bad_options(self) -> None:
        with pytest.raises(OptionError, match=r"max_length is -1.0; use a number of at least 0"):
            GapOptions(max_length=-1.0)
        with pytest.raises(OptionError, match="heading_length"):
            GapOptions(heading_length=0.0)


class TestPruneGaps:
    tee = graph_of([(0, 0), (100, 0)], [(50, -90), (50, -20)])

    def test_enough_traces_keep_a_gap_edge(self) -> None:
        filled = fill_gaps(self.tee)
        assert len(prune_gaps(filled, drives(3, 4)).edges) == 3
        assert len(prune_gaps(filled, drives(3, 3)).edges) == 2
        assert len(prune_gaps(filled, drives(3, 3), min_traces=3).edges) == 3

    def test_traces_that_begin_or_end_on_it_do_not_count(self) -> None:
        filled = fill_gaps(self.tee)
        for half in (drives(3, 9, left=False), drives(3, 9, entered=False)):
            assert len(prune_gaps(filled, half).edges) == 2

    def test_one_trace_that_comes_often_is_one_trace(self) -> None:
        filled = fill_gaps(self.tee)
        assert len(prune_gaps(filled, drives(3, 9).assign(trace_id=0)).edges) == 2

    def test_nobody_drove_restores_the_graph(self) -> None:
        pruned = prune_gaps(fill_gaps(self.tee), drives(3, 0))
        check_graph(pruned)
        for line, before in zip(pruned.edges.geometry, self.tee.edges.geometry, strict=True):
            assert line.simplify(0.0).equals_exact(before, 1e-9)
        assert len(pruned.nodes) == len(self.tee.nodes)

    def test_bad_option(self) -> None:
        with pytest.raises(OptionError, match="min_traces is -1"):
            prune_gaps(self.tee, drives(0, 0), min_traces=-1)


class TestGapWeights:
    def test_equation_1_of_the_paper(self) -> None:
        # A node with two edges of the segmentation and one gap edge.
        weights = gap_weights(fill_gaps(graph_of([(0, 0), (100, 0)], [(50, -90), (50, -20)]))).loc[[0, 2, 3]]
        shares = weights / weights.sum()
        assert shares.round(4).tolist() == [0.4762, 0.4762, 0.0476]

    def test_bad_weight(self) -> None:
        with pytest.raises(OptionError, match=r"gap is 0; use a number above 0 and at most 1"):
            gap_weights(empty_graph(UTM), gap=0)


class TestSplitEdges:
    def test_places_near_each_other_become_one_node(self) -> None:
        graph = graph_of([(0, 0), (100, 0)])
        cut, made = split_edges(graph, np.array([0, 0, 0]), np.array([30.0, 80.0, 32.0]), merge=5.0)
        check_graph(cut)
        assert made[0] == made[2] != made[1]
        assert cut.edges["length"].tolist() == [31, 49, 20]

    def test_no_places(self) -> None:
        graph = graph_of([(0, 0), (100, 0)])
        assert split_edges(graph, np.zeros(0, np.int64), np.zeros(0))[0] is graph

    def test_loop_can_be_cut(self) -> None:
        ring = graph_of([(0, 0), (50, 50), (0, 100), (0, 0)])
        cut, _ = split_edges(ring, np.array([0]), np.array([90.0]))
        check_graph(cut)
        assert cut.edges[["u", "v"]].to_numpy().tolist() == [[0, 1], [1, 0]]
        assert shapely.union_all(cut.edges.geometry.to_numpy()).length == pytest.approx(ring.length)


BARS = [[(0, 0), (50, 0)], [(50, 0), (99, 0)], [(0, 20), (50, 20)], [(50, 20), (99, 20)]]
SOUTH, NORTH = [(50, -60), (50, 0)], [(50, 20), (50, 80)]


def stems(*lines: Sequence[tuple[float, ...]], **options: Any) -> list[list[list[float]]]:
    """Return the places of the junctions that are joined because roads that end in them face each other."""
    graph = graph_of(*lines)
    places = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    return [sorted(places[pair].tolist()) for pair in facing_stems(graph, GapOptions(**options))]


def test_junctions_whose_stems_face_each_other_are_joined():
    assert stems(*BARS, SOUTH, NORTH) == [[[50.0, 0.0], [50.0, 20.0]]]
    filled = fill_gaps(graph_of(*BARS, SOUTH, NORTH))
    check_graph(filled)
    joined = filled.edges[filled.edges["origin"] == "gap"].geometry
    assert any(line.equals(shapely.LineString([(50, 0), (50, 20)])) for line in joined)


def test_a_stem_may_face_a_dead_end():
    assert stems(*BARS[:2], SOUTH, NORTH) == [[[50.0, 0.0], [50.0, 20.0]]]


@pytest.mark.parametrize(
    ("second", "options"),
    [
        ([(80, 20), (80, 80)], {}),  # not ahead
        ([(50, 20), (99, 60)], {}),  # turns away
        (NORTH, {"stem_turn": 0.0}),
        (NORTH, {"max_length": 19.0}),
    ],
)
def test_junctions_that_do_not_face_each_other_are_left_apart(second, options):
    bars = [*BARS[:2], [(0, 20), second[0]], [second[0], (99, 20)]]
    assert stems(*bars, SOUTH, second, **options) == []


def test_junctions_with_an_edge_between_them_need_no_link():
    assert stems(*BARS, SOUTH, [(50, 0), (60, 8), (60, 12), (50, 20)], NORTH, heading_length=5.0) == []


def test_a_link_between_junctions_crosses_no_third_road():
    assert stems(*BARS, [(0, 10), (99, 10)], SOUTH, NORTH) == []
