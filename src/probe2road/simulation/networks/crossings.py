"""Places where one road passes over another: plan crossings and stretches of stacked roads, with their order.

Strategy
--------
Two sections cross where their lines intersect in plan away from a common node. They are stacked where their
carriageways overlap in plan although one of them is a bridge or a tunnel and they differ in layer: a viaduct above
a street has no crossing point at all. Both become rows of one table: a place on the upper section and the place on the
lower one that lies beneath, each as two neighbouring vertices and a weight, so that a height at the place is linear in
the heights of the vertices. Around a node that both roads share, within reach of a ramp, overlap is not stacking but
two roads that part: those rows are left out, crossing points are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph

from probe2road.graph.ends import end_rows
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["ORDER_RULES", "Crossings", "find_crossings"]

ORDER_RULES = ("layer", "bridge", "ambiguous")

_SHARED_NODE = 4.0  # m; an intersection this close to a common node is that node
_RAMP_REACH = 250.0  # m; along the roads, roads that overlap within this of each other part or join
_ABUTMENT = 15.0  # m; from the end of a bridge, roads that do not cross lie beside each other
_RANK = {name: rank for rank, name in enumerate(("motorway", "trunk", "primary", "secondary", "tertiary"))}


@dataclass(frozen=True)
class Crossings:
    """Places where one section lies over another; n places.

    Attributes
    ----------
    table
        n rows: ``upper``, ``lower`` (section ids), ``x``, ``y`` (m), ``kind`` (``"crossing"`` or ``"stacked"``),
        ``rule`` (one of `ORDER_RULES`: what decided the order).
    upper_vertex, lower_vertex
        Row in ``network.vertices()`` of the vertex before the place, shape ``(n,)``.
    upper_weight, lower_weight
        Weight of the vertex after it, in [0, 1], shape ``(n,)``.
    """

    table: pd.DataFrame
    upper_vertex: NDArray[np.int64]
    upper_weight: NDArray[np.float64]
    lower_vertex: NDArray[np.int64]
    lower_weight: NDArray[np.float64]

    def clearance(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height of the upper road above the lower at every place, from all vertex heights."""
        upper = z[self.upper_vertex] * (1 - self.upper_weight) + z[self.upper_vertex + 1] * self.upper_weight
        lower = z[self.lower_vertex] * (1 - self.lower_weight) + z[self.lower_vertex + 1] * self.lower_weight
        return np.asarray(upper - lower)


def find_crossings(network: RoadNetwork) -> Crossings:
    """Find every place where one road passes over another, and which road is above.

    The order at a place follows from ``layer``; where layers are equal a bridge lies above and a tunnel below; where
    that does not decide either, the order is ``"ambiguous"`` and the road of the lower class, then of the higher id,
    lies above, because a lesser road is the likelier to have been led over.

    Parameters
    ----------
    network
        Heights are not looked at.

    Returns
    -------
    Crossings
        Sorted by kind, sections, and place along the upper section.

    Examples
    --------
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> lines = [[(0, 0), (200, 0)], [(100, -90), (100, 90)]]
    >>> network = network_from_sections(lines, crs="EPSG:32616", layer=[0, 1])
    >>> table = find_crossings(network).table
    >>> table.loc[table["kind"] == "crossing", ["upper", "lower", "x", "y", "rule"]].values.tolist()
    [[1, 0, 100.0, 0.0, 'layer']]
    """
    lines = shapely.force_2d(network.sections.geometry.to_numpy())
    points = _crossing_points(network, lines)
    overlaps = _overlaps(network, lines, points)
    places = pd.concat([points, overlaps], ignore_index=True)
    places = places.join(_order(network, places["i"].to_numpy(), places["j"].to_numpy()))
    first = places["first_above"].to_numpy()
    places["up"], places["down"] = (
        np.where(first, *places[["i", "j"]].to_numpy().T),
        np.where(first, *places[["j", "i"]].to_numpy().T),
    )
    where = shapely.points(places["x"].to_numpy(), places["y"].to_numpy())
    places["s"] = shapely.line_locate_point(lines[places["up"]], where)
    places = places.sort_values(["kind", "up", "down", "s"], ignore_index=True)
    where = shapely.points(places["x"].to_numpy(), places["y"].to_numpy())
    upper_vertex, upper_weight = _locate(lines, places["up"].to_numpy(), where)
    lower_vertex, lower_weight = _locate(lines, places["down"].to_numpy(), where)
    ids = network.sections.index.to_numpy()
    table = places.assign(upper=ids[places["up"]], lower=ids[places["down"]])
    table = table[["upper", "lower", "x", "y", "kind", "rule"]]
    return Crossings(table, upper_vertex, upper_weight, lower_vertex, lower_weight)


def _crossing_points(network: RoadNetwork, lines: NDArray[np.object_]) -> pd.DataFrame:
    """Intersect all lines in plan: return section rows i < j, and x, y, without the common nodes of sections."""
    i, j = shapely.STRtree(lines).query(lines, predicate="intersects")
    keep = i < j
    i, j = i[keep], j[keep]
    parts, pair = shapely.get_parts(shapely.intersection(lines[i], lines[j]), return_index=True)
    # Lines that run exactly above each other intersect in lines: those are stacked, not crossing.
    is_point = shapely.get_type_id(parts) == shapely.GeometryType.POINT
    parts, pair = parts[is_point], pair[is_point]
    i, j, xy = i[pair], j[pair], shapely.get_coordinates(parts)
    ends = end_rows(network.nodes, network.sections)
    position = shapely.get_coordinates(network.nodes.geometry.to_numpy())[ends]
    at_node = np.zeros(len(i), dtype=bool)
    for a in (0, 1):
        for b in (0, 1):
            near = np.hypot(*(xy - position[i, a]).T) < _SHARED_NODE
            at_node |= (ends[i, a] == ends[j, b]) & near
    keep = ~at_node
    table = pd.DataFrame({"i": i[keep], "j": j[keep], "x": xy[keep, 0], "y": xy[keep, 1]})
    return table.assign(kind="crossing")


def _overlaps(network: RoadNetwork, lines: NDArray[np.object_], points: pd.DataFrame) -> pd.DataFrame:
    """Sample stretches where carriageways that belong at different heights overlap in plan."""
    sections = network.sections
    half = ((sections["lanes_forward"] + sections["lanes_backward"]) * sections["lane_width"] / 2).to_numpy()
    lifted = np.flatnonzero((sections["bridge"] | sections["tunnel"]).to_numpy())
    k, j = shapely.STRtree(lines).query(lines[lifted], predicate="dwithin", distance=half[lifted] + half.max(initial=0))
    i = lifted[k]
    order = _order(network, i, j)
    apart = (
        (i != j)
        & (order["rule"] != "ambiguous").to_numpy()
        & (sections["layer"].to_numpy()[i] != sections["layer"].to_numpy()[j])
    )
    pairs = np.concatenate([np.column_stack([i[apart], j[apart]]), points[["i", "j"]], points[["j", "i"]]])
    pairs = np.unique(pairs.astype(np.int64), axis=0)
    # Every vertex of i that lies over the carriageway of j.
    xyz, offsets = network.vertices()
    count = np.diff(offsets)[pairs[:, 0]]
    row = np.repeat(np.arange(len(pairs)), count)
    vertex = np.repeat(offsets[pairs[:, 0]], count) + np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    where = shapely.points(xyz[vertex, :2])
    inside = shapely.dwithin(where, lines[pairs[row, 1]], half[pairs[row, 0]] + half[pairs[row, 1]])
    row, vertex, where = row[inside], vertex[inside], where[inside]
    i, j = pairs[row].T
    keep = ~_near_by_road(network, lines, i, j, where) & _beside(lines, j, where)
    # A twin bridge leaves the ground beside the other carriageway: only roads that cross overlap at an abutment.
    crosses = pd.MultiIndex.from_arrays([np.minimum(i, j), np.maximum(i, j)]).isin(
        pd.MultiIndex.from_frame(points[["i", "j"]])
    )
    keep &= crosses | ~_at_abutment(network, lines, i, where)
    table = pd.DataFrame({"i": i, "j": j, "x": xyz[vertex, 0], "y": xyz[vertex, 1]})[keep]
    return table.assign(kind="stacked")


def _beside(lines: NDArray[np.object_], row: NDArray[np.int64], where: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Tell which places project to the inside of a line; a place beyond its ends belongs to the next section."""
    s = shapely.line_locate_point(lines[row], where)
    return np.asarray((s > 1e-6) & (s < shapely.length(lines[row]) - 1e-6))


def _at_abutment(
    network: RoadNetwork, lines: NDArray[np.object_], row: NDArray[np.int64], where: NDArray[np.object_]
) -> NDArray[np.bool_]:
    """Tell which places are near an end of their section where a bridge or tunnel ends or meets open road."""
    sections = network.sections
    raised = sections["bridge"] | sections["tunnel"]
    ends = pd.concat([sections["u"], sections["v"]]).to_frame("node").assign(raised=np.tile(raised.to_numpy(), 2))
    inner = ends.groupby("node")["raised"].agg(lambda flags: bool(flags.all()) and len(flags) > 1)
    s = shapely.line_locate_point(lines[row], where)
    near = np.zeros(len(row), dtype=bool)
    for end, along in (("u", s), ("v", shapely.length(lines[row]) - s)):
        abutment = ~inner.loc[sections[end]].to_numpy()
        near |= abutment[row] & (along < _ABUTMENT)
    return near & raised.to_numpy()[row]


def _order(network: RoadNetwork, i: NDArray[np.int64], j: NDArray[np.int64]) -> pd.DataFrame:
    """Decide which of two sections lies above: return ``first_above``, and the ``rule`` that decided."""
    sections = network.sections
    layer = sections["layer"].to_numpy()
    raised = sections["bridge"].to_numpy().astype(int) - sections["tunnel"].to_numpy().astype(int)
    rank = sections["highway"].str.removesuffix("_link").map(_RANK).fillna(len(_RANK)).to_numpy()
    by_layer, by_bridge, by_rank = layer[i] - layer[j], raised[i] - raised[j], rank[i] - rank[j]
    rule = np.select([by_layer != 0, by_bridge != 0], ["layer", "bridge"], "ambiguous")
    tie = np.where(by_rank != 0, by_rank, i - j)
    above = np.select([by_layer != 0, by_bridge != 0], [by_layer > 0, by_bridge > 0], tie > 0)
    return pd.DataFrame({"first_above": above.astype(bool), "rule": rule})


def _locate(
    lines: NDArray[np.object_], row: NDArray[np.int64], where: NDArray[np.object_]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the vertex before the projection of points on lines, and the weight of the next one."""
    xy, owner = shapely.get_coordinates(lines, return_index=True)
    step = np.hypot(*np.diff(xy, axis=0, prepend=xy[:1]).T)
    head = np.diff(owner, prepend=-1) != 0
    # Along all lines in a row, with a gap of 1 m between them so that every line has its own range of arc lengths.
    arc = np.cumsum(np.where(head, 1.0, step))
    offsets = np.append(np.flatnonzero(head), len(owner))
    s = arc[offsets[row]] + shapely.line_locate_point(lines[row], where)
    vertex = np.clip(np.searchsorted(arc, s, side="right") - 1, offsets[row], offsets[row + 1] - 2)
    weight = (s - arc[vertex]) / np.maximum(arc[vertex + 1] - arc[vertex], 1e-9)
    return vertex.astype(np.int64), np.clip(weight, 0.0, 1.0)


def _near_by_road(
    network: RoadNetwork,
    lines: NDArray[np.object_],
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    where: NDArray[np.object_],
) -> NDArray[np.bool_]:
    """Tell which places on two sections are within the length of a ramp of each other along the roads."""
    if not len(i):
        return np.zeros(0, dtype=bool)
    ends = end_rows(network.nodes, network.sections)
    length = shapely.length(lines)
    size = len(network.nodes)
    shortest = pd.DataFrame({"a": ends[:, 0], "b": ends[:, 1], "length": length}).groupby(["a", "b"])["length"].min()
    a, b = (shortest.index.get_level_values(level).to_numpy() for level in (0, 1))
    roads = sparse.csr_array((shortest.to_numpy(), (a, b)), shape=(size, size))
    sources, source = np.unique(ends[i], return_inverse=True)
    distance = csgraph.dijkstra(roads, directed=False, indices=sources, limit=_RAMP_REACH)
    source = source.reshape(-1, 2)
    s, t = (shapely.line_locate_point(lines[k], where) for k in (i, j))
    best = np.where(i == j, np.abs(s - t), np.inf)
    for end_i, from_i in ((0, s), (1, length[i] - s)):
        for end_j, from_j in ((0, t), (1, length[j] - t)):
            best = np.minimum(best, from_i + distance[source[:, end_i], ends[j, end_j]] + from_j)
    return np.asarray(best < _RAMP_REACH)
