"""Thinning and vectorisation of a road mask, and the fake edges that thinning makes at crossings.

Run with ``python benchmarks/bench_vectorize.py`` (``--fake-edges`` for the table of the documentation).
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from pyproj import CRS
from rasterio.features import rasterize
from scipy.ndimage import binary_dilation

from probe2road.graph.clean import clean_graph
from probe2road.raster.counts import Grid
from probe2road.vectorize.lines import vectorize
from probe2road.vectorize.skeleton import Method, skeleton_pixels, skeletonize, skeletonize_windows
from probe2road.vectorize.tracing import trace_pixels

METHODS: tuple[Method, ...] = ("guo_hall", "zhang_suen")
WIDTHS = (3, 5, 9, 13)  # px
ANGLES = (20, 30, 45, 60, 75, 90)  # degrees


def road_mask(size: int, *, roads: int = 42, width: float = 9.0) -> NDArray[np.bool_]:
    """Draw winding roads across a square of ``size`` pixels."""
    rng = np.random.default_rng(7)
    lines = []
    along = np.linspace(-1.5 * size, 1.5 * size, 600)
    for _ in range(roads):
        heading, phase = rng.uniform(0, 2 * np.pi, 2)
        ahead = np.array([np.cos(heading), np.sin(heading)])
        sideways = rng.uniform(0, 60) * np.sin(along * 2 * np.pi / rng.uniform(400, 2000) + phase)
        lines.append(rng.uniform(0, size, 2) + along[:, None] * ahead + sideways[:, None] * ahead[::-1] * [-1, 1])
    return rasterize([shapely.LineString(line).buffer(width / 2) for line in lines], (size, size)).astype(bool)


def best_of(repeats: int, call: Callable[[], Any]) -> float:
    """Return the shortest of several run times, seconds."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def speed(size: int) -> None:
    """Print run times, ours and those of the usual libraries."""
    mask = road_mask(size)
    grid = Grid(448000.0, 4636000.0, 1.0, size, size, CRS("EPSG:32616"))
    graph = clean_graph(vectorize(skeletonize(mask[:300, :300]), grid.window(0, 0, 300, 300)))  # compiles
    skeleton = skeletonize(mask)
    graph = vectorize(skeleton, grid)
    print(f"mask {size} x {size}, {mask.mean():.1%} road, {skeleton.sum()} skeleton pixels, {graph}")
    thinning, vectorising = best_of(3, lambda: skeletonize(mask)), best_of(3, lambda: vectorize(skeleton, grid))
    print(f"skeletonize           {thinning:6.2f} s")
    print(f"skeletonize_windows   {best_of(1, lambda: skeletonize_windows(mask, window=1024)):6.2f} s (1024 px)")
    print(f"vectorize             {vectorising:6.2f} s")
    print(f"clean_graph           {best_of(3, lambda: clean_graph(graph)):6.2f} s ({clean_graph(graph)})")
    print(f"thin and vectorise    {thinning + vectorising:6.2f} s")

    from skan import Skeleton, summarize  # type: ignore[import-untyped]
    from skimage.morphology import thin

    thin_s = best_of(1, lambda: thin(mask))  # type: ignore[no-untyped-call]
    print(f"skimage thin          {thin_s:6.2f} s, {thin_s / thinning:.1f} times ours")
    summarize(Skeleton(skeleton[:300, :300]), separator="_")
    skan_s = best_of(2, lambda: summarize(Skeleton(skeleton), separator="_"))
    print(f"skan                  {skan_s:6.2f} s, {skan_s / vectorising:.1f} times ours")


def crossing(width: int, angle: float, turn: float, *, drawing: str, size: int = 401) -> NDArray[np.bool_]:
    """Draw two straight roads that cross in the middle.

    ``exact`` fills the pixels whose centre is in the road; ``brush`` moves a square of ``width`` pixels along a
    line one pixel wide, as image libraries do, which makes slanted roads wider by up to 41 %.
    """
    middle = size / 2
    roads = [
        shapely.LineString([(middle - middle * x, middle - middle * y), (middle + middle * x, middle + middle * y)])
        for x, y in ((np.cos(np.radians(a)), np.sin(np.radians(a))) for a in (turn, turn + angle))
    ]
    if drawing == "exact":
        return rasterize([road.buffer(width / 2) for road in roads], (size, size)).astype(bool)
    return binary_dilation(rasterize(roads, (size, size)).astype(bool), np.ones((width, width), bool))


def fake_edge(mask: NDArray[np.bool_], method: Method) -> float:
    """Distance of the junctions farthest apart that one crossing has become, pixels."""
    pixels = trace_pixels(*skeleton_pixels(skeletonize(mask, method=method)))
    degree = np.bincount(np.append(pixels.start, pixels.stop))
    junction = np.stack([pixels.node_row, pixels.node_col], axis=1)[degree >= 3]
    middle = np.array(mask.shape) / 2
    junction = junction[np.hypot(*(junction - middle).T) < 100]
    return float(np.hypot(*(junction[:, None] - junction[None]).T).max()) if len(junction) else np.nan


def fake_edges() -> None:
    """Print the mean over 12 orientations per mask width and crossing angle, as METHOD 7.3 does."""
    for drawing in ("exact", "brush"):
        print(f"\n{drawing}, px, Guo-Hall / Zhang-Suen\n| width |" + "".join(f" {angle} deg |" for angle in ANGLES))
        for width in WIDTHS:
            cells = []
            for angle in ANGLES:
                masks = [crossing(width, angle, turn, drawing=drawing) for turn in np.arange(12) * 15.0 + 3.7]
                cells.append(" / ".join(f"{np.mean([fake_edge(m, method) for m in masks]):.1f}" for method in METHODS))
            print(f"| {width} px | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=4000, help="side of the mask, pixels")
    parser.add_argument("--fake-edges", action="store_true", help="measure crossings instead of speed")
    arguments = parser.parse_args()
    if arguments.fake_edges:
        fake_edges()
    else:
        speed(arguments.size)
