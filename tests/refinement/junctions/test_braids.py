from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.errors import InputError, OptionError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.refinement.junctions.braids import BraidOptions, open_braids
from sketches import graph_of

Way = list[tuple[int, bool]]  # edges and whether they are driven forwards

# Two carriageways 7 m apart with three joints: a lens of 60 m, and a line of 40 m behind it.
ARMS = [[(-300, 3.5), (-60, 3.5), (-50, 0)], [(-300, -3.5), (-60, -3.5), (-50, 0)]]
LENS = [[(-50, 0), (-20, 2.5), (10, 0)], [(-50, 0), (-20, -2.5), (10, 0)], [(10, 0), (50, 0)]]
LEGS = [[(50, 0), (60, 3.5), (300, 3.5)], [(50, 0), (60, -3.5), (300, -3.5)]]
BRAID = [*ARMS, *LENS, *LEGS]
WEST, EAST = 0, 1
# Traffic keeps to the right; inside the lens it was matched to either line.
EASTWARDS: list[Way] = [[(1, True), (k, True), (4, True), (6, True)] for k in (2, 3, 3)]
WESTWARDS: list[Way] = [[(5, False), (4, False), (k, False), (0, False)] for k in (2, 2, 3)]


def driven(*ways: Way) -> pd.DataFrame:
    """Steps of drives: one trace for each way."""
    rows = [
        {"trace_id": k, "position": at, "edge": edge, "forward": forward}
        for k, way in enumerate(ways)
        for at, (edge, forward) in enumerate(way)
    ]
    return pd.DataFrame(rows)


def bent(lines: list[Any], bend: float) -> list[list[tuple[float, float]]]:
    """Lines on a bend: moved by the square of x."""
    dense = (shapely.get_coordinates(shapely.segmentize(shapely.LineString(line), 5.0)) for line in lines)
    return [[(x, y + bend * x * x) for x, y in line] for line in dense]


def roads(graph: RoadGraph) -> list[shapely.LineString]:
    """Lines of a graph from north to south, in the middle."""
    middle = shapely.LineString([(0, -400), (0, 400)])
    return sorted(graph.edges.geometry, key=lambda line: -line.intersection(middle).y)


@pytest.mark.parametrize("bend", [0.0, 4e-4])
def test_two_carriageways_come_apart_whatever_was_matched_between(bend: float) -> None:
    graph = graph_of(*bent(BRAID, bend))
    opened = open_braids(graph, driven(*EASTWARDS, *WESTWARDS))
    assert len(opened.edges) == 2
    assert opened.degrees().tolist() == [1, 1, 1, 1]
    truth = [shapely.LineString(line) for line in bent([[(-300, y), (300, y)] for y in (3.5, -3.5)], bend)]
    for line, true in zip(roads(opened), truth, strict=True):
        assert line.hausdorff_distance(true) < 1.0
        assert line.length == pytest.approx(true.length, rel=0.01)


def test_one_road_stays_one_line() -> None:
    lines = [[(-200, 0), (-30, 0)], [(-30, 0), (0, 3), (30, 0)], [(-30, 0), (0, -3), (30, 0)], [(30, 0), (200, 0)]]
    ways: list[Way] = [[(0, True), (k, True), (3, True)] for k in (1, 1, 2, 2)]
    opened = open_braids(graph_of(*lines), driven(*ways))
    (line,) = opened.edges.geometry
    assert line.hausdorff_distance(shapely.LineString([(-200, 0), (200, 0)])) < 1.0


@pytest.mark.parametrize(
    ("case", "ways"),
    [
        ("traffic that turns back", [*EASTWARDS, *WESTWARDS, *3 * [[(1, True), (2, True), (4, True), (5, True)]]]),
        ("too few traces", [EASTWARDS[0], *WESTWARDS]),
        ("one direction on both carriageways", [*EASTWARDS, *3 * [[(0, True), (2, True), (4, True), (5, True)]]]),
    ],
)
def test_what_traces_do_not_prove_stays(case: str, ways: list[Way]) -> None:
    graph = graph_of(*BRAID)
    assert open_braids(graph, driven(*ways)) is graph, case


def test_a_ramp_that_leaves_at_a_joint_keeps_it_closed() -> None:
    graph = graph_of(*BRAID, [(10, 0), (60, 20), (200, 60)])
    ramp: list[Way] = 4 * [[(1, True), (2, True), (7, True)]]
    assert open_braids(graph, driven(*EASTWARDS, *WESTWARDS, *ramp)) is graph


def test_roads_far_apart_are_none(subtests: Any) -> None:
    wide = [[(x, 3.0 * y) for x, y in line] for line in BRAID]
    for lines, options in ((wide, None), (BRAID, BraidOptions(max_inner=0)), (BRAID, BraidOptions(max_inner=30))):
        with subtests.test(options=options):
            graph = graph_of(*lines)
            assert open_braids(graph, driven(*EASTWARDS, *WESTWARDS), options=options) is graph


def test_a_long_stretch_counts_where_both_directions_share_it() -> None:
    longer = [[(x + 150 if x > 20 else x, y) for x, y in line] for line in BRAID]
    graph, steps = graph_of(*longer), driven(*EASTWARDS, *WESTWARDS)
    assert len(open_braids(graph, steps).edges) == 2
    assert open_braids(graph, steps, options=BraidOptions(max_shared=100.0)) is graph


def test_all_else_keeps_its_ids_and_lines() -> None:
    crossing = [[(-300, 500), (0, 520)], [(0, 520), (300, 500)], [(0, 520), (0, 700)]]
    graph = graph_of(*crossing, *BRAID)
    ways = [[(edge + 3, forward) for edge, forward in way] for way in (*EASTWARDS, *WESTWARDS)]
    opened = open_braids(graph, driven(*ways))
    assert opened.edges.index[:3].tolist() == [0, 1, 2]
    assert opened.edges.geometry[:3].geom_equals(graph.edges.geometry[:3]).all()
    assert len(opened.edges) == 5
    assert opened.turns.empty


def test_the_order_of_edges_does_not_matter() -> None:
    ways = [*EASTWARDS, *WESTWARDS]
    order = np.random.default_rng(3).permutation(len(BRAID))
    place = np.argsort(order)
    mixed = graph_of(*(BRAID[k] for k in order))
    steps = driven(*[[(int(place[edge]), forward) for edge, forward in way] for way in ways])
    one, other = (roads(open_braids(*given)) for given in ((graph_of(*BRAID), driven(*ways)), (mixed, steps)))
    for line, same in zip(one, other, strict=True):
        assert line.normalize().equals_exact(same.normalize(), 1e-6)


def test_steps_of_another_graph_are_refused() -> None:
    with pytest.raises(InputError, match="edge 99 of the matches"):
        open_braids(graph_of(*BRAID), driven([(99, True)]))


def test_negative_numbers_are_refused() -> None:
    with pytest.raises(OptionError, match="max_width is -1"):
        BraidOptions(max_width=-1)
