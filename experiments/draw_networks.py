"""Draw the pictures of docs/concepts/simulator-networks.md: a contact sheet of generated networks, and details.

Usage: python experiments/draw_networks.py docs/img
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection
from PIL import Image

from probe2road.simulation.drawn.generate import INTERCHANGES, generate_corridor, generate_interchange, generate_town
from probe2road.simulation.lanes.features import road_features
from probe2road.simulation.networks.network import RoadNetwork

SEED = 3
Window = tuple[float, float, float]  # centre and half the side, m

SHEET: dict[str, Window] = {
    "diamond": (0, 0, 420),
    "cloverleaf": (0, 0, 520),
    "stack": (0, 0, 900),
    "trumpet": (-60, -60, 470),
    "shallow_overpass": (0, 0, 400),
    "double_deck": (-100, -50, 500),
    "merge_beside_bridge": (-50, 0, 250),
    "tunnel_under_junction": (0, 0, 420),
    "weaving": (0, 0, 480),
    "roundabout": (0, 0, 150),
    "corridor": (0, 0, 1300),
    "town": (0, 0, 560),
    "old town": (0, 0, 480),
}
DETAILS: list[tuple[str, Window]] = [
    ("diamond", (-290, -5, 60)),
    ("stack", (0, 0, 160)),
    ("merge_beside_bridge", (0, -5, 60)),
    ("roundabout", (0, 0, 55)),
]


def network_of(scene: str) -> RoadNetwork:
    """Generate one scene."""
    rng = np.random.default_rng(SEED)
    if scene in INTERCHANGES:
        return generate_interchange(scene, rng=rng)
    return generate_corridor(rng=rng) if scene == "corridor" else generate_town(rng=rng, regular=scene == "town")


def draw(axes: Any, scene: str, window: Window, *, detail: bool) -> None:
    """Draw boundaries red, markings green, section lines by height."""
    network = network_of(scene)
    features = road_features(network)
    lines = np.split(features.xyz[:, :2], features.offsets[1:-1])
    for kind, colour in (("road_boundary", "tab:red"), ("lane_marking", "tab:green")):
        chosen = [line for line, of in zip(lines, features.kind, strict=True) if of == kind]
        axes.add_collection(LineCollection(chosen, colors=colour, linewidths=0.5 if detail else 0.25))
    xyz, offsets = network.vertices()
    inside = np.ones(len(xyz) - 1, dtype=bool)
    inside[offsets[1:-1] - 1] = False
    steps = np.stack([xyz[:-1], xyz[1:]], axis=1)[inside]
    steps = steps[np.argsort(steps[:, :, 2].mean(axis=1))]  # the highest road is drawn last
    heights = steps[:, :, 2].mean(axis=1)
    axes.add_collection(
        LineCollection(list(steps[:, :, :2]), array=heights, cmap="viridis", linewidths=1.2 if detail else 2.0)
    )
    x, y, half = window
    axes.set(xlim=(x - half, x + half), ylim=(y - half, y + half), aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"{scene.replace('_', ' ')}, {2 * half:.0f} m, z {np.ptp(xyz[:, 2]):.0f} m", fontsize=8)


def save(figure: Any, path: Path) -> None:
    """Save with a palette, which quarters the size of a line drawing."""
    figure.tight_layout(pad=0.9)
    figure.savefig(path, dpi=80)
    plt.close(figure)
    Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)


def main(folder: Path) -> None:
    """Draw both pictures."""
    mpl.use("Agg")
    figure, grid = plt.subplots(3, 5, figsize=(12.5, 7.9))
    for axes in grid.flat[len(SHEET) :]:
        axes.axis("off")
    for axes, (scene, window) in zip(grid.flat, SHEET.items(), strict=False):
        draw(axes, scene, window, detail=False)
    save(figure, folder / "generated-networks.png")
    figure, grid = plt.subplots(1, 4, figsize=(12.5, 3.4))
    for axes, (scene, window) in zip(grid.flat, DETAILS, strict=True):
        draw(axes, scene, window, detail=True)
    save(figure, folder / "generated-details.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
