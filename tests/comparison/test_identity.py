"""An edge keeps its id from build to build as long as it is the same road."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from probe2road.comparison.identity import CHANGES, keep_ids
from probe2road.errors import InputError, OptionError
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.matching.match import match, turn_counts
from probe2road.recipe import BuildOptions, build
from probe2road.segmentation.options import SegmentationOptions
from probe2road.simulation.fleet_simulation import simulate
from probe2road.simulation.networks.network import network_from_sections
from sketches import UTM, fleet_of, graph_of, spaced


def test_roads_are_kept_moved_new_and_gone() -> None:
    earlier = graph_of([(0, 0), (300, 0)], [(0, 100), (300, 100)], [(0, 200), (300, 200)])
    later = graph_of([(0, 400), (300, 400)], [(0, 205), (300, 205)], [(0, 1), (300, 1)])
    graph, changes = keep_ids(later, earlier)
    assert changes[["change", "edge", "earlier"]].fillna(-1).to_numpy().tolist() == [
        ["kept", 0, 0],
        ["gone", -1, 1],
        ["moved", 2, 2],
        ["new", 3, -1],
    ]
    assert changes["distance"].dropna().tolist() == pytest.approx([1, 5])
    assert [line.coords[0] for line in graph.edges.geometry] == [(0, 1), (0, 205), (0, 400)]
    assert graph.edges.index.tolist() == [0, 2, 3]
    check_graph(graph)


def test_edges_that_are_joined_have_the_id_of_the_longest() -> None:
    earlier = graph_of([(0, 0), (100, 0)], [(100, 0), (300, 0)])
    graph, changes = keep_ids(graph_of([(0, 0), (300, 0)]), earlier)
    assert graph.edges.index.tolist() == [1]
    assert changes[["change", "edge", "earlier"]].to_numpy().tolist() == [["merged", 1, 0], ["merged", 1, 1]]
    assert changes["of_edge"].tolist() == pytest.approx([1 / 3, 2 / 3])


def test_a_street_keeps_its_direction_and_a_one_way_street_its_own() -> None:
    earlier = graph_of([(0, 0), (300, 0)], [(0, 100), (300, 100)])
    later = graph_of([(300, 0), (0, 0)], [(300, 100), (0, 100)])
    later = replace(later, edges=later.edges.assign(forward=[7, 30], backward=[2, 0], oneway=["no", "yes"]))
    graph, _ = keep_ids(later, earlier)
    assert [line.coords[0] for line in graph.edges.geometry] == [(0, 0), (300, 100)]
    assert graph.edges[["forward", "backward"]].to_numpy().tolist() == [[2, 7], [30, 0]]


def test_a_carriageway_is_not_taken_for_the_other() -> None:
    oneway = pd.Series(["yes", "yes"])
    earlier = graph_of([(0, 0), (300, 0)], [(300, 6), (0, 6)])
    earlier = replace(earlier, edges=earlier.edges.assign(oneway=oneway))
    later = graph_of([(300, 3), (0, 3)], [(0, -3), (300, -3)])  # both have moved by 3 m: one lies in the middle
    later = replace(later, edges=later.edges.assign(oneway=oneway))
    graph, _ = keep_ids(later, earlier)
    assert [line.coords[0] for line in graph.edges.geometry] == [(0, -3), (300, 3)]


def test_turns_follow_the_new_names_and_a_position_stays() -> None:
    earlier = graph_of([(0, 0), (200, 0)], [(200, 0), (400, 0)], [(200, 0), (200, 200)])
    later = graph_of([(200, 200), (200, 0)], [(400, 0), (200, 0)], [(0, 0), (200, 0)])
    drive = fleet_of(spaced((10, 0), (200, 0), (200, 150)))
    before, after = match(earlier, drive), match(later, drive)
    later = replace(later, turns=turn_counts(after, later))
    graph, _ = keep_ids(later, earlier)
    assert graph.turns.to_numpy().tolist() == turn_counts(before, earlier).to_numpy().tolist()
    again = match(graph, drive)
    for column in ("edge", "at", "forward"):
        assert again.fixes[column].tolist() == before.fixes[column].tolist()
    assert before.fixes["at"].iloc[0] == pytest.approx(0.05)


def test_ids_do_not_depend_on_the_order_of_the_edges() -> None:
    lines = [[(0, 100 * row), (300, 100 * row)] for row in range(6)]
    earlier = graph_of(*lines[:3])
    graph, changes = keep_ids(graph_of(*lines), earlier)
    shuffled, same = keep_ids(graph_of(*lines[::-1]), earlier)
    assert graph.edges.geometry.to_wkt().tolist() == shuffled.edges.geometry.to_wkt().tolist()
    assert changes.drop(columns="geometry").equals(same.drop(columns="geometry"))


def test_every_edge_of_a_first_graph_is_new() -> None:
    graph, changes = keep_ids(graph_of([(0, 0), (300, 0)]), empty_graph(UTM), first_new=500)
    assert graph.edges.index.tolist() == [500]
    assert changes["change"].tolist() == ["new"]
    nothing, gone = keep_ids(empty_graph(UTM), graph)
    assert nothing.edges.empty
    assert gone["change"].tolist() == ["gone"]


def test_graphs_of_different_places_and_ids_without_end_are_refused() -> None:
    here, there = graph_of([(0, 0), (300, 0)]), graph_of([(0, 50_000), (300, 50_000)])
    with pytest.raises(InputError, match="the earlier graph is in another place"):
        keep_ids(here, there)
    with pytest.raises(OptionError, match=r"ids below 2\*\*63"):
        keep_ids(graph_of([(0, 0), (300, 0)], [(0, 90), (300, 90)]), here, first_new=2**63 - 1)


@pytest.fixture(scope="module")
def builds() -> tuple[RoadGraph, RoadGraph]:
    """Return the graph of ten drives on a crossing, and the one of twice as many, on one more road."""
    roads = [[(-400, 0), (0, 0)], [(0, 0), (400, 0)], [(0, -400), (0, 0)], [(0, 0), (0, 400)]]
    options = BuildOptions(segmentation=SegmentationOptions(segmenter="density"))
    graphs = []
    for sections, n_drives in ((roads, 10), ([*roads, [(-400, 0), (0, -400)]], 40)):
        network = network_from_sections(sections, crs=UTM)
        graphs.append(build(simulate(network, n_drives=n_drives, seed=n_drives).fleet, options=options))
    return graphs[0], graphs[1]


def test_more_drives_keep_the_ids_of_the_roads_that_were_there(builds: tuple[RoadGraph, RoadGraph]) -> None:
    first, second = builds
    graph, changes = keep_ids(second, first)
    check_graph(graph)
    assert set(changes["change"]) <= set(CHANGES)
    assert "new" in set(changes["change"])
    # What has an id of the first graph lies on the road that had it, and no road of the first graph has lost its id;
    # an edge of a few metres may have come from how pixels meet.
    ids = graph.edges.index.intersection(first.edges.index)
    lost = changes[changes["change"].isin(["split", "merged"])]
    roads = first.edges.index[first.edges["length"] > 20]
    assert set(roads) - set(ids) <= set(lost["earlier"])
    now, before = graph.edges.geometry.loc[ids], first.edges.geometry.loc[ids]
    common = now.intersection(before.buffer(15.0), align=False).length
    assert (common > 0.9 * np.minimum(now.length, before.length)).all()
    again, _ = keep_ids(second, first)
    assert again.edges.index.tolist() == graph.edges.index.tolist()
    assert keep_ids(graph, graph)[1]["change"].tolist() == ["kept"] * len(graph.edges)
