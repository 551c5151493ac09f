"""Writing of road graphs as OpenStreetMap files, in two dialects: one for editors, one for routing engines.

Coordinates in OSM files are whole multiples of 1e-7 degrees, 1 cm. A road is a way, a junction a node that ways share,
a height the node's ``ele``. What OSM has no tag for is kept under the prefix ``probe2road:``; mappers should remove
those tags before an upload.

========================  ========================================  =============================================
what                      editor                                    router
========================  ========================================  =============================================
ids                       negative: new, not uploaded               positive and ascending, as engines need them
class unknown             ``highway=road``: to be surveyed          ``highway=unclassified``: engines drive on it
seen on drives            only under the prefix                     also ``maxspeed``, ``layer``
turns that nobody makes   no                                        turn restrictions
========================  ========================================  =============================================
"""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal

import numpy as np
import osmium
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.bounds import Positive
from probe2road.crs import WGS84, crs_to_text, transform
from probe2road.errors import OptionError
from probe2road.graph.direction import ONEWAY_TAGS, DirectionOptions, driving_direction
from probe2road.graph.levels import crossing_layers
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import edges_with_turns
from probe2road.graph.untaken import untaken_turns
from probe2road.io.atomic import atomic_path
from probe2road.io.graph_tables import outgoing, text_value
from probe2road.options import checked

__all__ = ["GENERATOR", "KEPT_TAGS", "PREFIX", "OsmOptions", "write_osm"]

KEPT_TAGS = ("highway", "oneway", "layer", "bridge", "tunnel", "lanes", "name")  # tags that are columns of an edge
PREFIX = "probe2road:"  # of the tags that are our columns
GENERATOR = "probe2road; crs="  # in the header, before the metric CRS

_DECIMALS = 7  # of a degree, in every OSM file
_UNKNOWN_CLASS = {"editor": "road", "router": "unclassified"}
_LEAST_SPEED = 5.0  # km/h; a slower maxspeed closes a road to some engines
_LARGEST_ID = 2**63 - 1
_COURSE = 10.0  # m of an edge, over which its direction at a junction is measured
_STRAIGHT, _BACK = 30.0, 150.0  # degrees of a turn, up to which it goes straight on, and from which it goes back


@dataclass(frozen=True)
@checked
class OsmOptions:
    """How a graph is written as an OSM file."""

    dialect: Literal["editor", "router"] | None = None  # for whom; None: router for .osm.pbf, editor for others
    first_id: Positive[int] = 1  # of the nodes, of the ways and of the relations for routers
    min_expected: Positive[float] = 5.0  # drives expected on a turn that nobody made, from which on it is forbidden

    def of(self, path: str | PathLike[str]) -> Literal["editor", "router"]:
        """Return the dialect of a file.

        Examples
        --------
        >>> OsmOptions().of("roads.osm.pbf"), OsmOptions().of("roads.osm")
        ('router', 'editor')
        """
        return self.dialect or ("router" if str(path).lower().endswith(".pbf") else "editor")


def write_osm(graph: RoadGraph, path: str | PathLike[str], *, options: OsmOptions | None = None) -> None:
    """Write one way per edge to an OSM file, XML, PBF or OsmChange by suffix; edges share the node at a junction.

    A way is tagged ``highway``, ``oneway=yes`` where it is one-way, ``source`` and our columns under their prefix. The
    metric CRS is recorded in the header. For routing engines a way also gets ``maxspeed``, the mean speed of its drives
    in km/h, and ``layer`` where it passes over another road; turns that were possible for many drives and made by none
    become restrictions. Tags that an edge brings as columns go before all of these.

    Parameters
    ----------
    graph
        What to write.
    path
        File with the suffix ``.osm``, ``.osm.pbf`` or ``.osc``.
    options
        None takes the defaults.

    Raises
    ------
    OptionError
        If ids beyond 2**63 - 1 would be needed.
    OutputError
        If the file cannot be written or the graph holds private columns.

    Examples
    --------
    >>> import tempfile
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> from probe2road.io.osm_ways import read_ways
    >>> graph = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_osm(graph, f"{folder}/roads.osm.pbf", options=OsmOptions(first_id=700))
    ...     ways = read_ways(f"{folder}/roads.osm.pbf", None)
    >>> ways.ids.tolist(), ways.refs.tolist(), ways.tags[0]["highway"]
    ([700], [700, 701], 'unclassified')
    """
    options = options or OsmOptions()
    graph = outgoing(graph, where=path)
    router = options.of(path) == "router"
    positions, node_lists = _numbered_nodes(graph)
    if options.first_id + max(len(positions), len(graph.edges)) > _LARGEST_ID:
        raise OptionError(f"first_id is {options.first_id}", where=path, fix="use ids below 2**63")
    first, step = (options.first_id, 1) if router else (-1, -1)
    tags = _way_tags(graph, router=router)
    header = osmium.io.Header()
    header.set("generator", f"{GENERATOR}{crs_to_text(graph.crs)}")
    made = osmium.osm.mutable
    with atomic_path(path) as temporary, _writer(temporary, header) as writer:
        for number, (lon, lat, z) in zip(itertools.count(first, step), positions.tolist(), strict=False):
            height = {"ele": f"{z:.3f}"} if np.isfinite(z) else {}
            writer.add_node(made.Node(id=number, version=1, location=(lon, lat), tags=height))
        for number, refs, pairs in zip(itertools.count(first, step), node_lists, tags, strict=False):
            nodes = (first + step * refs).tolist()
            writer.add_way(made.Way(id=number, version=1, nodes=nodes, tags=pairs))
        if router:
            for number, (start, via, end, kind) in enumerate(_restrictions(graph, options), start=first):
                members = [("w", first + start, "from"), ("n", first + via, "via"), ("w", first + end, "to")]
                pairs = {"type": "restriction", "restriction": kind}
                writer.add_relation(made.Relation(id=number, version=1, members=members, tags=pairs))


@contextmanager
def _writer(path: Path, header: osmium.io.Header) -> Iterator[osmium.SimpleWriter]:
    """Open a writer of osmium, and report a full disk as such."""
    writer = osmium.SimpleWriter(str(path), header=header)
    try:
        yield writer
        writer.close()
    except RuntimeError:
        # A writer that failed ends the process when it is taken down (osmium flushes it once more): it never is.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(writer))
        raise


def _numbered_nodes(graph: RoadGraph) -> tuple[NDArray[np.float64], list[NDArray[np.int64]]]:
    """Return positions ``(lon, lat, z)`` of shape ``(n, 3)``, junctions first, and the rows of every edge's nodes."""
    coordinates, owner = shapely.get_coordinates(graph.edges.geometry.to_numpy(), include_z=True, return_index=True)
    n_edges, used = len(graph.edges), _used_nodes(graph)
    heads = np.searchsorted(owner, np.arange(n_edges))
    tails = np.searchsorted(owner, np.arange(n_edges), side="right") - 1
    number = np.full(len(coordinates), -1)
    for vertex, end in ((heads, "u"), (tails, "v")):
        number[vertex] = np.searchsorted(used, graph.edges[end])
    inner = np.flatnonzero(number < 0)
    number[inner] = len(used) + np.arange(len(inner))
    positions = np.zeros((len(used) + len(inner), 3))
    positions[number[::-1]] = coordinates[::-1]  # the first end at a junction places it
    positions[:, 2] = np.nan
    np.fmax.at(positions[:, 2], number, coordinates[:, 2])  # and the highest gives its height
    lon, lat = transform(positions[:, 0], positions[:, 1], graph.crs, WGS84)
    rounded = np.column_stack([np.round(lon, _DECIMALS), np.round(lat, _DECIMALS), positions[:, 2]])
    return rounded, np.split(number, heads[1:]) if n_edges else []


def _used_nodes(graph: RoadGraph) -> NDArray[np.int64]:
    """Return the ids of the nodes at the ends of edges, ascending: the first nodes of the file."""
    return np.unique(graph.edges[["u", "v"]]).astype(np.int64)


def _way_tags(graph: RoadGraph, *, router: bool) -> list[dict[str, str]]:
    """Return the tags of every edge."""
    table = pd.DataFrame(edges_with_turns(graph.edges, graph.turns).drop(columns=["geometry", "length"]))
    unknown = _UNKNOWN_CLASS["router" if router else "editor"]
    way = _probable_direction(graph.edges) if router else driving_direction(graph.edges)
    oneway = way.map({1: ONEWAY_TAGS[1], -1: ONEWAY_TAGS[-1]}).array
    plain = {"highway": unknown, **(_seen_tags(graph) if router else {})}
    kept = {name: table[name].array for name in KEPT_TAGS if name in table}
    public = pd.DataFrame({**plain, **kept, "oneway": oneway, "source": "probe2road"}, index=table.index)
    public["highway"] = public["highway"].fillna(unknown)
    text = pd.concat([public, table.add_prefix(PREFIX)], axis=1).astype(object).map(text_value)
    return [{key: value for key, value in row.items() if isinstance(value, str)} for row in text.to_dict("records")]


def _probable_direction(edges: pd.DataFrame) -> pd.Series:
    """Return the driving direction of each edge, the more probable one where too few drives were seen to be sure."""
    unweighed = edges.drop(columns="oneway_confidence", errors="ignore")  # which would keep open what was left open
    return driving_direction(unweighed, options=DirectionOptions(min_confidence=0.5))


def _seen_tags(graph: RoadGraph) -> dict[str, NDArray[np.object_]]:
    """Return the tags that engines understand and that follow from the drives."""
    speed = graph.edges.get("speed", pd.Series(np.nan, graph.edges.index)).to_numpy("float64", na_value=np.nan) * 3.6
    layer = crossing_layers(graph)
    return {
        "maxspeed": np.array([f"{max(v, _LEAST_SPEED):.0f}" if np.isfinite(v) else None for v in speed], object),
        "layer": np.array([str(n) if n else None for n in layer], object),
    }


def _restrictions(graph: RoadGraph, options: OsmOptions) -> list[tuple[int, int, int, str]]:
    """Return the rows of the first edge, of the node and of the second edge of each forbidden turn, and its kind."""
    turns = untaken_turns(graph, min_expected=options.min_expected)
    start, end = (graph.edges.index.get_indexer(turns[name]) for name in ("from_edge", "to_edge"))
    node = turns["via_node"].to_numpy()
    via = np.searchsorted(_used_nodes(graph), node)
    at_stop = graph.edges["u"].to_numpy()[[start, end]] != node
    back, on = graph.ends(reach=_COURSE).ahead[2 * np.stack([start, end]) + at_stop]
    aside = on[:, 0] * back[:, 1] - on[:, 1] * back[:, 0]
    turned = np.degrees(np.arctan2(aside, -(on * back).sum(axis=1)))  # to the left
    kinds = np.select(
        [np.abs(turned) <= _STRAIGHT, np.abs(turned) >= _BACK, turned > 0],
        ["no_straight_on", "no_u_turn", "no_left_turn"],
        "no_right_turn",
    )
    return list(zip(start.tolist(), via.tolist(), end.tolist(), kinds.tolist(), strict=True))
