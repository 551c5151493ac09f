import json
import shutil
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import numpy as np
import pytest

from probe2road.benchmark.sets.aligning import align_dataset
from probe2road.benchmark.sets.datasets import find_dataset
from probe2road.benchmark.sets.prepare import check_dataset, prepare_dataset
from probe2road.benchmark.sets.recording import Recording
from probe2road.benchmark.tables.source import Source, make_fleet
from probe2road.cli.main import main
from probe2road.errors import InputError
from probe2road.io.fleet_reader import read_fleet_files
from probe2road.training.sources import TrainingSource, open_scene

pytest.importorskip("gtsam", reason="alignment needs the extra 'align'")

NAME = "interchange-diamond-1"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one small data set, not aligned."""
    sets = tmp_path_factory.mktemp("sets")
    prepare_dataset(replace(find_dataset(NAME), drive_km=40.0), sets / NAME, data="")
    return sets


@pytest.fixture(scope="module")
def sets(prepared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same, aligned by the command."""
    folder = tmp_path_factory.mktemp("aligned") / "sets"
    shutil.copytree(prepared, folder)
    with pytest.raises(SystemExit) as done:
        main(["benchmark", "align", str(folder), "--name", NAME, "--quiet"])
    assert done.value.code in (None, 0)
    return folder


def test_aligned_drives_are_nearer_to_the_truth_than_raw_ones(sets: Path) -> None:
    recording = Recording(sets / NAME)
    truth = gpd.read_parquet(recording.poses).geometry.get_coordinates().to_numpy()
    error = {}
    for poses in ("raw", "aligned"):
        fleet = read_fleet_files(recording.traces(poses))
        assert len(fleet.traces) == len(truth)
        assert len(fleet.points) > 0
        error[poses] = np.sqrt(((fleet.traces[["x", "y"]].to_numpy() - truth) ** 2).mean())
    assert error["aligned"] < 0.8 * error["raw"]
    assert json.loads((recording.folder / "aligned.json").read_text())["rejected"] == 0


def test_the_data_set_itself_stays_as_it_was(sets: Path, prepared: Path) -> None:
    check_dataset(sets / NAME)
    new = {path.name for path in (sets / NAME).iterdir()} - {path.name for path in (prepared / NAME).iterdir()}
    assert new == {"aligned.parquet", "aligned.points.parquet", "aligned.json"}


def test_what_is_aligned_is_taken_as_it_is(sets: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("probe2road.benchmark.sets.aligning.align", None)
    assert align_dataset(sets / NAME) == Recording(sets / NAME).aligned


def test_comparisons_take_the_aligned_fleet(sets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("probe2road.benchmark.sets.aligning.align", None)
    source = Source(sets / NAME, tmp_path, "aligned")
    make_fleet(source)
    assert source.fleet_file == Recording(sets / NAME).aligned


def test_training_takes_it_and_says_what_to_run_without_it(sets: Path, prepared: Path) -> None:
    aligned, modelled = (open_scene(TrainingSource(NAME, data=data), sets) for data in ("aligned", "modelled"))
    assert aligned.fix_xyz.shape == modelled.fix_xyz.shape
    assert not np.array_equal(aligned.fix_xyz, modelled.fix_xyz)
    with pytest.raises(InputError, match=f"benchmark align .* --name {NAME}"):
        open_scene(TrainingSource(NAME, data="aligned"), prepared)


def test_a_folder_without_points_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no raw traces with points"):
        align_dataset(tmp_path)
