from __future__ import annotations

import json
import logging
from collections.abc import Callable

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.errors import InputError, OptionError
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from probe2road.metrics import METRICS, SCORE_DTYPES, GeoOptions, clip_graph, comparable, evaluate
from probe2road.metrics.normalise import drop_twin_edges
from sketches import UTM, graph_of

Streets = Callable[..., RoadGraph]


def test_all_metrics_of_identical_graphs_are_one(streets: Streets) -> None:
    table = evaluate(streets(1, block=80.0), streets(1, block=80.0), metrics=list(METRICS))
    assert set(table["metric"]) == set(METRICS)
    scored = table[table["reference"] > 0]
    assert set(METRICS) - set(scored["metric"]) == {"apart"}  # no streets run so close beside each other
    assert scored[["precision", "recall", "f1"]].to_numpy() == pytest.approx(1.0)


def test_the_table_is_tidy_and_says_its_parameters(streets: Streets) -> None:
    table = evaluate(streets(1), streets(2), metrics=list(METRICS))
    assert table.dtypes.astype(str).replace("object", "str").to_dict() == SCORE_DTYPES
    for row in table.itertuples():
        assert json.loads(row.parameters)
        assert {"proposal_km", "reference_km"} <= set(json.loads(row.details))
        assert 0.0 <= row.f1 <= max(row.precision, row.recall) <= 1.0


@pytest.mark.parametrize("empty_side", [0, 1])
def test_empty_graphs_score_zero_and_never_nan(empty_side: int, streets: Streets) -> None:
    sides = [streets(1), streets(1)]
    sides[empty_side] = empty_graph(UTM)
    table = evaluate(*sides, metrics=list(METRICS))
    assert (table[["precision", "recall", "f1"]] == 0.0).all(axis=None)
    both = evaluate(empty_graph(UTM), empty_graph(UTM), metrics=list(METRICS))
    assert (both[["precision", "recall", "f1"]] == 0.0).all(axis=None)


def test_inputs_are_left_as_they_are(streets: Streets) -> None:
    proposal, reference = streets(1), streets(2)
    before = proposal.edges.copy(), reference.edges.copy()
    evaluate(proposal, reference, metrics=["geo"], area=(10, 10, 60, 60))
    pd.testing.assert_frame_equal(proposal.edges, before[0])
    pd.testing.assert_frame_equal(reference.edges, before[1])


def test_each_score_is_logged_with_its_parameters(streets: Streets, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="probe2road"):
        evaluate(streets(1), streets(2), metrics=[GeoOptions(radius=15.0)])
    assert "radius=15.0" in caplog.text


def test_unknown_metrics_are_refused(streets: Streets) -> None:
    with pytest.raises(OptionError, match="no metric 'GEO'; use geo, itopo"):
        evaluate(streets(1), streets(1), metrics=["GEO"])
    with pytest.raises(OptionError, match="float are not options"):
        evaluate(streets(1), streets(1), metrics=[6.0])  # type: ignore[list-item]


def test_merging_and_twins() -> None:
    cut = graph_of([(0, 0), (50, 0)], [(50, 0), (0, 0)], [(50, 0), (90, 0)], [(90, 0), (90, 30)])
    merged, _ = comparable(cut, cut)
    assert merged.edges["length"].tolist() == [120.0]


def test_stacked_roads_are_no_twins() -> None:
    road = graph_of([(0, 0), (50, 0)])
    nodes = pd.concat([road.nodes, road.nodes.set_index(road.nodes.index + 2)]).rename_axis("node")
    upper = road.edges.assign(u=2, v=3).set_index(road.edges.index + 1)
    stacked = RoadGraph(nodes, pd.concat([road.edges, upper]), road.turns)
    check_graph(stacked)
    assert len(drop_twin_edges(stacked).edges) == 2


def test_clipping_cuts_a_road_that_leaves_and_returns() -> None:
    road = graph_of([(0, 0), (100, 0), (100, 40), (0, 40)], [(0, 0), (0, 40)])
    clipped = clip_graph(road, (-10, -10, 60, 60))
    check_graph(clipped)
    assert clipped.edges["length"].tolist() == [40.0, 60.0, 60.0]
    assert clipped.degrees().sort_values().tolist() == [1, 1, 2, 2]


def test_clipping_keeps_crossings_without_a_node_apart() -> None:
    crossing = graph_of([(-50, 0), (50, 0)], [(0, -50), (0, 50)])
    clipped = clip_graph(crossing, (-20, -20, 20, 20))
    check_graph(clipped)
    assert clipped.edges["length"].tolist() == [40.0, 40.0]


def test_a_ramp_that_crosses_itself_is_cut_at_the_border_only() -> None:
    angle = np.linspace(0.0, 2.5 * np.pi, 400)
    spiral = np.column_stack([(30 + angle) * np.cos(angle), (30 - angle) * np.sin(angle)])
    clipped = clip_graph(graph_of(spiral), (-100, -20, 100, 100))
    check_graph(clipped)
    assert len(clipped.edges) == 2


def test_heights_are_interpolated_where_a_road_is_cut() -> None:
    clipped = clip_graph(graph_of([(0, 0, 0), (100, 0, 10)]), (25, -10, 75, 10))
    assert shapely.get_coordinates(clipped.edges.geometry.iloc[0], include_z=True)[:, 2].tolist() == [2.5, 7.5]


@pytest.mark.parametrize("seed", range(4))
def test_clipped_length_equals_an_intersection(seed: int, streets: Streets) -> None:
    road, area = streets(seed), shapely.Point(40, 40).buffer(33.0)
    clipped = clip_graph(road, area)
    check_graph(clipped)
    expected = shapely.length(shapely.intersection(road.edges.geometry.to_numpy(), area)).sum()
    assert clipped.length == pytest.approx(expected)


def test_an_area_far_away_leaves_nothing(streets: Streets) -> None:
    clipped = clip_graph(streets(1), (1e6, 1e6, 2e6, 2e6))
    assert (len(clipped.nodes), len(clipped.edges)) == (0, 0)
    assert len(clip_graph(empty_graph(UTM), (0, 0, 1, 1)).edges) == 0


def test_an_empty_area_is_refused(streets: Streets) -> None:
    with pytest.raises(InputError, match="area to clip to is empty"):
        clip_graph(streets(1), (0, 0, 0, 10))
