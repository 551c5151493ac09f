"""The main job on built-in data: a simulated fleet drives a cloverleaf, and its roads are built and scored."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pandas as pd

from probe2road.draw.stages import draw_stages
from probe2road.draw.view import view
from probe2road.fleet.contract import Fleet
from probe2road.io.atomic import make_folder
from probe2road.io.fleet_reader import read_fleet_files
from probe2road.io.fleet_writer import write_fleet
from probe2road.io.graph_files import write_graph
from probe2road.metrics import evaluate
from probe2road.recipe import build
from probe2road.run.progress import Progress
from probe2road.simulation.drawn.generate import generate_interchange
from probe2road.simulation.fleet_simulation import SimulatedFleet, simulate

__all__ = ["demo_fleet", "run_demo"]

logger = logging.getLogger(__name__)


def demo_fleet(*, n_drives: int = 200, seed: int = 1) -> Fleet:
    """Return simulated fleet data of a cloverleaf interchange.

    Parameters
    ----------
    n_drives
        How many vehicles pass.
    seed
        Decides the roads and the drives.

    Returns
    -------
    Fleet
        Traces and semantic points as recorded, with the errors of consumer vehicles.

    Examples
    --------
    >>> demo_fleet(n_drives=3).n_traces
    3
    """
    return _simulated(n_drives, seed).fleet


def run_demo(folder: str | Path, *, progress: Progress | None = None) -> tuple[dict[Path, str], pd.DataFrame]:
    """Write fleet data into a folder, build the road graph from it, and compare that with the true roads.

    Parameters
    ----------
    folder
        Created where it does not exist; files of an earlier demo are replaced.
    progress
        As for `probe2road.build`.

    Returns
    -------
    dict
        The files to open, and what each is.
    DataFrame
        The scores, one row per metric.

    Raises
    ------
    OutputError
        If the folder cannot be created.
    """
    folder = Path(folder)
    make_folder(folder)
    simulated = _simulated(200, 1)
    drives, roads, truth = (folder / name for name in ("drives.parquet", "roads.gpkg", "true-roads.gpkg"))
    write_fleet(simulated.fleet, drives)
    write_graph(simulated.reference, truth)

    fleet = read_fleet_files(drives)
    graph = build(fleet, workspace=folder / "stages", progress=progress)
    write_graph(graph, roads)
    scores = evaluate(graph, simulated.reference, metrics=["geo", "itopo"])

    page, filmstrip = folder / "roads.html", folder / "stages.png"
    view(graph, page, fleet=fleet, title="probe2road demo: a cloverleaf")
    draw_stages(folder / "stages", fleet, filmstrip)
    files = {
        page: "the roads over the traces, in any browser",
        filmstrip: "how they came about, stage by stage",
        roads: "the road graph, in QGIS",
        truth: "the roads that the simulated vehicles drove",
        drives: "what they recorded",
    }
    return files, scores


def _simulated(n_drives: int, seed: int) -> SimulatedFleet:
    network = generate_interchange("cloverleaf", rng=np.random.default_rng(seed))
    return simulate(network, preset="mixed", n_drives=n_drives, seed=seed)
