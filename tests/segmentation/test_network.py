import logging
from dataclasses import replace

import numpy as np
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.raster.counts import fleet_grid, rasterize
from probe2road.raster.grid import Grid
from probe2road.recipe import BuildOptions, build
from probe2road.segmentation import probability
from probe2road.segmentation.mask import MaskOptions
from probe2road.segmentation.network import NetworkOptions, find_weights, network_segmenter, shipped_weights
from probe2road.segmentation.options import SegmentationOptions
from probe2road.segmentation.tiling import segment_raster
from probe2road.segmentation.weights import read_weights
from sketches import UTM, fleet_of

GNSS = ("traces",)


def crossing(*, points=False, n=8):
    """A fleet on two streets of 800 m that cross, eight drives each, a fix every 15 m."""
    rng = np.random.default_rng(0)
    at = np.arange(0.0, 800.0, 15.0)
    drives = []
    for number in range(2 * n):
        along, across = at, np.full(len(at), 400.0 + rng.normal(0, 1.0))
        x, y = (along, across) if number % 2 else (across, along)
        drives.append(np.stack([446000 + x, 4636000 + y], axis=1))
    fleet = fleet_of(*drives)
    seen = fleet.traces[["trace_id", "t", "x", "y"]].assign(z=0.0, kind="lane_marking")
    return fleet_of(*drives, points=seen) if points else fleet


@pytest.fixture(scope="module")
def fleet():
    return crossing()


def options(path, **changes):
    return BuildOptions(
        segmentation=SegmentationOptions(
            segmenter="network", network=NetworkOptions(weights=str(path), threads=1, **changes)
        ),
        refine=False,
    )


def test_a_crossing_comes_out(fleet, write_weights):
    graph = build(fleet, options=options(write_weights(GNSS)))
    assert sorted(graph.degrees()) == [1, 1, 1, 1, 4]
    assert graph.length == pytest.approx(4 * 400, abs=40)


def test_tiles_agree_with_the_whole(fleet, write_weights):
    grid, weights = fleet_grid(fleet), read_weights(write_weights())
    counts = rasterize(fleet, grid)
    tiled, whole = (
        segment_raster(network_segmenter(weights, grid, NetworkOptions(threads=1, **cut)), counts, grid)
        for cut in ({"tile": 128, "overlap": 0.5}, {"tile": 1024, "overlap": 0.0})
    )
    assert whole.max() > 0.9
    # This network looks 2 pixels far, so what it sees differs only where tiles begin and end.
    rows, cols = ((np.arange(length) - 32) % 64 for length in grid.shape)
    inside = np.logical_and.outer((rows >= 2) & (rows < 62), (cols >= 2) & (cols < 62))
    # Far from all traces it says 0.002, where tiles that are never looked at say 0.
    np.testing.assert_allclose(*(np.maximum(array[inside], 0.01) for array in (tiled, whole)), atol=1e-5)


def test_a_run_goes_on_where_it_stopped(fleet, write_weights, tmp_path, monkeypatch):
    chosen = options(write_weights(GNSS))
    whole = build(fleet, options=chosen)
    calls, predict = [], probability.predict_window

    def counting(segmenter, window, counts, grid):
        calls.append(window)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return predict(segmenter, window, counts, grid)

    monkeypatch.setattr("probe2road.segmentation.probability.predict_window", counting)
    with pytest.raises(KeyboardInterrupt):
        build(fleet, options=chosen, workspace=tmp_path / "work")
    assert len(list((tmp_path / "work").glob("1-window-*.npz"))) == 4
    graph = build(fleet, options=chosen, workspace=tmp_path / "work")
    assert calls[4] == calls[5]
    assert len(calls) - 1 == len(set(calls)) > 8
    assert graph.edges.geometry.geom_equals_exact(whole.edges.geometry, 0.0).all()
    assert not list((tmp_path / "work").glob("*.npz"))


def test_other_weights_in_the_same_file_start_a_run_afresh(fleet, write_weights, tmp_path, caplog):
    chosen = options(write_weights(GNSS))
    build(fleet, options=chosen, workspace=tmp_path / "work")
    write_weights(GNSS, threshold=0.4)
    with caplog.at_level(logging.INFO):
        build(fleet, options=chosen, workspace=tmp_path / "work")
    assert "starting afresh" in caplog.text


@pytest.mark.parametrize(("points", "name"), [(True, "gnss-vision.onnx"), (False, "gnss.onnx")])
def test_the_shipped_weights_suit_the_fleet(points, name, write_weights, monkeypatch, tmp_path):
    (tmp_path / "weights").mkdir()
    for channels, file in ((GNSS, "gnss.onnx"), (("traces", "lane_markings", "road_boundaries"), "gnss-vision.onnx")):
        write_weights(channels, file=f"weights/{file}")
    monkeypatch.setattr("importlib.resources.files", lambda package: tmp_path)
    weights = find_weights(crossing(points=points, n=1), NetworkOptions())
    assert weights.path.name == name


def test_an_installation_without_weights_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr("importlib.resources.files", lambda package: tmp_path)
    with pytest.raises(InputError, match=r'gnss\.onnx: this installation has no weights; .*segmenter="density"'):
        shipped_weights(points=False)


def test_weights_that_look_at_points_need_points(fleet, write_weights):
    with pytest.raises(InputError, match="looks at traces, lane_markings, road_boundaries, and the fleet has no sem"):
        build(fleet, options=options(write_weights()))


def test_weights_for_traces_serve_fleets_with_points(write_weights):
    assert (
        find_weights(crossing(points=True, n=1), NetworkOptions(weights=str(write_weights(GNSS)))).info.channels == GNSS
    )


def test_weights_that_look_at_an_unknown_channel_are_refused(fleet, write_weights):
    with pytest.raises(InputError, match=r'weights\.onnx: no raster has the channels heading; use segmenter="density"'):
        build(fleet, options=options(write_weights(("traces", "heading"))))


def test_a_raster_with_too_few_channels_is_refused(fleet, write_weights):
    grid = fleet_grid(fleet)
    segmenter = network_segmenter(read_weights(write_weights()), grid, NetworkOptions(threads=1))
    with pytest.raises(InputError, match="the raster has 1 channels, the network wants traces, lane_markings, road"):
        segment_raster(segmenter, rasterize(fleet, grid)[:1], grid)


def test_another_resolution_is_refused(fleet, write_weights):
    coarse = options(write_weights(GNSS))
    with pytest.raises(OptionError, match=r"pixels of 1\.0 m, the raster has 0\.5 m; use resolution=1\.0"):
        build(fleet, options=replace(coarse, segmentation=replace(coarse.segmentation, resolution=0.5)))


def test_an_all_zero_raster_has_no_roads(fleet, write_weights):
    grid = fleet_grid(fleet)
    segmenter = network_segmenter(read_weights(write_weights()), grid, NetworkOptions(threads=1))
    assert not segment_raster(segmenter, np.zeros((3, *grid.shape), np.uint32), grid).any()


def test_options_take_precedence_over_the_model(write_weights):
    grid = Grid(446000.0, 4636000.0, 1.0, 64, 64, crossing(n=1).crs)
    weights = read_weights(write_weights(threshold=0.4, seed_threshold=0.6))
    own = network_segmenter(weights, grid)
    assert (own.threshold, own.seed_threshold, own.window, own.halo, own.blend) == (0.4, 0.6, 192, 32, True)
    assert own.parameters["model"] == "blur"
    other = network_segmenter(weights, grid, NetworkOptions(tile=512, overlap=0.25))
    assert (other.window, other.halo) == (384, 64)
    assert MaskOptions().of(own) == (0.4, 0.6)
    assert MaskOptions(threshold=0.7).of(own) == (0.7, 0.7)
    assert MaskOptions(seed_threshold=0.8).of(own) == (0.4, 0.8)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"device": "tpu"}, "NetworkOptions: device is 'tpu'; use cpu or cuda"),
        ({"overlap": 1.0}, "overlap is 1.0"),
        ({"overlap": -0.5}, "overlap is -0.5"),
        ({"threads": 0}, "threads is 0"),
        ({"tile": 0}, "tile is 0"),
        ({"tile": 1000}, "model blur: a tile of 1000 px does not suit a stride of 32 px"),
    ],
)
def test_options_that_mean_nothing_are_refused(changes, message, fleet, write_weights):
    with pytest.raises(OptionError, match=message):
        network_segmenter(read_weights(write_weights()), fleet_grid(fleet), NetworkOptions(**changes))


def test_a_network_that_is_asked_four_times_sees_no_direction():
    grid = Grid(446000.0, 4636512.0, 1.0, 512, 512, UTM)
    counts = np.random.default_rng(3).poisson(0.02, (1, 512, 512)).astype(np.uint32)
    counts[0, 250:260, 40:] += 9
    weights = read_weights(shipped_weights(points=False))
    for turns, alike in ((1, False), (4, True)):
        segmenter = network_segmenter(weights, grid, NetworkOptions(turns=turns, threads=1))
        upright, turned = (segmenter.predict(np.rot90(counts, k, (1, 2)), grid) for k in (0, 1))
        assert upright.max() > 0.5
        assert np.allclose(np.rot90(upright), turned, atol=1e-4) == alike


def test_more_than_four_right_angles_are_refused():
    for turns in (0, 5):
        with pytest.raises(OptionError, match=f"turns is {turns}"):
            NetworkOptions(turns=turns)
