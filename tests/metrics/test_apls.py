from __future__ import annotations

from collections.abc import Callable
from itertools import combinations, pairwise

import networkx as nx
import numpy as np
import pytest
import shapely

from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.metrics import AplsOptions, apls, comparable
from sketches import UTM, graph_of

Streets = Callable[..., RoadGraph]


def test_identical_graphs_are_perfect(streets: Streets) -> None:
    assert apls(streets(1), streets(1)).f1 == pytest.approx(1.0)


def test_points_farther_than_the_snap_distance_score_zero() -> None:
    reference, proposal = ([[(0, y), (400, y)]] for y in (0.0, 5.0))
    sides = graph_of(*proposal), graph_of(*reference)
    assert apls(*sides).f1 == 0.0
    assert apls(*sides, options=AplsOptions(snap=6.0)).f1 == 1.0


def test_a_detour_costs_its_relative_length() -> None:
    reference = graph_of([(0, 0), (40, 0)])
    proposal = graph_of([(0, 0), (20, 15), (40, 0)])
    assert apls(proposal, reference).recall == pytest.approx(0.75)


@pytest.mark.parametrize("empty_side", [0, 1])
def test_an_empty_graph_scores_zero(empty_side: int, streets: Streets) -> None:
    sides = [streets(1), streets(1)]
    sides[empty_side] = empty_graph(UTM)
    assert apls(*sides).f1 == 0.0


def test_the_draw_of_control_points_is_reproducible(streets: Streets) -> None:
    sides = streets(1, size=8), streets(2, size=8)
    first, again, other = (apls(*sides, options=AplsOptions(snap=8.0, max_points=20, seed=seed)) for seed in (0, 0, 1))
    assert first == again
    assert first.f1 != other.f1
    assert first.reference <= 190


def cut_graph(graph: RoadGraph, points: list[shapely.Point], snap: float) -> tuple[nx.Graph, list[object]]:
    """Insert every point into its nearest edge with shapely, one after the other: slow and plain."""
    lines = list(graph.edges.geometry)
    stops: list[list[tuple[float, object]]] = [
        [(0.0, ("node", u)), (line.length, ("node", v))]
        for line, u, v in zip(lines, graph.edges["u"], graph.edges["v"], strict=True)
    ]
    names: list[object] = []
    for k, point in enumerate(points):
        gaps = [line.distance(point) for line in lines]
        nearest = int(np.argmin(gaps)) if gaps else -1
        names.append(("point", k) if gaps and gaps[nearest] <= snap else None)
        if names[-1] is not None:
            stops[nearest].append((lines[nearest].project(point), names[-1]))
    cut = nx.MultiGraph()
    for row in stops:
        row.sort(key=lambda stop: stop[0])
        for (a, first), (b, second) in pairwise(row):
            cut.add_edge(first, second, weight=b - a)
    return cut, names


def brute_force(graph: RoadGraph, other: RoadGraph, snap: float) -> float:
    points = [graph.nodes.geometry[node] for node in graph.nodes.index]
    for line in graph.edges.geometry:
        points += [line.interpolate(50.0 * k) for k in range(1, int(np.ceil(line.length / 50.0 - 1e-9)))]
    own, own_names = cut_graph(graph, points, 1e-6)
    there, there_names = cut_graph(other, points, snap)
    similar = []
    for i, j in combinations(range(len(points)), 2):
        if not nx.has_path(own, own_names[i], own_names[j]):
            continue
        length = nx.shortest_path_length(own, own_names[i], own_names[j], weight="weight")
        ends = there_names[i], there_names[j]
        if None in ends or not nx.has_path(there, *ends):
            similar.append(0.0)
            continue
        detour = nx.shortest_path_length(there, *ends, weight="weight")
        similar.append(1.0 - min(1.0, abs(length - detour) / length))
    return float(np.mean(similar))


@pytest.mark.parametrize("seed", range(3))
def test_similarity_equals_networkx(seed: int, streets: Streets) -> None:
    proposal, reference = comparable(streets(seed, block=70.0), streets(seed + 100, block=70.0))
    score = apls(proposal, reference, options=AplsOptions(snap=8.0))
    assert score.recall == pytest.approx(brute_force(reference, proposal, 8.0), abs=1e-6)
    assert score.precision == pytest.approx(brute_force(proposal, reference, 8.0), abs=1e-6)
