"""What must hold for every graph and every set of drives when gaps are filled and junctions split."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import finish_edges
from probe2road.refinement.gaps.fill import GapOptions, fill_gaps, prune_gaps
from probe2road.refinement.junctions.split import DisambiguateOptions, split_false_junctions
from sketches import graph_of

NOBODY = pd.DataFrame({"trace_id": [], "edge": [], "entered": [], "left": []})


@st.composite
def graphs(draw: st.DrawFn) -> RoadGraph:
    """Random streets, cut where every second one crosses another, so that there are dead ends and junctions."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    size = draw(st.sampled_from([60, 150, 400]))
    ends = rng.uniform(0, size, (draw(st.integers(2, 12)), 2, 2))
    streets = [shapely.LineString(pair) for pair in ends]
    cut = shapely.get_parts(shapely.unary_union(streets[::2]))
    return graph_of(*cut, *streets[1::2])


@st.composite
def drives(draw: st.DrawFn) -> tuple[RoadGraph, pd.DataFrame, pd.DataFrame]:
    """Random walks on a random graph, and positions for them."""
    graph = draw(graphs())
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    ends = graph.edges[["u", "v"]].to_numpy()
    rows = []
    for trace in range(draw(st.integers(0, 30))):
        edge, forward = int(rng.integers(len(ends))), bool(rng.integers(2))
        for place in range(int(rng.integers(1, 6))):
            rows.append((trace, place, graph.edges.index[edge], forward, place > 0, ends[edge, 0 if forward else 1]))
            onward = np.argwhere(ends == ends[edge, 1 if forward else 0])
            edge, side = (int(value) for value in onward[rng.integers(len(onward))])
            forward = side == 0
    columns = ["trace_id", "position", "edge", "forward", "entered", "via_node"]
    steps = pd.DataFrame(rows, columns=columns).astype({"entered": bool, "forward": bool})
    onto = steps.loc[steps["entered"], ["trace_id", "position", "via_node"]]
    xyz = rng.normal(0.0, draw(st.sampled_from([0.1, 5.0])), (len(onto), 3))
    return graph, steps, onto.assign(x=xyz[:, 0], y=xyz[:, 1], z=xyz[:, 2])


def shuffled(graph: RoadGraph, seed: int) -> RoadGraph:
    order = np.random.default_rng(seed).permutation(len(graph.edges))
    return replace(graph, edges=finish_edges(graph.edges.iloc[order]))


def lines_of(graph: RoadGraph) -> list[str]:
    lines = shapely.normalize(shapely.set_precision(graph.edges.geometry.to_numpy(), 1e-6))
    return sorted(shapely.to_wkt(lines, rounding_precision=4))


def network(graph: RoadGraph) -> shapely.Geometry:
    return shapely.normalize(shapely.set_precision(shapely.unary_union(graph.edges.geometry.to_numpy()), 1e-4))


@settings(max_examples=12, deadline=None)
@given(graphs(), st.integers(0, 100))
def test_links_do_not_depend_on_the_order_of_the_edges(graph: RoadGraph, seed: int) -> None:
    assert lines_of(fill_gaps(graph)) == lines_of(fill_gaps(shuffled(graph, seed)))


@settings(max_examples=12, deadline=None)
@given(graphs())
def test_links_keep_their_promises(graph: RoadGraph) -> None:
    options = GapOptions()
    filled = fill_gaps(graph, options=options)
    check_graph(filled)
    gap = filled.edges["origin"] == "gap"
    # Ends that share a new node are moved onto it.
    assert (filled.edges.loc[gap, "length"] <= options.max_length + 5.0).all()
    links = pd.concat([filled.edges.loc[gap, "u"], filled.edges.loc[gap, "v"]]).value_counts()
    places = 2  # on one edge within 5 m of each other can become one node
    assert links.max() <= places * options.max_links if len(links) else not gap.any()
    assert np.isclose(filled.edges.loc[~gap, "length"].sum(), graph.length)


@settings(max_examples=12, deadline=None)
@given(graphs())
def test_links_that_nobody_drives_leave_no_trace(graph: RoadGraph) -> None:
    pruned = prune_gaps(fill_gaps(graph), NOBODY)
    check_graph(pruned)
    assert network(pruned).hausdorff_distance(network(graph)) < 1e-3
    assert np.isclose(pruned.length, graph.length)


@settings(max_examples=12, deadline=None)
@given(drives(), st.sampled_from(["guarded", "literal"]), st.integers(1, 5))
def test_splitting_keeps_the_invariants(
    driven: tuple[RoadGraph, pd.DataFrame, pd.DataFrame], variant: str, count: int
) -> None:
    graph, steps, positions = driven
    options = DisambiguateOptions(variant=variant, min_count=count)
    split = split_false_junctions(graph, steps, positions=positions, options=options)
    check_graph(split)
    whole = split_false_junctions(graph, steps, positions=positions, options=replace(options, merge=False))
    check_graph(whole)
    if variant == "literal":
        # A turn that was driven often enough is still possible, and nothing else is lost than nodes.
        turns = pd.DataFrame({"of": steps["edge"].shift(), "to": steps["edge"], "via": steps["via_node"]})
        counts = turns[steps["entered"]].value_counts()
        assert counts[counts >= count].sum() <= whole.turns["count"].sum() <= counts.sum()
        assert whole.edges.index.equals(graph.edges.index)
        assert whole.length == graph.length


@settings(max_examples=12, deadline=None)
@given(drives(), st.integers(0, 100))
def test_splitting_does_not_depend_on_the_order_of_the_edges(
    driven: tuple[RoadGraph, pd.DataFrame, pd.DataFrame], seed: int
) -> None:
    graph, steps, positions = driven
    options = DisambiguateOptions(min_count=2, merge=False)
    one, other = (
        split_false_junctions(one, steps, positions=positions, options=options)
        for one in (graph, shuffled(graph, seed))
    )
    assert lines_of(one) == lines_of(other)
    assert len(one.nodes) == len(other.nodes)


@settings(max_examples=12, deadline=None)
@given(drives())
def test_guarded_splits_never_more_than_literal(driven: tuple[RoadGraph, pd.DataFrame, pd.DataFrame]) -> None:
    graph, steps, _ = driven
    guarded, literal = (
        split_false_junctions(graph, steps, options=DisambiguateOptions(variant=name, min_share=0.0, merge=False))
        for name in ("guarded", "literal")
    )
    assert len(guarded.nodes) <= len(literal.nodes)
