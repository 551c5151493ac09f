"""What may be withheld of a graph before it is handed on."""

from __future__ import annotations

from dataclasses import replace

import pandas as pd
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.graph.check import check_graph
from probe2road.graph.disclosure import withhold
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines


@pytest.fixture
def graph() -> RoadGraph:
    """A street of two edges that many drove, a drive to a house, and a street of the map that nobody drove."""
    lines = [[(0, 0), (100, 0)], [(100, 0), (200, 0)], [(100, 0), (100, 50)], [(0, 0), (0, 80)]]
    counts = pd.DataFrame(
        {
            "origin": ["segmentation", "segmentation", "segmentation", "reference"],
            "support": pd.array([9, 8, 3, None], "Int64"),
            "drive_support": pd.array([9, 8, 3, None], "Int64"),
            "vehicle_support": pd.array([5, 4, 1, None], "Int64"),
            "speed": [9.0, 9.0, 3.0, None],
        }
    )
    plain = graph_from_lines(lines, crs="EPSG:32616", attributes=counts)
    turns = pd.DataFrame({"from_edge": [0, 0, 1], "via_node": 1, "to_edge": [1, 2, 0], "count": [7, 6, 1]})
    return replace(plain, turns=turns)


@pytest.mark.parametrize("least", [{"min_vehicles": 2}, {"min_drives": 4}])
def test_an_edge_goes_with_its_turns_and_its_node(graph: RoadGraph, least: dict[str, int]) -> None:
    seen = withhold(graph, **least)
    assert seen.edges.index.tolist() == [0, 1, 3]
    assert seen.turns[["from_edge", "to_edge"]].to_numpy().tolist() == [[0, 1]]
    assert len(seen.nodes) == len(graph.nodes) - 1
    assert check_graph(seen) == check_graph(graph)
    assert 3.0 not in seen.edges["speed"].tolist()


def test_one_is_no_limit(graph: RoadGraph) -> None:
    assert withhold(graph) is graph


def test_counts_that_are_not_there_are_asked_for_in_vain(graph: RoadGraph) -> None:
    unnamed = replace(graph, edges=graph.edges.assign(vehicle_support=pd.array([None] * 4, "Int64")))
    with pytest.raises(InputError, match="no vehicle_support; the fleet names no vehicles: use min_drives"):
        withhold(unnamed, min_vehicles=2)
    with pytest.raises(OptionError, match="min_drives is 0"):
        withhold(graph, min_drives=0)
