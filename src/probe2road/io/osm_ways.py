"""The roads in an OpenStreetMap file: ways of chosen classes, where their nodes lie, and where they meet.

Strategy: osmium keeps the positions of nodes, takes the ways of the wanted classes and looks their nodes up, all before
Python sees an object, so nodes of buildings and forests cost next to nothing. The file may hold ways before nodes, as
answers of Overpass do. osmium keeps no node with a negative id, which is how editors and we mark new objects: those
are read one by one.

``osmium.filter.IdFilter`` was tried for the nodes. It has a bit for every id that there could be, 1.5 GB today, and
takes longer to fill than the nodes of a city take to read.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
import osmium
import pandas as pd
from numpy.typing import NDArray
from osmium.filter import KeyFilter, TagFilter

from probe2road.io.compressed import unpacked
from probe2road.io.guard import parsing

__all__ = [
    "OsmWays",
    "WayParts",
    "osm_errors",
    "placed_parts",
    "read_heights",
    "read_restrictions",
    "read_ways",
    "split_at_shared_nodes",
]


_PER_DEGREE = 10_000_000  # OpenStreetMap counts positions in whole multiples of 1e-7 degrees
_BLOCK, _LONGEST_TAG = 1 << 22, 4096  # bytes of a file read at once, and of the longest start tag of a way
_DELETED_WAY = re.compile(rb"""<way\s[^<>]*?\baction=['"]delete['"][^<>]*>""")
_ID = re.compile(rb"""\sid=['"](-?\d{1,18})['"]""")
_NO_POSITION = 2_147_483_647  # what osmium has for a node that is not in the file


@dataclass(frozen=True)
class OsmWays:
    """The ways of a file, in its order, with their vertices in flat arrays.

    Attributes
    ----------
    ids
        Shape (ways,).
    tags
        Key to value, one dictionary for each way.
    way
        Shape (vertices,): row of the way that each vertex belongs to.
    refs
        Shape (vertices,): id of the node at the vertex.
    lon, lat
        Shape (vertices,): degrees; NaN where the file has no such node, or no position for it.
    """

    ids: NDArray[np.int64]
    tags: list[dict[str, str]]
    way: NDArray[np.int64]
    refs: NDArray[np.int64]
    lon: NDArray[np.float64]
    lat: NDArray[np.float64]

    @property
    def n_nodes(self) -> NDArray[np.int64]:
        """Return the number of vertices of each way, shape (ways,)."""
        return np.bincount(self.way, minlength=len(self.ids))

    @property
    def placed(self) -> NDArray[np.bool_]:
        """Tell which vertices have a known position, shape (vertices,)."""
        return np.isfinite(self.lon)

    def tag_table(self, keys: Collection[str]) -> pd.DataFrame:
        """Return the values of some tags, one row for each way; a key without any value is no column."""
        there = [key for key in keys if any(key in tags for tags in self.tags)]
        values = {key: [tags.get(key) for tags in self.tags] for key in there}
        return pd.DataFrame(values, index=pd.RangeIndex(len(self.ids)), dtype="str")

    def select_vertices(self, chosen: NDArray[Any]) -> OsmWays:
        """Return all ways with only the vertices of a mask or an array of rows."""
        return replace(self, way=self.way[chosen], refs=self.refs[chosen], lon=self.lon[chosen], lat=self.lat[chosen])

    def select_ways(self, kept: NDArray[np.bool_]) -> OsmWays:
        """Return the ways of a mask of shape (ways,)."""
        inside = self.select_vertices(kept[self.way])
        tags = [tags for tags, wanted in zip(self.tags, kept.tolist(), strict=True) if wanted]
        return replace(inside, ids=self.ids[kept], tags=tags, way=(np.cumsum(kept) - 1)[inside.way])


def placed_parts(ways: OsmWays) -> OsmWays:
    """Cut ways at vertices without a position; the parts between them keep the id and the tags.

    An extract that was cut at a line holds the nodes inside only. No chord joins where a way leaves and comes back.

    Examples
    --------
    >>> out = np.array([9.0, 9.1, np.nan, 9.3, 9.4, np.nan, 9.6])
    >>> ways = OsmWays(np.array([7]), [{}], np.zeros(7, int), np.arange(7), out, out)
    >>> parts = placed_parts(ways)
    >>> parts.ids.tolist(), parts.refs.tolist(), parts.way.tolist()
    ([7, 7], [0, 1, 3, 4], [0, 0, 1, 1])
    """
    placed = ways.placed
    if placed.all():
        return ways
    starts = placed & ((np.diff(ways.way, prepend=-1) != 0) | ~np.append(False, placed[:-1]))
    part = np.cumsum(starts)[placed] - 1
    inside = ways.select_vertices(placed)
    of_way = inside.way[np.unique(part, return_index=True)[1]]
    parts = replace(inside, ids=ways.ids[of_way], tags=[ways.tags[row] for row in of_way.tolist()], way=part)
    return parts.select_ways(parts.n_nodes > 1)


@dataclass(frozen=True)
class WayParts:
    """Ways cut where they meet; a vertex at which a way is cut appears twice.

    Attributes
    ----------
    vertex
        Shape (drawn,): the vertex of the ways that is drawn.
    part
        Shape (drawn,): the number of the part that it belongs to.
    first, last
        Shape (parts,): where in ``vertex`` each part begins and ends.
    """

    vertex: NDArray[np.int64]
    part: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]


def osm_errors(path: str | PathLike[str]) -> AbstractContextManager[None]:
    """Convert the errors of osmium to ours; see `probe2road.io.guard.parsing`."""
    return parsing(path, "cannot be read as OSM data")


def read_ways(path: str | PathLike[str], highways: Collection[str] | None) -> OsmWays:
    """Read the ways of some classes, with all their tags and the positions of their nodes.

    Parameters
    ----------
    path
        The file.
    highways
        Values of the ``highway`` tag to keep; None keeps every way that has one.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    if highways is None:
        wanted: Any = KeyFilter("highway")
    else:  # the filter wants a value: no road has an empty one
        wanted = TagFilter(*[("highway", kind) for kind in highways or [""]])
    ids, tags, n_nodes, refs, x, y = [], [], [], [], [], []
    with osm_errors(path):
        positions = _positions(path)
        for item in osmium.FileProcessor(str(path), osmium.osm.WAY).with_filter(wanted).with_filter(positions):
            way: Any = item
            if way.deleted or not way.visible:
                continue
            ids.append(way.id)
            tags.append(dict(way.tags))
            n_nodes.append(len(way.nodes))
            for node in way.nodes:
                refs.append(node.ref)
                x.append(node.x)
                y.append(node.y)
    lon, lat = (np.where(np.array(part) == _NO_POSITION, np.nan, np.array(part) / _PER_DEGREE) for part in (x, y))
    way_of_vertex = np.repeat(np.arange(len(ids)), n_nodes)
    ways = OsmWays(np.array(ids, np.int64), tags, way_of_vertex, np.array(refs, np.int64), lon, lat)
    ways = _with_inline_positions(_with_new_nodes(ways, path), path, wanted)
    deleted = _marked_for_deletion(path)
    return ways.select_ways(~np.isin(ways.ids, list(deleted))) if deleted else ways


def _with_inline_positions(ways: OsmWays, path: str | PathLike[str], wanted: Any) -> OsmWays:
    """Fill in positions at the node references of ways, which Overpass (``out geom``) and osmium can write."""
    if ways.placed.all():
        return ways
    x, y = [], []
    with osm_errors(path):
        for item in osmium.FileProcessor(str(path), osmium.osm.WAY).with_filter(wanted):
            way: Any = item
            if way.deleted or not way.visible:
                continue
            for node in way.nodes:
                x.append(node.x)
                y.append(node.y)
    lon, lat = (np.where(np.array(part) == _NO_POSITION, np.nan, np.array(part) / _PER_DEGREE) for part in (x, y))
    placed = ways.placed
    return replace(ways, lon=np.where(placed, ways.lon, lon), lat=np.where(placed, ways.lat, lat))


def _marked_for_deletion(path: str | PathLike[str]) -> set[int]:
    """Return the ids of ways that JOSM has marked for deletion, which osmium does not report."""
    if not str(path).lower().endswith((".osm", ".gz", ".bz2")):
        return set()
    found: set[int] = set()
    with osm_errors(path), unpacked(path) as file:
        rest = b""
        while block := file.read(_BLOCK):
            text = rest + block
            for tag in _DELETED_WAY.finditer(text):
                if ident := _ID.search(tag[0]):
                    found.add(int(ident[1]))
            rest = text[-_LONGEST_TAG:]  # a tag may go on in the next block; ids are collected once
    return found


def _positions(path: str | PathLike[str]) -> osmium.NodeLocationsForWays:
    """Return a filter that gives nodes of ways their positions; nodes with negative ids get none."""
    positions = osmium.NodeLocationsForWays(osmium.index.create_map("flex_mem"))
    positions.ignore_errors()
    with osmium.io.Reader(str(path), osmium.osm.NODE) as reader:
        osmium.apply(reader, positions)
    return positions


def _with_new_nodes(ways: OsmWays, path: str | PathLike[str]) -> OsmWays:
    """Fill in the positions of nodes with negative ids."""
    new = ways.refs < 0
    if not new.any():
        return ways
    with osm_errors(path):
        nodes: Iterable[Any] = osmium.FileProcessor(str(path), osmium.osm.NODE)
        found = {node.id: (node.lon, node.lat) for node in nodes if node.id < 0 and node.location.valid()}
    lon, lat = ways.lon.copy(), ways.lat.copy()
    unknown = (np.nan, np.nan)
    lon[new], lat[new] = np.array([found.get(ref, unknown) for ref in ways.refs[new].tolist()]).T
    return replace(ways, lon=lon, lat=lat)


def read_heights(path: str | PathLike[str], ways: OsmWays) -> NDArray[np.float64]:
    """Read the heights that nodes carry as ``ele``: metres, shape (vertices,), NaN where there is none.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    with osm_errors(path):
        nodes: Iterable[Any] = osmium.FileProcessor(str(path), osmium.osm.NODE).with_filter(KeyFilter("ele"))
        found = {node.id: node.tags["ele"] for node in nodes}
    text = pd.Series([found.get(ref) for ref in ways.refs.tolist()], dtype="str")
    return pd.to_numeric(text, errors="coerce").to_numpy(np.float64, na_value=np.nan)


def read_restrictions(path: str | PathLike[str]) -> list[tuple[str, dict[str, list[int]]]]:
    """Read the turn restrictions: the value of each, and the ids of its members by role and kind.

    A role and a kind make one key: ``from_w`` holds ways that are turned from, ``via_n`` nodes.

    Raises
    ------
    InputError
        If the file is damaged.
    """
    restrictions = []
    with osm_errors(path):
        relations: Any = osmium.FileProcessor(str(path), osmium.osm.RELATION)
        for relation in relations.with_filter(TagFilter(("type", "restriction"))):
            members: dict[str, list[int]] = {}
            for member in relation.members:
                members.setdefault(f"{member.role}_{member.type}", []).append(member.ref)
            restrictions.append((relation.tags.get("restriction", ""), members))
    return restrictions


def split_at_shared_nodes(ways: OsmWays) -> WayParts:
    """Cut ways at the nodes that are used more than once, by several ways or by one.

    Every way needs two vertices or more.

    Examples
    --------
    >>> street, lane = [1, 2, 3], [2, 4]
    >>> nowhere = np.full(5, np.nan)
    >>> way, refs = np.array([0, 0, 0, 1, 1]), np.array(street + lane)
    >>> ways = OsmWays(np.array([7, 8]), [{}, {}], way, refs, nowhere, nowhere)
    >>> parts = split_at_shared_nodes(ways)
    >>> ways.refs[parts.vertex].tolist(), parts.part.tolist()
    ([1, 2, 2, 3, 2, 4], [0, 0, 1, 1, 2, 2])
    """
    begins = np.diff(ways.way, prepend=-1) != 0
    ends = np.append(begins[1:], True)[: len(begins)]
    _, node, uses = np.unique(ways.refs, return_inverse=True, return_counts=True)
    cut = (uses[node] > 1) & ~begins & ~ends
    # Every vertex that is cut is drawn twice: as the last of one part and the first of the next.
    repeats = np.where(cut, 2, 1)
    vertex = np.repeat(np.arange(len(cut)), repeats)
    starts = np.repeat(begins, repeats)
    starts[np.cumsum(repeats)[cut] - 1] = True
    first = np.flatnonzero(starts)
    return WayParts(vertex, np.cumsum(starts) - 1, first, np.append(first[1:], len(vertex))[: len(first)] - 1)
