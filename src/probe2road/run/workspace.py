"""The stored results of the stages of a run, from which the next run can continue.

A workspace is a folder with a mark of its own and the files of `probe2road.run.stages`; no other file in it is ever
touched. Files are written atomically, so whatever is there is complete, and each names the fingerprint of the fleet,
options and weights that made it: a file of another run is as good as absent. What the segmentation made, which is most
of the work, has a fingerprint without the options of later stages, and so stays where only these changed. One run at a
time holds a workspace.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import pandas as pd
from filelock import FileLock
from numpy.typing import NDArray

from probe2road.errors import OutputError
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path, discard, is_workshop, make_folder, sweep_leftovers
from probe2road.io.graph_files import read_graph
from probe2road.io.graph_readers import read_note
from probe2road.io.graph_writers import write_geopackage
from probe2road.raster.blocks import Blocks
from probe2road.raster.grid import Grid, read_blocks, read_tag, write_raster
from probe2road.run.locks import holder, lock_folder
from probe2road.run.stages import Stage, stage_of

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["Workspace", "copy_segmentation", "fingerprint", "open_workspace", "resumable"]

logger = logging.getLogger(__name__)

_MARK, _LOCK = "workspace.json", "workspace.lock"
_RUN = "probe2road_run"  # name of the tag with the fingerprint of a run in its files
_FORMAT = 4  # increased when the content of the files changes


@dataclass(frozen=True)
class Workspace:
    """A folder for the files of stages; without a folder, nothing is stored and nothing is found.

    Attributes
    ----------
    folder
        Folder of the files, or None.
    run, segmentation
        Fingerprints of all inputs of the run, and of those that its probability depends on.
    lock
        Held while the workspace is open.

    Examples
    --------
    >>> from probe2road.run.stages import ROADS
    >>> with Workspace() as work:
    ...     print(work.read_graph(ROADS))
    None
    """

    folder: Path | None = None
    run: str = ""
    segmentation: str = ""
    lock: FileLock | None = None

    def __enter__(self) -> Self:
        """Return the workspace, which is open already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Unlock the folder for other runs."""
        if self.lock is not None:
            self.lock.release()

    def write_raster(self, stage: Stage, array: NDArray[Any] | Blocks, grid: Grid) -> None:
        """Store a raster."""
        if self.folder is not None:
            tags = {_RUN: self._fingerprint(stage)}
            write_raster(self.folder / stage.file(), array, grid, names=[stage.name], tags=tags)

    def read_raster(self, stage: Stage, grid: Grid) -> Blocks | None:
        """Return the single band of a raster that an earlier run stored on this grid, or None."""
        path = self._kept(stage)
        if path is None or read_tag(path, _RUN) != self._fingerprint(stage):
            return None
        blocks, kept_grid = read_blocks(path)
        if kept_grid.shape != grid.shape:
            return None
        logger.info("taking %s from an earlier run", path.name)
        return blocks

    def write_graph(self, stage: Stage, graph: RoadGraph) -> None:
        """Store a graph."""
        if self.folder is not None:
            write_geopackage(graph, self.folder / stage.file(), note={_RUN: self._fingerprint(stage)})

    def read_graph(self, stage: Stage) -> RoadGraph | None:
        """Return a graph that an earlier run stored, or None."""
        path = self._kept(stage)
        if path is None or read_note(path, _RUN) != self._fingerprint(stage):
            return None
        logger.info("taking %s from an earlier run", path.name)
        return read_graph(path)

    def finish(self, stage: Stage, graph: RoadGraph) -> RoadGraph:
        """Store the result of a run, and return it as a continued run would return it: equal to the last byte."""
        self.write_graph(stage, graph)
        return graph if self.folder is None else read_graph(self.folder / stage.file())

    def write_arrays(self, stage: Stage, part: str, **arrays: NDArray[Any]) -> None:
        """Store arrays of one part, compressed, because intermediate results are many times larger than final ones."""
        if self.folder is not None:
            with atomic_path(self.folder / stage.file(part)) as temporary:
                named: dict[str, Any] = {_RUN: np.array(self._fingerprint(stage)), **arrays}
                np.savez_compressed(temporary, **named)

    def read_arrays(self, stage: Stage, part: str) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of one part that an earlier run stored, or None."""
        path = self._kept(stage, part)
        if path is None:
            return None
        with np.load(path) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
        return arrays if str(arrays.pop(_RUN, "")) == self._fingerprint(stage) else None

    def drop(self, stage: Stage) -> None:
        """Remove the files of a stage, once a later stage has stored what they contain."""
        if self.folder is not None:
            for path in self.folder.iterdir():
                if stage_of(path.name) is stage:
                    path.unlink()

    def write_record(self, stage: Stage, record: Mapping[str, Any]) -> None:
        """Store the configuration of a stage."""
        if self.folder is not None:
            with atomic_path(self.folder / stage.file()) as temporary:
                temporary.write_text(json.dumps({_RUN: self._fingerprint(stage), **record}, indent=1))

    def read_record(self, stage: Stage) -> dict[str, Any] | None:
        """Return a record that an earlier run stored, or None."""
        path = self._kept(stage)
        record = {} if path is None else dict(json.loads(path.read_text()))
        return record if record.pop(_RUN, None) == self._fingerprint(stage) else None

    def _kept(self, stage: Stage, part: str = "") -> Path | None:
        """Return the stored file of a stage, or None."""
        path = None if self.folder is None else self.folder / stage.file(part)
        return path if path is not None and path.exists() else None

    def _fingerprint(self, stage: Stage) -> str:
        return self.segmentation if stage.segmentation else self.run


def open_workspace(
    folder: str | Path | None,
    fleet: Fleet,
    options: DataclassInstance,
    *,
    weights: str | None = None,
    segmentation: DataclassInstance | None = None,
) -> Workspace:
    """Open the workspace of a run; it is closed at the end of the ``with`` block.

    Files of stages that belong to another fleet, other options or other weights are removed; so is what killed
    processes left behind. Everything else in the folder stays as it is.

    Parameters
    ----------
    folder
        Created where it does not exist; None for a workspace that keeps nothing.
    fleet, options
        What the run works on.
    weights
        Digest of the network's weights, if the run uses one.
    segmentation
        The options that decide the probability. Its files stay where these, the fleet and the weights are the same.
        Without them all options count for all files.

    Raises
    ------
    OutputError
        If the folder has files in it but is not a workspace, if another run holds it, or if it cannot be created.
    """
    if folder is None:
        return Workspace()
    folder = Path(folder)
    base = {"format": _FORMAT, "fleet": fingerprint(fleet), "weights": weights}
    mark: dict[str, Any] = {
        "program": "probe2road",
        "run": _digest({**base, "options": asdict(options)}),
        "segmentation": _digest({**base, "options": asdict(segmentation or options)}),
        "options": asdict(options),
        **holder(),
    }
    make_folder(folder)
    _require_ours(folder)
    lock = lock_folder(folder, _LOCK, mark=_MARK)
    sweep_leftovers(folder)
    for path in folder.iterdir():
        if _is_leftover(path) and not is_workshop(path):
            path.rmdir()
    kept = _read_mark(folder)
    if kept is not None and kept["run"] != mark["run"]:
        stays = kept["segmentation"] == mark["segmentation"]
        logger.info("%s belongs to another run: %s", folder, "keeping its probability" if stays else "starting afresh")
        for path in folder.iterdir():
            stage = stage_of(path.name)
            if stage is not None and not (stays and stage.segmentation):
                path.unlink()
    with atomic_path(folder / _MARK) as temporary:
        temporary.write_text(json.dumps(mark, indent=1, default=str))
    return Workspace(folder, mark["run"], mark["segmentation"], lock)


def _require_ours(folder: Path) -> None:
    """Refuse a folder that is not empty and not a workspace."""
    if _read_mark(folder) is not None:
        return
    foreign = sorted(path.name for path in folder.iterdir() if path.name != _LOCK and not _is_leftover(path))
    if foreign:
        fault = f"the folder is not empty and not a workspace: it holds {foreign[0]}"
        raise OutputError(fault, where=folder, fix="name an empty folder, or one that does not exist")


def _read_mark(folder: Path) -> dict[str, Any] | None:
    """Return the content of the mark file of a workspace, or None if the folder has none."""
    try:
        mark = json.loads((folder / _MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return mark if isinstance(mark, dict) and {"program", "run", "segmentation"} <= set(mark) else None


def _is_leftover(path: Path) -> bool:
    """Tell whether a path is left over from a killed run: a hidden folder of ours, or one with nothing in it."""
    return path.name.startswith(".") and path.is_dir() and (is_workshop(path) or not any(path.iterdir()))


@contextmanager
def resumable(output: str | Path) -> Iterator[Path]:
    """Give long work a hidden workspace beside its output, which is removed if the block ends without an error.

    An error or a kill leaves the workspace, so that the same call goes on from there.

    Parameters
    ----------
    output
        File that the work will write, in a folder that exists.

    Yields
    ------
    Path
        Folder for the argument ``workspace`` of a verb.

    Raises
    ------
    OutputError
        If the folder of the output does not exist.

    Examples
    --------
    >>> import tempfile
    >>> import probe2road as p2r
    >>> from probe2road.demo import demo_fleet
    >>> output = Path(tempfile.mkdtemp(), "roads.gpkg")
    >>> options = p2r.BuildOptions(segmentation=p2r.SegmentationOptions(segmenter="density"))
    >>> with resumable(output) as folder:
    ...     p2r.write_graph(p2r.build(demo_fleet(n_drives=20), options=options, workspace=folder), output)
    >>> [path.name for path in output.parent.iterdir()]
    ['roads.gpkg']
    """
    output = Path(output)
    if not output.parent.is_dir():
        raise OutputError(f"folder {output.parent} does not exist", where=output, fix="create it first")
    folder = output.parent / f".{output.name}.probe2road"
    yield folder
    discard(folder, output.name)


def copy_segmentation(folder: Path, target: Path) -> None:
    """Start a workspace with the probability of another one, for a run that differs only in options of later stages.

    Parameters
    ----------
    folder
        Workspace whose segmentation is complete.
    target
        The new workspace. `open_workspace` empties it if the run differs in more.
    """
    with atomic_path(target) as temporary:
        temporary.mkdir()
        for file in folder.iterdir():
            stage = stage_of(file.name)
            if file.name == _MARK or (stage is not None and stage.segmentation):
                shutil.copy(file, temporary)


def fingerprint(fleet: Fleet) -> str:
    """Return a digest of all data of a fleet; equal fleets have equal digests.

    Examples
    --------
    >>> from probe2road.demo import demo_fleet
    >>> fingerprint(demo_fleet(n_drives=2)) == fingerprint(demo_fleet(n_drives=2))
    True
    >>> fingerprint(demo_fleet(n_drives=2)) == fingerprint(demo_fleet(n_drives=3))
    False
    """
    digest = hashlib.blake2b(fleet.crs.to_wkt().encode(), digest_size=16)
    for table in (fleet.traces, fleet.points):
        for name in table:
            digest.update(name.encode())
            digest.update(pd.util.hash_pandas_object(table[name], index=False).to_numpy().tobytes())
    return digest.hexdigest()


def _digest(record: Mapping[str, Any]) -> str:
    """Return a digest of the inputs that determine a run."""
    return hashlib.blake2b(json.dumps(record, default=str).encode(), digest_size=16).hexdigest()
