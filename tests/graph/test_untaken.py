"""Turns that drives would have made by now, if they could be made."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest

from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.untaken import untaken_turns
from sketches import graph_of

ARMS = [[(-50, 0), (0, 0)], [(0, 0), (50, 0)], [(0, -50), (0, 0)], [(0, 0), (0, 50)]]


def crossing(made: dict[tuple[int, int], int], *, oneway: bool = True) -> RoadGraph:
    graph = graph_of(*ARMS)
    turns = pd.DataFrame([(start, 1, end, n) for (start, end), n in made.items()], columns=list(graph.turns))
    edges = graph.edges.assign(oneway=pd.array(["yes" if oneway else "no"] * 4, dtype="str"))
    return replace(graph, edges=edges, turns=turns)


def pairs(graph: RoadGraph, **options: float) -> list[tuple[int, int]]:
    turns = untaken_turns(graph, **options)
    return list(zip(turns["from_edge"].tolist(), turns["to_edge"].tolist(), strict=True))


def test_roads_that_only_cross_are_closed_to_each_other():
    assert pairs(crossing({(0, 1): 30, (2, 3): 20})) == [(0, 3), (2, 1)]


def test_a_turn_that_one_drive_made_is_open():
    assert pairs(crossing({(0, 1): 30, (2, 3): 20, (0, 3): 1})) == [(2, 1)]


def test_few_drives_forbid_nothing():
    assert pairs(crossing({(0, 1): 6, (2, 3): 6})) == []
    assert pairs(crossing({(0, 1): 6, (2, 3): 6}), min_expected=3.0) == [(0, 3), (2, 1)]


def test_a_turn_onto_a_quiet_road_is_not_expected():
    assert pairs(crossing({(0, 1): 100, (2, 3): 4})) == []  # 3.8 of each


def test_one_way_roads_are_not_entered_against_their_direction():
    both = pairs(crossing({(0, 1): 50, (1, 0): 50, (2, 3): 50, (3, 2): 50}, oneway=False))
    assert both == [(0, 2), (0, 3), (1, 2), (1, 3), (2, 0), (2, 1), (3, 0), (3, 1)]


def test_a_graph_without_turns_has_none():
    assert untaken_turns(graph_of(*ARMS)).empty
    assert list(untaken_turns(graph_of(*ARMS))) == ["from_edge", "via_node", "to_edge", "expected"]


def test_nothing_expected_is_refused():
    with pytest.raises(OptionError, match="min_expected is 0"):
        untaken_turns(graph_of(*ARMS), min_expected=0)
