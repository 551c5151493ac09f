"""What a workspace keeps, whose it is, and what it never touches."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from probe2road.demo import demo_fleet
from probe2road.errors import OutputError
from probe2road.fleet.contract import Fleet
from probe2road.io.atomic import atomic_path
from probe2road.raster.grid import Grid
from probe2road.run.stages import DENSITY, PROBABILITY, ROADS, WINDOW
from probe2road.run.workspace import copy_segmentation, open_workspace, resumable
from sketches import graph_of

ROAD = graph_of([(0, 0), (100, 0)])
GRID = Grid.from_bounds((0, 0, 4, 2), crs=ROAD.crs)


@dataclass(frozen=True)
class Early:
    size: float = 1.0


@dataclass(frozen=True)
class Options:
    early: Early = Early()
    late: int = 1


@pytest.fixture(scope="module")
def fleet() -> Fleet:
    return demo_fleet(n_drives=2)


def fill(folder: Path, fleet: Fleet, options: Options) -> None:
    """Keep something of every kind."""
    with open_workspace(folder, fleet, options, segmentation=options.early) as work:
        work.write_raster(PROBABILITY, np.ones(GRID.shape, np.float32), GRID)
        work.write_record(DENSITY, {"bandwidth": 4.0})
        work.write_arrays(WINDOW, "0-0", probability=np.arange(3.0))
        work.write_graph(ROADS, ROAD)


def found(folder: Path, fleet: Fleet, options: Options) -> list[str]:
    """Name the stages that a run finds."""
    with open_workspace(folder, fleet, options, segmentation=options.early) as work:
        kept = {
            "probability": work.read_raster(PROBABILITY, GRID),
            "density": work.read_record(DENSITY),
            "window": work.read_arrays(WINDOW, "0-0"),
            "roads": work.read_graph(ROADS),
        }
    return [name for name, value in kept.items() if value is not None]


def test_the_same_run_finds_everything(tmp_path: Path, fleet: Fleet) -> None:
    fill(tmp_path / "work", fleet, Options())
    assert found(tmp_path / "work", fleet, Options()) == ["probability", "density", "window", "roads"]


def test_later_options_keep_the_probability_and_other_options_nothing(tmp_path: Path, fleet: Fleet) -> None:
    fill(tmp_path / "work", fleet, Options())
    assert found(tmp_path / "work", fleet, Options(late=2)) == ["probability", "density", "window"]
    assert found(tmp_path / "work", fleet, Options(early=Early(2.0))) == []
    assert sorted(file.name for file in (tmp_path / "work").iterdir()) == ["workspace.json", "workspace.lock"]


def test_a_file_of_another_run_is_as_good_as_absent(tmp_path: Path, fleet: Fleet) -> None:
    fill(tmp_path / "one", fleet, Options(late=1))
    fill(tmp_path / "two", fleet, Options(late=2))
    for name in ("7-roads.gpkg", "1-probability.tif"):
        (tmp_path / "one" / name).replace(tmp_path / "two" / name)
    assert found(tmp_path / "two", fleet, Options(late=2)) == ["probability", "density", "window"]


def test_only_files_of_stages_are_ever_removed(tmp_path: Path, fleet: Fleet) -> None:
    folder = tmp_path / "work"
    fill(folder, fleet, Options())
    others = ["reference.gpkg", "run.json", "stages.png", "notes.tif", ".hidden.json"]
    for name in others:
        (folder / name).write_text("mine")
    found(folder, fleet, Options(early=Early(3.0)))
    assert sorted(file.name for file in folder.iterdir()) == sorted([*others, "workspace.json", "workspace.lock"])


@pytest.mark.parametrize("mark", ["{}", "[]", '{"format": 2, "seed": 0}', "no JSON"])
def test_a_folder_with_another_mark_is_no_workspace(tmp_path: Path, fleet: Fleet, mark: str) -> None:
    (tmp_path / "run.json").write_text(mark)
    (tmp_path / "workspace.json").write_text(mark)
    with pytest.raises(OutputError, match=r"not a workspace: it holds run\.json"):
        open_workspace(tmp_path, fleet, Options())
    assert sorted(file.name for file in tmp_path.iterdir()) == ["run.json", "workspace.json"]


def test_a_second_run_is_told_who_holds_the_workspace(tmp_path: Path, fleet: Fleet) -> None:
    with open_workspace(tmp_path, fleet, Options()):
        with pytest.raises(OutputError, match=f"process {os.getpid()} on .* is working in this folder"):
            open_workspace(tmp_path, fleet, Options(late=2))
        assert json.loads((tmp_path / "workspace.json").read_text())["options"]["late"] == 1
    open_workspace(tmp_path, fleet, Options(late=2)).__exit__(None, None, None)


def die_holding(folder: Path, fleet: Fleet) -> None:
    open_workspace(folder, fleet, Options())
    with atomic_path(folder / "7-roads.gpkg") as temporary:
        temporary.write_text("half")
        os.kill(os.getpid(), signal.SIGKILL)


def test_the_lock_and_the_leftovers_of_a_killed_run_do_not_stay(tmp_path: Path, fleet: Fleet) -> None:
    killed = multiprocessing.get_context("spawn").Process(target=die_holding, args=(tmp_path / "work", fleet))
    (tmp_path / "work").mkdir()
    killed.start()
    killed.join()
    assert killed.exitcode == -signal.SIGKILL
    assert len(list((tmp_path / "work").glob(".7-roads.gpkg.*.p2r-part"))) == 1
    assert found(tmp_path / "work", fleet, Options()) == []
    assert sorted(file.name for file in (tmp_path / "work").iterdir()) == ["workspace.json", "workspace.lock"]


def test_a_run_killed_before_its_mark_blocks_nothing(tmp_path: Path, fleet: Fleet) -> None:
    (tmp_path / ".workspace.json.abcd").mkdir()
    assert found(tmp_path, fleet, Options()) == []
    assert sorted(file.name for file in tmp_path.iterdir()) == ["workspace.json", "workspace.lock"]


def test_a_result_is_returned_as_the_next_run_will_find_it(tmp_path: Path, fleet: Fleet) -> None:
    with open_workspace(tmp_path, fleet, Options()) as work:
        made = work.finish(ROADS, ROAD)
        kept = work.read_graph(ROADS)
    assert kept is not None
    assert made.edges.dtypes.to_dict() == kept.edges.dtypes.to_dict()
    assert made.edges.equals(kept.edges)


def test_a_copied_segmentation_is_found_by_a_run_that_differs_behind_it(tmp_path: Path, fleet: Fleet) -> None:
    fill(tmp_path / "one", fleet, Options())
    copy_segmentation(tmp_path / "one", tmp_path / "two")
    assert not (tmp_path / "two" / "7-roads.gpkg").exists()
    assert found(tmp_path / "two", fleet, Options(late=5)) == ["probability", "density", "window"]


def test_a_resumable_block_leaves_its_workspace_only_where_it_fails(tmp_path: Path) -> None:
    folders = []

    def work(output: Path, *, fails: bool) -> None:
        with resumable(output) as folder:
            folder.mkdir(exist_ok=True)
            folders.append(folder)
            if fails:
                raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work(tmp_path / "roads.gpkg", fails=True)
    assert folders[0].is_dir()
    work(tmp_path / "roads.gpkg", fails=False)
    assert folders[0] == folders[1]
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OutputError, match="does not exist"), resumable(tmp_path / "none" / "roads.gpkg"):
        pass
