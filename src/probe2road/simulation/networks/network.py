"""The road network of the simulator: directed sections with lanes, in three dimensions.

A section is a stretch of one carriageway between two nodes, drawn from ``u`` to ``v``: in the driving direction
where it is one-way. Its line is the middle of all its lanes. Sections meet only at nodes; where two lines cross
in plan without a common node, one passes over the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from pyproj import CRS

from probe2road.crs import parse_crs, require_metric
from probe2road.errors import InputError, OptionError
from probe2road.graph.ends import line_ends
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.simulation.networks.road_classes import CLASS_DEFAULTS, MarkingStyle, marking_style

__all__ = [
    "CLASS_DEFAULTS",
    "DRIVING_SIDES",
    "MarkingStyle",
    "NetworkReport",
    "RoadNetwork",
    "check_network",
    "network_from_sections",
]

DRIVING_SIDES = ("right", "left")

SECTION_DTYPES = {
    "u": "int64",
    "v": "int64",
    "highway": "str",  # OSM class
    "lanes_forward": "int64",  # lanes driven from u to v, at least 1
    "lanes_backward": "int64",  # lanes driven from v to u; 0 where one-way
    "lane_width": "float64",  # m
    "speed_limit": "float64",  # m/s
    "layer": "int64",  # order at crossings, not a height
    "bridge": "bool",
    "tunnel": "bool",
    "roundabout": "bool",
    "name": "str",  # empty where unnamed
    "osm_way": "int64",  # -1 where generated
}
RESTRICTION_DTYPES = {"from_section": "int64", "via_node": "int64", "to_section": "int64"}

_END_TOLERANCE = 1e-3  # m; a section ends at its node to within this, in plan and in height
_SPACING = 10.0  # m; section lines have a vertex at least this often
_HEADING_REACH = 20.0  # m; the heading of a section's end is measured over this length
_U_TURN = 150.0  # degrees; a sharper change of heading at a node is a U-turn


@dataclass(frozen=True)
class NetworkReport:
    """Counts of what a reader found, repaired and left out; all zero for a generated network."""

    ways: int = 0  # ways of the wanted classes
    missing_nodes: int = 0  # node references without a position
    short_ways: int = 0  # ways left out because fewer than two positions remained
    defaulted: Mapping[str, int] = field(default_factory=dict)  # tag to ways where it is absent, so the class decides
    bad_tags: Mapping[str, int] = field(default_factory=dict)  # "key=value" to ways where it made no sense
    restrictions: int = 0  # turn restrictions applied
    bad_restrictions: int = 0  # turn restrictions left out: members missing, or not joined at the via node


@dataclass(frozen=True)
class RoadNetwork:
    """Directed carriageway sections with lanes and heights, in one metric CRS.

    Build it with a reader, a generator or `network_from_sections`; the constructor trusts you, `check_network`
    does not.

    Attributes
    ----------
    nodes
        Index ``node`` (int64, unique); ``geometry`` Points with Z. Further columns are kept.
    sections
        Index ``section`` (int64, unique); ``u``, ``v``, ``highway`` (OSM class), ``lanes_forward``,
        ``lanes_backward`` (0 where one-way), ``lane_width`` (m), ``speed_limit`` (m/s), ``layer``, ``bridge``,
        ``tunnel``, ``roundabout``, ``name``, ``osm_way`` (-1 where generated), ``geometry`` (LineString Z from u to
        v, a vertex at least every 10 m).
    driving_side
        ``"right"`` or ``"left"``.
    markings
        How the country paints its roads.
    restrictions
        Forbidden turns: ``from_section``, ``via_node``, ``to_section``.
    report
        What the reader found.
    """

    nodes: gpd.GeoDataFrame
    sections: gpd.GeoDataFrame
    driving_side: str
    markings: MarkingStyle
    restrictions: pd.DataFrame
    report: NetworkReport = field(default_factory=NetworkReport)

    @property
    def crs(self) -> CRS:
        """Return the metric CRS of nodes and sections."""
        return self.sections.crs

    @property
    def length(self) -> float:
        """Return the total length of the sections in plan, metres."""
        return float(self.sections.length.sum())

    def vertices(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the vertices of all sections as flat arrays.

        Returns
        -------
        xyz
            Shape ``(n, 3)``, in the order of ``sections``.
        offsets
            Shape ``(len(sections) + 1,)``; section row i owns ``xyz[offsets[i]:offsets[i + 1]]``.
        """
        geometry = self.sections.geometry.to_numpy()
        xyz = shapely.get_coordinates(geometry, include_z=True)
        return xyz, np.concatenate([[0], np.cumsum(shapely.get_num_coordinates(geometry))]).astype(np.int64)

    def movements(self) -> pd.DataFrame:
        """Return every permitted move from the end of one section to the start of another.

        A two-way section is driven both ways, hence the directions: +1 drives from u to v, -1 from v to u. Left out
        are restricted turns, the way back along the same section, and changes of heading beyond 150 degrees.

        Returns
        -------
        DataFrame
            ``from_section``, ``from_direction``, ``via_node``, ``to_section``, ``to_direction``, ``turn`` (change of
            heading in degrees, positive to the right), sorted by the first five.

        Examples
        --------
        >>> lines = [[(0, 0), (90, 0)], [(90, 0), (180, 0)], [(90, 0), (90, -90)]]
        >>> network = network_from_sections(lines, crs="EPSG:32616", lanes_backward=[0, 0, 1])
        >>> network.movements()[["from_section", "from_direction", "to_section", "to_direction"]].values.tolist()
        [[0, 1, 1, 1], [0, 1, 2, 1], [2, -1, 1, 1]]
        """
        ends = self._directed_ends()
        arriving = ends.rename(columns={"end_node": "via_node", "end_heading": "heading_in"})
        leaving = ends.rename(columns={"start_node": "via_node", "start_heading": "heading_out"})
        moves = arriving[["section", "direction", "via_node", "heading_in"]].merge(
            leaving[["section", "direction", "via_node", "heading_out"]], on="via_node", suffixes=("_from", "_to")
        )
        moves["turn"] = (moves["heading_out"] - moves["heading_in"] + 180.0) % 360.0 - 180.0
        back = (moves["section_from"] == moves["section_to"]) & (moves["direction_from"] != moves["direction_to"])
        moves = moves[~back & (moves["turn"].abs() <= _U_TURN)].rename(
            columns={f"{what}_{end}": f"{end}_{what}" for what in ("section", "direction") for end in ("from", "to")}
        )
        moves = moves.merge(self.restrictions, on=list(RESTRICTION_DTYPES), how="left", indicator=True)
        order = ["from_section", "from_direction", "via_node", "to_section", "to_direction"]
        allowed = moves.loc[moves["_merge"] == "left_only", [*order, "turn"]]
        return allowed.sort_values(order, ignore_index=True)

    def reference_graph(self) -> RoadGraph:
        """Return the true road graph: topology, geometry with heights, and which roads pass over which.

        One edge a section, with the section's id; ``highway``, ``bridge``, ``tunnel``, ``layer``, ``oneway`` and
        ``section`` are kept as further columns, and ``origin`` is ``"reference"``.

        Examples
        --------
        >>> graph = network_from_sections([[(0, 0), (90, 0)]], crs="EPSG:32616").reference_graph()
        >>> graph.edges[["u", "v", "origin", "oneway", "section"]].values.tolist()
        [[0, 1, 'reference', True, 0]]
        """
        kept = ["u", "v", "highway", "bridge", "tunnel", "layer", "geometry"]
        edges = self.sections[kept].assign(
            oneway=self.sections["lanes_backward"] == 0, section=self.sections.index, origin="reference"
        )
        return RoadGraph(self.nodes, finish_edges(edges), empty_turns())

    def _directed_ends(self) -> pd.DataFrame:
        """Return one row for each section and driving direction: its end nodes, and its headings there (degrees)."""
        _, away = line_ends(self.sections.geometry.to_numpy(), reach=_HEADING_REACH)
        start, end = _heading(away[0::2]), _heading(-away[1::2])
        table = {"section": self.sections.index.to_numpy(), "u": self.sections["u"].to_numpy()}
        table |= {"v": self.sections["v"].to_numpy(), "start": start, "end": end}
        forward = pd.DataFrame(table).assign(direction=1)
        backward = forward[(self.sections["lanes_backward"] > 0).to_numpy()].assign(direction=-1)
        swapped = backward.rename(columns={"u": "v", "v": "u"}).assign(
            start=(backward["end"] + 180.0) % 360.0, end=(backward["start"] + 180.0) % 360.0
        )
        names = {"u": "start_node", "v": "end_node", "start": "start_heading", "end": "end_heading"}
        return pd.concat([forward, swapped], ignore_index=True).rename(columns=names)

    def __repr__(self) -> str:
        return (
            f"RoadNetwork({len(self.nodes)} nodes, {len(self.sections)} sections, {self.length / 1000:.3f} km, "
            f"{self.driving_side}-hand traffic, {self.crs.name})"
        )


def network_from_sections(
    sections: Any,
    *,
    crs: Any = None,
    driving_side: str = "right",
    markings: MarkingStyle | str = "US",
    restrictions: pd.DataFrame | None = None,
    report: NetworkReport | None = None,
    spacing: float = _SPACING,
    snap: float = 0.01,
    **columns: Any,
) -> RoadNetwork:
    """Build a network from lines that meet at their ends; missing properties follow from the road class.

    Parameters
    ----------
    sections
        GeoDataFrame of LineStrings with any of the section columns, or a sequence of LineStrings or coordinate
        sequences. Lines without Z lie at height 0. With ``u`` and ``v`` those are the nodes; without, ends at one
        plan position are one node.
    crs
        Metric CRS of plain lines; a GeoDataFrame brings its own.
    driving_side
        One of `DRIVING_SIDES`.
    markings
        A style, or the country code of one in `MARKING_STYLES`.
    restrictions
        Forbidden turns: ``from_section``, ``via_node``, ``to_section``.
    report
        What the reader found.
    spacing
        Lines get a vertex at least this often (m).
    snap
        Ends nearer than this (m) are one node where ``u`` and ``v`` are not given.
    **columns
        Section columns, one value for all or one for each.

    Returns
    -------
    RoadNetwork
        Sections numbered in the given order (a GeoDataFrame keeps its index). ``highway`` defaults to
        ``"motorway"``, traffic to one-way.

    Raises
    ------
    CRSError
        If the CRS is missing or not metric.
    OptionError
        If the driving side, the country or a highway class is unknown.

    Examples
    --------
    >>> network_from_sections([[(0, 0), (90, 0)]], crs="EPSG:32616", highway="secondary", lanes_backward=1)
    RoadNetwork(2 nodes, 1 sections, 0.090 km, right-hand traffic, WGS 84 / UTM zone 16N)
    """
    table = _section_table(sections, crs).assign(**columns)
    require_metric(table.crs, where="network")
    if driving_side not in DRIVING_SIDES:
        raise OptionError(f"driving side {driving_side!r} is unknown", where="network", fix="use right or left")
    table = _fill_defaults(table)
    lines = shapely.force_3d(table.geometry.to_numpy(), 0.0)
    lines = shapely.segmentize(lines, spacing * (1 - 1e-9))
    if "u" not in table or "v" not in table:
        table["u"], table["v"] = _join_ends(lines, snap)
    nodes, lines = _nodes_at_ends(lines, table["u"].to_numpy(), table["v"].to_numpy(), table.crs)
    further = [column for column in table if column not in SECTION_DTYPES and column != "geometry"]
    table = table.set_geometry(gpd.GeoSeries(lines, index=table.index, crs=table.crs))
    table = table[[*SECTION_DTYPES, *further, "geometry"]].astype(SECTION_DTYPES)
    table.index = table.index.astype("int64").rename("section")
    forbidden = pd.DataFrame(columns=list(RESTRICTION_DTYPES)) if restrictions is None else restrictions
    return RoadNetwork(
        nodes,
        table,
        driving_side,
        marking_style(markings) if isinstance(markings, str) else markings,
        forbidden[list(RESTRICTION_DTYPES)].astype(RESTRICTION_DTYPES).drop_duplicates(ignore_index=True),
        report or NetworkReport(),
    )


def check_network(network: RoadNetwork, *, where: object = "network") -> None:
    """Check the invariants of a road network, and report all faults at once.

    Raises
    ------
    InputError
        Naming every invariant that is broken: unique ids, known end nodes, LineStrings with finite Z that start and
        end at their nodes in plan and height, at least one forward lane, positive widths and speeds.

    Examples
    --------
    >>> network = network_from_sections([[(0, 0), (90, 0)]], crs="EPSG:32616")
    >>> check_network(network)
    >>> network.sections["lane_width"] = 0.0
    >>> check_network(network)
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: network: section 0 has no positive lane width
    """
    nodes, sections = network.nodes, network.sections
    ids = [
        f"{name} ids are not unique" for name, t in (("node", nodes), ("section", sections)) if not t.index.is_unique
    ]
    known = sections["u"].isin(nodes.index) & sections["v"].isin(nodes.index)
    if ids or not known.all():
        unknown = [f"section {section} ends at an unknown node" for section in sections.index[~known][:3]]
        raise InputError.from_faults(ids + unknown, where=where)
    xyz, offsets = network.vertices()
    place = pd.DataFrame(shapely.get_coordinates(nodes.geometry.to_numpy(), include_z=True), index=nodes.index)
    finite = np.logical_and.reduceat(np.isfinite(xyz).all(axis=1), offsets[:-1]) if len(xyz) else np.ones(0, bool)
    checks = {
        "has a coordinate that is not finite": finite,
        "has no forward lane": sections["lanes_forward"] >= 1,
        "has a negative number of backward lanes": sections["lanes_backward"] >= 0,
        "has no positive lane width": sections["lane_width"] > 0,
        "has no positive speed limit": sections["speed_limit"] > 0,
    }
    for end, vertex in (("u", offsets[:-1]), ("v", offsets[1:] - 1)):
        away = np.abs(xyz[vertex] - place.loc[sections[end]].to_numpy()).max(axis=1)
        checks[f"does not touch its node {end}"] = away <= _END_TOLERANCE
    faults = [f"section {sections.index[~np.asarray(ok)][0]} {what}" for what, ok in checks.items() if not np.all(ok)]
    if faults:
        raise InputError.from_faults(faults, where=where)


def _section_table(sections: Any, crs: Any) -> gpd.GeoDataFrame:
    if isinstance(sections, gpd.GeoDataFrame):
        return sections.copy()
    lines: Sequence[Any] = [s if isinstance(s, shapely.Geometry) else shapely.LineString(s) for s in sections]
    return gpd.GeoDataFrame(geometry=lines, crs=parse_crs(crs) if crs is not None else None)


def _fill_defaults(table: gpd.GeoDataFrame) -> gpd.GeoDataFrame:
    """Fill missing section columns from the highway class."""
    if "highway" not in table:
        table["highway"] = "motorway"
    unknown = sorted(set(table["highway"]) - set(CLASS_DEFAULTS))
    if unknown:
        known = ", ".join(CLASS_DEFAULTS)
        raise OptionError(f"highway class {unknown[0]!r} is unknown", where="network", fix=f"use one of {known}")
    classes = table["highway"].map(CLASS_DEFAULTS)
    if "lanes_backward" not in table:
        table["lanes_backward"] = 0
    if "lanes_forward" not in table:
        one_way = table["lanes_backward"] == 0
        table["lanes_forward"] = [
            kind.lanes_oneway if alone else kind.lanes_twoway // 2 for kind, alone in zip(classes, one_way, strict=True)
        ]
    for column in ("lane_width", "speed_limit"):
        if column not in table:
            table[column] = [getattr(kind, column) for kind in classes]
    fixed = {"layer": 0, "bridge": False, "tunnel": False, "roundabout": False, "name": "", "osm_way": -1}
    return table.assign(**{column: value for column, value in fixed.items() if column not in table})


def _join_ends(lines: NDArray[Any], snap: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give line ends at the same position in plan one number, in the order of first appearance."""
    first, last = (shapely.get_coordinates(shapely.get_point(lines, end)) for end in (0, -1))
    cells = np.round(np.stack([first, last], axis=1).reshape(-1, 2) / snap).astype(np.int64)
    node, _ = pd.factorize(pd.MultiIndex.from_arrays(cells.T))
    return node[::2].astype(np.int64), node[1::2].astype(np.int64)


def _nodes_at_ends(
    lines: NDArray[Any], u: NDArray[np.int64], v: NDArray[np.int64], crs: CRS
) -> tuple[gpd.GeoDataFrame, NDArray[Any]]:
    """Place each node at the first end that names it, and move the other ends there."""
    xyz, owner = shapely.get_coordinates(lines, include_z=True, return_index=True)
    heads = np.flatnonzero(np.diff(owner, prepend=-1))
    tails = np.append(heads[1:], len(owner)) - 1 if len(heads) else heads
    ends = np.stack([heads, tails], axis=1).ravel()
    ids, first, inverse = np.unique(np.stack([u, v], axis=1), return_index=True, return_inverse=True)
    position = xyz[ends[first]]
    xyz[ends] = position[inverse.ravel()]
    nodes = gpd.GeoDataFrame(
        geometry=shapely.points(position), index=pd.Index(ids, name="node", dtype="int64"), crs=crs
    )
    return nodes, shapely.linestrings(xyz, indices=owner)


def _heading(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the heading of vectors, shape ``(n, 2)``, degrees clockwise from north."""
    return np.degrees(np.arctan2(vector[:, 0], vector[:, 1])) % 360.0
