"""OSRM as a map matcher: a road graph prepared for it, a local server, and requests to any server.

The binaries come with the package ``osrm-bindings``. Its wheels are for Python 3.12 and later, but the binaries in them
are programs of their own: beside an older Python, unpack a wheel anywhere with ``pip install --no-deps --only-binary
:all: --python-version 3.12 --target DIR osrm-bindings`` and set ``PROBE2ROAD_OSRM`` to that folder.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import tempfile
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import osmium
from numba import njit
from numpy.typing import NDArray

from probe2road.bounds import NotNegative, Positive, Share
from probe2road.crs import WGS84, transform
from probe2road.errors import InputError, MissingExtraError, OptionError
from probe2road.fleet.contract import Fleet
from probe2road.graph.direction import driving_direction
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.frame import courses, edge_lines, stations_along
from probe2road.matching.servers import free_port, run_program, served
from probe2road.options import checked

__all__ = ["OsrmNetwork", "OsrmOptions", "find_osrm", "osrm_network", "osrm_segments", "osrm_server", "serve_osm"]

logger = logging.getLogger(__name__)

_FOLDER = "PROBE2ROAD_OSRM"  # environment variable
_DECIMALS = 7  # decimals of a degree in OSM files


@dataclass(frozen=True)
@checked
class OsrmOptions:
    """How traces are matched with OSRM (METHOD 5.2)."""

    radius: Positive[float] = 8.0  # m, 1 sigma of fixes; it looks for roads within three times that
    min_confidence: Share = 0.5  # sub-matchings below are dropped
    spacing: NotNegative[float] = 10.0  # m, and
    interval: NotNegative[float] = 1.0  # s, least distances of two fixes that are sent
    chunk: Positive[int] = 200  # fixes in a request
    overlap: NotNegative[int] = 5  # fixes that a request repeats of the one before
    vertex_spacing: Positive[float] = 20.0  # m between vertices of the network, at most: resolution of what was driven
    respect_oneway: bool = True  # whether edges that driving_direction calls one-way are closed the other way
    timeout: Positive[float] = 60.0  # s for an answer

    def __post_init__(self) -> None:
        """Refuse chunks that do not advance."""
        if self.overlap >= self.chunk - 1:
            fault = f"overlap is {self.overlap}, chunk is {self.chunk}"
            raise OptionError(fault, where="OsrmOptions", fix="use a larger chunk")


@dataclass(frozen=True)
class OsrmNetwork:
    """A road graph as OSRM gets it: K segments between V vertices; vertex v is OSM node v + 1."""

    lonlat: NDArray[np.float64]  # (V, 2) degrees
    vertices: NDArray[np.int64]  # (K, 2) vertices of a segment
    edge: NDArray[np.int64]  # (K,) row of the edge that a segment is part of
    low: NDArray[np.float64]  # (K,) m from the start of the edge to that of the segment
    high: NDArray[np.float64]  # (K,) the same for its end
    direction: NDArray[np.int64]  # (E,) 1 from u to v only, -1 from v to u only, 0 both ways

    def segment(self, one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the segments between pairs of vertices, in either order; -1 where there is none."""
        size = len(self.lonlat) + 1
        low, high = self.vertices.min(axis=1), self.vertices.max(axis=1)
        key = low * size + high
        order = np.argsort(key, kind="stable")
        wanted = np.minimum(one, other) * size + np.maximum(one, other)
        place = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
        return np.where(key[order][place] == wanted, order[place], -1)


def find_osrm(folder: str | Path | None = None) -> Path:
    """Return the folder that holds ``bin`` and ``share`` of OSRM.

    Looks in the folder given, in that of the environment variable ``PROBE2ROAD_OSRM``, and where the package
    ``osrm-bindings`` is installed; a folder that a wheel was unpacked into will do as well.

    Raises
    ------
    MissingExtraError
        If there is none.
    InputError
        If the folder given is none.

    Examples
    --------
    >>> find_osrm("nowhere")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: nowhere: holds no bin/osrm-routed; unpack a wheel of osrm-bindings there
    """
    named = folder or os.environ.get(_FOLDER)
    if named:
        for home in (Path(named), Path(named) / "osrm"):
            if (home / "bin" / "osrm-routed").is_file():
                return home
        fix = "unpack a wheel of osrm-bindings there"
        raise InputError("holds no bin/osrm-routed", where=named, fix=fix)
    found = importlib.util.find_spec("osrm")  # looks it up without loading it
    for place in (found.submodule_search_locations or []) if found else []:
        if (Path(place) / "bin" / "osrm-routed").is_file():
            return Path(place)
    raise MissingExtraError(
        "matching with OSRM needs its programs",
        fix="install them with: pip install 'probe2road[osrm]', or beside Python 3.11 with: pip install --no-deps "
        f"--only-binary :all: --python-version 3.12 --target DIR osrm-bindings, and set {_FOLDER}=DIR",
    )


def osrm_network(graph: RoadGraph, options: OsrmOptions | None = None) -> OsrmNetwork:
    """Prepare a road graph for OSRM, with vertices close enough to tell how much of an edge was driven.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> network = osrm_network(graph_from_lines([[(0, 0), (50, 0)], [(50, 0), (50, 15)]], crs="EPSG:32616"))
    >>> network.edge.tolist(), network.high.round(1).tolist()
    ([0, 0, 0, 1], [16.7, 33.3, 50.0, 15.0])
    >>> network.vertices.tolist()
    [[0, 3], [3, 4], [4, 1], [1, 2]]
    """
    options = options or OsrmOptions()
    lines = edge_lines(graph)
    stations = stations_along(lines.length, options.vertex_spacing)
    edge, along, xyz = courses(lines, stations, np.ones(len(stations.edge), bool))
    n_nodes, n_edges = len(graph.nodes), len(graph.edges)
    first = np.searchsorted(edge, np.arange(n_edges))
    last = np.searchsorted(edge, np.arange(n_edges), side="right") - 1
    vertex = np.full(len(edge), -1)
    vertex[first], vertex[last] = graph.end_rows.T
    inner = np.flatnonzero(vertex < 0)
    vertex[inner] = n_nodes + np.arange(len(inner))
    position = np.zeros((n_nodes + len(inner), 2))
    position[vertex] = xyz[:, :2]
    lon, lat = transform(position[:, 0], position[:, 1], graph.crs, WGS84)
    same = np.flatnonzero(np.diff(edge) == 0)
    direction = driving_direction(graph.edges).to_numpy() if options.respect_oneway else np.zeros(n_edges, np.int64)
    return OsrmNetwork(
        lonlat=np.round(np.column_stack([lon, lat]), _DECIMALS),
        vertices=np.column_stack([vertex[same], vertex[same + 1]]),
        edge=edge[same],
        low=along[same],
        high=along[same + 1],
        direction=direction,
    )


@contextmanager
def osrm_server(network: OsrmNetwork, *, folder: str | Path | None = None) -> Iterator[str]:
    """Prepare a network for OSRM, and serve it on this machine until the context ends.

    Parameters
    ----------
    network
        From `osrm_network`.
    folder
        Where OSRM is; see `find_osrm`.

    Yields
    ------
    str
        Address of the server.

    Raises
    ------
    MissingExtraError
        If OSRM is not installed.
    Probe2RoadError
        If one of its programs fails, with the last line it printed.
    """
    home = find_osrm(folder)
    with tempfile.TemporaryDirectory(prefix="probe2road-osrm-") as temporary:
        source = Path(temporary) / "network.osm.pbf"
        _write_network(network, source)
        with serve_osm(source, folder=home) as url:
            yield url


@contextmanager
def serve_osm(source: Path, *, folder: str | Path | None = None) -> Iterator[str]:
    """Prepare an OSM file for OSRM's profile for cars, and serve it on this machine until the context ends.

    Parameters
    ----------
    source
        File with the suffix ``.osm.pbf``; what OSRM makes of it is written beside it.
    folder
        Where OSRM is; see `find_osrm`.

    Yields
    ------
    str
        Address of the server.

    Raises
    ------
    MissingExtraError
        If OSRM is not installed.
    Probe2RoadError
        If one of its programs fails, with the last line it printed.
    """
    home = find_osrm(folder)
    base = source.with_name(source.name.removesuffix(".osm.pbf") + ".osrm")
    profile = home / "share" / "profiles" / "car.lua"
    run_program(home / "bin" / "osrm-extract", "--threads", "1", "--profile", profile, source, where="OSRM")
    for tool in ("osrm-partition", "osrm-customize"):
        run_program(home / "bin" / tool, "--threads", "1", base, where="OSRM")
    port = free_port()
    words = ["--algorithm", "mld", "--ip", "127.0.0.1", "--port", str(port), "--threads", "1"]
    words += ["--max-matching-size", "100000", str(base)]
    with served(home / "bin" / "osrm-routed", *words, port=port, where="OSRM"):
        yield f"http://127.0.0.1:{port}"


def osrm_segments(
    fleet: Fleet, network: OsrmNetwork, url: str, options: OsrmOptions | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ask an OSRM server which segments of its network the traces of a fleet drove.

    Long traces are sent in overlapping pieces; fixes that are closer than the options allow are left out. What the
    server cannot match is skipped, as are sub-matchings that it does not trust.

    Parameters
    ----------
    fleet
        Traces.
    network
        What the server runs on.
    url
        Address of the server, for example ``http://127.0.0.1:5000``.
    options
        None takes the defaults.

    Returns
    -------
    trace, segment : ndarray of int64
        Shape (n,): numbers of traces and segments, each pair once, sorted.

    Raises
    ------
    InputError
        If the server cannot be reached.
    """
    options = options or OsrmOptions()
    starts = fleet.starts
    xy = fleet.traces[["x", "y"]].to_numpy(np.float64)
    clock = fleet.traces["t"].to_numpy("datetime64[ns]")
    known = ~np.isnat(clock)
    seconds = np.full(len(clock), np.nan)
    seconds[known] = (clock[known] - clock[known].min(initial=np.datetime64("2262"))) / np.timedelta64(1, "s")
    sent = np.flatnonzero(_thinned(xy, seconds, starts, options.spacing, options.interval))
    lon, lat = transform(xy[sent, 0], xy[sent, 1], fleet.crs, WGS84)
    bounds = np.searchsorted(sent, starts)
    found: list[NDArray[np.int64]] = [np.zeros((0, 2), np.int64)]
    dropped = 0
    for trace in range(len(starts) - 1):
        for begin in range(bounds[trace], bounds[trace + 1] - 1, options.chunk - options.overlap):
            part = slice(begin, min(begin + options.chunk, bounds[trace + 1]))
            answer = _ask(url, np.column_stack([lon[part], lat[part]]), seconds[sent[part]], options)
            for matching in answer.get("matchings", []):
                if matching["confidence"] < options.min_confidence:
                    dropped += 1
                    continue
                driven = _driven(matching, network)
                found.append(np.column_stack([np.full(len(driven), trace), driven]))
    pairs = np.unique(np.concatenate(found), axis=0)
    logger.info("OSRM: %d fixes sent, %d sub-matchings dropped, %d segments driven", len(sent), dropped, len(pairs))
    return pairs[:, 0], pairs[:, 1]


def _driven(matching: Mapping[str, Any], network: OsrmNetwork) -> NDArray[np.int64]:
    """List the segments that one part of an OSRM matching drove."""
    parts = []
    for leg in matching["legs"]:
        nodes = np.array(leg["annotation"]["nodes"], np.int64) - 1
        parts.append(network.segment(nodes[:-1], nodes[1:]))
    segments = np.concatenate(parts) if parts else np.zeros(0, np.int64)
    return segments[segments >= 0]


def _ask(url: str, lonlat: NDArray[np.float64], seconds: NDArray[np.float64], options: OsrmOptions) -> dict[str, Any]:
    """Send one request to OSRM; return an empty answer if OSRM finds no match."""
    places = ";".join(f"{lon:.7f},{lat:.7f}" for lon, lat in lonlat)
    query = {
        "annotations": "nodes",
        "overview": "false",
        "steps": "false",
        "generate_hints": "false",
        "gaps": "split",
        "radiuses": ";".join([f"{options.radius:g}"] * len(lonlat)),
    }
    if np.isfinite(seconds).all():
        query["timestamps"] = ";".join(str(int(second)) for second in seconds)
    words = "&".join(f"{name}={value}" for name, value in query.items())
    try:
        with urllib.request.urlopen(f"{url}/match/v1/driving/{places}?{words}", timeout=options.timeout) as response:
            return dict(json.load(response))
    except urllib.error.HTTPError as error:
        with error:
            fault = json.loads(error.read() or b"{}")
        if fault.get("code") in ("NoMatch", "NoSegment"):
            return {}
        what = f"refused a request ({fault.get('code')}: {fault.get('message')})"
        raise InputError(what, where=url, fix="check that it is OSRM, and its --max-matching-size") from error
    except OSError as error:
        raise InputError(f"cannot be reached ({error})", where=url, fix="check the address") from error


@njit(cache=True)
def _thinned(
    xy: NDArray[np.float64],
    seconds: NDArray[np.float64],
    starts: NDArray[np.int64],
    spacing: float,
    interval: float,
) -> NDArray[np.bool_]:
    """Keep fixes that are far enough in place and time from the last kept fix (NaN counts as far)."""
    chosen = np.zeros(len(xy), np.bool_)
    for trace in range(len(starts) - 1):
        before = -1
        for fix in range(starts[trace], starts[trace + 1]):
            far = before < 0
            if not far:
                apart = np.hypot(xy[fix, 0] - xy[before, 0], xy[fix, 1] - xy[before, 1])
                far = apart >= spacing and not seconds[fix] - seconds[before] < interval
            if far:
                chosen[fix] = True
                before = fix
    return chosen


def _write_network(network: OsrmNetwork, path: Path) -> None:
    """Write a network as OSM data, one way for each edge, with positive ids because OSRM accepts no others."""
    heads = np.flatnonzero(np.diff(network.edge, prepend=-1))
    with osmium.SimpleWriter(str(path)) as writer:
        for number, place in enumerate(network.lonlat.tolist(), start=1):
            writer.add_node(osmium.osm.mutable.Node(id=number, version=1, location=tuple(place)))
        tails = np.append(heads[1:], len(network.edge))
        for head, tail in zip(heads.tolist(), tails.tolist(), strict=True):
            refs = [*(network.vertices[head:tail, 0] + 1).tolist(), int(network.vertices[tail - 1, 1]) + 1]
            oneway = {1: "yes", -1: "-1", 0: "no"}[int(network.direction[network.edge[head]])]
            tags = {"highway": "primary", "oneway": oneway}
            writer.add_way(osmium.osm.mutable.Way(id=head + 1, version=1, nodes=refs, tags=tags))
