import logging
from dataclasses import replace

import numpy as np
import pytest

from probe2road.errors import InputError, OptionError, OutputError
from probe2road.fleet.contract import Fleet
from probe2road.graph.check import check_graph
from probe2road.graph.clean import CleanOptions
from probe2road.io.graph_files import read_graph
from probe2road.metrics import evaluate
from probe2road.raster.grid import read_raster
from probe2road.recipe import BuildOptions, build
from probe2road.run.workspace import fingerprint
from probe2road.segmentation.density import DensityOptions, density_probability
from probe2road.segmentation.options import SegmentationOptions
from sketches import fleet_of, graph_of, spaced

ORIGIN = np.array([446000.0, 4636000.0])
DENSITY = BuildOptions(
    segmentation=SegmentationOptions(segmenter="density")
)  # no weights: quick, and everything is decided by the data
CROSS = [[(0, 400), (400, 400)], [(400, 400), (800, 400)], [(400, 0), (400, 400)], [(400, 400), (400, 800)]]


def drives(*paths, n=8, noise=1.0, seed=0):
    """A fleet that drives each path n times, with a lateral offset per drive; a fix every 15 m."""
    rng = np.random.default_rng(seed)
    return fleet_of(*(ORIGIN + spaced(*path, spacing=15.0) + rng.normal(0, noise, 2) for path in paths * n))


@pytest.fixture(scope="module")
def crossing():
    return drives([(0, 400), (800, 400)], [(400, 0), (400, 800)])


def test_a_crossing_comes_out(crossing):
    graph = build(crossing, options=replace(DENSITY, refine=False))
    check_graph(graph)
    assert sorted(graph.degrees()) == [1, 1, 1, 1, 4]
    reference = graph_of(*(np.array(line) + ORIGIN for line in CROSS))
    scores = evaluate(graph, reference, metrics=["geo"])
    assert scores["f1"].iloc[0] > 0.9
    assert graph.edges["score"].between(0.5, 1).all()


def test_roads_that_nobody_turns_between_cross_without_a_node(crossing):
    graph = build(crossing, options=DENSITY)
    check_graph(graph)
    assert sorted(graph.degrees()) == [1, 1, 1, 1]
    assert graph.edges.geometry.iloc[0].crosses(graph.edges.geometry.iloc[1])


def test_roads_that_drives_turn_between_meet():
    turning = drives([(0, 400), (800, 400)], [(400, 0), (400, 800)], [(0, 400), (400, 400), (400, 800)])
    graph = build(turning, options=DENSITY)
    assert sorted(graph.degrees()) == [1, 1, 1, 1, 4]
    assert len(graph.turns) >= 3


def test_every_stage_is_kept_on_request(crossing, tmp_path):
    graph = build(crossing, options=DENSITY, workspace=tmp_path / "stages")
    probability, grid = read_raster(tmp_path / "stages" / "1-probability.tif")
    mask, _ = read_raster(tmp_path / "stages" / "2-mask.tif")
    skeleton, _ = read_raster(tmp_path / "stages" / "3-skeleton.tif")
    assert grid.crs == crossing.crs
    assert 0 < skeleton.sum() < mask.sum() < (probability > 0).sum()
    kept = read_graph(tmp_path / "stages" / "7-roads.gpkg")
    assert kept.edges.geometry.geom_equals_exact(graph.edges.geometry, 1e-6).all()
    assert len(read_graph(tmp_path / "stages" / "4-vectorized.gpkg").edges) == 4
    assert len(read_graph(tmp_path / "stages" / "5-cleaned.gpkg").edges) == 4


def test_an_interrupted_run_goes_on_where_it_stopped(crossing, tmp_path, monkeypatch):
    options = BuildOptions(segmentation=SegmentationOptions(segmenter="density", density=DensityOptions(bandwidth=4.5)))
    whole = build(crossing, options=options)
    monkeypatch.setattr("probe2road.segmentation.density._WINDOW", 256)
    windows = []

    def counting(counts, grid, options):
        if len(windows) == 3:
            windows.append("stop")
            raise KeyboardInterrupt
        windows.append(grid.bounds)
        return density_probability(counts, grid, options=options)

    monkeypatch.setattr("probe2road.segmentation.density.density_probability", counting)
    with pytest.raises(KeyboardInterrupt):
        build(crossing, options=options, workspace=tmp_path / "work")
    assert len(list((tmp_path / "work").glob("1-window-*.npz"))) == 3
    graph = build(crossing, options=options, workspace=tmp_path / "work")
    windows.remove("stop")
    assert len(windows) == len(set(windows)) > 3  # none was done twice
    assert not list((tmp_path / "work").glob("1-window-*.npz"))
    assert graph.edges.geometry.geom_equals_exact(whole.edges.geometry, 1e-6).all()


def test_the_bandwidth_is_estimated_once_for_all_parts_of_a_run(crossing, tmp_path, monkeypatch):
    estimates, predictions = [], []

    def estimating(fleet, grid, *, gaps):
        estimates.append(5.0)
        return 5.0

    def failing_at_first(counts, grid, options):
        predictions.append(options.bandwidth)
        if len(predictions) == 1:
            raise KeyboardInterrupt
        return density_probability(counts, grid, options=options)

    monkeypatch.setattr("probe2road.segmentation.density.estimate_bandwidth", estimating)
    monkeypatch.setattr("probe2road.segmentation.density.density_probability", failing_at_first)
    with pytest.raises(KeyboardInterrupt):
        build(
            crossing,
            options=replace(DENSITY, refine=False),
            workspace=tmp_path / "work",
        )
    build(
        crossing,
        options=replace(DENSITY, refine=False),
        workspace=tmp_path / "work",
    )
    (tmp_path / "work" / "7-roads.gpkg").unlink()
    build(
        crossing,
        options=replace(DENSITY, refine=False),
        workspace=tmp_path / "work",
    )
    assert estimates == [5.0]
    assert set(predictions) == {5.0}


def test_a_workspace_of_another_run_is_not_mixed_in(crossing, tmp_path, caplog):
    build(crossing, options=DENSITY, workspace=tmp_path / "work")
    with caplog.at_level(logging.INFO):
        other = build(
            crossing,
            options=BuildOptions(
                segmentation=SegmentationOptions(segmenter="density", density=DensityOptions(bandwidth=9.0))
            ),
            workspace=tmp_path / "work",
        )
    assert "starting afresh" in caplog.text
    again = build(
        crossing,
        options=BuildOptions(
            segmentation=SegmentationOptions(segmenter="density", density=DensityOptions(bandwidth=9.0))
        ),
    )
    assert other.edges.geometry.geom_equals_exact(again.edges.geometry, 1e-6).all()


def test_options_behind_the_segmentation_keep_its_probability(crossing, tmp_path, monkeypatch):
    build(crossing, options=DENSITY, workspace=tmp_path / "work")
    monkeypatch.setattr("probe2road.segmentation.probability.predict_window", None)  # nothing is predicted again
    other = replace(DENSITY, thinning="zhang_suen", clean=CleanOptions(dead_end=40.0))
    graph = build(crossing, options=other, workspace=tmp_path / "work")
    monkeypatch.undo()
    again = build(crossing, options=other)
    assert graph.edges.geometry.geom_equals_exact(again.edges.geometry, 1e-6).all()


def test_an_unknown_thinning_is_refused():
    with pytest.raises(OptionError, match="thinning is 'medial'"):
        BuildOptions(thinning="medial")


def test_a_folder_with_other_things_in_it_is_left_alone(crossing, tmp_path):
    (tmp_path / "thesis.tex").write_text("chapter 1")
    with pytest.raises(OutputError, match="not a workspace"):
        build(crossing, options=DENSITY, workspace=tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


def test_progress_is_reported_to_the_end(crossing):
    told = []
    build(crossing, options=DENSITY, progress=lambda *args: told.append(args))
    assert [stage for stage, done, total in told if done == total] == ["segmentation", "graph", "refinement"]


def test_a_finer_grid_gives_the_same_roads(crossing):
    coarse, fine = (
        build(crossing, options=BuildOptions(segmentation=SegmentationOptions(segmenter="density", resolution=r)))
        for r in (1.0, 0.5)
    )
    assert evaluate(fine, coarse, metrics=["geo"])["f1"].iloc[0] > 0.9


def test_a_single_fix_makes_no_road():
    graph = build(fleet_of([ORIGIN]), options=DENSITY)
    check_graph(graph)
    assert graph.edges.empty


def test_no_fixes_are_an_error(crossing):
    with pytest.raises(InputError, match="no fixes"):
        build(Fleet(crossing.traces.iloc[:0], crossing.points, crossing.crs), options=DENSITY)


def test_an_unknown_segmenter_is_an_error():
    with pytest.raises(OptionError, match="density"):
        BuildOptions(segmentation=SegmentationOptions(segmenter="magic"))


def test_the_fingerprint_sees_every_change(crossing):
    moved = Fleet(crossing.traces.assign(x=crossing.traces["x"] + 1e-6), crossing.points, crossing.crs)
    renamed = Fleet(crossing.traces.assign(trace_id=crossing.traces["trace_id"] + 1), crossing.points, crossing.crs)
    assert len({fingerprint(fleet) for fleet in (crossing, moved, renamed)}) == 3
