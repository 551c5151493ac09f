"""Draw the places where a built graph and the reference disagree most.

Usage: probe2road benchmark run SETS --output TABLES --work WORK --poses modelled --name boston --method probe2road
       python experiments/worst_places.py SETS/boston WORK/boston-modelled/probe2road/stages docs/img/worst-boston.png

Every point on either graph, 5 m apart, that is farther than 6 m from the other graph counts for its square of 200 m.
With `--junctions` every junction and dead end counts that is farther than 15 m from all of the other graph. The squares
with most of them are drawn: the probability above, and the graph (orange; red dots are dead ends, black dots junctions)
over the reference (grey) below. Prints what the squares hold.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from rasterio.windows import from_bounds

mpl.use("Agg")
import matplotlib.pyplot as plt
from PIL import Image

from probe2road import read_graph
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.graph.roadgraph import RoadGraph

SPACING, RADIUS = 5.0, 6.0  # m, of points on roads
NODE_RADIUS = 15.0  # m
SQUARE = 200.0  # m
COLUMNS = 5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="folder of a prepared data set")
    parser.add_argument("workspace", type=Path, help="of a finished build")
    parser.add_argument("picture", type=Path)
    parser.add_argument("--places", type=int, default=10)
    parser.add_argument("--junctions", action="store_true", help="count junctions and dead ends in place of roads")
    options = parser.parse_args()
    reference = labelled_reference(read_graph(options.dataset / "reference.gpkg"))
    graph = read_graph(options.workspace / "7-roads.gpkg")
    apart, worth, unit = (nodes_apart, 1.0, "") if options.junctions else (roads_apart, SPACING, " m")
    missed, extra = apart(reference, graph), apart(graph, reference)
    squares, count = np.unique(np.floor(np.concatenate([missed, extra]) / SQUARE), axis=0, return_counts=True)
    worst = squares[np.argsort(-count, kind="stable")[: options.places]]
    for number, square in enumerate(worst, start=1):
        lost, added = (
            worth * np.count_nonzero((np.floor(points / SQUARE) == square).all(axis=1)) for points in (missed, extra)
        )
        x, y = (square + 0.5) * SQUARE
        print(f"| {number} | {x:.0f}, {y:.0f} | {lost:.0f}{unit} | {added:.0f}{unit} |")
    draw(worst, reference, graph, options.workspace / "1-probability.tif", options.picture)


def roads_apart(graph: RoadGraph, other: RoadGraph) -> NDArray[np.float64]:
    """Points on a graph that are far from another: shape ``(n, 2)``."""
    xy = shapely.get_coordinates(shapely.segmentize(graph.edges.geometry.to_numpy(), SPACING))
    return far_from(xy, other.edges.geometry.to_numpy(), RADIUS)


def nodes_apart(graph: RoadGraph, other: RoadGraph) -> NDArray[np.float64]:
    """Junctions and dead ends of a graph that are far from those of another: shape ``(n, 2)``."""
    own, others = (each.nodes.geometry.to_numpy()[each.degrees().to_numpy() != 2] for each in (graph, other))
    return far_from(shapely.get_coordinates(own), others, NODE_RADIUS)


def far_from(xy: NDArray[np.float64], shapes: NDArray[np.object_], radius: float) -> NDArray[np.float64]:
    """Those of some points that no shape is near."""
    near = shapely.STRtree(shapes).query(shapely.points(xy), "dwithin", distance=radius)[0]
    far = np.ones(len(xy), bool)
    far[near] = False
    return xy[far]


def draw(
    squares: NDArray[np.float64], reference: RoadGraph, graph: RoadGraph, probability: Path, picture: Path
) -> None:
    """Draw the squares, two panels each."""
    rows = -(-len(squares) // COLUMNS)
    figure, axes = plt.subplots(2 * rows, COLUMNS, figsize=(3 * COLUMNS, 6 * rows), layout="constrained", squeeze=False)
    nodes, degree = shapely.get_coordinates(graph.nodes.geometry.to_numpy()), graph.degrees().to_numpy()
    for axis in axes.ravel():
        axis.set_axis_off()
    for number, square in enumerate(squares):
        left, bottom = (square - 0.25) * SQUARE
        bounds = (left, bottom, left + 1.5 * SQUARE, bottom + 1.5 * SQUARE)
        row, column = divmod(number, COLUMNS)
        upper, lower = axes[2 * row, column], axes[2 * row + 1, column]
        with rasterio.open(probability) as raster:
            window = from_bounds(*bounds, raster.transform)
            shown = raster.read(1, window=window, boundless=True, fill_value=0)
        upper.imshow(shown, extent=(bounds[0], bounds[2], bounds[1], bounds[3]), cmap="gray_r", vmin=0, vmax=1)
        upper.set_title(str(number + 1))
        for lines, colour, width in ((reference, "0.75", 4.0), (graph, "tab:orange", 1.2)):
            for line in lines.edges.geometry[lines.edges.intersects(shapely.box(*bounds))]:
                lower.plot(*shapely.get_coordinates(line).T, color=colour, lw=width)
        for chosen, colour in ((degree >= 3, "black"), (degree == 1, "red")):
            lower.plot(*nodes[chosen].T, ".", color=colour, ms=5)
        for axis in (upper, lower):
            axis.set(xlim=bounds[0::2], ylim=bounds[1::2], aspect="equal", xticks=[], yticks=[])
            axis.set_axis_on()
    figure.savefig(picture, dpi=70)
    plt.close(figure)
    with Image.open(picture) as image:  # few colours: a third of the size
        image.convert("RGB").quantize(64).save(picture, optimize=True)


if __name__ == "__main__":
    main()
