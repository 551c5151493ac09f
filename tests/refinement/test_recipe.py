"""The whole refinement, on graphs as masks give them."""

from __future__ import annotations

import pandas as pd
import pytest
import shapely

from probe2road.fleet.contract import Fleet
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.refinement.gaps.driven import DrivenOptions
from probe2road.refinement.recipe import RefineOptions, refine
from sketches import fleet_of, graph_of, spaced

# A road on a bridge over two others, whose mask is lost between them and has grown into both.
LOST = [
    [(-200, 0), (100, 0)], [(180, 0), (500, 0)],
    [(100, -300), (100, 0)], [(100, 0), (100, 300)], [(180, -300), (180, 0)], [(180, 0), (180, 300)],
]  # fmt: skip


def drives(n: int = 6) -> Fleet:
    """Drives on the bridge, and on both roads under it."""
    bridge = spaced((-90, 0, 8), (480, 0, 8))
    below = [spaced((x, -290, 0), (x, 280, 0)) for x in (100, 180)]
    return fleet_of(*(road for road in (bridge, *below) for _ in range(n)))


def refined(graph: RoadGraph, **driven: float) -> RoadGraph:
    result = refine(graph, drives(), learned=False, options=RefineOptions(driven=DrivenOptions(**driven)))
    check_graph(result)
    return result


def test_a_bridge_that_the_mask_lost_becomes_one_road_over_the_others() -> None:
    graph = refined(graph_of(*LOST))
    assert sorted(graph.edges["length"].round()) == [600.0, 600.0, 700.0]
    assert graph.degrees().tolist() == [1] * 6
    assert (graph.edges["support"] == 6).all()


def test_without_proof_it_stays_in_pieces() -> None:
    graph = refined(graph_of(*LOST), min_traces=7)
    assert sorted(graph.edges["length"].round())[-1] < 700.0


def test_one_way_edges_run_in_their_driving_direction() -> None:
    against = [[(500, 0), (-200, 0)], [(100, 300), (100, -300)], [(180, -300), (180, 300)]]
    edges = refine(graph_of(*against), drives(12), learned=False).edges
    assert edges["oneway"].tolist() == ["yes"] * 3
    assert edges[["u", "v", "forward", "backward"]].to_numpy().tolist() == [[1, 0, 12, 0], [3, 2, 12, 0], [4, 5, 12, 0]]
    first, last = (shapely.get_coordinates(shapely.get_point(edges.geometry.to_numpy(), end)) for end in (0, -1))
    assert (last - first).sum(axis=1) == pytest.approx([700, 600, 600], abs=1.0)


def test_faint_edges_go_at_last_where_a_network_drew_the_mask_of_a_fleet_with_cameras() -> None:
    graph = graph_of([(-200, 0), (0, 0)], [(0, 0), (200, 0)], [(0, 0), (0, 200)])
    through, aside = spaced((-190, 0), (190, 0)), spaced((-190, 0), (0, 0), (0, 190))
    seen = pd.DataFrame({"trace_id": 0, "x": [0.0], "y": 2.0, "z": 0.0, "kind": "lane_marking"})
    fleet = fleet_of(*[through] * 20, *[aside] * 2, points=seen)
    assert len(refine(graph, fleet, learned=True).edges) == 1
    assert len(refine(graph, fleet, learned=False).edges) == 3
    assert len(refine(graph, fleet, learned=True, options=RefineOptions(min_support=0)).edges) == 3
    assert len(refine(graph, fleet_of(*[through] * 20, *[aside] * 2), learned=True).edges) == 3
    assert len(refine(graph, fleet_of(through, through, aside, points=seen), learned=True).edges) == 3
