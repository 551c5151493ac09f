"""What the stages of one run leave behind, so that the next run can go on from there.

A workspace is a folder with one file per stage and the fingerprint of the fleet, options and weights that made them.
Files are written atomically, so whatever is there is complete. A folder with another fingerprint is emptied
of its stage files first: stages of two runs never mix. What the first stage made, which is most of the work, stays
where only options of later stages changed.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.errors import OutputError
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path, make_folder
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.raster.grid import Grid, read_raster, write_raster

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

__all__ = ["Workspace", "copy_first_stage", "fingerprint", "open_workspace"]

logger = logging.getLogger(__name__)


_MARK = "run.json"
_FIRST = ("1-", "window-")  # how the files of the first stage begin
_FORMAT = 3  # raised when what a stage writes changes


@dataclass(frozen=True)
class Workspace:
    """A folder for stage files; with no folder, nothing is kept and nothing is found."""

    folder: Path | None

    def write_raster(self, name: str, array: NDArray[Any], grid: Grid) -> None:
        """Keep a raster as ``NAME.tif``."""
        if self.folder is not None:
            write_raster(self.folder / f"{name}.tif", array, grid, names=[name])

    def read_raster(self, name: str, grid: Grid) -> NDArray[Any] | None:
        """Return the one band of a raster an earlier run kept on this grid, or None."""
        path = None if self.folder is None else self.folder / f"{name}.tif"
        if path is None or not path.exists():
            return None
        array, kept_grid = read_raster(path)
        if kept_grid.shape != grid.shape:
            return None
        logger.info("taking %s from an earlier run", path.name)
        return array[0]

    def write_graph(self, name: str, graph: RoadGraph) -> None:
        """Keep a graph as ``NAME.gpkg``."""
        if self.folder is not None:
            write_graph(graph, self.folder / f"{name}.gpkg")

    def read_graph(self, name: str) -> RoadGraph | None:
        """Return a graph an earlier run kept, or None."""
        path = None if self.folder is None else self.folder / f"{name}.gpkg"
        if path is None or not path.exists():
            return None
        logger.info("taking %s from an earlier run", path.name)
        return read_graph(path)

    def write_array(self, name: str, array: NDArray[Any]) -> None:
        """Keep an array as ``NAME.npz``, compressed: what is kept on the way is many times what is kept at the end."""
        if self.folder is not None:
            with atomic_path(self.folder / f"{name}.npz") as temporary:
                np.savez_compressed(temporary, array)

    def read_array(self, name: str) -> NDArray[Any] | None:
        """Return an array an earlier run kept, or None."""
        path = None if self.folder is None else self.folder / f"{name}.npz"
        if path is None or not path.exists():
            return None
        with np.load(path) as arrays:
            return np.asarray(arrays["arr_0"])

    def drop_arrays(self) -> None:
        """Remove the arrays, once a raster holds them all."""
        if self.folder is not None:
            for path in self.folder.glob("*.npz"):
                path.unlink()

    def write_record(self, name: str, record: dict[str, Any]) -> None:
        """Keep what a stage was configured with as ``NAME.json``."""
        if self.folder is not None:
            with atomic_path(self.folder / f"{name}.json") as temporary:
                temporary.write_text(json.dumps(record, indent=1))

    def read_record(self, name: str) -> dict[str, Any] | None:
        """Return a record an earlier run kept, or None."""
        path = None if self.folder is None else self.folder / f"{name}.json"
        return None if path is None or not path.exists() else json.loads(path.read_text())


def open_workspace(
    folder: str | Path | None,
    fleet: Fleet,
    options: DataclassInstance,
    *,
    weights: str | None = None,
    first: DataclassInstance | None = None,
) -> Workspace:
    """Open the workspace of a run, empty unless it belongs to the same fleet, options and weights.

    Parameters
    ----------
    folder
        Created where it does not exist; None for a workspace that keeps nothing.
    fleet, options
        What the run works on.
    weights
        Digest of the network's weights, if the run uses one.
    first
        The options that the first stage depends on. Its files stay where these, the fleet and the weights are the same.
        Without them all options count for all files.

    Raises
    ------
    OutputError
        If the folder has files in it but is not a workspace, or cannot be created.
    """
    if folder is None:
        return Workspace(None)
    folder = Path(folder)
    mark = {"format": _FORMAT, "fleet": fingerprint(fleet), "weights": weights}
    mark |= {"options": asdict(options), "first": asdict(first or options)}
    mark = json.loads(json.dumps(mark))  # tuples become lists, as they are in a file
    make_folder(folder)
    path = folder / _MARK
    if not path.exists() and any(folder.iterdir()):
        raise OutputError("the folder is not empty and not a workspace", where=folder, fix="name an empty folder")
    if path.exists() and (kept := json.loads(path.read_text())) != mark:
        stays = _FIRST if all(kept.get(name) == mark[name] for name in mark if name != "options") else ()
        logger.info("%s belongs to another run: %s", folder, "keeping its first stage" if stays else "starting afresh")
        for file in folder.iterdir():
            if file.suffix in (".tif", ".gpkg", ".npz", ".npy", ".json", ".png") and not file.name.startswith(stays):
                file.unlink()
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(mark, indent=1))
    return Workspace(folder)


def copy_first_stage(folder: Path, target: Path) -> None:
    """Start a workspace with the first stage of another, for a run that differs only in options of later stages.

    Parameters
    ----------
    folder
        Workspace whose first stage is complete.
    target
        The new workspace. `open_workspace` empties it if the run differs in more.
    """
    with atomic_path(target) as temporary:
        temporary.mkdir()
        for file in folder.iterdir():
            if file.name == _MARK or file.name.startswith(_FIRST):
                shutil.copy(file, temporary)


def fingerprint(fleet: Fleet) -> str:
    """Return a digest of everything in a fleet, which equal fleets share.

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
