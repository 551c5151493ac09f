from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.errors import OptionError
from probe2road.graph.check import check_graph
from probe2road.graph.clean import (
    CleanOptions,
    clean_graph,
    collapse_short_edges,
    drop_dead_ends,
    drop_small_components,
    merge_degree_two_nodes,
)
from probe2road.graph.roadgraph import RoadGraph, empty_graph
from sketches import UTM, graph_of


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


class TestDropDeadEnds:
    def test_spurs_go_and_their_road_becomes_one_edge(self) -> None:
        graph = graph_of([(0, 0), (50, 0)], [(50, 0), (50, 4)], [(50, 0), (90, 0)])
        pruned = drop_dead_ends(graph)
        assert vertices(pruned, 0) == [(0, 0), (50, 0), (90, 0)]
        assert len(pruned.nodes) == 2
        check_graph(pruned)

    def test_length_of_exactly_the_limit_stays(self) -> None:
        graph = graph_of([(0, 0), (50, 0)], [(50, 0), (50, 15)], [(50, 0), (90, 0)])
        assert drop_dead_ends(graph) is graph

    def test_dead_ends_are_measured_up_to_their_junction(self) -> None:
        graph = graph_of([(0, 0), (50, 0)], [(50, 0), (50, 9)], [(50, 9), (50, 18)], [(50, 0), (90, 0)])
        assert drop_dead_ends(graph).length == graph.length

    def test_a_comb_at_the_end_of_a_road_is_not_eaten_up_tooth_by_tooth(self) -> None:
        teeth = [[(x, 0), (x, 5)] for x in (60, 70, 80)]
        road = [[(a, 0), (b, 0)] for a, b in ((0, 60), (60, 70), (70, 80), (80, 90))]
        pruned = drop_dead_ends(graph_of(*road, *teeth))
        assert pruned.edges["length"].tolist() == [90]

    def test_isolated_edges_go_by_their_length_and_stars_keep_their_longest_pair(self) -> None:
        star = [[(0, 0), (9, 0)], [(0, 0), (-8, 0)], [(0, 0), (0, 7)]]
        pruned = drop_dead_ends(graph_of(*star, [(50, 0), (64, 0)], [(50, 50), (66, 50)]))
        assert sorted(pruned.edges["length"]) == [16, 17]

    def test_loops_are_no_dead_ends(self) -> None:
        graph = graph_of([(0, 0), (50, 0)], [(50, 0), (53, 3), (53, -3), (50, 0)])
        assert drop_dead_ends(graph) is graph

    def test_turns_on_dropped_edges_go(self) -> None:
        graph = graph_of([(0, 0), (50, 0)], [(50, 0), (50, 4)], [(50, 0), (90, 0)], [(50, 0), (50, -40)])
        turns = pd.DataFrame({"from_edge": [0, 0], "via_node": [1, 1], "to_edge": [1, 2], "count": [5, 4]})
        assert drop_dead_ends(replace(graph, turns=turns)).turns.to_numpy().tolist() == [[0, 1, 2, 4]]


class TestCollapseShortEdges:
    CROSS = ([(0, 40), (40, 3)], [(0, -40), (40, 3)], [(40, 3), (48, 3)], [(48, 3), (88, 40)], [(48, 3), (88, -40)])

    def test_two_junctions_become_one_in_the_middle(self) -> None:
        graph = collapse_short_edges(graph_of(*self.CROSS))
        assert len(graph.edges) == 4
        assert graph.degrees()[1] == 4
        assert graph.nodes.geometry[1].coords[0] == (44, 3)
        check_graph(graph)

    def test_roads_change_only_near_the_new_junction(self) -> None:
        before = graph_of(*self.CROSS)
        after = collapse_short_edges(before)
        reach = shapely.Point(44, 3).buffer(12, 64)
        for edge in after.edges.index:
            old, new = (shapely.difference(graph.edges.geometry[edge], reach) for graph in (before, after))
            assert old.hausdorff_distance(new) < 0.02
        assert after.length == pytest.approx(before.length, abs=10)

    def test_kinks_inside_the_circle_are_cut_off(self) -> None:
        hooked = [*self.CROSS[:4], [(48, 3), (46, 1), (48, 1), (88, -40)]]
        line = vertices(collapse_short_edges(graph_of(*hooked)), 4)
        assert line[0] == (44, 3)
        assert len(line) == 3
        assert np.hypot(line[1][0] - 44, line[1][1] - 3) == pytest.approx(12)

    def test_dead_ends_and_long_edges_stay(self) -> None:
        graph = graph_of(
            [(0, 0), (50, 0)], [(50, 0), (50, 4)], [(50, 0), (66, 0)], [(66, 0), (66, 40)], [(66, 0), (99, 0)]
        )
        assert collapse_short_edges(graph) is graph

    def test_chains_count_as_one_edge(self) -> None:
        parted = [*self.CROSS[:2], [(40, 3), (44, 3)], [(44, 3), (48, 3)], *self.CROSS[3:]]
        assert len(collapse_short_edges(graph_of(*parted)).edges) == 4
        assert len(collapse_short_edges(graph_of(*parted), max_length=7.9).edges) == 5

    def test_clusters_grow_to_the_middle_of_all_their_junctions(self) -> None:
        arms = [[(x, 0), (x, 60)] for x in (0, 6, 13)]
        road = [[(-50, 0), (0, 0)], [(0, 0), (6, 0)], [(6, 0), (13, 0)], [(13, 0), (60, 0)]]
        graph = collapse_short_edges(graph_of(*road, *arms), max_shift=None)
        assert graph.degrees().max() == 5
        assert graph.nodes.geometry[graph.degrees().idxmax()].x == pytest.approx(19 / 3)

    @pytest.mark.parametrize("angle", [20.0, 30.0, 45.0])
    def test_the_two_junctions_of_a_flat_crossing_become_one(self, angle: float) -> None:
        """Two roads as a mask 3 m wide shows them: they are one line while they are less than 3 m apart."""
        half = np.radians(angle) / 2
        join = 1.5 / np.tan(half)  # m from the crossing to where they are
        far = (80 * np.cos(half), 80 * np.sin(half))
        arms = [[(x * join, 0), (x * far[0], y * far[1])] for x in (-1, 1) for y in (-1, 1)]
        graph = collapse_short_edges(graph_of(*arms, [(-join, 0), (join, 0)]), max_length=25.0)
        assert sorted(graph.degrees()) == [1, 1, 1, 1, 4]
        assert shapely.get_coordinates(graph.nodes.geometry[graph.degrees() == 4])[0] == pytest.approx(0.0, abs=1e-9)

    @pytest.mark.parametrize("apart", [10.0, 14.0, 20.0])
    def test_crossing_dual_carriageways_keep_four_junctions(self, apart: float) -> None:
        at = (0.0, apart)
        inner = [[(x, 0), (x, apart)] for x in at] + [[(0, y), (apart, y)] for y in at]
        outer = [[(x, y), (x, y + (80 if y else -80))] for x in at for y in at]
        outer += [[(x, y), (x + (80 if x else -80), y)] for x in at for y in at]
        graph = graph_of(*inner, *outer)
        assert collapse_short_edges(graph) is graph
        assert len(clean_graph(graph).nodes) == len(graph.nodes)
        assert len(collapse_short_edges(graph, max_length=25.0, max_shift=None).edges) < len(graph.edges)

    @pytest.mark.parametrize(("diameter", "n_arms"), [(12.0, 3), (12.0, 4), (20.0, 5), (30.0, 6)])
    def test_roundabouts_keep_their_ring_and_their_arms(self, diameter: float, n_arms: int) -> None:
        angles = np.arange(n_arms) * 2 * np.pi / n_arms
        circle = [
            diameter / 2 * np.stack([np.cos(a), np.sin(a)], axis=-1)
            for a in (np.linspace(*pair, 9) for pair in pairwise([*angles, 2 * np.pi]))
        ]
        arms = [[line[0], line[0] * 100 / diameter] for line in circle]
        graph = graph_of(*circle, *arms)
        assert clean_graph(graph) is graph

    def test_two_close_arms_of_a_roundabout_become_one_and_the_ring_stays(self) -> None:
        angles = np.radians([0, 12, 120, 240, 360])
        circle = [
            12 * np.stack([np.cos(a), np.sin(a)], axis=-1) for a in (np.linspace(*pair, 9) for pair in pairwise(angles))
        ]
        graph = collapse_short_edges(graph_of(*circle, *[[line[0], line[0] * 8] for line in circle]))
        assert sorted(graph.degrees()) == [1, 1, 1, 1, 3, 3, 4]

    def test_staggered_side_roads_stay_apart_where_a_collapse_would_bend_them(self) -> None:
        def staggered(by: float) -> RoadGraph:
            road = [[(-80, 0), (0, 0)], [(0, 0), (by, 0)], [(by, 0), (80, 0)]]
            return graph_of(*road, [(0, 0), (0, 80)], [(by, 0), (by, -80)])

        assert len(collapse_short_edges(staggered(5.0)).edges) == 4
        assert len(collapse_short_edges(staggered(12.0)).edges) == 5

    def test_holes_of_the_mask_collapse_with_their_edges(self) -> None:
        lens = [[(0, 0), (4, 3), (8, 0)], [(0, 0), (4, -3), (8, 0)]]
        graph = collapse_short_edges(graph_of([(-50, 0), (0, 0)], *lens, [(8, 0), (60, 0)]))
        assert graph.edges[["u", "v"]].to_numpy().tolist() == [[0, 1], [1, 3]]
        assert graph.length == pytest.approx(110)

    def test_short_side_of_a_block_leaves_a_loop(self) -> None:
        block = [(0, 0), (0, 90), (90, 90), (90, 0), (10, 0)]
        graph = graph_of([(-50, 0), (0, 0)], [(0, 0), (10, 0)], block, [(10, 0), (60, -50)])
        collapsed = collapse_short_edges(graph, max_shift=None)
        assert (collapsed.edges["u"] == collapsed.edges["v"]).sum() == 1
        check_graph(collapsed)
        assert collapse_short_edges(graph) is graph

    def test_heights_stay_with_their_roads(self) -> None:
        lifted = [[(x, y, 7.0) for x, y in line] for line in self.CROSS]
        graph = collapse_short_edges(graph_of(*lifted))
        assert set(shapely.get_coordinates(graph.edges.geometry.to_numpy(), include_z=True)[:, 2]) == {7.0}

    def test_turns_move_to_the_new_junction(self) -> None:
        rows = {"from_edge": [0, 2, 0], "via_node": [1, 3, 1], "to_edge": [1, 3, 2], "count": [5, 4, 3]}
        graph = replace(graph_of(*self.CROSS), turns=pd.DataFrame(rows))
        assert collapse_short_edges(graph).turns.to_numpy().tolist() == [[0, 1, 1, 5]]


class TestDropSmallComponents:
    def test_components_go_by_their_total_length(self) -> None:
        graph = graph_of([(0, 0), (8, 0)], [(8, 0), (8, 8)], [(50, 0), (64, 0)], [(80, 0), (83, 3), (80, 3), (80, 0)])
        kept = drop_small_components(graph)
        assert kept.edges.index.tolist() == [0, 1]
        assert len(kept.nodes) == 3

    def test_zero_keeps_all(self) -> None:
        graph = graph_of([(0, 0), (1, 0)])
        assert drop_small_components(graph, min_length=0) is graph


class TestCleanGraph:
    def test_spurs_do_not_bend_the_road_that_carries_them(self) -> None:
        road = [[(a, 0), (b, 0)] for a, b in ((0, 50), (50, 58), (58, 99))]
        graph = clean_graph(graph_of(*road, [(50, 0), (50, 3)], [(58, 0), (58, -4)]))
        assert vertices(graph, 0) == [(0, 0), (50, 0), (58, 0), (99, 0)]

    def test_all_limits_at_zero_only_merge(self) -> None:
        graph = graph_of([(0, 0), (1, 0)], [(1, 0), (1, 1)], [(1, 0), (2, 0)])
        assert clean_graph(graph, options=CleanOptions(short_edge=0, dead_end=0, component=0)) is graph

    def test_empty_graph(self) -> None:
        assert len(clean_graph(empty_graph(UTM)).edges) == 0

    def test_negative_lengths_are_refused(self) -> None:
        with pytest.raises(OptionError, match="dead_end is -1"):
            CleanOptions(dead_end=-1)
        with pytest.raises(OptionError, match="max_length is nan"):
            collapse_short_edges(empty_graph(UTM), max_length=float("nan"))
