"""OpenStreetMap files: extracts as reference graphs, and our graphs for JOSM, Valhalla and OSRM.

Coordinates in OSM files are whole multiples of 1e-7 degrees, 1 cm. Objects that we make have negative ids,
which every OSM tool takes for "not uploaded". A road is a way, a junction a node that ways share, a height
the node's ``ele``. What OSM has no tag for is kept under the prefix ``probe2road:``; editors should remove
those tags before an upload.
"""

from __future__ import annotations

import logging
from collections.abc import Collection, Iterable
from os import PathLike
from typing import Any

import geopandas as gpd
import numpy as np
import osmium
import pandas as pd
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import WGS84, crs_to_text, local_crs, parse_crs, require_metric, transform
from probe2road.errors import CRSError, InputError
from probe2road.graph.direction import driving_direction
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.graph.tables import edges_with_turns
from probe2road.io.atomic import atomic_path
from probe2road.io.graph_tables import OWN_COLUMNS, graph_from_edge_table, outgoing, text_value, typed_column

__all__ = ["DRIVABLE", "read_osm", "write_osm"]

logger = logging.getLogger(__name__)

_CLASSES = ("motorway", "trunk", "primary", "secondary", "tertiary")
DRIVABLE = frozenset(
    [
        *_CLASSES,
        *(f"{name}_link" for name in _CLASSES),
        "unclassified",
        "residential",
        "living_street",
        "service",
        "road",
    ]
)  # values of the highway tag that cars drive on

_KEPT_TAGS = ("highway", "oneway", "layer", "bridge", "tunnel", "lanes", "name")
_PREFIX = "probe2road:"
_GENERATOR = "probe2road; crs="
_DECIMALS = 7  # of a degree, in every OSM file


def read_osm(
    path: str | PathLike[str], *, target_crs: Any = None, highways: Collection[str] | None = DRIVABLE
) -> RoadGraph:
    """Read the roads of an OSM extract (``.osm``, ``.osm.pbf`` and what else osmium reads).

    Ways are split where they share a node, so that a bridge stays apart from the road below. A file written
    by `write_osm` comes back as the graph it was, to the 1 cm of the format.

    Parameters
    ----------
    path
        The file.
    target_crs
        Metric CRS to work in; otherwise the recorded one, or a local one.
    highways
        Values of the ``highway`` tag to keep; None keeps every way that has one. Files written by us are
        read whole.

    Returns
    -------
    RoadGraph
        With the tags ``highway``, ``oneway``, ``layer``, ``bridge``, ``tunnel``, ``lanes``, ``name`` and the
        way's id ``osmid`` as columns. ``oneway`` is filled in for roundabouts and motorways, which imply it.

    Raises
    ------
    InputError
        If the file is damaged or holds no road of these classes.

    See Also
    --------
    write_osm
    """
    try:
        recorded = _recorded_crs(path)
        ways, refs = _read_ways(path, None if recorded is not None else highways)
        nodes = _read_nodes(path, refs)
    except CRSError:
        raise  # a ValueError as well, and says what is wrong
    except (RuntimeError, ValueError) as error:  # osmium's own errors are RuntimeErrors
        raise InputError(
            f"cannot be read as OSM data ({error})", where=path, fix="check that it is complete"
        ) from error
    if recorded is None and ways.empty:
        classes = "any highway tag" if highways is None else f"highway = {', '.join(sorted(highways))}"
        raise InputError(f"holds no way with {classes}", where=path, fix="check the extract, or choose other classes")
    if target_crs is None:
        target_crs = recorded or local_crs(nodes["lon"], nodes["lat"])
    target = require_metric(parse_crs(target_crs, where=path), where=path)
    if recorded is not None:
        return _restored(ways, refs, nodes, target, path)
    return _split_at_junctions(ways, refs, nodes, target, path)


def _recorded_crs(path: str | PathLike[str]) -> CRS | None:
    """Return the metric CRS in the header of a file of ours, None in one from elsewhere."""
    with osmium.io.Reader(str(path), osmium.osm.osm_entity_bits.NOTHING) as reader:
        generator = reader.header().get("generator")
    return parse_crs(generator.removeprefix(_GENERATOR), where=path) if generator.startswith(_GENERATOR) else None


def _read_ways(path: str | PathLike[str], highways: Collection[str] | None) -> tuple[pd.DataFrame, NDArray[np.int64]]:
    """Return the tags of the ways, with ``osmid`` and ``n_nodes``, and the ids of their nodes end to end."""
    rows, refs = [], []
    objects: Iterable[Any] = osmium.FileProcessor(str(path), osmium.osm.WAY)
    for way in objects:
        tags = dict(way.tags)
        wanted = "highway" in tags and (highways is None or tags["highway"] in highways)
        if not wanted or tags.get("area") == "yes":
            continue
        ids = [node.ref for node in way.nodes]
        ids = [ref for ref, before in zip(ids, [None, *ids], strict=False) if ref != before]
        if len(ids) > 1:
            rows.append({"osmid": way.id, "n_nodes": len(ids), **tags})
            refs += ids
    return pd.DataFrame(rows, columns=None if rows else ["osmid", "n_nodes"]), np.array(refs, np.int64)


def _read_nodes(path: str | PathLike[str], refs: NDArray[np.int64]) -> pd.DataFrame:
    """Return ``lon``, ``lat``, ``ele`` (NaN where not tagged) of the nodes that are wanted and there."""
    wanted = set(refs.tolist())
    rows = []
    objects: Iterable[Any] = osmium.FileProcessor(str(path), osmium.osm.NODE)
    for node in objects:
        if node.id in wanted:
            ele = node.tags.get("ele") if len(node.tags) else None
            rows.append((node.id, node.lon, node.lat, ele))
    nodes = pd.DataFrame(rows, columns=["id", "lon", "lat", "ele"]).drop_duplicates("id", keep="last").set_index("id")
    return nodes.assign(ele=pd.to_numeric(nodes["ele"], errors="coerce").astype("float64"))


def _lines(nodes: pd.DataFrame, refs: NDArray[np.int64], owner: NDArray[np.int64], crs: CRS) -> NDArray[Any]:
    """Draw lines through nodes, those in three dimensions whose every node has a height."""
    x, y = transform(nodes["lon"].to_numpy(), nodes["lat"].to_numpy(), WGS84, crs)
    coordinates = np.column_stack([x, y, nodes["ele"]])[nodes.index.get_indexer(refs)]
    lines = shapely.linestrings(coordinates, indices=owner)
    in_plan = np.zeros(len(lines), bool)
    in_plan[owner[np.isnan(coordinates[:, 2])]] = True
    return np.where(in_plan, shapely.force_2d(lines), lines)


def _split_at_junctions(
    ways: pd.DataFrame, refs: NDArray[np.int64], nodes: pd.DataFrame, target: CRS, path: object
) -> RoadGraph:
    """Cut ways at the nodes they share, and keep the parts whose every node is in the file."""
    there = nodes.index.get_indexer(refs) >= 0
    way = np.repeat(np.arange(len(ways)), ways["n_nodes"])
    whole = np.ones(len(ways), bool)
    whole[way[~there]] = False  # an extract may cut a way off: what lies outside is unknown
    if not whole.all():
        logger.warning("%s: %d ways reach beyond the extract and are left out", path, int((~whole).sum()))
    refs, way = refs[whole[way]], way[whole[way]]
    if not len(refs):
        raise InputError("no way has its nodes in the file", where=path, fix="make the extract with complete ways")

    # A vertex is a junction where ways end or where its node is used more than once.
    is_end = np.diff(way, prepend=-1) != 0
    is_last = np.append(is_end[1:], True)
    _, place, uses = np.unique(refs, return_inverse=True, return_counts=True)
    cut = (uses[place] > 1) & ~is_end & ~is_last
    # Every cut vertex is drawn twice: as the last of one part and the first of the next.
    repeats = np.where(cut, 2, 1)
    drawn = np.repeat(np.arange(len(refs)), repeats)
    starts_part = np.repeat(is_end, repeats)
    starts_part[np.cumsum(repeats)[cut] - 1] = True
    part = np.cumsum(starts_part) - 1
    way_of_part = way[drawn][starts_part]

    lines = _lines(nodes, refs[drawn], part, target)
    tags = ways.reindex(columns=["osmid", *_KEPT_TAGS]).assign(oneway=_oneway(ways))
    graph = graph_from_lines(lines, crs=target, origin="reference", snap=1e-6, attributes=tags.iloc[way_of_part])
    logger.info("%s: %d ways became %s", path, int(whole.sum()), graph)
    return graph


def _oneway(ways: pd.DataFrame) -> pd.Series:
    """Return the oneway tag, with what roundabouts and motorways imply filled in."""
    tags = ways.reindex(columns=["oneway", "junction", "highway"])
    implied = tags["junction"].isin(["roundabout", "circular"]) | tags["highway"].isin(["motorway", "motorway_link"])
    return tags["oneway"].where(tags["oneway"].notna() | ~implied, "yes")


def _restored(ways: pd.DataFrame, refs: NDArray[np.int64], nodes: pd.DataFrame, target: CRS, path: object) -> RoadGraph:
    """Undo `write_osm`."""
    n_nodes = ways["n_nodes"].to_numpy(np.int64)
    if (nodes.index.get_indexer(refs) < 0).any():
        raise InputError("some nodes of its ways are missing", where=path, fix="write it again")
    lines = _lines(nodes, refs, np.repeat(np.arange(len(ways)), n_nodes), target)
    ours = ways[[name for name in ways if name.startswith(_PREFIX)]].rename(
        columns=lambda name: name.removeprefix(_PREFIX)
    )
    table = gpd.GeoDataFrame(ours.apply(typed_column), geometry=lines, crs=target)
    if not set(OWN_COLUMNS) <= set(table):
        table = table.reindex(columns=[*OWN_COLUMNS, "geometry"])
    return graph_from_edge_table(table, where=path)


def write_osm(graph: RoadGraph, path: str | PathLike[str]) -> None:
    """Write one way per edge to an OSM file, XML or PBF by suffix; edges share the node at a junction.

    A way is tagged ``highway`` (``road``, the class of a road whose class is unknown, unless the edge says
    otherwise), ``oneway`` where it is known, ``source`` and our columns under their prefix. The metric CRS
    is recorded in the header.

    Raises
    ------
    OutputError
        If the file cannot be written or the graph holds private columns.
    """
    graph = outgoing(graph, where=path)
    positions, node_lists = _numbered_nodes(graph)
    tags = _way_tags(graph)
    header = osmium.io.Header()
    header.set("generator", f"{_GENERATOR}{crs_to_text(graph.crs)}")
    with atomic_path(path) as temporary, osmium.SimpleWriter(str(temporary), header=header) as writer:
        for number, (lon, lat, z) in enumerate(positions.tolist(), start=1):
            height = {"ele": f"{z:.3f}"} if np.isfinite(z) else {}
            writer.add_node(osmium.osm.mutable.Node(id=-number, version=1, location=(lon, lat), tags=height))
        for number, (refs, pairs) in enumerate(zip(node_lists, tags, strict=True), start=1):
            writer.add_way(osmium.osm.mutable.Way(id=-number, version=1, nodes=refs, tags=pairs))


def _numbered_nodes(graph: RoadGraph) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Return positions ``(lon, lat, z)`` of shape ``(n, 3)``, junctions first, and the ids of every edge's nodes."""
    coordinates, owner = shapely.get_coordinates(graph.edges.geometry.to_numpy(), include_z=True, return_index=True)
    n_edges, used = len(graph.edges), np.unique(graph.edges[["u", "v"]])
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
    return rounded, [part.tolist() for part in np.split(-(number + 1), heads[1:])] if n_edges else []


def _way_tags(graph: RoadGraph) -> list[dict[str, str]]:
    """Return the tags of every edge."""
    table = pd.DataFrame(edges_with_turns(graph.edges, graph.turns).drop(columns=["geometry", "length"]))
    direction = driving_direction(graph.edges).map({1: "yes", -1: "-1"}).array
    plain = {"highway": "road", **{name: table[name].array for name in _KEPT_TAGS if name in table}}
    public = pd.DataFrame({**plain, "oneway": direction, "source": "probe2road"}, index=table.index)
    public["highway"] = public["highway"].fillna("road")
    text = pd.concat([public, table.add_prefix(_PREFIX)], axis=1).astype(object).map(text_value)
    return [{key: value for key, value in row.items() if isinstance(value, str)} for row in text.to_dict("records")]
