"""Pictures of refinement, stage by stage, on graphs built from simulated traces.

Run with ``python experiments/draw_junctions.py``; it writes the pictures of docs/concepts/refinement.md.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import shapely

from probe2road.graph.clean import clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import match
from probe2road.recipe import BuildOptions, build
from probe2road.refinement.gaps.fill import fill_gaps, gap_weights, prune_gaps
from probe2road.refinement.junctions.passages import passing_positions
from probe2road.refinement.junctions.split import split_false_junctions
from probe2road.segmentation.options import SegmentationOptions
from probe2road.simulation.drawn.generate import generate_interchange
from probe2road.simulation.fleet_simulation import SimulatedFleet, simulate
from probe2road.simulation.presets import find_preset

PANELS: dict[str, tuple[str, float | None, float]] = {  # kind, angle, half the width shown in m
    "cloverleaf": ("cloverleaf", None, 140.0),
    "diamond": ("diamond", None, 140.0),
    "overpass at 25 degrees": ("shallow_overpass", 25.0, 120.0),
    "merge beside a bridge": ("merge_beside_bridge", None, 120.0),
}
TITLES = ("cleaned segmentation", "gaps filled (red)", "gaps that traces drive", "false junctions split")
ROAD, EDGE, GAP, NODE, DEAD_END = "#d9dde3", "#27496d", "#d1495b", "#111111", "#e09f3e"


def stages(simulated: SimulatedFleet) -> list[RoadGraph]:
    """Build a graph and return it after each step."""
    fleet = simulated.fleet
    graph = build(fleet, options=BuildOptions(segmentation=SegmentationOptions(segmenter="density"), refine=False))
    filled = fill_gaps(graph)
    pruned = clean_graph(prune_gaps(filled, match(filled, fleet, edge_weights=gap_weights(filled)).steps))
    matches = match(pruned, fleet)
    split = split_false_junctions(pruned, matches.steps, positions=passing_positions(pruned, fleet, matches))
    return [graph, filled, pruned, split]


def draw(axes: Any, graph: RoadGraph, reference: RoadGraph, half: float) -> None:
    """Draw a graph over the true roads."""
    for line in reference.edges.geometry:
        axes.plot(*shapely.get_coordinates(line).T, color=ROAD, lw=5, zorder=1, solid_capstyle="butt")
    for line, origin in zip(graph.edges.geometry, graph.edges["origin"], strict=True):
        color, order = (GAP, 3) if origin == "gap" else (EDGE, 2)
        axes.plot(*shapely.get_coordinates(line).T, color=color, lw=1.6, zorder=order)
    degree = graph.degrees().to_numpy()
    xy = shapely.get_coordinates(graph.nodes.geometry.to_numpy())
    axes.scatter(*xy[degree >= 3].T, s=16, color=NODE, zorder=4)
    axes.scatter(*xy[degree == 1].T, s=16, color=DEAD_END, zorder=4)
    axes.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xticks=[], yticks=[])


def main() -> None:
    """Draw every panel."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/img/refinement.png"))
    args = parser.parse_args()
    mpl.use("Agg")
    figure, grid = plt.subplots(len(PANELS), len(TITLES), figsize=(12, 3 * len(PANELS)), squeeze=False)
    preset = replace(find_preset("mixed"), camera=None)
    for row, (name, (kind, angle, half)) in zip(grid, PANELS.items(), strict=True):
        network = generate_interchange(kind, rng=np.random.default_rng(1), angle=angle)
        simulated = simulate(network, preset=preset, n_drives=200, seed=1)
        for axes, graph in zip(row, stages(simulated), strict=True):
            draw(axes, graph, simulated.reference, half)
        row[0].set_ylabel(name)
    for axes, title in zip(grid[0], TITLES, strict=True):
        axes.set_title(title, fontsize=10)
    figure.tight_layout()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(args.out, dpi=80)


if __name__ == "__main__":
    main()
