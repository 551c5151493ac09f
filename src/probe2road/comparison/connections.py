"""Where two maps join roads differently: ways from one road onto another that only one of them has.

Strategy. A connection is looked at from two spots, one on either side of it and some metres away, on both maps. If
there is a way between them on one map, and none of about that length on the other, the other lacks a connection. It
is only said where both spots have a counterpart: what lacks a road has other faults. Two roads that part at a small
angle are joined somewhere along that angle, and maps differ in where; a longer way is allowed for those.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from probe2road.comparison.mutual import Mutual
from probe2road.comparison.overlap import OverlapOptions, Roads
from probe2road.graph.levels import CLEARANCE, heights_at
from probe2road.metrics.junctions import crossings_without_node, routes_within
from probe2road.metrics.network import Network, locate
from probe2road.metrics.projection import direction_over, project_along

__all__ = [
    "base_connections",
    "dead_end_distance",
    "driven_connections",
    "is_level",
    "one_a_place",
    "with_crossings",
    "with_other_map",
]

_REACH = 35.0  # m from a connection to the spots from which it is looked at, at most half of the edge
_ASIDE = 20.0  # m, the same for a change of roads in the middle of an edge
_DETOUR, _SLACK = 1.5, 20.0  # a way connects two spots up to this factor times their distance, plus so many metres
_FORK = 250.0  # m more where two roads part at a small angle
_SMALL_ANGLE = 0.8  # cosine of the angle up to which it is small
_SAME_NODE = 4.0  # m; crossings this close to a common node are none


@dataclass(frozen=True, eq=False)
class Spots:
    """Positions on edges, shape (K,) each, and the driving direction there, shape (K, 2)."""

    edge: NDArray[np.int64]
    offset: NDArray[np.float64]
    driven: NDArray[np.float64]


def driven_connections(ours: Roads, found: Mutual) -> tuple[pd.DataFrame, Spots, Spots]:
    """Return the ways that drives took from one road of the base onto another, as far as our graph knows.

    They are the turns at our nodes, and the places along our edges where their counterpart changes from one edge of
    the base to another.

    Returns
    -------
    ways : DataFrame
        ``x``, ``y`` (where), ``count`` (drives), ``reach`` (m from spot to spot).
    first, second
        The spots before and after.
    """
    turned, inside = _turns(ours), _changes_of_road(ours, found)
    table = pd.concat([turned, inside], ignore_index=True)
    network = ours.network
    spots = []
    for name in ("from", "to"):
        edge, offset = table[f"{name}_edge"].to_numpy(np.int64), table[f"{name}_offset"].to_numpy(np.float64)
        driven = direction_over(network, edge, offset, 5.0) * table[f"{name}_way"].to_numpy(np.float64)[:, None]
        spots.append(Spots(edge, offset, driven))
    return table[["x", "y", "count", "reach"]], spots[0], spots[1]


def _turns(ours: Roads) -> pd.DataFrame:
    """Return the spots before and after each turn that was driven."""
    graph, network = ours.graph, ours.network
    turns = graph.turns[graph.turns["from_edge"] != graph.turns["to_edge"]]
    table = pd.DataFrame({"count": turns["count"].to_numpy(np.float64)})
    node = graph.nodes.index.get_indexer(turns["via_node"])
    reach = np.zeros(len(turns))
    for name, edge in (("from", turns["from_edge"]), ("to", turns["to_edge"])):
        row = graph.edges.index.get_indexer(edge)
        out = np.minimum(_REACH, network.length[row] / 2)
        starts = network.u[row] == node
        table[f"{name}_edge"], table[f"{name}_offset"] = row, np.where(starts, out, network.length[row] - out)
        # A drive leaves the node on the second edge, and comes to it on the first.
        table[f"{name}_way"] = np.where(starts, 1.0, -1.0) * (1.0 if name == "to" else -1.0)
        reach += out
    table["reach"] = reach
    table["x"], table["y"] = network.node_xy[node].T if len(node) else (np.zeros(0), np.zeros(0))
    return table


def _changes_of_road(ours: Roads, found: Mutual) -> pd.DataFrame:
    """Return the spots before and after each place along our edges where the road of the base changes."""
    graph, network = ours.graph, ours.network
    counts = [graph.edges[name].to_numpy(np.float64, na_value=0.0) for name in ("forward", "backward")]
    tables = []
    for way in (0, 1):
        places, has = found.found[way], found.has[way]
        rows = np.flatnonzero(has)
        here, there = rows[:-1], rows[1:]
        near = places.offset[there] - places.offset[here] <= 2 * _ASIDE
        changes = (places.edge[here] == places.edge[there]) & (places.other[here] != places.other[there]) & near
        here, there = here[changes], there[changes]
        edge = places.edge[here]
        low = np.maximum(places.offset[here] - _ASIDE, 0.0)
        high = np.minimum(places.offset[there] + _ASIDE, network.length[edge])
        xy, _ = locate(network, edge, (places.offset[here] + places.offset[there]) / 2)
        before, after = (low, high) if way == 0 else (high, low)
        sign = 1.0 if way == 0 else -1.0
        tables.append(
            pd.DataFrame(
                {
                    **{"count": counts[way][edge], "from_edge": edge, "from_offset": before, "from_way": sign},
                    **{"to_edge": edge, "to_offset": after, "to_way": sign, "reach": high - low},
                    **{"x": xy[:, 0], "y": xy[:, 1]},
                }
            )
        )
    return pd.concat(tables, ignore_index=True)


def base_connections(theirs: Roads, flows: pd.DataFrame, *, min_expected: float) -> tuple[pd.DataFrame, Spots, Spots]:
    """Return the turns that the base allows, and that drives would have made if they were possible.

    As in `probe2road.graph.untaken.untaken_turns`, a turn is expected to be made by as many as arrive on its first
    road, times the share of all that leave on its second.

    Returns
    -------
    ways : DataFrame
        As of `driven_connections`, with ``expected`` in place of ``count``.
    first, second
        The spots before and after.
    """
    network, n = theirs.network, len(theirs.sense)
    edge = np.tile(np.arange(n), 2)
    at_start = np.repeat([True, False], n)
    node = np.where(at_start, network.u[edge], network.v[edge])
    along, against = (flows[name].to_numpy()[edge] for name in ("along", "against"))
    ends = pd.DataFrame(
        {
            "edge": edge,
            "node": node,
            "at_start": at_start,
            # At the start of its line an edge is left along it, and arrived on against it.
            "arrive": np.where(at_start, against, along) * (theirs.sense[edge] * np.where(at_start, 1, -1) <= 0),
            "leave": np.where(at_start, along, against) * (theirs.sense[edge] * np.where(at_start, 1, -1) >= 0),
        }
    )
    ends = ends[network.degree[ends["node"]] > 2]
    ends["leaving"] = ends.groupby("node")["leave"].transform("sum")
    ways = ends[ends["arrive"] > 0].merge(ends[ends["leave"] > 0], on="node", suffixes=("_from", "_to"))
    ways = ways[ways["edge_from"] != ways["edge_to"]]
    ways["expected"] = ways["arrive_from"] * ways["leave_to"] / ways["leaving_to"]
    ways = ways[ways["expected"] >= min_expected].reset_index(drop=True)
    reach, spots = np.zeros(len(ways)), []
    for name, sign in (("from", -1.0), ("to", 1.0)):
        row, starts = ways[f"edge_{name}"].to_numpy(np.int64), ways[f"at_start_{name}"].to_numpy(bool)
        out = np.minimum(_REACH, network.length[row] / 2)
        offset = np.where(starts, out, network.length[row] - out)
        driven = direction_over(network, row, offset, 5.0) * (sign * np.where(starts, 1.0, -1.0))[:, None]
        spots.append(Spots(row, offset, driven))
        reach += out
    x, y = network.node_xy[ways["node"]].T
    table = pd.DataFrame({"x": x, "y": y, "expected": ways["expected"], "reach": reach})
    return table, spots[0], spots[1]


def with_other_map(
    ways: pd.DataFrame, first: Spots, second: Spots, own: Roads, other: Roads, options: OverlapOptions
) -> pd.DataFrame:
    """Add to ways what the other map says: where the two spots are on it, and whether it connects them.

    Returns
    -------
    DataFrame
        The rows whose spots are on two roads of the other map, or apart on one, with ``edge``, ``at``, ``edge_to``,
        ``at_to`` (rows and metres on the own map), ``other``, ``other_at``, ``other_to``, ``other_at_to`` (on the
        other), ``straight`` (cosine of the angle between the two directions), ``closed`` and ``closed_to`` (whether
        the other map has the roads closed in the direction that is driven) and ``connected``.
    """
    sought = {"radius": options.radius, "max_angle": options.max_angle, "span": options.span}
    table = ways.copy()
    for name, spots in (("", first), ("_to", second)):
        xy, _ = locate(own.network, spots.edge, spots.offset)
        edge, offset = project_along(
            xy, spots.driven, other.network, sense=other.sense, against=options.against, **sought
        )
        table[f"edge{name}"], table[f"at{name}"] = spots.edge, spots.offset
        table[f"other{name}"], table[f"other_at{name}"] = edge, offset
        on = edge >= 0
        table[f"closed{name}"] = False
        runs = (direction_over(other.network, edge[on], offset[on], options.span) * spots.driven[on]).sum(axis=1)
        table.loc[on, f"closed{name}"] = other.sense[edge[on]] * runs < 0
    table["straight"] = (first.driven * second.driven).sum(axis=1)
    table = table[(table["other"] >= 0) & (table["other_to"] >= 0)].reset_index(drop=True)
    n = len(table)
    limit = _DETOUR * table["reach"].to_numpy() + _SLACK + _FORK * (table["straight"].to_numpy() >= _SMALL_ANGLE)
    table["connected"] = routes_within(
        other.network,
        table[["other", "other_to"]].to_numpy(np.int64).T.ravel(),
        table[["other_at", "other_at_to"]].to_numpy(np.float64).T.ravel(),
        np.arange(n),
        n + np.arange(n),
        limit,
    )
    return table


def with_crossings(ways: pd.DataFrame, roads: Roads, *, rows: tuple[str, str], radius: float) -> pd.DataFrame:
    """Add whether the two roads of a map cross without meeting near a place, and what lies between their heights.

    Parameters
    ----------
    ways
        With ``x`` and ``y``.
    roads
        The map.
    rows
        The columns with the rows of its two edges.
    radius
        Metres from the place to the crossing.

    Returns
    -------
    DataFrame
        With ``crosses``, and ``clearance`` (m; NaN where they do not cross, or a height is unknown).
    """
    i, j, xy = crossings_without_node(roads.network, _SAME_NODE)
    table = ways.assign(crosses=False, clearance=np.nan)
    if not len(i) or table.empty:
        return table
    lines, points = roads.graph.edges.geometry.to_numpy(), shapely.points(xy)
    clearance = np.abs(heights_at(lines[i], points) - heights_at(lines[j], points))
    near = KDTree(xy).query_ball_point(table[["x", "y"]].to_numpy(), radius)
    for row, found in enumerate(near):
        pair = {int(table[rows[0]].iloc[row]), int(table[rows[1]].iloc[row])}
        same = [crossing for crossing in found if {int(i[crossing]), int(j[crossing])} == pair]
        if same:
            table.loc[row, "crosses"] = True
            table.loc[row, "clearance"] = clearance[same].max()
    return table


def is_level(ways: pd.DataFrame) -> NDArray[np.bool_]:
    """Tell of which ways the two roads pass over each other."""
    return (ways["clearance"] >= CLEARANCE).to_numpy(bool)


def dead_end_distance(xy: NDArray[np.float64], network: Network) -> NDArray[np.float64]:
    """Return the distance from places to the nearest dead end of a map, metres, shape (n,); infinity without one."""
    ends = network.node_xy[network.degree == 1]
    if not len(ends) or not len(xy):
        return np.full(len(xy), np.inf)
    return np.asarray(KDTree(ends).query(xy)[0])


def one_a_place(ways: pd.DataFrame, *, weight: list[str], radius: float) -> pd.DataFrame:
    """Keep the way with the largest weights of those within a radius of each other, and count them as ``ways``."""
    if ways.empty:
        return ways.assign(ways=np.zeros(0, np.int64))
    xy = ways[["x", "y"]].to_numpy()
    near = KDTree(xy).query_pairs(radius, output_type="ndarray")
    n = len(ways)
    links = coo_array((np.ones(len(near), bool), (near[:, 0], near[:, 1])), shape=(n, n))
    place = connected_components(links, directed=False)[1]
    table = ways.assign(place=place, ways=np.bincount(place)[place])
    order = table.sort_values([*weight, "x", "y"], ascending=[False] * len(weight) + [True, True], kind="stable")
    return order.drop_duplicates("place").sort_index().drop(columns="place").reset_index(drop=True)
