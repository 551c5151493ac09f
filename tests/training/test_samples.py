from dataclasses import replace

import numpy as np
import pytest

from probe2road.benchmark.sets.recording import Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.errors import InputError, OptionError
from probe2road.fleet.contract import fleet_from_tables
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.fleet_writer import points_path
from probe2road.io.graph_files import read_graph
from probe2road.raster.counts import rasterize
from probe2road.raster.drawing import label_mask
from probe2road.raster.grid import Grid
from probe2road.training.samples import SampleOptions, draw_sample, square
from probe2road.training.scene import load_scene, make_scene, rows_around, save_scene
from probe2road.training.sources import TrainingSource, open_scene

DATASET = "interchange-diamond-1"
PLAIN = SampleOptions(
    size=128, rotation="none", flip=False, all_drives_share=1.0, least_points=1.0, busy_share=0.0, jitter=0.0
)


@pytest.fixture(scope="module")
def scene(sets):
    return open_scene(TrainingSource(DATASET), sets)


def place(scene):
    """A place on a road. Recorded coordinates are whole centimetres, so none lies on the border of two pixels."""
    return tuple((np.floor(scene.spots[len(scene.spots) // 2]) + 0.005).tolist())


def test_a_square_shows_what_build_would_see_and_what_the_benchmark_scores_against(scene, sets):
    recording = Recording(sets / DATASET)
    fleet = read_fleet(recording.modelled, points_path(recording.modelled))
    x, y = scene.origin + place(scene)
    grid = Grid(x - 64, y + 64, 1.0, 128, 128, fleet.crs)
    drawn = square(scene, place(scene), replace(PLAIN, label_width=1))
    assert drawn.counts.sum() > 1000
    assert np.array_equal(drawn.counts, rasterize(fleet, grid))
    label = label_mask(labelled_reference(read_graph(recording.reference)), grid)
    assert label.sum() > 100
    assert np.count_nonzero(drawn.label != label) <= 2


def test_the_same_seed_draws_the_same_sample(scene):
    one, same, other = (draw_sample(scene, np.random.default_rng(seed), SampleOptions(size=64)) for seed in (3, 3, 4))
    assert np.array_equal(one.counts, same.counts)
    assert np.array_equal(one.label, same.label)
    assert not np.array_equal(one.counts, other.counts)


def test_right_angles_and_flips_turn_the_square(scene):
    turned = replace(PLAIN, rotation="right_angles", flip=True)
    upright = draw_sample(scene, np.random.default_rng(7), PLAIN).label
    views = [np.rot90(view, k) for view in (upright, upright[:, ::-1]) for k in range(4)]
    for number in range(12):
        # The first draws of the generator choose the place, those after it the turn.
        sample = draw_sample(scene, FirstDraws(7, 2, number), turned)
        assert max(np.mean(sample.label == view) for view in views) > 0.97


class FirstDraws:
    """A generator that begins as one seed does and goes on as another."""

    def __init__(self, seed, draws, other):
        self.first, self.other, self.left = np.random.default_rng(seed), np.random.default_rng(other), draws

    def __getattr__(self, name):
        self.left -= 1
        return getattr(self.first if self.left >= 0 else self.other, name)


def test_a_label_needs_enough_of_the_drives_that_are_left(scene):
    all_drives = square(scene, place(scene), PLAIN)
    assert all_drives.label.any()
    assert not square(scene, place(scene), replace(PLAIN, min_drives=10_000)).label.any()
    few = replace(PLAIN, all_drives_share=0.0, least_drives=0.001)
    samples = [draw_sample(scene, np.random.default_rng(seed), few) for seed in range(20)]
    assert min(sample.counts[0].sum() for sample in samples) < all_drives.counts[0].sum() / 4
    thin = min(samples, key=lambda sample: sample.counts[0].max())
    assert thin.counts[0].max() < 4
    assert not thin.label.any()


def test_fewer_fixes_draw_nearly_the_same_line(scene):
    dense, sparse = (
        draw_sample(scene, np.random.default_rng(5), replace(PLAIN, intervals=(seconds,))).counts[0]
        for seconds in (0.0, 2.0)
    )
    assert sparse.sum() == pytest.approx(dense.sum(), rel=0.15)
    assert np.count_nonzero(sparse) == pytest.approx(np.count_nonzero(dense), rel=0.25)


def test_offsets_spread_the_drives(scene):
    calm, spread = (
        draw_sample(scene, np.random.default_rng(5), replace(PLAIN, offsets=(sigma,))).counts[0] for sigma in (0.0, 5.0)
    )
    assert np.count_nonzero(spread) > 1.1 * np.count_nonzero(calm)


def test_points_are_thinned_but_traces_are_not(scene):
    full, thinned = (
        draw_sample(scene, np.random.default_rng(5), replace(PLAIN, least_points=least)).counts for least in (1.0, 0.0)
    )
    assert np.array_equal(full[0], thinned[0])
    assert thinned[1:].sum() < full[1:].sum()


def test_rows_around_a_place_outside_are_none(scene):
    assert len(rows_around(scene.fix_cells, scene.table, (-1e5, 0.0), 50.0)) == 0


def test_a_scene_is_kept_and_made_anew_when_its_origin_changes(scene, tmp_path):
    save_scene(scene, tmp_path / "scene", about={"made": "today"})
    kept = load_scene(tmp_path / "scene", about={"made": "today"})
    assert np.array_equal(kept.point_xy, scene.point_xy)
    assert load_scene(tmp_path / "scene", about={"made": "tomorrow"}) is None
    assert load_scene(tmp_path / "none") is None


def test_your_own_fleet_and_reference(sets, tmp_path):
    recording = Recording(sets / DATASET)
    own = TrainingSource("mine", fleet=str(recording.modelled), reference=str(recording.reference))
    scene, truth = open_scene(own, tmp_path), open_scene(TrainingSource(DATASET), sets)
    drawn = square(scene, place(truth), replace(PLAIN, label_width=5))
    known = square(truth, place(truth), replace(PLAIN, label_width=1))
    assert drawn.label[known.label > 0].mean() > 0.9
    assert not drawn.counts[1:].any()


def test_clear_errors(sets, tmp_path):
    with pytest.raises(InputError, match="run probe2road benchmark prepare milan"):
        open_scene(TrainingSource("milan"), sets)
    with pytest.raises(OptionError, match="give the name of a data set"):
        TrainingSource("mine", fleet="drives.csv")
    with pytest.raises(OptionError, match="rotation is 'some'"):
        SampleOptions(rotation="some")
    fleet = fleet_from_tables(
        read_fleet(Recording(sets / DATASET).modelled).traces, crs="EPSG:32632", target_crs="EPSG:32632"
    )
    reference = read_graph(Recording(sets / DATASET).reference).to_crs("EPSG:32631")
    with pytest.raises(InputError, match="reproject one of them"):
        make_scene(fleet, reference, None)
