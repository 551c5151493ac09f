"""A picture of the stages of a run."""

from __future__ import annotations

import logging
from pathlib import Path

from probe2road.draw.picture import Panel, write_filmstrip
from probe2road.fleet.contract import Fleet
from probe2road.io.graph_files import read_graph
from probe2road.raster.counts import rasterize
from probe2road.raster.grid import read_blocks, read_raster
from probe2road.run.stages import PROBABILITY, ROADS, SKELETON, VECTORIZED

__all__ = ["draw_stages"]

logger = logging.getLogger(__name__)

_MOST_PIXELS = 400_000_000  # of a picture of some inches


def draw_stages(folder: str | Path, fleet: Fleet, path: str | Path) -> None:
    """Draw the stages of a run from its workspace, side by side, as a PNG.

    Of an area that is too wide for it there is none, and a warning.

    Parameters
    ----------
    folder
        Workspace of a finished `build`.
    fleet
        The fleet it was built from.
    path
        The picture.

    Raises
    ------
    InputError
        If a stage is missing.
    """
    folder = Path(folder)
    _, grid = read_blocks(folder / PROBABILITY.file())
    if grid.rows * grid.cols > _MOST_PIXELS:
        logger.warning("%s is not drawn: the area has %s pixels", path, f"{grid.rows * grid.cols:,}")
        return
    probability, _ = read_raster(folder / PROBABILITY.file())
    skeleton, _ = read_raster(folder / SKELETON.file())
    traces = rasterize(fleet, grid)[0]
    panels = [
        Panel("Traces", traces, grid, f"{fleet.n_traces:,} traces, {len(fleet.traces):,} fixes"),
        Panel("Probability", probability[0], grid, "of a centreline"),
        Panel("Skeleton", skeleton[0].astype(bool), grid, f"{int(skeleton.sum()):,} pixels"),
        Panel("Graph", read_graph(folder / VECTORIZED.file())),
        Panel("Roads", read_graph(folder / ROADS.file())),
    ]
    write_filmstrip(panels, path)
