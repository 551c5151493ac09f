"""Properties of the metrics on random small street graphs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import shapely
import shapely.affinity
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from probe2road.metrics import GeoOptions, evaluate, geo, itopo, junctions, lateral
from sketches import graph_of

CHEAP = ["geo", "itopo", "buffer_geo", "graph_sampling"]


@st.composite
def street_lines(draw: st.DrawFn) -> list[list[tuple[float, float]]]:
    """Edges between random corners of a 40 m raster, each with a bend."""
    corner = st.tuples(st.integers(0, 4), st.integers(0, 4))
    pairs = draw(st.lists(st.tuples(corner, corner), min_size=1, max_size=8, unique_by=frozenset))
    shift = st.floats(-8.0, 8.0)
    lines = []
    for (i, j), (k, m) in pairs:
        if (i, j) != (k, m):
            bend = (20.0 * (i + k) + draw(shift), 20.0 * (j + m) + draw(shift))
            lines.append([(40.0 * i, 40.0 * j), bend, (40.0 * k, 40.0 * m)])
    return lines or [[(0.0, 0.0), (20.0, 5.0), (40.0, 0.0)]]


@settings(max_examples=15, deadline=None)
@given(street_lines())
@example([[(0.0, 0.0), (0.0, 20.0), (0.0, 40.0)], [(0.0, 0.0), (0.0, 40.0), (0.0, 80.0)]])  # one upon the other
@example([[(0.0, 0.0), (0.0, 60.0), (0.0, 120.0)], [(0.0, 40.0), (0.0, 60.0), (0.0, 80.0)]])  # one within the other
@example([[(40.0, 0.0), (40.0, 60.0), (40.0, 120.0)], [(40.0, 40.0), (40.0, 61.25909373815464), (40.0, 80.0)]])
def test_a_graph_against_itself_scores_one(lines: list[Any]) -> None:
    table = evaluate(graph_of(*lines), graph_of(*lines), metrics=CHEAP)
    assert table["f1"].to_numpy() == pytest.approx(1.0)


@settings(max_examples=25, deadline=None)
@given(street_lines())
def test_a_graph_against_itself_connects_alike_and_lies_in_place(lines: list[Any]) -> None:
    drawn = [shapely.LineString(line) for line in lines]
    assume(shapely.length(shapely.union_all(drawn)) > sum(map(shapely.length, drawn)) - 0.01)  # no road above another
    connected, beside = junctions(graph_of(*lines), graph_of(*lines)), lateral(graph_of(*lines), graph_of(*lines))
    assert connected.matched_proposal == connected.proposal == connected.reference
    assert connected.details["arms_not_found"] == 0
    assert (beside.f1, beside.details["rms_m"]) == (1.0, 0.0)


@settings(max_examples=15, deadline=None)
@given(street_lines(), street_lines())
def test_optimal_geo_is_symmetric_and_at_least_greedy(first: list[Any], second: list[Any]) -> None:
    there, back = (
        geo(graph_of(*a), graph_of(*b), options=GeoOptions(matching="optimal"))
        for a, b in ((first, second), (second, first))
    )
    assert (there.precision, there.recall) == (back.recall, back.precision)
    assert there.matched_proposal >= geo(graph_of(*first), graph_of(*second)).matched_proposal


@settings(max_examples=15, deadline=None)
@given(street_lines(), street_lines(), st.integers(-10_000, 10_000))
def test_moving_both_graphs_changes_nothing(first: list[Any], second: list[Any], shift: int) -> None:
    moved = [[[(x + shift, y - shift) for x, y in line] for line in lines] for lines in (first, second)]
    before = evaluate(graph_of(*first), graph_of(*second), metrics=CHEAP)
    after = evaluate(graph_of(*moved[0]), graph_of(*moved[1]), metrics=CHEAP)
    assert after["f1"].to_numpy() == pytest.approx(before["f1"].to_numpy(), abs=0.02)


@settings(max_examples=15, deadline=None)
@given(street_lines(), st.data())
def test_cutting_edges_changes_nothing(lines: list[Any], data: st.DataObject) -> None:
    """Cut some edges at their bends: merging nodes of degree 2 undoes it, up to direction."""
    drawn = [shapely.LineString(line) for line in lines]
    assume(shapely.length(shapely.union_all(drawn)) > sum(map(shapely.length, drawn)) - 0.01)  # twin pieces are one
    bends, ends = [tuple(line[1]) for line in lines], {tuple(line[k]) for line in lines for k in (0, -1)}
    assume(len(set(bends)) == len(bends) and not ends & set(bends))  # a cut where others meet would join them
    pieces = []
    for line in lines:
        cut = data.draw(st.booleans())
        pieces += [line[:2], line[1:]] if cut else [line]
    reference = [shapely.affinity.translate(shapely.LineString(line), 2.0, 1.0) for line in lines]
    whole, cut = (itopo(graph_of(*part), graph_of(*reference)) for part in (lines, pieces))
    assert cut.proposal == whole.proposal
    assert cut.matched_proposal == pytest.approx(whole.matched_proposal, abs=0.02 * whole.proposal + 1)


@settings(max_examples=15, deadline=None)
@given(street_lines(), street_lines(), st.floats(1.0, 20.0), st.floats(1.0, 20.0))
def test_a_larger_radius_never_matches_less(first: list[Any], second: list[Any], a: float, b: float) -> None:
    near, far = (
        geo(graph_of(*first), graph_of(*second), options=GeoOptions(radius=radius, matching="optimal"))
        for radius in sorted((a, b))
    )
    assert near.matched_proposal <= far.matched_proposal
    assert np.isfinite(far.f1)
