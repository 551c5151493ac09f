from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probe2road.baselines.biagioni.collapse import collapse_segments, run_errors
from probe2road.baselines.biagioni.density import LEVELS, blur, blur_kernel, close_with_disk, level_ranks, trip_lines
from probe2road.baselines.biagioni.gray_skeleton import gray_skeleton
from probe2road.baselines.biagioni.pruning import prune_segments
from probe2road.baselines.biagioni.recipe import FLEET, SIGMAS, BiagioniOptions, build_biagioni
from probe2road.baselines.biagioni.street_map import straight_pieces
from probe2road.baselines.biagioni.traversals import Runs, good_runs, match_pieces, observe_trips
from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.graph.check import check_graph
from probe2road.matching.network import build_states
from probe2road.matching.published import emission_table, transition
from probe2road.raster.grid import Grid
from sketches import UTM, fleet_of, graph_of

MODEL = BiagioniOptions().matcher


def trips_of(*trips: list[tuple[float, float]], interval: float = 2.0) -> Fleet:
    return fleet_of(*trips, interval=interval)


def straight(x0: float, y0: float, x1: float, y1: float, fixes: int = 21) -> list[tuple[float, float]]:
    return list(zip(np.linspace(x0, x1, fixes).tolist(), np.linspace(y0, y1, fixes).tolist(), strict=True))


def runs_of(*runs: tuple[int, bool, list[tuple[float, float]]]) -> Runs:
    return Runs(
        segment=np.array([run[0] for run in runs]),
        forward=np.array([run[1] for run in runs]),
        offsets=np.cumsum([0, *(len(run[2]) for run in runs)]),
        xy=np.concatenate([np.array(run[2]) for run in runs]),
    )


class TestNumbersOfTheMethod:
    """What METHOD 4 states about the published program."""

    def test_emissions(self) -> None:
        table = emission_table(MODEL)
        assert table[[0, 10, 25, 50, 100, 116, 149]].round(4).tolist() == [
            0.5, 0.4207, 0.3085, 0.1587, 0.0228, 0.0102, 0.0014,
        ]  # fmt: skip
        assert len(table) == 150
        assert MODEL.unknown == 0.01

    def test_transition_is_shared_by_weight_and_its_row_leaks(self) -> None:
        lines = [[(0, 0), (9, 0)], [(9, 0), (18, 0)], [(9, 0), (9, 9)]]
        states = build_states(graph_of(*lines))
        weight = np.array([3.0, 6.0, 1.0])
        onward = [transition(states, weight, 0, after) for after in (0, 1, 2, 4)]
        np.testing.assert_allclose(onward, [0.5, 1e-5, 0.6 * 0.49999, 0.1 * 0.49999])

    def test_vertex_in_the_middle_of_a_chain_halves_the_way_on(self) -> None:
        states = build_states(graph_of([(0, 0), (9, 0)], [(9, 0), (18, 0)]))
        assert transition(states, np.ones(2), 0, 2) == pytest.approx(0.249995)
        assert transition(states, np.ones(2), 0, 1) == 0.0  # nobody turns back there

    @pytest.mark.parametrize(("sigma", "ridge"), [("code", 4.4), ("paper", 1.5)])
    def test_ridge_of_one_trip(self, sigma: str, ridge: float) -> None:
        lines = np.zeros((121, 121))
        lines[60] = 32
        width, cut = SIGMAS[sigma]
        assert blur(lines, blur_kernel(width, round(cut)))[60, 60] == pytest.approx(ridge, abs=0.05)

    def test_levels(self) -> None:
        assert len(LEVELS) == 28
        assert LEVELS[[0, 14, 15, 27]].tolist() == [1, 15, 16, 65536]

    def test_kernel_of_the_code_is_that_of_opencv(self) -> None:
        width, cut = SIGMAS["code"]
        assert 2 * cut + 1 == 17
        assert width == pytest.approx(0.3 * ((17 - 1) / 2 - 1) + 0.8)


class TestDensity:
    def test_diagonal_line_carries_as_much_per_metre_as_a_straight_one(self) -> None:
        grid = Grid.from_bounds((900, 0, 1020, 120), crs=UTM)
        sums = []
        for end in ((1000.5, 20.5), (970.5, 90.5), (940.5, 20.5 + 70)):
            fleet = trips_of([(920.5, 20.5), end])
            length = np.hypot(end[0] - 920.5, end[1] - 20.5)
            sums.append(trip_lines(fleet, grid).sum() / length)
        assert np.ptp(sums) < 0.03 * np.mean(sums)
        assert np.mean(sums) == pytest.approx(32, rel=0.05)

    def test_trip_counts_once_and_trips_add_up(self) -> None:
        grid = Grid.from_bounds((900, 0, 960, 20), crs=UTM)
        once, there = [(905.5, 10.5), (950.5, 10.5)], [(950.5, 10.5), (905.5, 10.5)]
        single = trip_lines(trips_of(once), grid)
        np.testing.assert_array_equal(trip_lines(trips_of(once + there), grid), single)
        np.testing.assert_array_equal(trip_lines(trips_of(once, there, once), grid), 3 * single)

    def test_gap_is_not_drawn(self) -> None:
        fleet = trips_of([(905.5, 10.5), (915.5, 10.5), (1415.5, 10.5), (1425.5, 10.5)])
        lines = trip_lines(fleet, Grid.from_bounds((900, 0, 1450, 20), crs=UTM))
        assert (lines[:, 5:16].max(axis=0) == 32).all()
        assert not lines[:, 100:400].any()

    def test_closing_equals_its_definition(self) -> None:
        values = np.random.default_rng(4).integers(0, 9, (17, 23))
        disk = [(r, c) for r in range(-3, 4) for c in range(-3, 4) if r * r + c * c <= 9]

        def extreme(image: np.ndarray, pick: np.ufunc, outside: int) -> np.ndarray:
            padded = np.pad(image, 3, constant_values=outside)
            parts = [padded[3 + r : 3 + r + 17, 3 + c : 3 + c + 23] for r, c in disk]
            return pick.reduce(parts)

        expected = extreme(extreme(values, np.maximum, 0), np.minimum, 99)
        np.testing.assert_array_equal(close_with_disk(values, 3)[3:-3, 3:-3], expected[3:-3, 3:-3])

    def test_windows_leave_no_seam(self, monkeypatch: pytest.MonkeyPatch) -> None:
        grid = Grid.from_bounds((900, 0, 1080, 90), crs=UTM)
        fleet = trips_of(straight(910, 20, 1070, 70), straight(910, 60, 1070, 30), straight(990, 5, 991, 85))
        kernel = blur_kernel(2.9, 8)
        whole = level_ranks(fleet, grid, kernel, closing=8)
        monkeypatch.setattr("probe2road.baselines.biagioni.density._WINDOW", 37)
        np.testing.assert_array_equal(level_ranks(fleet, grid, kernel, closing=8), whole)
        assert whole.max() > 4


class TestGraySkeleton:
    def test_quiet_branch_is_attached_to_the_busy_road_where_that_is(self) -> None:
        ranks = np.zeros((25, 31), np.uint8)
        ranks[3:10, 2:29] = 1  # the busy road's own outskirts, wider to the south
        ranks[3:6, 2:29] = 4
        ranks[8:23, 14:17] = 2  # a quiet road from the south
        skeleton = gray_skeleton(ranks)
        assert set(np.unique(skeleton[4, 5:26])) == {4}
        assert skeleton[20, 15] == 2
        assert (skeleton[4:21, 13:18] > 0).any(axis=1).all()  # connected all the way

    def test_empty(self) -> None:
        assert not gray_skeleton(np.zeros((4, 5), np.uint8)).any()


class TestTraversals:
    # A street of two segments with a bend in the second, driven by trips on it and 30 m beside it.
    graph = graph_of([(900, 0), (1000, 0)], [(1000, 0), (1100, 0), (1100, 100)])

    def runs(self, fleet: Fleet, *, blackout: float = 30.0, last_runs: bool = True) -> Runs:
        observations, pieces = observe_trips(fleet, step=10.0), straight_pieces(self.graph)
        found = match_pieces(observations, pieces, np.ones(2), MODEL)
        return good_runs(observations, pieces, *found, blackout=blackout, max_error=10.0, last_runs=last_runs)

    def test_trip_has_one_run_for_each_segment_in_its_direction(self) -> None:
        runs = self.runs(trips_of(straight(905, 1, 1095, 1), straight(1095, 2, 905, 2)))
        assert runs.segment.tolist() == [0, 1, 1, 0]
        assert runs.forward.tolist() == [True, True, False, False]
        assert (np.abs(runs.xy[:, 1]) < 3).all()

    def test_last_run_of_every_trip_is_lost_as_published(self) -> None:
        fleet = trips_of(straight(905, 1, 1095, 1), straight(1095, 2, 905, 2))
        assert self.runs(fleet, last_runs=False).segment.tolist() == [0, 1]

    def test_run_far_from_the_segment_is_not_good(self) -> None:
        assert len(self.runs(trips_of(straight(905, -30, 1000, -30))).segment) == 0

    def test_half_a_minute_around_the_unknown_is_left_out(self) -> None:
        # 10 m and 5 s a step; the last part is far from every road.
        fleet = trips_of(
            [(905.0 + 10 * k, 1.0) for k in range(10)] + [(1000.0, -150.0 - 10 * k) for k in range(5)], interval=5.0
        )
        clear, dark = (self.runs(fleet, blackout=blackout) for blackout in (0.0, 30.0))
        assert clear.offsets[-1] > dark.offsets[-1] > 0
        assert dark.xy[:, 0].max() < clear.xy[:, 0].max() - 25

    def test_without_a_clock_only_the_unknown_itself_is_left_out(self) -> None:
        traces = pd.DataFrame({"trace_id": 0, "x": np.linspace(905, 995, 10), "y": 1.0})
        observations = observe_trips(fleet_from_tables(traces, crs=UTM, keep_crs=True), step=10.0)
        assert np.isnan(observations.seconds).all()
        assert len(observations.trip) == 10


class TestPruning:
    lines = ([(0, 0), (90, 0)], [(90, 0), (180, 0)], [(90, 0), (90, 90)])

    def test_two_runs_in_one_direction_keep_a_segment(self) -> None:
        graph = graph_of(*self.lines)
        at = [(0.0, 0.0)]
        runs = runs_of((0, True, at), (0, True, at), (1, True, at), (1, False, at), (2, False, at), (2, False, at))
        kept, rest = prune_segments(graph, runs, min_runs=2)
        assert len(kept.edges) == 1
        assert kept.edges[["length", "forward", "backward", "support"]].iloc[0].tolist() == [180.0, 0, 0, 2]
        assert rest.segment.tolist() == [0, 0, 0, 0]
        check_graph(kept)

    def test_nothing_left(self) -> None:
        graph = graph_of(*self.lines)
        kept, rest = prune_segments(graph, runs_of((0, True, [(0.0, 0.0)])), min_runs=2)
        assert len(kept.edges) == len(kept.nodes) == len(rest.segment) == 0


class TestCollapse:
    def test_errors_are_to_the_nearest_line(self) -> None:
        runs = runs_of((0, True, [(0.0, 3.0), (5.0, -4.0)]), (0, True, [(10.0, 1.0)]))
        lines = [np.array([[0.0, 0.0], [10.0, 0.0]]), np.array([[10.0, 1.0], [10.0, 9.0]])]
        np.testing.assert_allclose(run_errors(runs, np.array([0, 1]), lines), [np.sqrt(12.5), 0.0])

    def test_parallel_segment_becomes_a_loop_and_loops_stay(self) -> None:
        graph = graph_of([(0, 0), (30, 0)], [(0, 0), (15, 20), (30, 0)], [(30, 0), (200, 0)])
        none = runs_of((2, True, [(150.0, 0.0)]))
        collapsed = collapse_segments(graph, none, max_length=35.0, max_error=12.0)
        assert collapsed.edges[["u", "v"]].to_numpy().tolist() == [[0, 0], [0, 2]]
        check_graph(collapsed)

    def test_long_segments_are_not_tried(self) -> None:
        graph = graph_of([(0, 0), (60, 0)], [(60, 0), (120, 0)])
        none = runs_of((0, True, [(30.0, 0.0)]))
        assert len(collapse_segments(graph, none, max_length=50.0, max_error=12.0).edges) == 2


class TestRecipe:
    def test_crossroads_driven_by_three_trips_each_way(self, tmp_path: Path) -> None:
        east = [straight(900, y, 1300, y, 41) for y in (499.0, 500.0, 501.0)]
        north = [straight(x, 300, x, 700, 41) for x in (1099.0, 1100.0, 1101.0)]
        fleet = trips_of(*east, *north, straight(1200, 300, 1200, 480, 19))
        graph = build_biagioni(fleet, options=BiagioniOptions(last_runs=True), workspace=tmp_path / "work")
        check_graph(graph)
        assert sorted(graph.degrees()) == [1, 1, 1, 1, 4]
        crossing = graph.nodes.geometry[graph.degrees() == 4].iloc[0]
        assert np.hypot(crossing.x - 1100, crossing.y - 500) < 2.0
        assert set(graph.edges["support"]) == {3}
        assert graph.length == pytest.approx(800, abs=60)
        again = build_biagioni(fleet, options=BiagioniOptions(last_runs=True), workspace=tmp_path / "work")
        assert again.length == pytest.approx(graph.length)

    def test_carriageways_stay_apart_with_the_settings_for_fleet_data_only(self) -> None:
        drives = [straight(900, y + d, 1300, y + d, 41) for y in (500.0, 512.0) for d in (-0.5, 0.0, 0.5)]
        fleet = trips_of(*drives)
        assert build_biagioni(fleet, options=FLEET).length == pytest.approx(800, abs=60)
        published = build_biagioni(fleet, options=BiagioniOptions(last_runs=True))
        assert published.length == pytest.approx(400, abs=40)

    def test_one_trip_is_no_road(self) -> None:
        graph = build_biagioni(trips_of(straight(900, 500, 1300, 500, 41)))
        assert len(graph.edges) == len(graph.nodes) == 0

    def test_bad_options(self) -> None:
        with pytest.raises(OptionError, match="'wide'"):
            BiagioniOptions(sigma="wide")
        with pytest.raises(OptionError, match="blackout is -1"):
            BiagioniOptions(blackout=-1.0)
