"""Scenes: fleet data and roads stored so that any square of them can be read in milliseconds.

Strategy: fixes, semantic points and reference edges become flat arrays, sorted by square cells of the plane where
they have no other order. A fetch reads the few runs of rows that belong to the cells around a place. Which drives
passed an edge is kept edge by edge, so that labels follow when drives are left out. The arrays are files that are
mapped into memory: several training runs share them, and a scene larger than memory works.
"""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.crs import require_same_crs
from probe2road.errors import InputError
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path

__all__ = ["CELL", "Scene", "load_scene", "make_scene", "rows_around", "save_scene"]

logger = logging.getLogger(__name__)

CELL = 100.0  # m, side of the cells

_FORMAT = 1  # raised when the arrays change
_ABOUT = "scene.json"


@dataclass(frozen=True)
class Scene:
    """Flat arrays of one area; coordinates in metres from its origin.

    Letters: f fixes, p semantic points, k cells, e edges, v vertices, m pairs of an edge and a drive on it.
    """

    fix_xyz: NDArray[np.float32]  # (f, 3) in driving order; z is 0 where it is not known
    fix_time: NDArray[np.float32]  # (f,) s since the first fix of the drive; its number where there is no clock
    fix_drive: NDArray[np.int32]  # (f,) number of the drive, from 0
    fix_rows: NDArray[np.int32]  # (f,) rows of the fixes, cell by cell
    fix_cells: NDArray[np.int64]  # (k + 1,) where each cell begins in fix_rows
    point_xy: NDArray[np.float32]  # (p, 2) cell by cell
    point_kind: NDArray[np.uint8]  # (p,) position in POINT_KINDS
    point_drive: NDArray[np.int32]  # (p,)
    point_cells: NDArray[np.int64]  # (k + 1,) where each cell begins
    vertex_xy: NDArray[np.float32]  # (v, 2) of the reference edges
    vertex_edge: NDArray[np.int32]  # (v,) row of the edge
    edge_starts: NDArray[np.int64]  # (e + 1,) where each edge begins in edge_drives
    edge_drives: NDArray[np.int32]  # (m,)
    spots: NDArray[np.float32]  # (s, 2) places along driven edges, for the centres of samples, every 10 m
    spot_edge: NDArray[np.int32]  # (s,) the edge of each
    spot_busy: NDArray[np.bool_]  # (s,) whether another edge meets or crosses nearby
    table: NDArray[np.int64]  # (2,) rows and columns of the table of cells
    origin: NDArray[np.float64]  # (2,) m in the CRS of the fleet

    @property
    def n_drives(self) -> int:
        """Return the number of drives."""
        return int(self.fix_drive.max()) + 1 if len(self.fix_drive) else 0


def make_scene(
    fleet: Fleet, reference: RoadGraph, driven: pd.DataFrame, *, area: shapely.Geometry | None = None
) -> Scene:
    """Make a scene from fleet data and reference edges.

    Parameters
    ----------
    fleet
        Traces and points.
    reference
        Centrelines in the same CRS.
    driven
        Which drive passed which edge: columns ``trace_id`` and ``edge`` (id in the reference).
    area
        Where centres of samples may lie; everywhere if None.

    Returns
    -------
    Scene

    Raises
    ------
    CRSError
        If fleet and reference are in different CRS.
    InputError
        If there are no fixes, or no road within the area.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> table = pd.DataFrame({"trace_id": 7, "t": range(9), "x": np.arange(9.0) * 25, "y": 0.0})
    >>> fleet = fleet_from_tables(table, crs="EPSG:32616", keep_crs=True)
    >>> reference = graph_from_lines([[(0, 0), (200, 0)]], crs="EPSG:32616")
    >>> scene = make_scene(fleet, reference, pd.DataFrame({"trace_id": [7], "edge": [0]}))
    >>> near = scene.fix_rows[rows_around(scene.fix_cells, scene.table, (30, 0), 40)]
    >>> scene.n_drives, len(scene.spots), np.sort(near).tolist()
    (1, 20, [0, 1, 2, 3])
    """
    require_same_crs(fleet.crs, reference.crs, where="make_scene", what=("the traces are", "the reference is"))
    if fleet.traces.empty:
        raise InputError("no fixes, so there is nothing to learn from", where="fleet")
    left, bottom, right, top = fleet.bounds
    origin = np.array([np.floor(left / CELL), np.floor(bottom / CELL)]) * CELL
    cols, rows = (np.floor((np.array([right, top]) - origin) / CELL)).astype(np.int64) + 1
    table = np.array([rows, cols])
    fixes = _fixes(fleet, origin, table)
    points = _points(fleet, origin, table)
    roads = _roads(reference, driven, fleet.ids, origin, area)
    if not len(roads["spots"]):
        raise InputError("no road within the area, so there is nothing to learn", where="reference")
    scene = Scene(**fixes, **points, **roads, table=table, origin=origin)
    logger.info(
        "scene of %d drives, %d fixes, %d points, %.0f km of driven road",
        scene.n_drives, len(scene.fix_drive), len(scene.point_kind), len(scene.spots) / 100,
    )  # fmt: skip
    return scene


def save_scene(scene: Scene, folder: str | Path, *, about: dict[str, Any] | None = None) -> None:
    """Write the arrays of a scene to a folder, which is complete once its ``scene.json`` exists.

    Parameters
    ----------
    scene
        What to write.
    folder
        Created where it does not exist.
    about
        Kept in ``scene.json``: what it was made from.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _ABOUT).unlink(missing_ok=True)
    for entry in fields(scene):
        with atomic_path(folder / f"{entry.name}.npy") as temporary, temporary.open("wb") as file:
            np.save(file, getattr(scene, entry.name))
    with atomic_path(folder / _ABOUT) as temporary:
        temporary.write_text(json.dumps({"format": _FORMAT, **(about or {})}, indent=1), encoding="utf-8")


def load_scene(folder: str | Path, *, about: dict[str, Any] | None = None) -> Scene | None:
    """Map a scene from a folder into memory.

    Returns
    -------
    Scene or None
        None where there is no complete scene, or ``about`` is given and it was made from something else.
    """
    folder = Path(folder)
    try:
        kept = json.loads((folder / _ABOUT).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    if kept.pop("format", None) != _FORMAT or (about is not None and kept != json.loads(json.dumps(about))):
        return None
    return Scene(**{entry.name: np.load(folder / f"{entry.name}.npy", mmap_mode="r") for entry in fields(Scene)})


def rows_around(
    starts: NDArray[np.int64], table: NDArray[np.int64], centre: tuple[float, float], reach: float
) -> NDArray[np.int64]:
    """List the rows of all cells that a square of half side ``reach`` (m) around a place touches; ascending.

    Parameters
    ----------
    starts
        Where each cell begins, row by row of the table of cells.
    table
        Rows and columns of that table.
    centre
        ``(x, y)`` from the scene's origin; may lie outside.
    reach
        Half the side of the square.
    """
    rows, cols = int(table[0]), int(table[1])
    low_col, low_row = (max(int(np.floor((c - reach) / CELL)), 0) for c in centre)
    high_col = min(int(np.floor((centre[0] + reach) / CELL)), cols - 1)
    high_row = min(int(np.floor((centre[1] + reach) / CELL)), rows - 1)
    if high_col < low_col or high_row < low_row:
        return np.zeros(0, np.int64)
    lines = range(low_row, high_row + 1)
    return np.concatenate([np.arange(starts[i * cols + low_col], starts[i * cols + high_col + 1]) for i in lines])


def _fixes(fleet: Fleet, origin: NDArray[np.float64], table: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Return the arrays of the fixes."""
    traces = fleet.traces
    xy = traces[["x", "y"]].to_numpy() - origin
    drive = fleet.owner.astype(np.int32)
    first = fleet.starts[:-1][drive]
    time = traces["t"].to_numpy(dtype="datetime64[ns]")
    seconds = (time - time[first]) / np.timedelta64(1, "s")
    order, starts = _by_cell(xy, table)
    return {
        "fix_xyz": np.column_stack([xy, np.nan_to_num(traces["z"].to_numpy())]).astype(np.float32),
        "fix_time": np.where(np.isnan(seconds), np.arange(len(xy)) - first, seconds).astype(np.float32),
        "fix_drive": drive,
        "fix_rows": order.astype(np.int32),
        "fix_cells": starts,
    }


def _points(fleet: Fleet, origin: NDArray[np.float64], table: NDArray[np.int64]) -> dict[str, NDArray[Any]]:
    """Return the arrays of the semantic points; points far from all traces go to a cell where no window finds them."""
    xy = (fleet.points[["x", "y"]].to_numpy() - origin).astype(np.float32)
    order, starts = _by_cell(xy, table)
    return {
        "point_xy": xy[order],
        "point_kind": fleet.points["kind"].cat.codes.to_numpy(np.uint8)[order],
        "point_drive": fleet.ids.get_indexer(fleet.points["trace_id"]).astype(np.int32)[order],
        "point_cells": starts,
    }


def _by_cell(xy: NDArray[Any], table: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort places by cell: return the order ``(n,)``, stable within a cell, and the start of each cell ``(k + 1,)``."""
    rows, cols = int(table[0]), int(table[1])
    row = np.clip(np.floor(xy[:, 1] / CELL), 0, rows - 1).astype(np.int64)
    col = np.clip(np.floor(xy[:, 0] / CELL), 0, cols - 1).astype(np.int64)
    cell = row * cols + col
    starts = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=rows * cols))])
    return np.argsort(cell, kind="stable"), starts


_SPOT = 10.0  # m between the places along an edge where a sample may be centred
_NEARBY = 60.0  # m from a junction or a crossing that makes a spot busy


def _roads(
    reference: RoadGraph,
    driven: pd.DataFrame,
    ids: pd.Index,
    origin: NDArray[np.float64],
    area: shapely.Geometry | None,
) -> dict[str, NDArray[Any]]:
    """Return the arrays of the reference edges and of the spots along them."""
    lines = reference.edges.geometry.to_numpy()
    xy, owner = shapely.get_coordinates(lines, return_index=True)
    pairs = driven.drop_duplicates(["trace_id", "edge"])
    drive, edge = ids.get_indexer(pairs["trace_id"]), reference.edges.index.get_indexer(pairs["edge"])
    known = (drive >= 0) & (edge >= 0)
    drive, edge = drive[known], edge[known]
    count = np.maximum(shapely.length(lines) // _SPOT, 1).astype(np.int64)
    spot_edge = np.repeat(np.arange(len(lines)), count)
    number = np.arange(len(spot_edge)) - np.repeat(np.cumsum(count) - count, count)
    spots = shapely.line_interpolate_point(lines[spot_edge], (number + 0.5) / count[spot_edge], normalized=True)
    chosen = np.bincount(edge, minlength=len(lines))[spot_edge] > 0
    if area is not None:
        shapely.prepare(area)
        chosen &= shapely.contains(area, spots)
    spots, spot_edge = spots[chosen], spot_edge[chosen]
    return {
        "vertex_xy": (xy - origin).astype(np.float32),
        "vertex_edge": owner.astype(np.int32),
        "edge_starts": np.concatenate([[0], np.cumsum(np.bincount(edge, minlength=len(lines)))]),
        "edge_drives": drive[np.argsort(edge, kind="stable")].astype(np.int32),
        "spots": (shapely.get_coordinates(spots) - origin).astype(np.float32).reshape(-1, 2),
        "spot_edge": spot_edge.astype(np.int32),
        "spot_busy": _busy(reference, lines, spots),
    }


def _busy(reference: RoadGraph, lines: NDArray[Any], spots: NDArray[Any]) -> NDArray[np.bool_]:
    """Tell which spots lie near a junction, or near a place where edges cross in plan."""
    busy = np.zeros(len(spots), bool)
    if not len(spots):
        return busy
    junctions = reference.nodes.geometry.to_numpy()[reference.degrees().to_numpy() >= 3]
    i, j = shapely.STRtree(lines).query(lines, predicate="crosses")
    crossings = shapely.get_parts(shapely.intersection(lines[i[i < j]], lines[j[i < j]]))
    busy[
        shapely.STRtree(spots).query(np.concatenate([junctions, crossings]), predicate="dwithin", distance=_NEARBY)[1]
    ] = True
    return busy
