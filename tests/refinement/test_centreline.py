from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from probe2road.errors import CRSError, OptionError
from probe2road.fleet.contract import Fleet
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.matching.match import match
from probe2road.refinement.centreline import CentrelineOptions, refine_centreline
from sketches import UTM, fleet_of, graph_of, spaced


def fleet(lines: list[list[tuple[float, float]]], points: pd.DataFrame | None = None) -> Fleet:
    """Return one trace per line, a fix each 10 m and 1 s."""
    return fleet_of(*(spaced(*line, start=5.0) for line in lines), points=points)


def refined(graph: RoadGraph, data: Fleet, **options: float) -> RoadGraph:
    result = refine_centreline(graph, data, match(graph, data), options=CentrelineOptions(**options))
    check_graph(result)
    return result


def heights(graph: RoadGraph) -> NDArray[np.float64]:
    return shapely.get_coordinates(graph.edges.geometry.to_numpy())[:, 1]


def test_one_way_traffic_is_the_centre() -> None:
    graph = graph_of([(0, 3), (600, 3)])
    moved = refined(graph, fleet([[(0, y), (600, y)] for y in (-1.0, 0.0, 0.0, 0.0, 1.0)]))
    assert np.abs(heights(moved)).max() < 0.3
    assert moved.nodes.geometry.y.abs().max() < 0.3


def test_two_way_traffic_keeps_right_of_the_centre_however_uneven() -> None:
    graph = graph_of([(0, 1), (600, 1)])
    there, back = [(0, -3), (600, -3)], [(600, 3), (0, 3)]
    moved = refined(graph, fleet([there] * 12 + [back] * 4))
    assert np.abs(heights(moved)).max() < 0.3


def test_a_stretch_driven_one_way_stays_in_the_middle() -> None:
    graph = graph_of([(0, 1), (900, 1)])
    moved = refined(graph, fleet([[(0, -3), (900, -3)]] * 6 + [[(400, 3), (0, 3)]] * 6))
    assert np.abs(heights(moved)).max() < 0.3


def test_boundaries_outvote_traffic_on_the_right_lane() -> None:
    graph = graph_of([(0, 0), (600, 0)])
    x = np.tile(np.arange(5.0, 600, 10), 2)
    points = [
        pd.DataFrame(
            {"trace_id": name, "t": np.tile(np.arange(60), 2), "x": x, "y": np.repeat([5.0, -5.0], 60), "z": 0.0}
        )
        for name in range(4)
    ]
    data = fleet([[(0, -3), (600, -3)]] * 4, pd.concat(points).assign(kind="road_boundary"))
    assert heights(refined(graph, data)).mean() == pytest.approx(0.0, abs=0.4)
    assert heights(refined(graph, data, boundaries=False)).mean() < -2.0


def test_shift_is_bounded_and_few_traces_do_nothing() -> None:
    graph = graph_of([(0, 12), (600, 12)])
    data = fleet([[(0, 0), (600, 0)]] * 5)
    assert heights(refined(graph, data, max_shift=2.0)) == pytest.approx(10.0, abs=0.3)
    few = fleet([[(0, 10), (600, 10)]] * 2)
    assert refined(graph, few).edges.geometry[0].equals(graph.edges.geometry[0])


def test_junction_moves_with_its_edges_and_stays_one() -> None:
    arms = [(-300, 0), (300, 0), (0, 300), (0, -300)]
    graph = graph_of(*([(2.0, 2.0), (x + 2.0, y + 2.0)] for x, y in arms))
    routes = [[a, (0, 0), b] for a in arms for b in arms if a != b]
    moved = refined(graph, fleet(routes))
    assert moved.nodes.index.tolist() == graph.nodes.index.tolist()
    assert moved.nodes.geometry[0].distance(shapely.Point(0, 0)) < 1.0
    assert moved.edges[["u", "v"]].to_numpy().tolist() == graph.edges[["u", "v"]].to_numpy().tolist()


def test_hairpin_does_not_fold() -> None:
    turn = [(20 * np.cos(a), 20 * np.sin(a)) for a in np.linspace(np.pi / 2, -np.pi / 2, 15)]
    graph = graph_of([(-200, 20), *turn, (-200, -20)])
    inner = [(-200, 14), *((0.7 * x, 0.7 * y) for x, y in turn), (-200, -14)]
    moved = refined(graph, fleet([inner] * 6), max_shift=8.0)
    line = moved.edges.geometry[0]
    assert line.is_simple
    assert line.hausdorff_distance(shapely.LineString(inner)) < 3.5


def test_heights_and_attributes_move_along() -> None:
    graph = graph_of([(0, 2, 5.0), (300, 2, 8.0), (600, 2, 5.0)])
    graph = replace(graph, edges=graph.edges.assign(name="A1"))
    moved = refined(graph, fleet([[(0, 0), (600, 0)]] * 5))
    z = shapely.get_coordinates(moved.edges.geometry.to_numpy(), include_z=True)[:, 2]
    assert (z.min(), z.max()) == (5.0, 8.0)
    assert moved.edges["name"].tolist() == ["A1"]


def test_nothing_to_do() -> None:
    data = fleet([[(0, 0), (600, 0)]])
    assert len(refined(empty_graph(UTM), data).edges) == 0
    far = graph_of([(0, 5000), (600, 5000)])
    assert refined(far, data) is far


def test_wrong_crs_and_options_are_refused() -> None:
    graph, data = graph_of([(0, 0), (600, 0)]), fleet([[(0, 0), (600, 0)]])
    with pytest.raises(CRSError):
        refine_centreline(graph.to_crs("EPSG:32617"), data, match(graph, data))
    for wrong in ({"spacing": 0.0}, {"max_shift": -1.0}, {"reach": float("nan")}):
        with pytest.raises(OptionError, match=next(iter(wrong))):
            CentrelineOptions(**wrong)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_any_graph_stays_a_graph(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(0, 400, (6, 2))
    graph = graph_of(*([tuple(places[a]), tuple(places[b])] for a, b in rng.integers(0, 6, (8, 2))))
    routes = [[tuple(p) for p in places[rng.permutation(6)[:4]] + rng.normal(0, 4, (4, 2))] for _ in range(12)]
    moved = refined(graph, fleet(routes), min_traces=1)
    before, after = (shapely.get_coordinates(g.nodes.geometry) for g in (graph, moved))
    assert np.hypot(*(after - before).T).max(initial=0.0) <= 5.0 + 1e-6
    for old, new in pairwise([graph.edges, moved.edges]):
        assert (shapely.is_simple(new.geometry.to_numpy()) | ~shapely.is_simple(old.geometry.to_numpy())).all()
        assert shapely.hausdorff_distance(old.geometry.to_numpy(), new.geometry.to_numpy()).max(initial=0.0) < 8.0


def test_edges_stay_where_lines_were_drawn() -> None:
    # The mask has the first half, 3 m beside the traffic; the second half was drawn by refinement.
    graph = graph_of([(0, 3), (300, 3), (600, 3)])
    data = fleet([[(0, 0), (600, 0)]] * 5)
    moved = refine_centreline(graph, data, match(graph, data), drawn=graph_of([(0, 3), (300, 3)]))
    check_graph(moved)
    line = moved.edges.geometry.iloc[0]
    at = [shapely.line_interpolate_point(line, x).y for x in (0, 150, 280, 450, 600)]
    assert at[:3] == pytest.approx([3.0, 3.0, 3.0], abs=0.3)
    assert at[3:] == pytest.approx([0.0, 0.0], abs=0.3)


def test_what_crosses_a_drawn_line_does_not_stay() -> None:
    graph = graph_of([(0, 3), (600, 3)])
    data = fleet([[(0, 0), (600, 0)]] * 5)
    across = graph_of(*([(x, -50), (x, 50)] for x in range(0, 601, 20)))
    assert np.abs(heights(refine_centreline(graph, data, match(graph, data), drawn=across))).max() < 0.3
