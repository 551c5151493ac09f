"""Choose the parameters of the KDE baseline by GEO F1 on training tiles of Columbus.

    probe2road benchmark prepare columbus --output SETS
    python experiments/fit_kde.py SETS/columbus            a few minutes on one core

Logs a Markdown table of all combinations, best first; the first row is what the defaults of KdeOptions are. Only
tiles of the training split are read: some of them, drawn at random with a fixed seed, because one fleet drove all. The
reference is the roads that at least four drives passed, as for every method.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np

from probe2road import evaluate, read_fleet, read_graph
from probe2road.baselines.kde import KdeOptions, build_kde
from probe2road.benchmark.sets.prepare import check_dataset, read_tiles
from probe2road.benchmark.sets.recording import Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.benchmark.sets.tiles import split_area
from probe2road.fleet.contract import Fleet
from probe2road.metrics.normalise import clip_graph

logger = logging.getLogger("fit_kde")

SEED = 7
MARGIN = 100.0  # m of traces around a tile
GRID = {  # of the search, in the unit of each field
    "sigma": (1.0, 1.5, 2.0, 3.0),
    "sigma_vertical": (1.0, 2.0, 4.0),
    "threshold": (0.5, 1.0, 1.5, 2.0, 3.0),
}


def main() -> None:
    """Search the grid and print what every combination scores."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the prepared data set")
    parser.add_argument("--tiles", type=int, default=8, help="training tiles to use")
    parser.add_argument("--raw", action="store_true", help="use the raw instead of the modelled fleet data")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logger.setLevel(logging.INFO)
    check_dataset(arguments.folder)
    recording = Recording(arguments.folder)
    tiles = chosen_tiles(read_tiles(arguments.folder), arguments.tiles)
    area = split_area(tiles, "train")
    fleet = within(read_fleet(recording.drives if arguments.raw else recording.modelled), tiles)
    truth = labelled_reference(read_graph(recording.reference), min_drives=4)
    logger.info(
        "%d traces, %d fixes; %.1f km of roads",
        fleet.n_traces,
        len(fleet.traces),
        clip_graph(truth, area).length / 1000,
    )
    rows = []
    for values in product(*GRID.values()):
        chosen: dict[str, Any] = dict(zip(GRID, values, strict=True))
        options = replace(KdeOptions(), **chosen)
        started = time.perf_counter()
        graph = build_kde(fleet, options=options)
        geo, itopo = (row for row in evaluate(graph, truth, metrics=["geo", "itopo"], area=area).itertuples())
        rows.append((geo.f1, *values, geo.precision, geo.recall, itopo.f1))
        logger.info("%s: GEO F1 %.3f, %.0f s", values, geo.f1, time.perf_counter() - started)
    table = [f"| GEO F1 | {' | '.join(GRID)} | precision | recall | iTOPO F1 |", f"|---|{'---|' * (len(GRID) + 3)}"]
    for f1, *parameters, precision, recall, itopo_f1 in sorted(rows, reverse=True):
        shown = " | ".join(f"{value:g}" for value in parameters)
        table.append(f"| {f1:.3f} | {shown} | {precision:.3f} | {recall:.3f} | {itopo_f1:.3f} |")
    logger.info("%s", "\n".join(table))


def chosen_tiles(tiles: gpd.GeoDataFrame, count: int) -> gpd.GeoDataFrame:
    """Draw training tiles."""
    training = np.flatnonzero(tiles["split"] == "train")
    return tiles.iloc[np.sort(np.random.default_rng(SEED).choice(training, count, replace=False))]


def within(fleet: Fleet, tiles: gpd.GeoDataFrame) -> Fleet:
    """Keep the fixes in tiles and around them; a trace that leaves and comes back is two."""
    x, y = fleet.traces["x"].to_numpy(), fleet.traces["y"].to_numpy()
    inside = np.zeros(len(x), bool)
    for left, bottom, right, top in tiles.bounds.to_numpy():
        inside |= (x > left - MARGIN) & (x < right + MARGIN) & (y > bottom - MARGIN) & (y < top + MARGIN)
    kept = np.flatnonzero(inside)
    trace = fleet.traces["trace_id"].to_numpy()[kept]
    new = (np.diff(kept, prepend=-2) != 1) | np.append(True, trace[1:] != trace[:-1])
    traces = fleet.traces.iloc[kept].assign(trace_id=np.cumsum(new)).reset_index(drop=True)
    return replace(fleet, traces=traces, points=fleet.points.iloc[:0])


if __name__ == "__main__":
    main()
