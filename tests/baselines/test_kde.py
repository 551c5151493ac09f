from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, label
from skimage.morphology import skeletonize

from probe2road.baselines.kde import KdeOptions, build_kde
from probe2road.baselines.volume import Pillars, count_voxels, dense_pillars, pillars_from_voxels
from probe2road.baselines.volume_graph import graph_from_volume, voxel_links
from probe2road.baselines.volume_skeleton import thin_volume
from probe2road.errors import OptionError
from probe2road.graph.check import check_graph
from probe2road.raster.grid import Grid
from sketches import UTM, fleet_of

Volume = NDArray[np.bool_]


def straight(x0: float, y0: float, x1: float, y1: float, z: float = 10.0) -> list[tuple[float, float, float]]:
    count = round(max(abs(x1 - x0), abs(y1 - y0)) / 10) + 1
    return [(x, y, z) for x, y in zip(np.linspace(x0, x1, count), np.linspace(y0, y1, count), strict=True)]


def pillars_of(volume: Volume) -> Pillars:
    return pillars_from_voxels(*np.argwhere(volume).T)


def volume_of(pillars: Pillars, shape: tuple[int, ...]) -> Volume:
    volume = np.zeros(shape, bool)
    volume[pillars.voxels()] = True
    return volume


class TestCounts:
    def test_trace_counts_once_where_its_segments_meet_and_again_when_it_returns(self) -> None:
        grid = Grid.from_bounds((900, 0, 910, 3), crs=UTM)
        there = [(902.5, 1.5, 1.0), (905.5, 1.5, 1.0), (908.5, 1.5, 1.0)]
        counts = count_voxels(fleet_of(there), grid, height=3.0)
        assert counts.count.tolist() == [1] * 7
        counts = count_voxels(fleet_of(there + there[-2::-1]), grid, height=3.0)
        assert counts.count.tolist() == [2, 2, 2, 2, 2, 2, 1]

    def test_fixes_without_altitude_are_left_out_unless_all_are(self) -> None:
        grid = Grid.from_bounds((900, 0, 910, 3), crs=UTM)
        some = fleet_of([(902.5, 1.5, 7.0), (904.5, 1.5, np.nan)])
        assert count_voxels(some, grid, height=3.0).key.tolist() == [grid.rowcol(902.5, 1.5)[0] * grid.cols + 2]
        none = fleet_of([(902.5, 1.5, np.nan), (904.5, 1.5, np.nan)])
        counts = count_voxels(none, grid, height=3.0)
        assert (counts.layers, counts.floor, len(counts.key)) == (1, 0.0, 3)


class TestDensity:
    @pytest.mark.parametrize(("traces", "threshold", "found"), [(1, 0.95, True), (1, 1.05, False), (3, 2.9, True)])
    def test_density_of_traces_on_one_line_is_their_number(self, traces: int, threshold: float, found: bool) -> None:
        fleet = fleet_of(*[straight(900, 50, 1000, 50)] * traces)
        counts = count_voxels(fleet, Grid.from_bounds(fleet.bounds, crs=UTM, margin=20), height=3.0)
        pillars = dense_pillars(counts, sigma=3.0, sigma_vertical=3.0, threshold=threshold)
        assert (len(pillars.row) > 0) == found

    def test_windows_leave_no_seam(self, monkeypatch: pytest.MonkeyPatch) -> None:
        fleet = fleet_of(straight(900, 20, 1060, 70, 5.0), straight(900, 60, 1060, 30, 14.0))
        counts = count_voxels(fleet, Grid.from_bounds(fleet.bounds, crs=UTM, margin=20), height=3.0)
        whole = dense_pillars(counts, sigma=2.0, sigma_vertical=2.0, threshold=0.5)
        monkeypatch.setattr("probe2road.baselines.volume._WINDOW", 23)
        parts = dense_pillars(counts, sigma=2.0, sigma_vertical=2.0, threshold=0.5)
        for one, other in zip(whole.voxels(), parts.voxels(), strict=True):
            np.testing.assert_array_equal(one, other)

    def test_voxels_far_above_others_are_left_out(self, caplog: pytest.LogCaptureFixture) -> None:
        place = np.zeros(2, np.int64)
        pillars = pillars_from_voxels(place, place, np.array([5, 67]))
        assert [part.tolist() for part in pillars.voxels()] == [[0], [0], [5]]
        assert "1 voxels lie more than 62 layers above" in caplog.text
        kept = pillars_from_voxels(place, place, np.array([5, 66]))
        assert kept.voxels()[2].tolist() == [5, 66]


class TestThinning:
    @pytest.mark.parametrize("seed", range(8))
    def test_equals_scikit_image(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        noise = gaussian_filter(rng.random((18, 23, 14)), rng.uniform(0.6, 2.2))
        volume = noise > np.quantile(noise, rng.uniform(0.3, 0.8))
        lee = skeletonize(np.pad(volume, 1), method="lee")[1:-1, 1:-1, 1:-1] > 0
        thinned = thin_volume(pillars_of(volume), guarded=False)
        np.testing.assert_array_equal(volume_of(thinned, volume.shape), lee)

    @pytest.mark.parametrize("seed", range(8))
    def test_parts_and_hollows_stay_as_many(self, seed: int) -> None:
        noise = gaussian_filter(np.random.default_rng(seed).random((18, 23, 14)), 0.8 + seed / 10)
        volume = np.pad(noise > np.quantile(noise, 0.5), 1)
        thinned = volume_of(thin_volume(pillars_of(volume)), volume.shape)
        assert not (thinned & ~volume).any()
        assert label(thinned, np.ones((3, 3, 3)))[1] == label(volume, np.ones((3, 3, 3)))[1]
        assert label(~thinned)[1] == label(~volume)[1]

    def test_published_method_eats_a_road_in_one_layer_up(self) -> None:
        road = pillars_of(np.ones((30, 4, 1), bool))
        assert len(thin_volume(road, guarded=False).voxels()[0]) <= 2
        assert len(thin_volume(road).voxels()[0]) >= 26

    @pytest.mark.parametrize("width", range(1, 7))
    def test_road_in_one_layer_becomes_a_line_that_keeps_its_length(self, width: int) -> None:
        for volume in (np.ones((width, 30, 1), bool), np.ones((30, width, 1), bool)):
            row, col, _ = thin_volume(pillars_of(volume)).voxels()
            assert 30 - width <= len(row) <= 30 + 2
            assert min(np.ptp(row), np.ptp(col)) <= 2

    def test_tunnel_stays_open(self) -> None:
        volume = np.ones((7, 7, 3), bool)
        volume[3, 3] = False
        ring = thin_volume(pillars_of(volume))
        one, other = voxel_links(*ring.voxels())
        assert (np.bincount(np.concatenate([one, other])) == 2).all()

    def test_empty(self) -> None:
        assert len(thin_volume(pillars_of(np.zeros((2, 2, 2), bool))).row) == 0


class TestGraph:
    grid = Grid.from_bounds((900, 0, 930, 30), crs=UTM)

    def test_step_across_a_cube_is_no_link_where_shorter_ones_lead(self) -> None:
        assert len(voxel_links(*np.array([[0, 0, 0], [1, 1, 1]]).T)[0]) == 1
        one, other = voxel_links(*np.array([[0, 0, 0], [1, 0, 0], [1, 1, 1]]).T)
        assert (one.tolist(), other.tolist()) == ([0, 1], [1, 2])

    def test_roads_above_each_other_do_not_meet(self) -> None:
        volume = np.zeros((31, 31, 8), bool)
        volume[15, 2:29, 1] = volume[2:29, 15, 6] = True
        graph = graph_from_volume(pillars_of(volume), self.grid, floor=0.0, height=3.0)
        check_graph(graph)
        assert sorted(graph.degrees()) == [1, 1, 1, 1]
        volume[15, 2:29, 1], volume[15, 2:29, 6] = False, True
        met = graph_from_volume(pillars_of(volume), self.grid, floor=0.0, height=3.0)
        assert sorted(met.degrees()) == [1, 1, 1, 1, 4]

    def test_ring_survives_simplification(self) -> None:
        volume = np.zeros((20, 20, 3), bool)
        angle = np.linspace(0, 2 * np.pi, 200)
        volume[np.rint(10 + 6 * np.sin(angle)).astype(int), np.rint(10 + 6 * np.cos(angle)).astype(int), 1] = True
        graph = graph_from_volume(thin_volume(pillars_of(volume)), self.grid, floor=0.0, height=3.0, tolerance=50.0)
        assert graph.edges[["u", "v"]].nunique(axis=1).tolist() == [1]
        assert graph.length == pytest.approx(2 * np.pi * 6, rel=0.1)

    def test_what_joins_two_levels_upright_is_no_edge(self) -> None:
        volume = np.zeros((31, 31, 8), bool)
        volume[15, 2:29, 1] = volume[2:29, 15, 5] = True
        volume[15, 15, 1:6] = True
        graph = graph_from_volume(pillars_of(volume), self.grid, floor=0.0, height=3.0)
        check_graph(graph)
        assert sorted(graph.degrees()) == [1, 1, 1, 1, 2, 2]

    def test_empty(self) -> None:
        graph = graph_from_volume(pillars_of(np.zeros((2, 2, 2), bool)), self.grid, floor=0.0, height=3.0)
        assert len(graph.edges) == len(graph.nodes) == 0


class TestRecipe:
    # Five drives on a road to the east, five across it to the north, 12 m above.
    drives = [straight(900, 500 + d, 1100, 500 + d, 10.0) for d in (-1, -0.5, 0, 0.5, 1)] + [
        straight(1000 + d, 400, 1000 + d, 600, 22.0) for d in (-1, -0.5, 0, 0.5, 1)
    ]

    def test_bridge_passes_over(self, tmp_path: Path) -> None:
        graph = build_kde(fleet_of(*self.drives), options=KdeOptions(threshold=2.0), workspace=tmp_path / "work")
        check_graph(graph)
        assert sorted(graph.degrees()) == [1, 1, 1, 1]
        assert graph.length == pytest.approx(400, abs=20)
        heights = sorted(line.coords[0][2] for line in graph.edges.geometry)
        assert np.abs(np.array(heights) - [10, 22]).max() <= 1.5
        again = build_kde(fleet_of(*self.drives), options=KdeOptions(threshold=2.0), workspace=tmp_path / "work")
        assert again.length == pytest.approx(graph.length)

    def test_without_altitudes_the_roads_cross(self) -> None:
        flat = fleet_of(*[[(x, y, np.nan) for x, y, _ in drive] for drive in self.drives])
        assert sorted(build_kde(flat, options=KdeOptions(threshold=2.0)).degrees()) == [1, 1, 1, 1, 4]

    def test_too_few_traces_give_no_road(self) -> None:
        assert len(build_kde(fleet_of(self.drives[0]), options=KdeOptions(threshold=2.0)).edges) == 0

    def test_bad_options(self) -> None:
        with pytest.raises(OptionError, match="sigma is 0"):
            KdeOptions(sigma=0.0)
