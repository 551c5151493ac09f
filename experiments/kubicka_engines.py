"""Run another map-matching engine on a problem written by kubicka.py; needs only that engine and Python.

PYTHON kubicka_engines.py fastmm|osrm|valhalla FOLDER [PARAMETERS]

FOLDER holds ``problem.json`` and ``network.osm.pbf``; ``result.json`` is written into it. All engines get the
same networks: every pair of twin arcs is one road of one class, open both ways, every single arc is one-way.
PARAMETERS is a JSON object that overrides those of the engine. Building their networks and precomputed tables is not
timed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from time import process_time
from typing import Any

Arc = tuple[int, int]
Solved = tuple[list[Arc], list[Arc | None]]  # arcs driven; arc of every fix
Solver = Callable[[dict[str, Any]], Solved]  # of one thinned track


def fastmm(folder: Path, parameters: dict[str, Any]) -> Callable[[dict[str, Any]], Solver]:
    """FMM (Yang and Gidofalvi 2018) in the package fastmm, with its table of routes up to 6 km."""
    import fastmm as engine  # type: ignore[import-not-found]

    numbers = {"max_candidates": 8, "candidate_search_radius": 50.0, "gps_error": 50.0} | parameters
    reach = numbers.pop("reach", 6000.0)

    def prepare(track: dict[str, Any]) -> Solver:
        network = engine.Network()
        xy = track["node_xy"]
        for number, (u, v) in enumerate(track["arcs"]):
            network.add_edge(number, source=u, target=v, geom=[tuple(xy[u]), tuple(xy[v])])
        network.finalize()
        matcher = engine.FastMapMatch(
            network,
            engine.TransitionMode.SHORTEST,
            max_distance_between_candidates=reach,
            cache_dir=str(folder / "fmm"),
        )

        def solve(case: dict[str, Any]) -> Solved:
            trajectory = engine.Trajectory.from_xy_tuples([tuple(place) for place in case["xy"]])
            result = matcher.match(trajectory, **numbers)
            path: list[int] = []
            fixes: list[int | None] = [None] * len(case["xy"])
            for part in result.subtrajectories:
                before = None
                for place, segment in enumerate(part.segments):
                    edges = [edge.edge_id for edge in segment.edges]
                    path += edges[1:] if edges and edges[0] == before else edges
                    before = edges[-1] if edges else before
                    if edges:
                        fixes[part.start_index + place], fixes[part.start_index + place + 1] = edges[0], edges[-1]
            arcs = [tuple(arc) for arc in track["arcs"]][: network.get_edge_count()]  # keeps the network alive, too
            return [arcs[e] for e in path], [None if e is None else arcs[e] for e in fixes]

        return solve

    return prepare


def osrm(folder: Path, parameters: dict[str, Any]) -> Callable[[dict[str, Any]], Solver]:
    """OSRM with its car profile, multi-level Dijkstra, in this process."""
    import osrm as engine  # type: ignore[import-not-found]

    home = Path(engine.__file__).parent
    base = folder / "network.osrm"
    if not (folder / "network.osrm.mldgr").exists():
        profile = home / "share" / "profiles" / "car.lua"
        tool = str(home / "bin" / "osrm-")
        source = str(folder / "network.osm.pbf")
        subprocess.run([tool + "extract", "-p", str(profile), source], check=True, capture_output=True)
        for step in ("partition", "customize"):
            subprocess.run([tool + step, str(base)], check=True, capture_output=True)
    service = engine.OSRM(
        algorithm="MLD", storage_config=str(base), use_shared_memory=False, max_locations_map_matching=100000
    )
    radius = parameters.get("radius")

    def prepare(track: dict[str, Any]) -> Solver:
        offset = track["offset"]

        def solve(case: dict[str, Any]) -> Solved:
            further = {} if radius is None else {"radiuses": [radius] * len(case["lonlat"])}
            asked = engine.MatchParameters(
                coordinates=[tuple(place) for place in case["lonlat"]], timestamps=[int(t) for t in case["t"]],
                annotations=["nodes"], gaps=parameters.get("gaps", "ignore"), tidy=parameters.get("tidy", False),
                generate_hints=False, **further,
            )  # fmt: skip
            try:
                result = service.Match(asked)
            except RuntimeError:
                return [], [None] * len(case["t"])
            path: list[Arc] = []
            legs = []
            for matching in result["matchings"]:
                arcs: list[list[Arc]] = []
                for leg in matching["legs"]:
                    nodes = [int(node) - offset for node in leg["annotation"]["nodes"]]
                    pairs = list(pairwise(nodes))
                    path += pairs[1:] if arcs and pairs and arcs[-1] and pairs[0] == arcs[-1][-1] else pairs
                    arcs.append(pairs)
                legs.append(arcs)
            fixes: list[Arc | None] = []
            for point in result["tracepoints"]:
                found = None
                if point is not None:
                    arcs, place = legs[int(point["matchings_index"])], int(point["waypoint_index"])
                    if place < len(arcs) and arcs[place]:
                        found = arcs[place][0]
                    elif place > 0 and arcs[place - 1]:
                        found = arcs[place - 1][-1]
                fixes.append(found)
            return path, fixes

        return solve

    return prepare


def valhalla(folder: Path, parameters: dict[str, Any]) -> Callable[[dict[str, Any]], Solver]:
    """Valhalla's Meili with costing auto, in this process."""
    import valhalla as engine  # type: ignore[import-not-found]

    tiles = folder / "valhalla"
    tiles.mkdir(exist_ok=True)
    config = engine.get_config(tile_extract="", tile_dir=str(tiles))
    for name in ("admin", "timezone"):
        config["mjolnir"].pop(name, None)
    config["service_limits"]["trace"] |= {
        "max_shape": 100000,
        "max_distance": 1e7,
        "max_gps_accuracy": 100.0,
        "max_search_radius": 200.0,
    }
    config["meili"]["customizable"] = [
        "mode",
        "search_radius",
        "turn_penalty_factor",
        "gps_accuracy",
        "sigma_z",
        "beta",
        "interpolation_distance",
        "breakage_distance",
        "max_route_distance_factor",
        "max_route_time_factor",
    ]
    config["meili"]["default"] |= {key: value for key, value in parameters.items() if key in config["meili"]["default"]}
    config["meili"]["auto"] |= {key: value for key, value in parameters.items() if key in config["meili"]["auto"]}
    (folder / "valhalla.json").write_text(json.dumps(config))
    if not any(tiles.rglob("*.gph")):
        program = Path(engine.__file__).parent / "bin" / "valhalla_build_tiles"
        subprocess.run(
            [str(program), "-c", str(folder / "valhalla.json"), str(folder / "network.osm.pbf")],
            check=True,
            capture_output=True,
        )
    actor = engine.Actor(str(folder / "valhalla.json"))

    def prepare(track: dict[str, Any]) -> Solver:
        roads = {way: tuple(arc) for way, arc in track["ways"]}
        nodes = track["nodes"]

        def solve(case: dict[str, Any]) -> Solved:
            shape = [
                {"lon": lon, "lat": lat, "time": t} for (lon, lat), t in zip(case["lonlat"], case["t"], strict=True)
            ]
            asked = {"shape": shape, "costing": "auto", "shape_match": "map_snap", "trace_options": parameters}
            try:
                result = actor.trace_attributes(asked)
            except (RuntimeError, ValueError) as error:
                print(error, file=sys.stderr)
                return [], [None] * len(shape)
            places = _decoded(result["shape"])
            arcs: list[Arc] = []
            for edge in result["edges"]:
                u, v = roads[edge["way_id"]]
                begin, end = places[edge["begin_shape_index"]], places[edge["end_shape_index"]]
                along = sum((end[k] - begin[k]) * (nodes[v][k] - nodes[u][k]) for k in range(2))
                arcs.append((u, v) if along >= 0 else (v, u))
            fixes = [
                arcs[p["edge_index"]] if p.get("edge_index", 2**62) < len(arcs) else None
                for p in result["matched_points"]
            ]
            path = [arc for place, arc in enumerate(arcs) if place == 0 or arc != arcs[place - 1]]
            return path, fixes

        return solve

    return prepare


def _decoded(text: str) -> list[tuple[float, float]]:
    """Decode a polyline with six decimals into pairs of longitude and latitude."""
    places, lat, lon, values = [], 0, 0, []
    value = shift = 0
    for letter in text.encode():
        value |= ((letter - 63) & 31) << shift
        shift += 5
        if letter - 63 < 32:
            values.append(~(value >> 1) if value & 1 else value >> 1)
            value = shift = 0
    for north, east in zip(values[0::2], values[1::2], strict=True):
        lat, lon = lat + north, lon + east
        places.append((lon / 1e6, lat / 1e6))
    return places


def main() -> None:
    """Solve every case of the problem."""
    name, folder = sys.argv[1], Path(sys.argv[2])
    parameters = json.loads(sys.argv[3]) if len(sys.argv) > 3 else {}
    problem = json.loads((folder / "problem.json").read_text())
    prepare = {"fastmm": fastmm, "osrm": osrm, "valhalla": valhalla}[name](folder, parameters)
    results: dict[str, list[Any]] = {interval: [] for interval in problem["intervals"]}
    seconds = dict.fromkeys(problem["intervals"], 0.0)
    for track in problem["tracks"]:
        solve = prepare(track)
        for interval in problem["intervals"]:
            case = track["cases"][interval]
            started = process_time()
            path, fixes = solve(case)
            seconds[interval] += process_time() - started
            results[interval].append({"path": path, "fixes": fixes})
    (folder / "result.json").write_text(json.dumps({"results": results, "seconds": seconds}))


if __name__ == "__main__":
    main()
