"""Roads that only traces show: what is one, where it is joined, and what is left alone."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
from numpy.typing import ArrayLike

from probe2road.errors import CRSError, OptionError
from probe2road.fleet.contract import Fleet
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.refinement.gaps.driven import DrivenOptions, add_driven_roads
from sketches import UTM, fleet_of, graph_of, spaced

# Half a ring over a motorway: both of its arms end beside the motorway, 60 m apart from end to end.
MOTORWAY = [[(-400, y), (400, y)] for y in (-6.0, 6.0)]
ARMS = [[(-90, -80), (0, -30)], [(0, 30), (-90, 80)]]
ARC = [(-90, -80), (0, -30), (10, 0), (0, 30), (-90, 80)]


def along(*corners: ArrayLike, times: int = 4, spread: float = 0.5, spacing: float = 5.0) -> list[ArrayLike]:
    """Return the positions of some drives, a little apart from each other."""
    aside = spread * (np.arange(times) - (times - 1) / 2)
    return [spaced(*corners, spacing=spacing) + np.array([0.0, y]) for y in aside]


def roads(graph: RoadGraph, fleet: Fleet, **options: Any) -> list[shapely.LineString]:
    """Return the lines that are added; the same graph comes back where there is none."""
    added = add_driven_roads(graph, fleet, options=DrivenOptions(**options))
    check_graph(added)
    assert (added is graph) == (len(added.edges) == len(graph.edges))
    return list(added.edges.geometry[added.edges["origin"] == "gap"])


def test_an_arc_over_a_motorway_is_drawn_where_it_was_driven():
    graph = graph_of(*MOTORWAY, *ARMS)
    added = add_driven_roads(graph, fleet_of(*along(*ARC)))
    road = added.edges.iloc[-1]
    assert (road["u"], road["v"], road["origin"]) == (5, 6, "gap")
    assert shapely.hausdorff_distance(road.geometry, shapely.LineString(ARC[1:4])) < 2.0
    assert added.degrees().tolist() == [1, 1, 1, 1, 1, 2, 2, 1]  # no junction with the motorway


def test_it_runs_in_the_middle_of_its_traces_whichever_way_they_drove():
    apart = [spaced(*[(x + shift, y) for x, y in ARC], spacing=5.0) for shift in (-1.0, 0.0, 2.0, 3.0, 3.0)]
    (road,) = roads(graph_of(*MOTORWAY, *ARMS), fleet_of(*apart[:3], *(drive[::-1] for drive in apart[3:])))
    middle = road.intersection(shapely.LineString([(-50, 0), (50, 0)]))
    assert middle.x == pytest.approx(12.0, abs=0.7)


def test_a_slip_road_splits_the_edges_on_which_it_ends():
    graph = graph_of([(0, 0), (300, 0)], [(300, 300), (300, 200)])
    slip = [(0, 0), (100, 0), (200, 80), (300, 200), (300, 300)]
    added = add_driven_roads(graph, fleet_of(*along(*slip)))
    assert len(added.edges) == 4
    assert added.degrees().tolist() == [1, 1, 1, 2, 3]
    split = added.nodes.geometry.iloc[4]
    assert split.y == 0.0
    assert 90 < split.x < 110


def test_traces_must_be_enough_and_all_drive_all_of_it():
    graph = graph_of(*MOTORWAY, *ARMS)
    assert roads(graph, fleet_of(*along(*ARC, times=3))) == []
    assert len(roads(graph, fleet_of(*along(*ARC, times=3)), min_traces=3)) == 1
    assert roads(graph, fleet_of(*along(*ARC)), min_traces=0) == []
    other = [(-90, -80), (0, -30), (10, 0), (90, 0)]  # half of the arc
    assert roads(graph, fleet_of(*along(*ARC, times=2), *along(*other, times=2))) == []


def test_few_of_many_are_errors():
    lines = [[(0, 0), (300, 0)], [(300, 0), (300, 300)]]
    usual = along((0, 0), (300, 0), (300, 300), times=100, spread=0.02)
    way = [(0, 0), (100, 0), (200, 80), (300, 200), (300, 300)]
    graph, fleet = graph_of(*lines), fleet_of(*usual, *along(*way))
    assert roads(graph, fleet, detour=1.0) == []
    assert len(roads(graph, fleet, detour=1.0, min_share=0.03)) == 1


def test_lanes_of_a_road_that_is_nowhere_drawn_are_one_road():
    graph = graph_of([(-100, 0), (0, 0)], [(500, 0), (600, 0)])
    lanes = [
        drive
        for y in (-6.0, 0.0, 6.0)
        for drive in along((-100, 0), (0, 0), (30, y), (470, y), (500, 0), (600, 0), times=6)
    ]
    assert len(roads(graph, fleet_of(*lanes))) == 1


def test_a_lane_beside_a_road_is_none():
    graph = graph_of([(0, 0), (600, 0)], [(100, 0), (0, 100)])
    lane = [(0, 100), (92, 8), (110, 8), (400, 8), (420, 0), (600, 0)]
    assert roads(graph, fleet_of(*along(*lane))) == []


def test_a_lane_of_a_road_that_is_not_connected_is_none():
    # The road ends in the mask before it joins the other: without the lane the way over the graph is endless.
    graph = graph_of([(0, 0), (600, 0)], [(90, 10), (0, 100)])
    lane = [(0, 100), (90, 10), (110, 8), (400, 8), (420, 0), (600, 0)]
    assert roads(graph, fleet_of(*along(*lane))) == []
    assert len(roads(graph, fleet_of(*along(*lane)), beside=0.0)) == 1


def test_a_cut_corner_is_no_road():
    graph = graph_of([(0, 0), (100, 0)], [(100, 0), (100, 100)])
    assert roads(graph, fleet_of(*along((0, 0), (85, 0), (100, 15), (100, 100)))) == []


def test_long_steps_say_nothing_about_the_course():
    graph = graph_of(*MOTORWAY, *ARMS)
    assert roads(graph, fleet_of(*along(*ARC, spacing=50.0))) == []


def test_what_begins_or_ends_off_the_graph_is_left_alone():
    graph = graph_of(*MOTORWAY, *ARMS)
    assert roads(graph, fleet_of(*along(*ARC[:3], (60, 30)))) == []


def test_heights_change_evenly_along_it():
    graph = graph_of([(-90, -80, 4), (0, -30, 4)], [(0, 30, 10), (-90, 80, 10)])
    (road,) = roads(graph, fleet_of(*along(*ARC)))
    z = shapely.get_coordinates(road, include_z=True)[:, 2]
    assert z[[0, -1]].tolist() == [4.0, 10.0]
    assert (np.diff(z) > 0).all()


def test_the_order_of_traces_and_edges_does_not_matter():
    drives = along(*ARC, times=5)
    one = roads(graph_of(*MOTORWAY, *ARMS), fleet_of(*drives))
    other = roads(graph_of(*ARMS[::-1], *MOTORWAY), fleet_of(*drives[::-1]))
    assert len(one) == len(other) == 1
    assert shapely.hausdorff_distance(one[0], other[0]) < 1e-9


def test_nothing_to_do():
    empty = empty_graph(UTM)
    assert add_driven_roads(empty, fleet_of(*along(*ARC))) is empty
    graph = graph_of(*MOTORWAY)
    assert add_driven_roads(graph, fleet_of(*along(*MOTORWAY[0]))) is graph


def test_bad_input_is_refused():
    with pytest.raises(CRSError):
        add_driven_roads(graph_of(*MOTORWAY), fleet_of(*along(*ARC)).to_crs("EPSG:32617"))
    with pytest.raises(OptionError):
        DrivenOptions(radius=0.0)
