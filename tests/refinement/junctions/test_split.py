from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.fleet.contract import fleet_from_tables
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import match
from probe2road.refinement.junctions.passages import node_passages, passing_positions
from probe2road.refinement.junctions.split import DisambiguateOptions, split_false_junctions
from sketches import UTM, fleet_of, graph_of, spaced

NOT_MERGED = DisambiguateOptions(merge=False)
LITERAL = DisambiguateOptions(variant="literal", merge=False)


#      3
#      |
#  0 --+-- 1
#      |
#      2
CROSS = graph_of([(-90, 0), (0, 0)], [(0, 0), (90, 0)], [(0, -90), (0, 0)], [(0, 0), (0, 90)])

#  0         2
#    \     /
#      -4-
#    /     \
#  1         3
FLAT = graph_of(
    [(-150, 60), (-12, 0)], [(-150, -60), (-12, 0)], [(12, 0), (150, 60)], [(12, 0), (150, -60)], [(-12, 0), (12, 0)]
)


def steps_of(graph: RoadGraph, paths: dict[tuple[int, ...], int]) -> pd.DataFrame:
    """Write the steps of traces that drive along edges, so many for each path."""
    rows = []
    trace = 0
    for path, times in paths.items():
        ends = [graph.edges.loc[edge, ["u", "v"]].tolist() for edge in path]
        for _ in range(times):
            for place, edge in enumerate(path):
                u, v = ends[place]
                near = ends[place + 1] if place + 1 < len(path) else ends[place - 1]
                forward = (v in near) == (place + 1 < len(path))
                rows.append((trace, place, edge, forward, place > 0, place + 1 < len(path), u if forward else v))
            trace += 1
    columns = ["trace_id", "position", "edge", "forward", "entered", "left", "via_node"]
    steps = pd.DataFrame(rows, columns=columns).astype({"via_node": "Int64"})
    return steps.assign(via_node=steps["via_node"].where(steps["entered"]), part=0)


def heights_of(steps: pd.DataFrame, height: dict[int, float]) -> pd.DataFrame:
    """Give every passage the height of the edge it leaves on."""
    onto = steps[steps["entered"]]
    return onto[["trace_id", "position", "via_node"]].assign(x=0.0, y=0.0, z=onto["edge"].map(height))


def apart(steps: pd.DataFrame, metres: float = 8.0) -> pd.DataFrame:
    """Give the traces of every path a place of their own at the junctions, without heights."""
    first = steps.groupby("trace_id")["edge"].transform("first")
    onto = steps["entered"]
    return steps.loc[onto, ["trace_id", "position", "via_node"]].assign(x=0.0, y=metres * first[onto], z=np.nan)


def parts(graph: RoadGraph) -> list[list[int]]:
    """Return the edges that meet, node by node, for nodes with two edges or more."""
    ends = pd.concat([graph.edges["u"], graph.edges["v"]])
    met = [sorted(ends.index[ends == node]) for node in graph.nodes.index]
    return sorted(edges for edges in met if len(edges) > 1)


class TestLiteral:
    def test_two_roads_that_cross_part(self) -> None:
        split = split_false_junctions(CROSS, steps_of(CROSS, {(0, 1): 4, (2, 3): 4}), options=LITERAL)
        assert parts(split) == [[0, 1], [2, 3]]
        check_graph(split)

    def test_both_directions_count_together(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 2, (1, 0): 2, (2, 3): 4})
        assert parts(split_false_junctions(CROSS, steps, options=LITERAL)) == [[0, 1], [2, 3]]

    def test_edges_connected_by_way_of_others_stay_together(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 4, (1, 2): 4, (2, 3): 4})
        assert parts(split_false_junctions(CROSS, steps, options=LITERAL)) == [[0, 1, 2, 3]]

    def test_what_nobody_drove_is_cut_off(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 4, (2, 3): 3})
        assert parts(split_false_junctions(CROSS, steps, options=LITERAL)) == [[0, 1]]

    def test_break_between_parts_is_no_passage(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 4, (2, 3): 4})
        steps.loc[steps["edge"] == 3, ["entered", "via_node"]] = [False, pd.NA]
        assert parts(split_false_junctions(CROSS, steps, options=LITERAL)) == [[0, 1]]


class TestGuarded:
    def test_two_roads_that_cross_part_and_become_two_edges(self) -> None:
        split = split_false_junctions(CROSS, steps_of(CROSS, {(0, 1): 4, (2, 3): 4}))
        assert [list(line.coords) for line in split.edges.geometry] == [
            [(-90, 0), (0, 0), (90, 0)],
            [(0, -90), (0, 0), (0, 90)],
        ]
        check_graph(split)

    def test_one_proven_road_is_no_proof_of_two(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 90, (2, 3): 3})
        assert parts(split_false_junctions(CROSS, steps)) == [[0, 1, 2, 3]]

    def test_undriven_edge_goes_with_what_it_continues(self) -> None:
        #  edge 4 continues edge 2, edge 3 bends away from it
        graph = graph_of(*[list(line.coords) for line in CROSS.edges.geometry], [(0, 0), (30, 90)])
        steps = steps_of(graph, {(0, 1): 4, (2, 3): 4})
        assert parts(split_false_junctions(graph, steps, options=NOT_MERGED)) == [[0, 1], [2, 3, 4]]

    def test_ramp_with_few_drives_stays_with_the_road_that_it_leaves(self) -> None:
        #  The ramp, edge 4, seems to continue edge 2, but its two drives come from edge 0.
        graph = graph_of(*[list(line.coords) for line in CROSS.edges.geometry], [(0, 0), (30, 90)])
        steps = steps_of(graph, {(0, 1): 9, (2, 3): 9, (0, 4): 2})
        assert parts(split_false_junctions(graph, steps, options=NOT_MERGED)) == [[0, 1, 4], [2, 3]]

    def test_matching_errors_do_not_join_busy_roads(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 200, (2, 3): 200, (0, 3): 5})
        assert parts(split_false_junctions(CROSS, steps, options=NOT_MERGED)) == [[0, 1], [2, 3]]
        trusting = DisambiguateOptions(min_share=0.0)
        assert parts(split_false_junctions(CROSS, steps, options=trusting)) == [[0, 1, 2, 3]]

    def test_no_traces_change_nothing(self) -> None:
        assert parts(split_false_junctions(CROSS, steps_of(CROSS, {}))) == [[0, 1, 2, 3]]

    def test_loop_is_split_by_its_ends(self) -> None:
        #  A loop ramp that crosses the road it came from: it begins and ends at the node, but never turns there.
        graph = graph_of([(-90, 0), (0, 0)], [(0, 0), (80, 0), (80, 80), (0, 80), (0, 0)], [(0, 0), (0, -90)])
        steps = pd.DataFrame({"trace_id": np.repeat(range(4), 3), "edge": [0, 1, 2] * 4, "forward": True})
        steps = steps.assign(entered=[False, True, True] * 4, position=[0, 1, 2] * 4, part=0)
        split = split_false_junctions(graph, steps)
        assert len(split.edges) == 1
        assert split.length == pytest.approx(graph.length)
        check_graph(split)


class TestHeights:
    def test_single_drive_over_a_bridge(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 50, (2, 3): 1})
        stacked = heights_of(steps, {1: 10.0, 3: 16.5})
        assert parts(split_false_junctions(CROSS, steps, positions=stacked)) == []
        level = heights_of(steps, {1: 10.0, 3: 12.0})
        assert parts(split_false_junctions(CROSS, steps, positions=level)) == [[0, 1, 2, 3]]

    def test_heights_that_scatter_prove_nothing(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 50, (2, 3): 1})
        heights = heights_of(steps, {1: 10.0, 3: 16.5})
        noisy = heights.assign(z=heights["z"] + 6.0 * np.resize([-1, 1], len(heights)))
        assert parts(split_false_junctions(CROSS, steps, positions=noisy)) == [[0, 1, 2, 3]]

    def test_crossing_at_one_level_stays_although_nobody_turns(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 50, (2, 3): 50})
        level = heights_of(steps, {1: 10.0, 3: 10.5})
        assert parts(split_false_junctions(CROSS, steps, positions=level)) == [[0, 1, 2, 3]]

    def test_roads_side_by_side_part_at_one_level(self) -> None:
        #  Two carriageways pinched together: nothing says that they cross.
        pinched = graph_of([(-90, 5), (0, 0)], [(0, 0), (90, 5)], [(-90, -5), (0, 0)], [(0, 0), (90, -5)])
        steps = steps_of(pinched, {(0, 1): 50, (2, 3): 50})
        level = heights_of(steps, {1: 10.0, 3: 10.0})
        assert parts(split_false_junctions(pinched, steps, positions=level, options=NOT_MERGED)) == [[0, 1], [2, 3]]

    def test_unknown_heights_are_no_evidence(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 4, (2, 3): 4})
        unknown = heights_of(steps, {1: np.nan, 3: np.nan})
        assert parts(split_false_junctions(CROSS, steps, positions=unknown, options=NOT_MERGED)) == [[0, 1], [2, 3]]

    def test_ramp_that_leaves_stays(self) -> None:
        ramp = graph_of([(-90, 0), (0, 0)], [(0, 0), (90, 0)], [(0, 0), (90, 20)])
        steps = steps_of(ramp, {(0, 1): 50, (0, 2): 1})
        climbing = heights_of(steps, {1: 10.0, 2: 16.0})
        assert parts(split_false_junctions(ramp, steps, positions=climbing)) == [[0, 1, 2]]


class TestArtefacts:
    crossing = steps_of(FLAT, {(0, 4, 3): 4, (1, 4, 2): 4})

    def test_flat_crossing_becomes_two_roads_without_a_common_node(self) -> None:
        split = split_false_junctions(FLAT, self.crossing, positions=apart(self.crossing))
        check_graph(split)
        assert split.edges[["u", "v"]].to_numpy().ravel().tolist() == [0, 5, 2, 4]
        one, other = split.edges.geometry
        assert one.crosses(other)

    def test_bend_of_the_skeleton_is_straightened(self) -> None:
        split = split_false_junctions(FLAT, self.crossing, positions=apart(self.crossing))
        line = split.edges.geometry.iloc[0]
        # The arms rise by 60 m over 138 m; led straight on, the road passes the middle with that slope.
        (x0, y0), (x1, y1) = (
            line.interpolate(0.48, normalized=True).coords[0],
            line.interpolate(0.52, normalized=True).coords[0],
        )
        assert -0.5 < (y1 - y0) / (x1 - x0) < -0.1

    def test_attributes_survive(self) -> None:
        graph = replace(FLAT, edges=FLAT.edges.assign(support=pd.array([9, 8, 7, 6, 20], dtype="Int64")))
        split = split_false_junctions(graph, self.crossing, positions=apart(self.crossing))
        assert split.edges["support"].tolist() == [6, 7]

    def test_not_without_positions_and_not_where_it_is_switched_off(self) -> None:
        assert len(split_false_junctions(FLAT, self.crossing).edges) == 5
        for off in (DisambiguateOptions(max_inner=0.0), DisambiguateOptions(max_inner=23.0)):
            assert (
                len(split_false_junctions(FLAT, self.crossing, positions=apart(self.crossing), options=off).edges) == 5
            )

    def test_what_a_node_settles_by_itself_is_no_artefact(self) -> None:
        # Another road passes over one end of the edge between two forks, which is a real road.
        lines = [list(line.coords) for line in FLAT.edges.geometry]
        graph = graph_of(*lines, [(12, 0), (40, 150)], [(12, 0), (-16, -150)])
        steps = steps_of(graph, {(0, 4, 3): 9, (1, 4, 2): 9, (5, 6): 9})
        split = split_false_junctions(graph, steps, positions=apart(steps), options=NOT_MERGED)
        check_graph(split)
        assert [5, 6] in parts(split)
        assert 4 in split.edges.index

    def test_traces_that_mix_prove_a_real_road(self) -> None:
        steps = steps_of(FLAT, {(0, 4, 3): 9, (1, 4, 2): 9, (0, 4, 2): 4})
        assert len(split_false_junctions(FLAT, steps, positions=apart(steps)).edges) == 5

    def test_traces_that_coincide_prove_a_real_road(self) -> None:
        assert len(split_false_junctions(FLAT, self.crossing, positions=apart(self.crossing, 2.0)).edges) == 5

    @pytest.mark.parametrize(("height", "edges"), [(8.0, 2), (6.0, 5), (3.0, 5)])  # four traces each
    def test_traces_that_coincide_in_plan_part_by_height(self, height: float, edges: int) -> None:
        positions = apart(self.crossing, 1.0)
        upper = positions["trace_id"].map(self.crossing.groupby("trace_id")["edge"].first()) == 1
        stacked = positions.assign(z=np.where(upper, height, 0.0))
        assert len(split_false_junctions(FLAT, self.crossing, positions=stacked).edges) == edges

    def test_roads_that_touch_but_do_not_cross_part_too(self) -> None:
        steps = steps_of(FLAT, {(0, 4, 2): 4, (1, 4, 3): 4})
        one, other = split_false_junctions(FLAT, steps, positions=apart(steps)).edges.geometry
        assert not one.crosses(other)

    def test_ramp_beside_a_flat_crossing_stays_connected(self) -> None:
        lines = [list(line.coords) for line in FLAT.edges.geometry]
        graph = graph_of(*lines, [(12, 0), (150, 20)])
        steps = steps_of(graph, {(0, 4, 3): 9, (1, 4, 2): 9, (1, 4, 5): 4})
        split = split_false_junctions(graph, steps, positions=apart(steps), options=NOT_MERGED)
        check_graph(split)
        assert parts(split) == [[0, 3], [1, 2, 5]]
        assert split.turns[["from_edge", "to_edge", "count"]].to_numpy().tolist() == [[0, 3, 9], [1, 2, 9], [1, 5, 4]]


class TestTurns:
    def test_table_holds_what_is_still_possible(self) -> None:
        steps = steps_of(CROSS, {(0, 1): 90, (1, 0): 30, (2, 3): 40, (0, 3): 1})
        split = split_false_junctions(CROSS, steps, options=NOT_MERGED)
        check_graph(split)
        assert split.turns[["from_edge", "to_edge", "count"]].to_numpy().tolist() == [
            [0, 1, 90],
            [1, 0, 30],
            [2, 3, 40],
        ]

    def test_old_node_stays_with_the_larger_group(self) -> None:
        graph = graph_of(*[list(line.coords) for line in CROSS.edges.geometry], [(0, 0), (30, 90)])
        node = graph.edges.loc[0, "v"]
        split = split_false_junctions(graph, steps_of(graph, {(0, 1): 4, (2, 3): 4, (2, 4): 4}))
        assert split.edges.loc[[2, 3, 4], ["u", "v"]].eq(node).any(axis=1).all()


class TestPositions:
    def test_interpolated_in_time_and_missing_without_a_clock(self) -> None:
        x = np.arange(-80.0, 81.0, 20)
        east = pd.DataFrame({"trace_id": "a", "t": range(9), "x": x, "y": 0.0, "z": 10 + x / 10})
        for table, expected in ((east, [0.0, 0.0, 10.0]), (east.drop(columns="t"), [np.nan] * 3)):
            fleet = fleet_from_tables(table, crs=UTM, keep_crs=True)
            found = passing_positions(CROSS, fleet, match(CROSS, fleet))
            assert found["via_node"].tolist() == [1]
            assert found[["x", "y", "z"]].to_numpy()[0] == pytest.approx(expected, abs=1e-6, nan_ok=True)

    def test_far_fixes_say_nothing(self) -> None:
        fleet = fleet_of([(-80.0, 0.0, 5.0), (80.0, 0.0, 5.0)], interval=4.0)
        assert passing_positions(CROSS, fleet, match(CROSS, fleet))["z"].isna().all()

    def test_other_graph(self) -> None:
        fleet = fleet_of(spaced((-80, 0), (80, 0), spacing=20.0))
        matches = match(CROSS, fleet)
        other = graph_of([(0, 0), (90, 0)])
        with pytest.raises(InputError, match="nodes that are not in the graph"):
            passing_positions(replace(other, nodes=other.nodes.iloc[:1]), fleet, matches)
        with pytest.raises(
            InputError, match=r"edge 1 of the matches is not in the graph; pass the graph that was matched"
        ):
            node_passages(other, steps_of(CROSS, {(1, 0): 1}))


def test_bad_options() -> None:
    with pytest.raises(OptionError, match=r"variant is 'bold'; use guarded or literal"):
        DisambiguateOptions(variant="bold")
    with pytest.raises(OptionError, match=r"min_share is -0\.1"):
        DisambiguateOptions(min_share=-0.1)
