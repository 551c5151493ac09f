"""Small graphs, fleets and masks that tests sketch, in metres: `from sketches import fleet_of, graph_of`."""

from __future__ import annotations

from collections.abc import Hashable, Mapping

import numpy as np
import pandas as pd
import shapely
from numpy.typing import ArrayLike, NDArray

from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.raster.grid import Grid

UTM = "EPSG:32616"
EAST, NORTH = 446_000.0, 4_636_000.0  # a place in it, for what asks whether coordinates can be true


def graph_of(*lines: ArrayLike | shapely.LineString) -> RoadGraph:
    """Return the graph of lines given by their corners, which meet where they end.

    >>> graph_of([(0, 0), (100, 0)], [(100, 0), (100, 80)]).degrees().tolist()
    [1, 2, 1]
    """
    return graph_from_lines(list(lines), crs=UTM)


def fleet_of(
    *drives: ArrayLike | Mapping[Hashable, ArrayLike],
    interval: float = 1.0,
    points: pd.DataFrame | None = None,
    **columns: object,
) -> Fleet:
    """Return a fleet of drives given by their positions, (n, 2) or with heights (n, 3), one each `interval` seconds.

    Traces are called 0, 1 and so on; one mapping in place of the drives calls them by its keys. `columns` are further
    columns of the traces, of one value or one a fix.

    >>> fleet_of([(0, 0), (9, 0)], [(0, 5), (9, 5)], speed=9.0).traces[["trace_id", "x", "y", "speed"]]
       trace_id    x    y  speed
    0         0  0.0  0.0    9.0
    1         0  9.0  0.0    9.0
    2         1  0.0  5.0    9.0
    3         1  9.0  5.0    9.0
    >>> fleet_of({"a": [(0, 0, 30), (9, 0, 31)]}).traces["z"].tolist()
    [30.0, 31.0]
    """
    named = drives[0] if len(drives) == 1 and isinstance(drives[0], Mapping) else dict(enumerate(drives))
    tables = []
    for name, drive in named.items():
        places = np.asarray(drive, float)
        table = pd.DataFrame(places, columns=["x", "y", "z"][: places.shape[1]])
        tables.append(table.assign(trace_id=name, t=interval * np.arange(len(places))))
    traces = pd.concat(tables, ignore_index=True).assign(**columns)
    return fleet_from_tables(traces, points, crs=UTM, keep_crs=True)


def spaced(*corners: ArrayLike, spacing: float = 10.0, start: float = 0.0) -> NDArray[np.float64]:
    """Return positions each `spacing` metres along the line through the corners, the first after `start` metres.

    They have heights where the corners have, and the end of the line is among them where it falls on one.

    >>> spaced((0, 0), (20, 0), (20, 10)).tolist()
    [[0.0, 0.0], [10.0, 0.0], [20.0, 0.0], [20.0, 10.0]]
    """
    line = shapely.LineString(np.asarray(corners, float))
    along = np.arange(start, line.length + 1e-6, spacing)
    return shapely.get_coordinates(shapely.line_interpolate_point(line, along), include_z=line.has_z)


def grid_of(rows: int, cols: int) -> Grid:
    """Return a grid of pixels of 1 m.

    >>> grid_of(3, 5).shape
    (3, 5)
    """
    return Grid.from_bounds((EAST, NORTH, EAST + cols - 0.5, NORTH + rows - 0.5), crs=UTM)


def mask_of(*rows: str) -> NDArray[np.bool_]:
    """Return the mask that rows of characters draw, true at `#`.

    >>> mask_of(".#", "##").tolist()
    [[False, True], [True, True]]
    """
    return np.array([[pixel == "#" for pixel in row] for row in rows])
