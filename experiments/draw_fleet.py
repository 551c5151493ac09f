"""Draw simulated fleet data at one place: boundaries red, markings green, traces blue, the reference graph black.

    python experiments/draw_fleet.py ../shared/data/osm/columbus.osm.pbf 39.9738 -82.9840 docs/img/fleet-columbus.png

The reference graph is drawn in a second panel over the traces.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import matplotlib as mpl
import numpy as np
import shapely

from probe2road.crs import WGS84, transform
from probe2road.simulation.fleet_simulation import SimulatedFleet, simulate
from probe2road.simulation.networks.osm import read_network
from probe2road.simulation.presets import PRESETS

COLOURS = {"lane_marking": "limegreen", "road_boundary": "red"}


def draw(fleet: SimulatedFleet, centre: tuple[float, float], half: float, path: Path) -> None:
    """Draw a square of the given half side (m) around a centre in the CRS of the fleet."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(12, 6), layout="constrained")
    left, bottom = centre[0] - half, centre[1] - half
    inside = {
        name: table[table["x"].between(left, left + 2 * half) & table["y"].between(bottom, bottom + 2 * half)]
        for name, table in (("points", fleet.fleet.points), ("traces", fleet.fleet.traces))
    }
    for kind, colour in COLOURS.items():
        points = inside["points"][inside["points"]["kind"] == kind]
        axes[0].plot(points["x"] - left, points["y"] - bottom, ",", color=colour)
    for axis in axes:
        for _, trace in inside["traces"].groupby("trace_id"):
            x, y = trace["x"].to_numpy() - left, trace["y"].to_numpy() - bottom
            away = np.flatnonzero(np.hypot(np.diff(x), np.diff(y)) > 50.0) + 1  # it left the picture and came back
            axis.plot(np.insert(x, away, np.nan), np.insert(y, away, np.nan), color="blue", lw=0.4)
        axis.set(xlim=(0, 2 * half), ylim=(0, 2 * half), xticks=[], yticks=[], aspect="equal")
    square = shapely.box(left, bottom, left + 2 * half, bottom + 2 * half)
    for line in fleet.reference.edges.geometry[fleet.reference.edges.intersects(square)]:
        vertices = shapely.get_coordinates(line)
        axes[1].plot(vertices[:, 0] - left, vertices[:, 1] - bottom, color="black", lw=1.0)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=85)
    plt.close(figure)


def main() -> None:
    """Simulate a fleet and draw it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("network", type=Path)
    parser.add_argument("lat", type=float)
    parser.add_argument("lon", type=float)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--half", type=float, default=300.0, help="half side of the square, m")
    parser.add_argument("--drives", type=int, default=200)
    parser.add_argument("--preset", choices=sorted(PRESETS), default="mixed")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    network = read_network(options.network)
    x, y = transform([options.lon], [options.lat], WGS84, network.crs)
    fleet = simulate(network, preset=options.preset, n_drives=options.drives, seed=1)
    draw(fleet, (float(x[0]), float(y[0])), options.half, options.picture)


if __name__ == "__main__":
    main()
