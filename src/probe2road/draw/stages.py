"""A picture of the stages of a run."""

from __future__ import annotations

from pathlib import Path

from probe2road.draw.picture import Panel, write_filmstrip
from probe2road.fleet.contract import Fleet
from probe2road.io.graph_files import read_graph
from probe2road.raster.counts import rasterize
from probe2road.raster.grid import read_raster
from probe2road.run.stages import PROBABILITY, ROADS, SKELETON, VECTORIZED

__all__ = ["draw_stages"]


def draw_stages(folder: str | Path, fleet: Fleet, path: str | Path) -> None:
    """Draw the stages of a run from its workspace, side by side, as a PNG.

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
    probability, grid = read_raster(folder / PROBABILITY.file())
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
