from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.clean import merge_degree_two_nodes
from probe2road.roadgraph import RoadGraph, check_graph, empty_graph, graph_from_lines

UTM = "EPSG:32616"


def graph_of(*lines: list[tuple[float, ...]]) -> RoadGraph:
    return graph_from_lines(list(lines), crs=UTM)


def with_columns(graph: RoadGraph, **columns: object) -> RoadGraph:
    return replace(graph, edges=graph.edges.assign(**columns).astype(graph.edges.dtypes))


def vertices(graph: RoadGraph, edge: int) -> list[tuple[float, ...]]:
    return list(graph.edges.geometry[edge].coords)


class TestMergeDegreeTwoNodes:
    def test_chain_keeps_every_vertex_and_the_direction_of_its_first_edge(self) -> None:
        graph = graph_of([(20, 1), (10, 0)], [(0, 0), (3, 3), (10, 0)], [(20, 1), (27, 5), (30, 0)])
        merged = merge_degree_two_nodes(graph)
        assert vertices(merged, 0) == [(30, 0), (27, 5), (20, 1), (10, 0), (3, 3), (0, 0)]
        assert merged.length == pytest.approx(graph.length)
        check_graph(merged)

    def test_junctions_stay(self) -> None:
        cross = graph_of(*[[(0, 0), (9 * dx, 9 * dy)] for dx, dy in ((1, 0), (0, 1), (-1, 0))])
        assert merge_degree_two_nodes(cross) is cross

    def test_ring_of_two_edges_keeps_one_node(self) -> None:
        ring = graph_of([(0, 0), (9, 0), (9, 9)], [(0, 0), (0, 9), (9, 9)])
        merged = merge_degree_two_nodes(ring)
        assert vertices(merged, 0) == [(0, 0), (9, 0), (9, 9), (0, 9), (0, 0)]
        assert (len(merged.nodes), len(merged.edges)) == (1, 1)
        check_graph(merged)

    def test_loop_at_a_dead_end_stays_apart_from_its_road(self) -> None:
        lollipop = graph_of([(0, 0), (50, 0)], [(50, 0), (60, 9), (60, 0)], [(60, 0), (60, -9), (50, 0)])
        merged = merge_degree_two_nodes(lollipop)
        assert merged.edges[["u", "v"]].to_numpy().tolist() == [[0, 1], [1, 1]]

    def test_parallel_edges_survive_with_keys(self) -> None:
        theta = graph_of(
            [(0, 0), (5, 0)], [(5, 0), (10, 0)], [(0, 0), (5, 5)], [(5, 5), (10, 0)], [(0, 0), (5, -5), (10, 0)]
        )
        merged = merge_degree_two_nodes(theta)
        assert merged.edges[["u", "v", "key"]].to_numpy().tolist() == [[0, 2, 0], [0, 2, 1], [0, 2, 2]]
        check_graph(merged)

    def test_heights_follow_their_vertices(self) -> None:
        graph = graph_of([(10, 0, 5), (0, 0, 4)], [(10, 0, 5), (20, 0, 6)])
        assert vertices(merge_degree_two_nodes(graph), 0) == [(20, 0, 6), (10, 0, 5), (0, 0, 4)]

    def test_attributes_of_a_chain(self) -> None:
        graph = with_columns(
            graph_of([(10, 0), (0, 0)], [(10, 0), (40, 0)]),
            support=[7, 4],
            score=[0.5, 0.9],
            forward=[1, 20],
            backward=[10, 2],
            origin=["gap", "segmentation"],
        )
        edge = merge_degree_two_nodes(graph).edges.loc[0]
        assert edge[["support", "forward", "backward", "origin"]].tolist() == [4, 1, 10, "segmentation"]
        assert edge["score"] == pytest.approx(0.8)

    def test_unknown_counts_stay_unknown_and_unknown_scores_are_left_out(self) -> None:
        graph = with_columns(
            graph_of([(0, 0), (10, 0)], [(10, 0), (40, 0)]), support=[7, pd.NA], score=[0.5, np.nan], origin="gap"
        )
        edge = merge_degree_two_nodes(graph).edges.loc[0]
        assert edge["support"] is pd.NA
        assert edge["score"] == 0.5
        assert edge["origin"] == "gap"

    def test_turns_follow_their_edges(self) -> None:
        graph = graph_of([(0, 0), (10, 0)], [(10, 0), (20, 0)], [(20, 0), (30, 9)], [(20, 0), (30, -9)])
        turns = pd.DataFrame({"from_edge": [0, 1], "via_node": [1, 2], "to_edge": [1, 3], "count": [5, 4]})
        merged = merge_degree_two_nodes(replace(graph, turns=turns))
        assert merged.turns.to_numpy().tolist() == [[0, 2, 3, 4]]

    def test_ids_and_further_columns_are_those_of_the_first_member(self) -> None:
        graph = graph_of([(0, 0), (10, 0)], [(10, 0), (20, 0)])
        named = replace(graph, edges=graph.edges.assign(name=["A", "B"]).set_index(pd.Index([70, 30], name="edge")))
        assert merge_degree_two_nodes(named).edges["name"].to_dict() == {70: "A"}

    def test_empty_graph(self) -> None:
        assert len(merge_degree_two_nodes(empty_graph(UTM)).edges) == 0

    def test_input_is_left_alone(self) -> None:
        graph = graph_of([(0, 0), (10, 0)], [(10, 0), (20, 0)])
        before = shapely.to_wkb(graph.edges.geometry.to_numpy()).tolist()
        merge_degree_two_nodes(graph)
        assert shapely.to_wkb(graph.edges.geometry.to_numpy()).tolist() == before
