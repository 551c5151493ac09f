"""Score map matching on the tracks of Kubicka et al. (2015), whose true routes are known.

python experiments/kubicka.py [DATA] [--intervals 1 5 15 30 60] [--profiles auto published]
python experiments/kubicka.py --engine fastmm PYTHON FOLDER '{"gps_error": 10}'    (and osrm, valhalla; repeatable)

An engine is run by PYTHON, with FOLDER, where it is installed, on its path; see kubicka_engines.py.

Two scores on fixes thinned to an interval (the last fix is kept). *Route mismatch*: length of the arcs wrongly added
plus those wrongly missed, over the length of the true route (Newson and Krumm 2009), as the mean over tracks. *Right
arc*: share of all fixes whose arc, with its direction, lies on the true route within 20 m of where the fix belongs on
it; fixes are laid along the route in order with the least sum of squared distances. Parameters were chosen on the
tracks in places 0, 2, 4, ... of the sorted names; the others are held out.

Times are CPU seconds without reading, without building networks and, for fastmm, without its table of routes. Ours
contain the set-up of the network for each call, so each track is matched as ten traces at once.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import geopandas as gpd
import numpy as np
import osmium
import osmium.osm.mutable
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.crs import WGS84, local_crs, transform
from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.matching.match import Matches, MatchOptions, match

DATA = Path(os.environ.get("PROBE2ROAD_DATA", "../shared/data")) / "mapmatching" / "kubicka"
INTERVALS = (1, 5, 15, 30, 60)  # s
TOLERANCE = 20.0  # m along the true route
COPIES = 10  # of each track, to time our matcher

Arc = tuple[int, int]  # start node, end node


@dataclass(frozen=True)
class Track:
    """One track: its network, its fixes at 1 Hz, its true route.

    ``nodes`` has shape (nodes, 2), degrees; ``xy`` and ``node_xy`` are metres; ``t`` is in s;
    ``position`` is where on the route (m) each fix belongs.
    """

    name: str
    graph: RoadGraph
    nodes: NDArray[np.float64]
    node_xy: NDArray[np.float64]
    arcs: NDArray[np.int64]
    lonlat: NDArray[np.float64]
    xy: NDArray[np.float64]
    t: NDArray[np.float64]
    route: list[Arc]
    position: NDArray[np.float64]

    def length(self, arc: Arc) -> float:
        """Length of an arc, m."""
        return float(np.hypot(*(self.node_xy[arc[0]] - self.node_xy[arc[1]])))

    def every(self, interval: float) -> NDArray[np.int64]:
        """Rows of the fixes at least so many seconds apart, from the first on, and of the last."""
        rows = [0]
        for row, t in enumerate(self.t):
            if t - self.t[rows[-1]] >= interval - 0.5:
                rows.append(row)
        return np.unique([*rows, len(self.t) - 1])


@dataclass(frozen=True)
class Found:
    """What an engine found on one track: the arcs driven, and the arc of every fix or None."""

    path: list[Arc]
    fixes: list[Arc | None]


def read_track(folder: Path) -> Track:
    """Read one track; twin arcs become one edge that is open both ways, single arcs a one-way edge."""
    nodes, arcs, track, route = (
        np.loadtxt(folder / f"{folder.name}.{kind}", ndmin=2) for kind in ("nodes", "arcs", "track", "route")
    )
    arcs = arcs.astype(np.int64)
    crs = local_crs(nodes[:, 0], nodes[:, 1])
    node_xy = np.stack(transform(nodes[:, 0], nodes[:, 1], WGS84, crs), axis=1)
    xy = np.stack(transform(track[:, 0], track[:, 1], WGS84, crs), axis=1)
    pairs = np.unique(arcs[arcs[:, 0] != arcs[:, 1]], axis=0)
    known = set(map(tuple, pairs.tolist()))
    twin = np.array([(v, u) in known for u, v in pairs.tolist()])
    kept = ~twin | (pairs[:, 0] < pairs[:, 1])
    u, v = pairs[kept].T
    edges = gpd.GeoDataFrame(
        {"u": u, "v": v, "origin": "reference", "oneway": np.where(twin[kept], "no", "yes")},
        geometry=shapely.linestrings(node_xy[pairs[kept]]),
        crs=crs,
    )
    node_table = gpd.GeoDataFrame(
        geometry=shapely.points(node_xy), index=pd.RangeIndex(len(nodes), name="node"), crs=crs
    )
    arcs_driven = [(int(a), int(b)) for a, b in arcs[route[:, 0].astype(int)]]
    return Track(
        name=folder.name,
        graph=RoadGraph(node_table, finish_edges(edges), empty_turns()),
        nodes=nodes,
        node_xy=node_xy,
        arcs=pairs,
        lonlat=track[:, :2],
        xy=xy,
        t=track[:, 2],
        route=arcs_driven,
        position=positions_on_route(xy, node_xy[np.array(arcs_driven)]),
    )


def positions_on_route(xy: NDArray[np.float64], route: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lay fixes along a route in order, with the least sum of squared distances; shape (fixes,), m.

    ``route`` has shape (arcs, 2 ends, 2).
    """
    start, step = route[:, 0], route[:, 1] - route[:, 0]
    length = np.hypot(*step.T)
    squared = np.maximum(length**2, 1e-12)
    share = np.empty((len(xy), len(route)), np.float32)
    back = np.empty((len(xy), len(route)), np.int32)
    cost = np.zeros(len(route))
    for i, place in enumerate(xy):
        share[i] = np.clip(((place - start) * step).sum(axis=1) / squared, 0.0, 1.0)
        distance = ((start + share[i][:, None] * step - place) ** 2).sum(axis=1)
        lowest = np.minimum.accumulate(cost)
        back[i] = np.maximum.accumulate(np.where(cost <= lowest, np.arange(len(cost)), 0))
        cost = lowest + distance
    arc = np.empty(len(xy), np.int64)
    arc[-1] = cost.argmin()
    for i in range(len(xy) - 1, 0, -1):
        arc[i - 1] = back[i, arc[i]]
    before = np.concatenate([[0.0], np.cumsum(length)])
    return np.asarray(before[arc] + share[np.arange(len(xy)), arc] * length[arc], np.float64)


def fleet_of(tracks: list[Track], interval: float, copies: int = 1) -> list[Fleet]:
    """Return the thinned fixes of every track as a fleet, of so many equal traces."""
    fleets = []
    for track in tracks:
        rows = track.every(interval)
        table = pd.DataFrame(
            {"trace_id": track.name, "t": track.t[rows], "x": track.xy[rows, 0], "y": track.xy[rows, 1]}
        )
        table = pd.concat([table.assign(trace_id=f"{track.name}-{copy}") for copy in range(copies)])
        fleets.append(fleet_from_tables(table, crs=track.graph.crs, target_crs=track.graph.crs))
    return fleets


def found_of(matches: Matches, track: Track) -> Found:
    """Turn our result into arcs."""
    ends = track.graph.edges[["u", "v"]].to_numpy()

    def arcs(edge: pd.Series, forward: pd.Series) -> list[Arc | None]:
        rows = edge.to_numpy(np.int64, na_value=-1)
        ways = forward.to_numpy(bool, na_value=True)
        pairs = np.where(ways[:, None], ends[rows], ends[rows][:, ::-1]).tolist()
        return [(a, b) if row >= 0 else None for (a, b), row in zip(pairs, rows, strict=True)]

    path = arcs(matches.steps["edge"], matches.steps["forward"])
    return Found([arc for arc in path if arc is not None], arcs(matches.fixes["edge"], matches.fixes["forward"]))


def ours(tracks: list[Track], interval: float, options: MatchOptions) -> tuple[list[Found], float]:
    """Match every track; return what was found and the CPU seconds it took, measured on ten copies."""
    fleets = fleet_of(tracks, interval, copies=COPIES)
    started = process_time()
    for fleet, track in zip(fleets, tracks, strict=True):
        match(track.graph, fleet, options=options)
    seconds = (process_time() - started) / COPIES
    fleets = fleet_of(tracks, interval)
    matched = [match(track.graph, fleet, options=options) for fleet, track in zip(fleets, tracks, strict=True)]
    return [found_of(matches, track) for matches, track in zip(matched, tracks, strict=True)], seconds


def mismatch(track: Track, path: list[Arc]) -> float:
    """Route mismatch fraction of a path."""
    true, driven = Counter(track.route), Counter(path)
    wrong = sum(track.length(arc) * abs(true[arc] - driven[arc]) for arc in true.keys() | driven.keys())
    return wrong / sum(track.length(arc) for arc in track.route)


def right_fixes(track: Track, rows: NDArray[np.int64], arcs: list[Arc | None]) -> int:
    """Count the fixes on the right arc."""
    stop = np.cumsum([track.length(arc) for arc in track.route])
    start = np.concatenate([[0.0], stop[:-1]])
    spans: dict[Arc, list[tuple[float, float]]] = {}
    for arc, low, high in zip(track.route, start, stop, strict=True):
        spans.setdefault(arc, []).append((low - TOLERANCE, high + TOLERANCE))
    at = track.position[rows]
    return sum(
        any(low <= place <= high for low, high in spans.get(arc, []))
        for arc, place in zip(arcs, at, strict=True)
        if arc is not None
    )


def score(tracks: list[Track], found: list[Found], interval: float) -> dict[str, float]:
    """Mean route mismatch over all tracks and over both halves, and share of fixes on the right arc."""
    wrong = np.array([mismatch(track, result.path) for track, result in zip(tracks, found, strict=True)])
    rows = [track.every(interval) for track in tracks]
    right = np.array([right_fixes(*each) for each in zip(tracks, rows, (f.fixes for f in found), strict=True)])
    count = np.array([len(each) for each in rows])
    return {
        "all": float(wrong.mean()),
        "chosen on": float(wrong[0::2].mean()),
        "held out": float(wrong[1::2].mean()),
        "right": float(right.sum() / count.sum()),
        "right held out": float(right[1::2].sum() / count[1::2].sum()),
    }


def read_tracks(folder: Path) -> list[Track]:
    """Read all tracks in the order of their names: parameters were chosen on those in places 0, 2, 4, ..."""
    return [read_track(path) for path in sorted(folder.iterdir()) if path.is_dir()]


def write_problem(tracks: list[Track], intervals: Sequence[float], folder: Path) -> None:
    """Write the networks and the thinned tracks for other engines."""
    problem: dict[str, Any] = {"intervals": [f"{interval:g}" for interval in intervals], "tracks": []}
    first_node = first_way = 1
    with osmium.SimpleWriter(str(folder / "network.osm.pbf"), overwrite=True) as writer:
        ways = []
        for track in tracks:
            for node, (lon, lat) in enumerate(track.nodes.tolist()):
                writer.add_node(osmium.osm.mutable.Node(id=first_node + node, location=(lon, lat), version=1))
            edges = track.graph.edges
            of_track = []
            for way, (u, v, oneway) in enumerate(
                zip(edges["u"], edges["v"], edges["oneway"], strict=True), start=first_way
            ):
                ways.append((way, [first_node + u, first_node + v], {"highway": "tertiary", "oneway": oneway}))
                of_track.append([way, [int(u), int(v)]])
            cases = {}
            for name, interval in zip(problem["intervals"], intervals, strict=True):
                rows = track.every(interval)
                cases[name] = {
                    "lonlat": track.lonlat[rows].tolist(),
                    "xy": track.xy[rows].tolist(),
                    "t": track.t[rows].tolist(),
                }
            problem["tracks"].append(
                {
                    "offset": first_node,
                    "nodes": track.nodes.tolist(),
                    "node_xy": track.node_xy.tolist(),
                    "arcs": track.arcs.tolist(),
                    "ways": of_track,
                    "cases": cases,
                }
            )
            first_node, first_way = first_node + len(track.nodes), first_way + len(edges)
        for way, nodes, tags in ways:
            writer.add_way(osmium.osm.mutable.Way(id=way, nodes=nodes, tags=tags, version=1))
    (folder / "problem.json").write_text(json.dumps(problem))


def other_engine(engine: list[str], folder: Path) -> dict[str, tuple[list[Found], float]]:
    """Run an engine on a written problem; per interval, what it found and the CPU seconds it took."""
    name, python, home, *parameters = engine
    program = Path(__file__).with_name("kubicka_engines.py")
    environment = {**os.environ, "PYTHONPATH": home}
    subprocess.run(
        [python, str(program), name, str(folder), *parameters], check=True, env=environment, stdout=subprocess.DEVNULL
    )
    solved = json.loads((folder / "result.json").read_text())

    def arc(pair: list[int] | None) -> Arc | None:
        return None if pair is None else (pair[0], pair[1])

    return {
        interval: (
            [Found([(u, v) for u, v in each["path"]], [arc(pair) for pair in each["fixes"]]) for each in results],
            solved["seconds"][interval],
        )
        for interval, results in solved["results"].items()
    }


def main() -> None:
    """Print one line for each engine and interval."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", default=DATA)
    parser.add_argument("--intervals", type=float, nargs="+", default=INTERVALS, metavar="S")
    parser.add_argument("--profiles", nargs="*", default=("auto", "published"))
    parser.add_argument("--engine", nargs="+", action="append", default=[], metavar="NAME PYTHON FOLDER [PARAMETERS]")
    arguments = parser.parse_args()
    tracks = read_tracks(arguments.data)
    fixes = {interval: sum(len(track.every(interval)) for track in tracks) for interval in arguments.intervals}
    print(f"{len(tracks)} tracks, fixes by interval: {fixes}")
    print(
        f"{'engine':<46}{'s':>4}{'mismatch':>10}{'chosen':>9}{'held out':>10}"
        f"{'right':>8}{'held out':>10}{'fixes/CPU-s':>13}"
    )
    for profile in arguments.profiles:
        ours(tracks[1:2], 1.0, MatchOptions(profile=profile))  # compile
        for interval in arguments.intervals:
            found, seconds = ours(tracks, interval, MatchOptions(profile=profile))
            report(f"probe2road {profile}", interval, score(tracks, found, interval), fixes[interval] / seconds)
    with TemporaryDirectory() as name:
        folder = Path(name)
        if arguments.engine:
            write_problem(tracks, arguments.intervals, folder)
        for engine in arguments.engine:
            label = " ".join([engine[0], *engine[3:]])
            for interval, (found, seconds) in zip(
                arguments.intervals, other_engine(engine, folder).values(), strict=True
            ):
                report(label, interval, score(tracks, found, interval), fixes[interval] / seconds)


def report(engine: str, interval: float, scores: dict[str, float], speed: float) -> None:
    """Print one line of the table."""
    widths = {"all": 10, "chosen on": 9, "held out": 10, "right": 8, "right held out": 10}
    numbers = "".join(f"{scores[name]:>{width}.4f}" for name, width in widths.items())
    print(f"{engine:<46}{interval:>4g}{numbers}{speed:>13,.0f}", flush=True)


if __name__ == "__main__":
    main()
