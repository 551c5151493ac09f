"""Do routing engines find on a built graph the ways that they find on the true roads?

Usage: python experiments/routing.py GRAPH REFERENCE [--pairs 1000] [--min-expected 5] [--engines ENGINE ...]

Graphs are written as OSM files for routers and built by OSRM and Valhalla (`make programs` installs them). Random pairs
of places on roads that enough drives passed are routed on the graph, on the roads of the reference that enough drives
passed, and on all roads of the reference. A place has an edge of the graph within 3 m and no second edge of the
reference within 15 m, so that no engine takes another carriageway for it, and ways are compared rather than missing
roads. Of the pairs that driven roads connect, a way on the graph that is shorter than on all roads by more than 5 %
leads over something that is not there, one that is longer than on driven roads lacks something, and others are right.
The table of docs/results/routing.md is the output.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
from numpy.typing import NDArray

from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.crs import WGS84, transform
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.io.osm_writer import OsmOptions

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
from routers import ENGINES

NEAR, ALONE = 3.0, 15.0  # m
CLOSE = 0.05  # share by which lengths may differ


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graph", type=Path)
    parser.add_argument("reference", type=Path)
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--min-drives", type=int, default=4)
    parser.add_argument("--min-expected", type=float, default=OsmOptions().min_expected, help="see OsmOptions")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES))
    options = parser.parse_args()
    graph = read_graph(options.graph)
    whole = read_graph(options.reference).to_crs(graph.crs)
    roads = replace(whole, turns=whole.turns.iloc[:0])  # a turn that nobody made is open there
    driven = labelled_reference(roads, min_drives=options.min_drives)
    places = common_places(graph, driven, 2 * options.pairs, np.random.default_rng(options.seed))
    print("| engine | pairs | reached | right | too short | too long |\n|---|---|---|---|---|---|")
    for engine in options.engines:
        osm = OsmOptions(min_expected=options.min_expected)
        built, known, possible = (lengths(one, places, engine, osm) for one in (graph, driven, roads))
        connected = np.isfinite(known)
        built, known, possible = built[connected], known[connected], possible[connected]
        short, long = built < (1 - CLOSE) * possible, built > (1 + CLOSE) * known
        shares = [np.isfinite(built), np.isfinite(built) & ~short & ~long, short, long]
        cells = " | ".join(f"{100 * share.mean():.1f} %" for share in shares)
        print(f"| {engine} | {len(built)} | {cells} |", flush=True)


def common_places(graph: RoadGraph, reference: RoadGraph, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw places ``(count / 2, 2, 2)`` in degrees, pairs of them on edges that both graphs have, by length."""
    lines, tree = reference.edges.geometry.to_numpy(), shapely.STRtree(reference.edges.geometry.to_numpy())
    built = shapely.STRtree(graph.edges.geometry.to_numpy())
    length = shapely.length(lines)
    rows = rng.choice(len(lines), 20 * count, p=length / length.sum())
    points = shapely.force_2d(shapely.line_interpolate_point(lines[rows], rng.random(len(rows)), normalized=True))
    near = np.bincount(built.query(points, predicate="dwithin", distance=NEAR)[0], minlength=len(points)) > 0
    alone = np.bincount(tree.query(points, predicate="dwithin", distance=ALONE)[0], minlength=len(points)) == 1
    x, y = shapely.get_coordinates(points[near & alone][:count]).T
    return np.column_stack(transform(x, y, reference.crs, WGS84)).reshape(-1, 2, 2)


def lengths(graph: RoadGraph, places: NDArray[np.float64], engine: str, osm: OsmOptions) -> NDArray[np.float64]:
    """Return the length of the way between the places of each pair, m; NaN where there is none."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "roads.osm.pbf")
        write_graph(graph, path, osm=osm)
        with ENGINES[engine](path) as route:
            ways = [route(pair) for pair in places]
    return np.array([np.nan if way is None else way.length for way in ways])


if __name__ == "__main__":
    main()
