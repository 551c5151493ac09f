"""Pictures for reports and documentation: the stages side by side, and a graph over its traces, as PNG."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.errors import InputError, OptionError
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path
from probe2road.raster.counts import rasterize, without_rare
from probe2road.raster.grid import Grid

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "BLUE",
    "DPI",
    "FRAME",
    "INK",
    "ORANGE",
    "PURPLE",
    "SOFT",
    "Panel",
    "draw_graph",
    "save_figure",
    "write_filmstrip",
]

logger = logging.getLogger(__name__)

Bounds = tuple[float, float, float, float]

_PANEL = 4.2  # inches, the longer side of a panel
# The look, which other figures share.
DPI = 150
INK, SOFT, FRAME = "#1f2933", "#616e7c", "#cbd2d9"
BLUE, ORANGE, PURPLE = "#1c7ed6", "#f08c00", "#7048e8"
_ORIGIN_COLORS = {"segmentation": BLUE, "gap": ORANGE, "reference": PURPLE}
_REFERENCE_COLOR = "#bfe3c6"
_DEAD_END_COLOR = "#c92a2a"


@dataclass(frozen=True)
class Panel:
    """One panel of a filmstrip.

    Attributes
    ----------
    title
        Name of the stage.
    content
        What to draw: a graph; or an array ``(rows, cols)``, where integers are counts (drawn with the
        logarithm), floats probabilities, and booleans a mask.
    grid
        Where an array lies; None for a graph.
    caption
        A line of numbers under the title; of a graph it is made here where it is empty.
    reference
        Graph to draw underneath as a broad pale band.
    """

    title: str
    content: RoadGraph | NDArray[Any]
    grid: Grid | None = None
    caption: str = ""
    reference: RoadGraph | None = None


def write_filmstrip(
    stages: Sequence[Panel], path: str | PathLike[str], *, bounds: Bounds | None = None, columns: int = 5
) -> None:
    """Draw the stages of a run side by side, all of the same area, with one scale.

    Parameters
    ----------
    stages
        At least one, in the order of the pipeline.
    path
        The PNG file.
    bounds
        ``(left, bottom, right, top)`` of the area in metres; everything there is if it is None.
    columns
        Panels in a row; further ones start another row.

    Raises
    ------
    OptionError
        If there is no stage, an array has no grid, or the columns are not positive.
    InputError
        If there is nothing to draw and no bounds.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> picture = Path(tempfile.mkdtemp()) / "strip.png"
    >>> write_filmstrip([Panel("Graph", graph_from_lines([[(0, 0), (100, 50)]], crs="EPSG:32616"))], picture)
    >>> picture.read_bytes()[1:4]
    b'PNG'
    """
    if not stages or columns < 1:
        raise OptionError("there is nothing to draw", where="filmstrip", fix="pass a stage, and a column or more")
    for stage in stages:
        if not isinstance(stage.content, RoadGraph) and stage.grid is None:
            raise OptionError(f"the array of {stage.title!r} has no grid", where="filmstrip", fix="pass its grid")
    area = bounds or _common_bounds([_stage_bounds(stage) for stage in stages])
    columns = min(columns, len(stages))
    figure, axes = _panels(area, -(-len(stages) // columns), columns, headroom=0.5)
    for axis in axes[len(stages) :]:
        axis.set_axis_off()
    for axis, stage in zip(axes, stages, strict=False):
        if stage.reference is not None:
            _draw_lines(axis, stage.reference.edges.geometry.to_numpy(), _REFERENCE_COLOR, 4.0, level=0)
        if isinstance(stage.content, RoadGraph):
            _draw_edges(axis, stage.content)
            caption = stage.caption or f"{len(stage.content.edges):,} edges, {stage.content.length / 1000:,.1f} km"
        else:
            _draw_array(axis, stage.content, stage.grid, area)
            caption = stage.caption
        axis.set_title(caption or " ", loc="left", fontsize=8.5, color=SOFT, pad=4)
        axis.annotate(
            stage.title, (0, 1), (0, 18), xycoords="axes fraction", textcoords="offset points",
            fontsize=11, fontweight="bold", color=INK,
        )  # fmt: skip
        _frame(axis, area)
    _scale_bar(axes[0], area)
    save_figure(figure, path)


def draw_graph(
    graph: RoadGraph,
    path: str | PathLike[str],
    *,
    fleet: Fleet | None = None,
    reference: RoadGraph | None = None,
    bounds: Bounds | None = None,
    title: str = "",
    width: float = 10.0,
    min_drives: int = 1,
) -> None:
    """Draw a graph over its traces, and over a reference graph if one is given.

    Parameters
    ----------
    graph
        The graph; edges are coloured by origin.
    path
        The PNG file.
    fleet
        Traces to draw underneath, in grey; in the graph's CRS or another.
    reference
        Graph to draw underneath as a broad pale band, so that what the two share and miss shows.
    bounds
        ``(left, bottom, right, top)`` of the area in metres; everything there is if it is None.
    title
        Heading.
    width
        Inches of the longer side.
    min_drives
        Traces that a pixel needs to be drawn.

    Raises
    ------
    InputError
        If there is nothing to draw and no bounds.
    """
    fleet = fleet if fleet is None or fleet.crs == graph.crs else fleet.to_crs(graph.crs)
    reference = reference if reference is None else reference.to_crs(graph.crs)
    shown = [graph.bounds, *([fleet.bounds] if fleet is not None and len(fleet.traces) else [])]
    area = bounds or _common_bounds([*shown, *([reference.bounds] if reference is not None else [])])
    figure, (axis,) = _panels(area, 1, 1, side=width, headroom=0.4)
    handles = []
    if fleet is not None and len(fleet.traces):
        left, bottom, right, top = area
        resolution = max(right - left, top - bottom) / (width * DPI)
        grid = Grid.from_bounds(area, resolution=resolution, crs=graph.crs)
        counts = without_rare(rasterize(fleet, grid), grid, least=min_drives)
        _draw_array(axis, counts[0], grid, area)
        handles.append(("#8a97a6", 1.5, "traces"))
    if reference is not None:
        _draw_lines(axis, reference.edges.geometry.to_numpy(), _REFERENCE_COLOR, 5.0, level=0)
        handles.append((_REFERENCE_COLOR, 5.0, "reference"))
    _draw_edges(axis, graph, scale=1.3)
    handles += [
        (_ORIGIN_COLORS[origin], 1.8, origin) for origin in _ORIGIN_COLORS if (graph.edges["origin"] == origin).any()
    ]
    _legend(axis, handles)
    axis.set_title(title, loc="left", fontsize=12, fontweight="bold", color=INK)
    _frame(axis, area)
    _scale_bar(axis, area)
    save_figure(figure, path)


def save_figure(figure: Any, path: str | PathLike[str]) -> None:
    """Write a figure of matplotlib as PNG without metadata, so that equal pictures are equal files."""
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", facecolor="#ffffff", metadata={"Software": None})
    logger.info("wrote %s", path)


def _common_bounds(boxes: list[Bounds]) -> Bounds:
    """Return the box around boxes and a margin; boxes of empty graphs are NaN and are ignored."""
    known = np.array([box for box in boxes if np.isfinite(box).all()])
    if not len(known):
        raise InputError("there is nothing to draw", where="picture", fix="pass bounds")
    left, bottom = known[:, :2].min(axis=0)
    right, top = known[:, 2:].max(axis=0)
    margin = 0.03 * max(right - left, top - bottom, 10.0)
    return float(left - margin), float(bottom - margin), float(right + margin), float(top + margin)


def _stage_bounds(stage: Panel) -> Bounds:
    """Return the bounds of a graph, or of the pixels of an array that are not zero."""
    if isinstance(stage.content, RoadGraph):
        return stage.content.bounds
    rows, cols = (np.flatnonzero(stage.content.any(axis=axis)) for axis in (1, 0))
    if stage.grid is None or not len(rows):
        return (np.nan,) * 4
    part = stage.grid.window(int(rows[0]), int(cols[0]), int(np.ptp(rows)) + 1, int(np.ptp(cols)) + 1)
    return part.bounds


def _panels(area: Bounds, rows: int, columns: int, *, side: float = _PANEL, headroom: float) -> tuple[Any, list[Axes]]:
    """Return a figure of equal panels in the shape of the area, and its axes row by row."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    left, bottom, right, top = area
    longest = max(right - left, top - bottom)
    width, height = side * (right - left) / longest, side * (top - bottom) / longest
    width, height = max(width, 0.4 * side), max(height, 0.25 * side)  # a street from north to south needs a title too
    figure = Figure(figsize=(columns * (width + 0.2) + 0.2, rows * (height + headroom + 0.15) + 0.1), dpi=DPI)
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel().tolist()
    total_width, total_height = figure.get_size_inches()
    figure.subplots_adjust(
        left=0.2 / total_width,
        right=1 - 0.2 / total_width,
        bottom=0.15 / total_height,
        top=1 - headroom / total_height,
        wspace=0.2 / width,
        hspace=(headroom + 0.15) / height,
    )
    return figure, axes


def _draw_array(axis: Axes, array: NDArray[Any], grid: Grid | None, area: Bounds) -> None:
    """Draw counts, probabilities or a mask; thin structures stay visible at screen resolution."""
    from matplotlib.colors import LinearSegmentedColormap

    assert grid is not None
    left, bottom, right, top = area
    row, col = (int(index[0]) for index in grid.rowcol([left], [top]))
    last_row, last_col = (int(index[0]) for index in grid.rowcol([right], [bottom]))
    row, col = max(row, 0), max(col, 0)
    part = array[row : max(last_row + 1, row), col : max(last_col + 1, col)]
    if not part.size:
        return
    box = grid.window(row, col, *part.shape).bounds
    pixels = max(axis.bbox.width, axis.bbox.height)
    part = _reduced(part, int(np.ceil(max(part.shape) / pixels)))
    values = np.log1p(part.astype(np.float64)) if part.dtype.kind in "ui" else part.astype(np.float64)
    # Zero is transparent, so that what lies below stays visible.
    shades = ["#24344700", "#243447"] if part.dtype.kind == "b" else ["#b9c4d000", "#b9c4d0", "#12304f"]
    ramp = LinearSegmentedColormap.from_list("ink", shades)
    peak = 1.0 if part.dtype.kind in "fb" else float(np.quantile(values[values > 0], 0.99)) if values.any() else 1.0
    extent = (box[0], box[2], box[1], box[3])
    axis.imshow(values, cmap=ramp, vmin=0, vmax=peak, extent=extent, interpolation="antialiased", zorder=1)


def _reduced(array: NDArray[Any], factor: int) -> NDArray[Any]:
    """Shrink an array to its block maxima; the last block may be smaller."""
    rows, cols = (np.arange(0, size, factor) for size in array.shape)
    return np.maximum.reduceat(np.maximum.reduceat(array, rows, axis=0), cols, axis=1)


def _draw_edges(axis: Axes, graph: RoadGraph, *, scale: float = 1.0) -> None:
    """Draw edges by origin, junctions as dark dots and dead ends as red ones."""
    for origin, color in _ORIGIN_COLORS.items():
        part = graph.edges["origin"] == origin
        if part.any():
            lines = graph.edges.geometry[part].to_numpy()
            _draw_lines(axis, lines, color, 1.3 * scale, level=3)
    degree = graph.degrees().to_numpy()
    position = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    size = scale * float(np.clip(2000 / max(len(degree), 1), 1.5, 9.0))  # a city has too many nodes for large dots
    for kind, color in ((degree >= 3, INK), (degree <= 1, _DEAD_END_COLOR)):
        axis.scatter(position[kind, 0], position[kind, 1], s=size, c=color, linewidths=0, zorder=4)


def _draw_lines(axis: Axes, lines: NDArray[Any], color: str, width: float, *, level: int) -> None:
    """Draw lines; those with a higher level lie on top, and the raster has level 1."""
    from matplotlib.collections import LineCollection

    coordinates, owner = shapely.get_coordinates(lines, return_index=True)
    parts = np.split(coordinates, np.flatnonzero(np.diff(owner)) + 1)
    axis.add_collection(LineCollection(parts, colors=color, linewidths=width, capstyle="round", zorder=level))


def _legend(axis: Axes, entries: list[tuple[str, float, str]]) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], color=color, linewidth=width, label=label) for color, width, label in entries]
    if handles:
        axis.legend(
            handles=handles,
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(handles),
            borderaxespad=0.2,
            fontsize=9,
            frameon=False,
            labelcolor=INK,
        )


def _frame(axis: Axes, area: Bounds) -> None:
    """Show the area at equal scale, in a thin frame without ticks."""
    left, bottom, right, top = area
    axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[], facecolor="#ffffff")
    for spine in axis.spines.values():
        spine.set(color=FRAME, linewidth=0.8)


def _scale_bar(axis: Axes, area: Bounds) -> None:
    """Draw a bar of a round length, about a fifth of the width, at the lower left."""
    left, bottom, right, top = area
    fifth = (right - left) / 5
    power = 10.0 ** np.floor(np.log10(fifth))
    length = power * max(step for step in (1, 2, 5) if step * power <= fifth)
    x, y = left + 0.03 * (right - left), bottom + 0.04 * (top - bottom)
    label = f"{length / 1000:g} km" if length >= 1000 else f"{length:g} m"
    axis.plot([x, x + length], [y, y], color=INK, linewidth=2, solid_capstyle="butt", zorder=6)
    box = {"facecolor": "#ffffff", "edgecolor": "none", "alpha": 0.8, "pad": 1}
    axis.annotate(label, (x, y), (0, 5), textcoords="offset points", fontsize=8, color=INK, bbox=box, zorder=6)
