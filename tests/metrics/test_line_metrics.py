"""Buffer GEO and graph sampling, and the facts known about the reference maps they are used with."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import shapely

from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.metrics import BufferGeoOptions, GraphSamplingOptions, buffer_geo, comparable, graph_sampling
from probe2road.metrics.network import network_from_graph
from probe2road.metrics.sampling import Centres, sample_around
from sketches import UTM, graph_of

DATA = Path(os.environ.get("PROBE2ROAD_DATA", Path(__file__).parents[3] / "shared" / "data")) / "traces"
Streets = Callable[..., RoadGraph]


def test_duplicates_are_free_in_buffer_geo_and_dear_in_graph_sampling() -> None:
    reference = graph_of([(0, 0), (500, 0)])
    double = graph_of([(0, 2), (500, 2)], [(0, -2), (500, -2)])
    assert buffer_geo(double, reference)[0].f1 == 1.0
    score = graph_sampling(double, reference)[0]
    assert (score.precision, score.recall) == (0.5, 1.0)


def test_a_segment_drawn_both_ways_counts_once() -> None:
    both_ways = graph_of([(0, 0), (100, 0), (100, 50)], [(100, 0), (0, 0)])
    assert buffer_geo(both_ways, both_ways)[0].proposal == pytest.approx(150.0)


@pytest.mark.parametrize("seed", range(3))
def test_buffer_geo_equals_buffered_geometry(seed: int, streets: Streets) -> None:
    """The share of length inside the other map's buffer, by polygons."""
    proposal, reference = comparable(streets(seed), streets(seed + 100))
    options = BufferGeoOptions(radii=(5.0,), spacing=0.1)
    [score] = buffer_geo(proposal, reference, options=options)
    maps = [shapely.union_all(side.edges.geometry.to_numpy()) for side in (proposal, reference)]
    for share, own, other in ((score.precision, *maps), (score.recall, *maps[::-1])):
        inside = shapely.intersection(own, shapely.buffer(other, 5.0, quad_segs=64)).length
        assert share == pytest.approx(inside / own.length, abs=0.003)


def test_every_component_is_explored_from_one_root() -> None:
    """Samples every 5 m of network distance: 0, 5, 10 from (0, 0) and from (100, 0)."""
    sides = graph_of([(0, 0), (6, 0)], [(6, 0), (6, 7)], [(100, 0), (112, 0)])
    [score] = graph_sampling(sides, sides, options=GraphSamplingOptions(radii=(5.0,)))
    assert (score.proposal, score.f1) == (6, 1.0)


@pytest.mark.parametrize("seed", range(3))
def test_exploration_covers_all_edges(seed: int, streets: Streets) -> None:
    network = network_from_graph(streets(seed))
    root = Centres.from_nodes(np.array([0]))
    samples = sample_around(network, root, radius=np.inf, spacing=0.5, ends=False)
    reached = np.unique(samples.edge)
    assert len(samples.edge) == pytest.approx(2 * network.length[reached].sum(), abs=3 * len(reached))


@pytest.mark.parametrize("metric", [buffer_geo, graph_sampling])
def test_empty_graphs_score_zero(metric: Callable[..., list]) -> None:
    road, nothing = graph_of([(0, 0), (100, 0)]), empty_graph(UTM)
    for sides in ((road, nothing), (nothing, road), (nothing, nothing)):
        assert all((s.precision, s.recall, s.f1) == (0.0, 0.0, 0.0) for s in metric(*sides))


def published_map(name: str, *, min_trips: int = 0) -> RoadGraph:
    path = DATA / f"{name}.geojson"
    if not path.exists():
        pytest.skip(f"the reference map {name}.geojson is absent; set PROBE2ROAD_DATA")
    epsg = json.loads((path.parent / "meta.json").read_text())["epsg"]
    features = json.loads(path.read_text())["features"]
    lines = [
        feature["geometry"]["coordinates"]
        for feature in features
        if feature["properties"].get("trips_near", min_trips) >= min_trips
    ]
    return graph_from_lines(lines, crs=f"EPSG:{epsg}", origin="reference")


@pytest.mark.parametrize(
    ("name", "min_trips", "km"),
    [
        ("chicago_shuttle/gt_traversed_tang", 0, 35.56),
        ("chicago_shuttle/gt_traversed_graph", 0, 45.9),
        ("chicago_shuttle/gt_traversed_graph", 4, 31.8),
        ("athens_small/gt_traversed_graph", 0, 48.8),
        ("athens_small/gt_traversed_tang", 0, 44.4),
    ],
)
def test_lengths_of_reference_maps(name: str, min_trips: int, km: float) -> None:
    reference = published_map(name, min_trips=min_trips)
    score = buffer_geo(reference, reference)[0]
    assert score.reference / 1000 == pytest.approx(km, abs=0.06)
    assert score.f1 == pytest.approx(1.0)
