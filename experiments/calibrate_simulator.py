"""Measure the simulator against what is known of real fleets: the tables and figures of docs/results/calibration.md.

    python experiments/calibrate_simulator.py            everything, about two minutes on one core

Needs the shared data under ``../shared/data``, or where PROBE2ROAD_DATA says. The GNSS model alone is compared by
``experiments/fit_gnss.py``; this script measures what comes out of the whole simulator.
"""

from __future__ import annotations

import argparse
import logging
import os
import sqlite3
from dataclasses import replace
from pathlib import Path

import geopandas as gpd
import matplotlib as mpl
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.strtree import STRtree

from probe2road.simulation.driving.speeds import DriverModel, lane_wander
from probe2road.simulation.fleet_simulation import (
    SimulatedFleet,
    fleet_world,
    simulate,
    simulate_drive,
    visible_features,
)
from probe2road.simulation.lanes.features import FEATURE_STYLES
from probe2road.simulation.networks.network import RoadNetwork, network_from_sections
from probe2road.simulation.networks.osm import read_network
from probe2road.simulation.presets import PRESETS, RecordingModel, find_preset

logger = logging.getLogger("calibrate_simulator")

ROOT = Path(__file__).resolve().parents[1]
LANES = range(1, 6)  # of NGSIM I-80; 6 and 7 are the on-ramp and its taper
LATERAL_LAGS = (1.0, 2.0, 4.0)  # s
CHICAGO_INTERVAL = 3.0  # s, median between real fixes
DASH = FEATURE_STYLES.index("divider")


def data_folder() -> Path:
    """Return the folder of the shared data."""
    return Path(os.environ.get("PROBE2ROAD_DATA", ROOT.parent / "shared" / "data"))


def ngsim_offsets(folder: Path) -> list[NDArray[np.float64]]:
    """Return the lateral offset of every vehicle that kept its lane, from the middle line of the traffic in it (m)."""
    path = next((folder / "gnss" / "ngsim_i80").glob("*.shf"))
    with sqlite3.connect(f"file:{path}?mode=ro&immutable=1", uri=True) as base:
        table = pd.read_sql("SELECT * FROM Trajectory ORDER BY vehicle_id, sim_time", base)
    table = table[table.groupby("vehicle_id")["lane_id"].transform("nunique") == 1]
    offsets = []
    for lane in LANES:
        own = table[table["lane_id"] == lane]
        x, y = own["position_x"].to_numpy(), own["position_y"].to_numpy()
        rest = y - np.polyval(np.polyfit(x, y, 4), x)
        inner = np.abs(rest) < 1.0
        rest = y - np.polyval(np.polyfit(x[inner], y[inner], 4), x)
        centred = own.assign(offset=rest - np.median(rest))
        offsets += [group["offset"].to_numpy() for _, group in centred.groupby("vehicle_id")]
    return offsets


def lateral_row(offsets: list[NDArray[np.float64]]) -> dict[str, float]:
    """Summarise lateral offsets sampled at 10 Hz, one array a vehicle."""
    everything = np.concatenate(offsets)
    row = {f"p{q}, m": float(np.percentile(everything, q)) for q in (2.5, 25, 75, 97.5)}
    row["standard deviation, m"] = float(everything.std())
    row["between vehicles, m"] = float(np.std([own.mean() for own in offsets]))
    row["within 10 s, m"] = float(np.sqrt(np.mean([own.var() for own in offsets])))
    for lag in LATERAL_LAGS:
        steps = round(lag * 10)
        moved = np.concatenate([own[steps:] - own[:-steps] for own in offsets if len(own) > steps])
        row[f"rms change in {lag:g} s, m"] = float(np.sqrt((moved**2).mean()))
    return row


def lateral_table(folder: Path) -> pd.DataFrame:
    """Compare lane keeping with NGSIM: windows of the same lengths, a vehicle each."""
    real = ngsim_offsets(folder)
    rng = np.random.default_rng(1)
    made = [lane_wander(np.full(len(own), 0.1), DriverModel(), rng=rng) for own in real for _ in range(10)]
    return pd.DataFrame({"real": lateral_row(real), "simulated": lateral_row(made)}).round(2)


def chicago_table(folder: Path) -> pd.DataFrame:
    """Compare the phone preset on the streets of Chicago with the real shuttle: fix to the nearest road."""
    place = folder / "traces" / "chicago_shuttle"
    streets = gpd.read_file(place / "gt_osm_full.geojson").drop_duplicates(["u", "v"])
    fixes = pd.read_csv(place / "traces.csv.gz")
    tree = STRtree(streets.geometry.to_numpy())
    lines = gpd.GeoDataFrame(geometry=streets.geometry.to_numpy(), crs=streets.crs)
    network = network_from_sections(lines, highway="residential", lanes_backward=1, lanes_forward=1, lane_width=3.2)
    interval = (CHICAGO_INTERVAL, CHICAGO_INTERVAL)
    phone = replace(PRESETS["phone"], recording=replace(RecordingModel(), fix_interval=interval))
    made = simulate(network, preset=phone, n_drives=300, seed=1)
    columns = {"real": fixes, "simulated": made.fleet.traces}
    table = {}
    for name, fix in columns.items():
        _, distance = tree.query_nearest(shapely.points(fix["x"], fix["y"]), return_distance=True, all_matches=False)
        table[name] = {f"p{q}, m": float(np.percentile(distance, q)) for q in (50, 90, 95, 99)}
    error = np.hypot(made.fleet.traces["x"] - made.poses["x"], made.fleet.traces["y"] - made.poses["y"])
    table["simulated, to the true position"] = {f"p{q}, m": float(np.percentile(error, q)) for q in (50, 90, 95, 99)}
    return pd.DataFrame(table).round(1)


def dash_counts(network: RoadNetwork, *, preset: str = "mixed", drives: int = 60) -> NDArray[np.int64]:
    """Count the points that one pass leaves on each dash between the vehicle's lane and the next."""
    lines = visible_features(network, seed=1)
    chosen = find_preset(preset)
    world = fleet_world(network, chosen, seed=1)
    middle = np.add.reduceat(lines.xyz[:, :2], lines.offsets[:-1], axis=0) / np.diff(lines.offsets)[:, None]
    dashes = np.flatnonzero(lines.style == DASH)
    tree = STRtree(shapely.points(middle[dashes]))
    counts = []
    for number in range(drives):
        poses, _, seen = simulate_drive(world, number)
        if seen is None:
            continue
        found = np.bincount(seen.feature[seen.feature >= 0], minlength=len(lines.style))
        # Dashes within a lane's width of the driven line, and not of a road above or below.
        line = shapely.LineString(poses.xyz[::2, :2])
        near = dashes[tree.query(line, predicate="dwithin", distance=2.6)]
        counts.append(found[near])
    return np.concatenate(counts)


def support_table(fleet: SimulatedFleet) -> pd.DataFrame:
    """Distribution of the number of drives over the edges, by class of road."""
    edges = fleet.reference.edges
    support = edges["support"].astype(int)
    groups = {"all": support} | {str(name): support[edges["highway"] == name] for name in edges["highway"].unique()}
    rows = {
        name: {
            "edges": len(values),
            "none": f"{(values == 0).mean():.0%}",
            "1 to 3": f"{values.between(1, 3).mean():.0%}",
            "median": int(values.median()),
            "p90": int(values.quantile(0.9)),
            "p99": int(values.quantile(0.99)),
            "most": int(values.max()),
        }
        for name, values in groups.items()
    }
    return pd.DataFrame(rows).T


def error_table(network: RoadNetwork, *, n_drives: int = 100) -> pd.DataFrame:
    """Position error of each preset on one network, and how much of it changes within a second and within ten."""
    rows = {}
    for name in PRESETS:
        made = simulate(network, preset=name, n_drives=n_drives, seed=1)
        error = made.fleet.traces[["x", "y", "z"]].to_numpy() - made.poses[["x", "y", "z"]].to_numpy()
        plan = np.hypot(error[:, 0], error[:, 1])
        row = {f"p{q}": np.percentile(plan, q) for q in (50, 95, 99)}
        row |= {"vertical p50": np.percentile(np.abs(error[:, 2]), 50)}
        row |= {"vertical p95": np.percentile(np.abs(error[:, 2]), 95)}
        clock = made.poses["t"].astype("int64").to_numpy() / 1e9
        trace = made.poses["trace_id"].to_numpy()
        for lag in (1.0, 10.0):
            row[f"change in {lag:g} s, p50"] = np.nan if name == "phone" else _change(trace, clock, error, lag)
        rows[name] = row
    return pd.DataFrame(rows).T.round(2)


def _change(trace: NDArray[np.int64], clock: NDArray[np.float64], error: NDArray[np.float64], lag: float) -> float:
    """Median change of the horizontal error over a lag (s)."""
    order = clock - clock.min() + trace * 1e8  # one axis for all traces, far apart
    partner = np.minimum(np.searchsorted(order, order + lag), len(order) - 1)
    paired = (trace[partner] == trace) & (np.abs(clock[partner] - clock - lag) < 0.3)
    moved = error[partner[paired], :2] - error[paired, :2]
    return float(np.median(np.hypot(moved[:, 0], moved[:, 1])))


def draw_lateral(folder: Path, path: Path) -> None:
    """Plot the distribution of lateral offsets, real against simulated."""
    import matplotlib.pyplot as plt

    real = ngsim_offsets(folder)
    rng = np.random.default_rng(1)
    made = [lane_wander(np.full(len(own), 0.1), DriverModel(), rng=rng) for own in real for _ in range(10)]
    figure, axis = plt.subplots(figsize=(5, 3.2), layout="constrained")
    bins = np.linspace(-1.6, 1.6, 41).tolist()
    for offsets, label, style in ((real, "NGSIM I-80", "black"), (made, "simulated", "tab:orange")):
        axis.hist(np.concatenate(offsets), bins, density=True, histtype="step", color=style, lw=1.5, label=label)
    axis.set(xlabel="lateral offset in the lane, m", ylabel="density")
    axis.legend(frameon=False)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def draw_counts(counts: NDArray[np.int64], support: NDArray[np.int64], path: Path) -> None:
    """Plot points per dash, and drives per edge in descending order."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    axes[0].hist(counts, np.arange(-0.5, 25.5), color="tab:green", density=True)
    axes[0].axvspan(4.5, 10.5, color="black", alpha=0.08)
    axes[0].set(xlabel="points on a dash in one pass (shaded: 5 to 10)", ylabel="share of dashes")
    ordered = np.sort(support)[::-1]
    axes[1].plot(np.arange(1, len(ordered) + 1), np.maximum(ordered, 0.5))
    axes[1].set(xscale="log", yscale="log", xlabel="edges, busiest first", ylabel="drives (0 drawn at 0.5)")
    axes[1].grid(alpha=0.3)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    """Measure everything and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--drives", type=int, default=1000, help="drives on Columbus for the counts per edge")
    parser.add_argument("--figures", type=Path, default=ROOT / "docs" / "img")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    mpl.use("Agg")
    folder = data_folder()
    if not folder.is_dir():
        parser.exit(2, f"{folder}: no data; set PROBE2ROAD_DATA to the folder that holds gnss/ and osm/\n")
    logger.info("lateral offset in the lane\n%s", lateral_table(folder).to_string())
    draw_lateral(folder, options.figures / "lane-offsets.png")
    logger.info("Chicago, fix to nearest road\n%s", chicago_table(folder).to_string())
    columbus = read_network(folder / "osm" / "columbus.osm.pbf")
    logger.info("position error of the presets, Columbus\n%s", error_table(columbus).to_string())
    counts = dash_counts(columbus)
    quantiles = np.percentile(counts, [5, 25, 50, 75, 95])
    inside = ((counts >= 5) & (counts <= 10)).mean()
    logger.info(
        "points per dash and pass: mean %.1f, p5 p25 p50 p75 p95 %s, 5 to 10 on %.0f %%, none on %.0f %% of %d",
        counts.mean(), quantiles, 100 * inside, 100 * (counts == 0).mean(), len(counts),
    )  # fmt: skip
    # No camera: only the counts matter here.
    blind = replace(PRESETS["mixed"], camera=None)
    fleet = simulate(columbus, preset=blind, n_drives=options.drives, seed=1)
    logger.info("drives per edge, Columbus, %d drives\n%s", options.drives, support_table(fleet).to_string())
    draw_counts(counts, fleet.reference.edges["support"].to_numpy(np.int64), options.figures / "dashes-and-drives.png")


if __name__ == "__main__":
    main()
