"""The rules of link generation, one by one (METHOD 3.6)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from probe2road.baselines.deepmg.link_edges import add_links, choose_links
from probe2road.baselines.deepmg.links import (
    NO_NODE,
    Link,
    LinkOptions,
    angle_stretch,
    bearing_difference,
    propose_links,
)
from probe2road.baselines.deepmg.variants import find_variant
from probe2road.errors import OptionError
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph
from sketches import graph_of

FIXED, PUBLISHED = find_variant("fixed"), find_variant("as_published")
CENTRAL = 500_000.0  # easting of the middle of the zone
LONG = [(0, 0), (200, 0)]


def graph(*lines: Any) -> RoadGraph:
    moved = [[(x + CENTRAL, y + 4_000_000.0) for x, y in line] for line in lines]
    return graph_of(*moved)


def ends(found: list[Link], of: RoadGraph) -> list[tuple[float, float]]:
    """Return where links lead to, relative to the origin of the drawings."""
    at = of.nodes.geometry
    places = [(at.iloc[link.start].x + link.vector[0], at.iloc[link.start].y + link.vector[1]) for link in found]
    return sorted((round(x - CENTRAL, 6), round(y - 4_000_000.0, 6)) for x, y in places)


def proposed(*lines: Any, variant: str = "fixed") -> list[tuple[float, float]]:
    drawn = graph(*lines)
    return ends(propose_links(drawn, find_variant(variant)), drawn)


def test_an_extension_that_hits_an_edge_within_reach_leads_into_it() -> None:
    assert proposed(LONG, [(100, -90), (100, -40)]) == [(100, 0)]
    assert proposed(LONG, [(100, -140), (100, -50)]) == []


def test_a_hit_near_a_vertex_of_the_polyline_goes_to_that_vertex() -> None:
    bent = [(0, 0), (88, 0), (200, -2)]
    assert proposed(bent, [(100, -90), (100, -40)]) == [(88, 0)]
    far = [(0, 0), (80, 0), (200, -2)]
    ((x, y),) = proposed(far, [(100, -90), (100, -40)])
    assert (x, y) == pytest.approx((100, -2 / 120 * 20))


def test_a_hit_near_the_end_of_an_edge_goes_to_its_node() -> None:
    drawn = graph([(0, 0), (110, 0)], [(100, -90), (100, -40)])
    (link,) = [link for link in propose_links(drawn, FIXED) if link.edge == 0]
    assert link.node != NO_NODE
    assert ends([link], drawn) == [(110, 0)]


def test_an_extension_that_misses_goes_to_an_end_node_ahead() -> None:
    # The road ends at (100, 10) heading east and misses; (120, 30) is 45 degrees aside, (120, 90) out of reach.
    assert (120, 30) in proposed([(0, 10), (100, 10)], [(120, 30), (120, 190)])
    # Nothing behind is linked: the turn would be 135 degrees.
    assert (80, 30) not in proposed([(0, 10), (100, 10)], [(80, 30), (80, 190)])


def test_edges_between_the_same_two_nodes_are_no_candidates() -> None:
    assert proposed([(0, 0), (30, 0)]) == []


def test_the_nearer_end_of_an_isolated_stub_is_led_to_the_foot_beside_it() -> None:
    assert proposed(LONG, [(100, 20), (104, 30)]) == [(100, 0)]


def test_an_isolated_stub_is_led_to_the_nearest_end_of_another() -> None:
    found = proposed([(0, 0), (10, 0)], [(30, 4), (40, 4)])
    assert found == [(10, 0), (30, 4)]


def test_a_stub_without_a_foot_is_not_led_to_a_long_road() -> None:
    assert (0, 0) not in proposed(LONG, [(-20, 0), (-30, 0)])


def test_a_link_that_crosses_another_edge_is_dropped() -> None:
    beyond = [(-100, 20), (300, 20)]
    assert proposed(beyond, [(100, -90), (100, -20)]) == [(100, 20)]
    assert proposed(beyond, LONG, [(100, -90), (100, -20)]) == [(100, 0)]


def test_a_link_to_a_node_is_dropped_for_touching_a_road_there_only_as_published() -> None:
    roads = [[(100, 0), (20, 10)], [(100, 0), (20, 90)], [(100, -90), (100, -30)]]
    assert proposed(*roads) == [(100, 0)]
    assert proposed(*roads, variant="as_published") == []


def test_of_two_links_in_similar_directions_the_longer_goes() -> None:
    roads = [[(-60, 0), (0, 0)], [(20, 2), (25, 80)], [(40, -4), (45, -80)]]
    drawn = graph(*roads)
    found = [link for link in propose_links(drawn, FIXED) if link.start == 1]
    assert ends(found, drawn) == [(20, 2)]


def test_angles_of_degrees_are_stretched_eastwards() -> None:
    drawn = graph(LONG)
    assert angle_stretch(drawn) == pytest.approx(1 / np.cos(np.radians(36.14)), rel=1e-3)
    assert bearing_difference((1.0, 1.0), (0.0, 1.0), 1.0) == pytest.approx(45.0)
    assert bearing_difference((1.0, 1.0), (0.0, 1.0), 2.0) == pytest.approx(np.degrees(np.arctan(2.0)))


def link(start: int, node: int, vector: tuple[float, float], edge: int = 0) -> Link:
    return Link(start, edge, 0.0, node, vector)


def test_a_later_link_that_is_not_shorter_is_refused() -> None:
    short, longer = link(1, 9, (0.0, 20.0), edge=0), link(2, 9, (-2.0, 30.0), edge=1)
    degree = np.full(10, 1)
    assert choose_links([short, longer], degree, min_angle=20.0) == [short]


def test_a_shorter_link_replaces_a_similar_one_whose_ends_have_roads_enough() -> None:
    long, shorter = link(1, 9, (0.0, 30.0), edge=0), link(2, 9, (-2.0, 20.0), edge=1)
    assert choose_links([long, shorter], np.full(10, 3), min_angle=20.0) == [shorter]
    # At degree 1 the dead end of the first has degree 2 with its link, and keeps it.
    assert choose_links([long, shorter], np.full(10, 1), min_angle=20.0) == sorted([long, shorter])


def test_links_in_different_directions_stay() -> None:
    two = [link(1, 9, (0.0, 20.0), edge=0), link(2, 9, (20.0, 0.0), edge=1)]
    assert choose_links(two, np.full(10, 1), min_angle=20.0) == sorted(two)


def test_links_become_edges_and_split_what_they_lead_into() -> None:
    drawn = graph(LONG, [(100, -90), (100, -40)], [(60, 90), (60, 30)])
    linked = add_links(drawn, FIXED)
    check_graph(linked)
    assert linked.edges["origin"].value_counts().to_dict() == {"segmentation": 5, "gap": 2}
    assert sorted(linked.edges["length"].round(3)) == [30.0, 40.0, 40.0, 50.0, 60.0, 60.0, 100.0]


def test_links_do_not_depend_on_what_the_variants_share() -> None:
    drawn = graph(LONG, [(100, -90), (100, -40)])
    assert propose_links(drawn, FIXED) == propose_links(drawn, PUBLISHED)


def test_options_that_are_not_positive_are_refused() -> None:
    with pytest.raises(OptionError, match="radius is 0"):
        LinkOptions(radius=0.0)


def test_an_empty_graph_stays_empty() -> None:
    assert add_links(graph(), FIXED).edges.empty
