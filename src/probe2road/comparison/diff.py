"""The difference between a road graph from drives and a base map: what to do to the map, and why.

Strategy. Both maps are looked up on each other (`mutual`), and cut where one has no counterpart on the other. Counts
of drives are brought to the roads of the base (`flows`). Then each question is answered by a module of its own: which
way a road is driven (`directions`), whether nobody on a road means that it is closed (`closures`), and where roads are
joined differently (`connections`). What follows from the evidence is said with a probability (`probability`).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from shapely.ops import substring

from probe2road.bounds import Positive, Probability
from probe2road.comparison.closures import expected_passages
from probe2road.comparison.connections import (
    base_connections,
    dead_end_distance,
    driven_connections,
    is_level,
    one_a_place,
    with_crossings,
    with_other_map,
)
from probe2road.comparison.directions import direction_changes
from probe2road.comparison.flows import base_flows, require_counts
from probe2road.comparison.mutual import Mutual, mutual, pieces
from probe2road.comparison.overlap import OverlapOptions, Roads, require_common_area, roads_of
from probe2road.comparison.probability import probabilities
from probe2road.graph.direction import in_driving_direction
from probe2road.graph.roadgraph import RoadGraph
from probe2road.options import checked

__all__ = ["DIFFERENCES", "DiffOptions", "diff"]

logger = logging.getLogger(__name__)

DIFFERENCES = (
    "confirmed",
    "moved",
    "added",
    "undriven",
    "suspect_closed",
    "direction_changed",
    "connection_added",
    "connection_missing",
    "level_conflict",
)
_COLUMNS = {
    "change": "str",
    "probability": "float64",
    "edge": "Int64",
    "at_begin": "float64",
    "at_end": "float64",
    "base_edge": "Int64",
    "base_begin": "float64",
    "base_end": "float64",
    "other_edge": "Int64",
    "other_base_edge": "Int64",
    "osmid": "str",
    "length": "float64",
    "distance": "float64",
    "nearest": "float64",
    "support": "float64",
    "along": "float64",
    "against": "float64",
    "oneway": "str",
    "count": "float64",
    "expected": "float64",
    "clearance": "float64",
    "crosses": "boolean",
    "dead_end_distance": "float64",
    "odds": "float64",
}
_SEEN = ("count", "expected", "clearance", "crosses", "dead_end_distance")


@dataclass(frozen=True)
@checked
class DiffOptions:
    """What counts as a difference between a graph and a base map."""

    overlap: OverlapOptions = field(default_factory=lambda: OverlapOptions(radius=20.0))  # the same road on both
    shortest: Positive[float] = 30.0  # m of a piece that only one of the two has
    same_place: Positive[float] = 60.0  # m within which two missing connections are one
    driven: Probability = 0.5  # share of a base road that drives must be seen on, to judge its direction
    min_expected: Positive[float] = 1.0  # drives expected on a turn that nobody made, or on a closed road
    min_probability: Probability = 0.5  # of a difference, from which on it is listed


def diff(graph: RoadGraph, base: RoadGraph, *, options: DiffOptions | None = None) -> gpd.GeoDataFrame:
    """Compare a graph from drives with a base map, and list what they say of each other.

    Nothing that drives did not see is called wrong: a road of the base without drives is ``undriven``, unless so many
    drives passed its ends that it is ``suspect_closed``.

    Parameters
    ----------
    graph
        Built from drives, with counts and turns.
    base
        The map: what `probe2road.read_graph` reads. It is brought to the CRS of the graph.
    options
        None takes the defaults.

    Returns
    -------
    GeoDataFrame
        One row for each piece of a road, direction or connection, in the order of `DIFFERENCES` and along the edges,
        with the line in plan; what does not belong to a change is missing:

        * ``change``, and ``probability`` that it is so;
        * ``edge``, and ``at_begin``, ``at_end``: the stretch of our edge, 0 to 1 along it. ``base_edge``,
          ``base_begin``, ``base_end``: the same on the base; ``osmid``: its way, if the base names it. ``other_edge``,
          ``other_base_edge``: the second road of a connection, on which the stretch ends;
        * ``length`` (m); ``distance`` (m between the two roads, median); ``nearest`` (share of the base road that our
          line is nearer to than to any other); ``support`` (traces); ``along``, ``against`` (traversals in the
          direction of the base road, or of ours if it is added); ``oneway`` (what the map should say);
        * ``count`` (drives over a connection); ``expected`` (drives that should have passed); ``crosses`` and
          ``clearance`` (whether the two roads cross without meeting on the map that does not join them, and the m
          between them); ``dead_end_distance`` (m from a connection to a dead end on that map); ``odds`` (probability of
          a direction before calibration).

    Raises
    ------
    CRSError
        If the CRS of one is not metric.
    InputError
        If one of them has no roads, they are of different places, or the graph has no counts of drives.

    Examples
    --------
    The base lacks a street, and has another one that nobody drove:

    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> crs = "EPSG:32616"
    >>> counts = pd.DataFrame({"support": [9, 9], "forward": [9, 9], "backward": [8, 9]})
    >>> ours = graph_from_lines([[(0, 0), (200, 0)], [(200, 0), (200, 150)]], crs=crs, attributes=counts)
    >>> base = graph_from_lines([[(0, 1), (200, 1)], [(0, 1), (0, 300)]], crs=crs)
    >>> diff(ours, base)[["change", "edge", "base_edge"]].values.tolist()
    [['confirmed', 0, 0], ['added', 1, <NA>], ['undriven', <NA>, 1]]
    """
    options = options or DiffOptions()
    base = base.to_crs(graph.crs)
    require_common_area(graph, base, where="diff", name="base")
    ours, theirs = (roads_of(replace(one, edges=in_driving_direction(one.edges))) for one in (graph, base))
    require_counts(ours, where="diff")
    found, back = mutual(ours, theirs, options.overlap)
    flows = base_flows(ours, theirs, found, back)
    on_base = pieces(back, theirs.network.length, shortest=options.shortest)
    on_ours = pieces(found, ours.network.length, shortest=options.shortest)
    tables = [
        _positions(on_base, ours, theirs, flows),
        _added(on_ours, ours, options),
        _undriven(on_base, theirs, flows, options),
        _directions(theirs, flows, options),
        _connections_added(ours, theirs, found, options),
        _connections_missing(ours, theirs, flows, options),
    ]
    table = _joined(tables, graph)
    counts = table["change"].value_counts()
    logger.info("differences: %s", ", ".join(f"{counts.get(name, 0)} {name}" for name in DIFFERENCES))
    return table


def _positions(on_base: pd.DataFrame, ours: Roads, theirs: Roads, flows: pd.DataFrame) -> pd.DataFrame:
    """Return the pieces of the base that drives confirm, or that lie elsewhere."""
    table = on_base[on_base["matched"] & (on_base["other"] >= 0)].reset_index(drop=True)
    table["length"] = table["end"] - table["begin"]
    table["nearest"] = flows["nearest"].to_numpy()[table["edge"]]
    probability = probabilities("moved", table)
    moved = probability >= 0.5
    line = np.where(
        moved,
        _cut(ours, table["other"], table["other_begin"], table["other_end"]),
        _cut(theirs, table["edge"], table["begin"], table["end"]),
    )
    return pd.DataFrame(
        {
            "change": np.where(moved, "moved", "confirmed"),
            "probability": np.where(moved, probability, 1.0 - probability),
            **_place(ours, table["other"], table["other_begin"], table["other_end"]),
            **_place(theirs, table["edge"], table["begin"], table["end"], base=True),
            **{name: table[name] for name in ("length", "distance", "nearest")},
            **{name: flows[name].to_numpy()[table["edge"]] for name in ("support", "along", "against")},
            "geometry": line,
        }
    )


def _added(on_ours: pd.DataFrame, ours: Roads, options: DiffOptions) -> pd.DataFrame:
    """Return the pieces of our roads that the base lacks."""
    table = on_ours[~on_ours["matched"]].assign(length=lambda piece: piece["end"] - piece["begin"])
    table = table[table["length"] >= options.shortest].reset_index(drop=True)
    edges = ours.graph.edges.iloc[table["edge"]]
    counts = {
        name: edges[column].to_numpy(np.float64, na_value=0.0)
        for name, column in (("support", "support"), ("along", "forward"), ("against", "backward"))
    }
    table = table.assign(**counts)
    table["probability"] = probabilities("added", table)
    table["oneway"] = pd.Series("yes", table.index).where(ours.sense[table["edge"]] == 1)
    table = table[table["probability"] >= options.min_probability].reset_index(drop=True)
    return pd.DataFrame(
        {
            "change": "added",
            "probability": table["probability"],
            **_place(ours, table["edge"], table["begin"], table["end"]),
            **{name: table[name] for name in ("length", "support", "along", "against", "oneway")},
            "geometry": _cut(ours, table["edge"], table["begin"], table["end"]),
        }
    )


def _undriven(on_base: pd.DataFrame, theirs: Roads, flows: pd.DataFrame, options: DiffOptions) -> pd.DataFrame:
    """Return the pieces of the base that nobody drove, and how many would have passed if they were open."""
    table = on_base[~on_base["matched"]].assign(length=lambda piece: piece["end"] - piece["begin"])
    unseen = table.groupby("edge")["length"].sum().reindex(range(len(theirs.sense)), fill_value=0.0)
    driven = unseen.to_numpy() < 0.5 * theirs.network.length
    expected = expected_passages(theirs, flows, driven)
    table = table[table["length"] >= np.minimum(options.shortest, theirs.network.length[table["edge"]] - 1e-6)]
    table = table.reset_index(drop=True)
    table["expected"] = expected[table["edge"]]
    probability = probabilities("suspect_closed", table)
    closed = (probability >= options.min_probability) & (table["expected"] >= options.min_expected).to_numpy()
    return pd.DataFrame(
        {
            "change": np.where(closed, "suspect_closed", "undriven"),
            "probability": np.where(closed, probability, 1.0 - probability),
            **_place(theirs, table["edge"], table["begin"], table["end"], base=True),
            "length": table["length"],
            "expected": table["expected"],
            "geometry": _cut(theirs, table["edge"], table["begin"], table["end"]),
        }
    )


def _directions(theirs: Roads, flows: pd.DataFrame, options: DiffOptions) -> pd.DataFrame:
    """Return the roads of the base that are driven another way than it says."""
    table = direction_changes(theirs, flows, options.overlap).assign(**flows).rename(columns={"probability": "odds"})
    table["edge"] = np.arange(len(table))
    table["probability"] = probabilities("direction_changed", table)
    kept = (table["probability"] >= options.min_probability) & (table["covered"] >= options.driven)
    table = table[kept & (theirs.network.length >= options.shortest)].reset_index(drop=True)
    length = theirs.network.length[table["edge"]]
    line = theirs.network.lines[table["edge"]]
    return pd.DataFrame(
        {
            "change": "direction_changed",
            **_place(theirs, table["edge"], 0.0 * length, length, base=True),
            "length": length,
            **{name: table[name] for name in ("probability", "support", "along", "against", "oneway", "odds")},
            "geometry": np.where(table["oneway"] == "-1", shapely.reverse(line), line),
        }
    )


def _connections_added(ours: Roads, theirs: Roads, found: Mutual, options: DiffOptions) -> pd.DataFrame:
    """Return the ways that drives took and the base lacks."""
    table = with_other_map(*driven_connections(ours, found), ours, theirs, options.overlap)
    # Against the direction of a road went nobody, but a drive that was on the road beside it.
    closed = table["closed"] | table["closed_to"]
    table = table[~table["connected"] & ~closed & (table["count"] > 0)].reset_index(drop=True)
    table = _probable(table, "connection_added", theirs, "count", options)
    own, base = ("edge", "at"), ("other", "other_at")
    return _connection_rows(table, "connection_added", ours, theirs, own=own, base=base)


def _connections_missing(ours: Roads, theirs: Roads, flows: pd.DataFrame, options: DiffOptions) -> pd.DataFrame:
    """Return the turns of the base that drives would have made, and for which our graph has no way."""
    asked = base_connections(theirs, flows, min_expected=options.min_expected)
    table = with_other_map(*asked, theirs, ours, options.overlap)
    table = _probable(
        table[~table["connected"]].reset_index(drop=True), "connection_missing", ours, "expected", options
    )
    change = np.where(is_level(table), "level_conflict", "connection_missing")
    own, base = ("other", "other_at"), ("edge", "at")
    return _connection_rows(table, change, ours, theirs, own=own, base=base)


def _probable(ways: pd.DataFrame, change: str, lacking: Roads, drives: str, options: DiffOptions) -> pd.DataFrame:
    """Return the ways that a map probably lacks, one for each place, the most probable or else the most driven."""
    table = with_crossings(ways, lacking, rows=("other", "other_to"), radius=options.same_place)
    table["dead_end_distance"] = dead_end_distance(table[["x", "y"]].to_numpy(), lacking.network)
    table["probability"] = probabilities(change, table)
    table = one_a_place(table, weight=["probability", drives], radius=options.same_place)
    return table[table["probability"] >= options.min_probability].reset_index(drop=True)


def _connection_rows(
    table: pd.DataFrame,
    change: str | NDArray[np.str_],
    ours: Roads,
    theirs: Roads,
    *,
    own: tuple[str, str],
    base: tuple[str, str],
) -> pd.DataFrame:
    """Return rows of connections; their line goes from the one road over the place to the other."""
    ids, base_ids = ours.graph.edges.index.to_numpy(), theirs.graph.edges.index.to_numpy()
    at = [table[f"{own[1]}{end}"] / ours.network.length[table[f"{own[0]}{end}"]] for end in ("", "_to")]
    base_at = [table[f"{base[1]}{end}"] / theirs.network.length[table[f"{base[0]}{end}"]] for end in ("", "_to")]
    spots = [
        shapely.line_interpolate_point(ours.network.lines[table[f"{own[0]}{end}"]], table[f"{own[1]}{end}"])
        for end in ("", "_to")
    ]
    middle = shapely.points(table[["x", "y"]].to_numpy(np.float64))
    corners = np.stack([spots[0], middle, spots[1]], axis=1) if len(table) else np.zeros((0, 3), object)
    lines = [shapely.LineString(list(row)) for row in corners]
    return pd.DataFrame(
        {
            "change": change,
            "probability": table["probability"],
            "edge": ids[table[own[0]]],
            "at_begin": at[0],
            "other_edge": ids[table[f"{own[0]}_to"]],
            "at_end": at[1],
            "base_edge": base_ids[table[base[0]]],
            "base_begin": base_at[0],
            "other_base_edge": base_ids[table[f"{base[0]}_to"]],
            "base_end": base_at[1],
            **{name: table[name] for name in _SEEN if name in table},
            "geometry": np.array(lines, object),
        }
    )


def _place(
    roads: Roads,
    edge: pd.Series,
    begin: pd.Series | NDArray[np.float64],
    end: pd.Series | NDArray[np.float64],
    *,
    base: bool = False,
) -> dict[str, NDArray[np.generic]]:
    """Return the id of an edge and a stretch of it, from 0 to 1, under the names of our graph or of the base."""
    row = edge.to_numpy(np.int64)
    length = roads.network.length[row]
    names = ("base_edge", "base_begin", "base_end") if base else ("edge", "at_begin", "at_end")
    columns: dict[str, NDArray[np.generic]] = {
        names[0]: roads.graph.edges.index.to_numpy()[row],
        names[1]: np.asarray(begin) / length,
        names[2]: np.asarray(end) / length,
    }
    if base and "osmid" in roads.graph.edges:
        columns["osmid"] = roads.graph.edges["osmid"].astype("str").to_numpy()[row]
    return columns


def _cut(roads: Roads, edge: pd.Series, begin: pd.Series, end: pd.Series) -> NDArray[np.object_]:
    """Return the stretches of edges in plan."""
    lines = roads.network.lines[edge]
    whole = (begin <= 0) & (end >= roads.network.length[edge])
    cut = [
        line if all_of_it else _stretch(line, low, high)
        for line, all_of_it, low, high in zip(lines, whole, begin, end, strict=True)
    ]
    result = np.empty(len(cut), object)
    result[:] = cut
    return result


def _stretch(line: shapely.LineString, low: float, high: float) -> shapely.LineString:
    """Return the part of a line, of a metre at least."""
    return substring(line, max(low - max(1.0 - (high - low), 0.0), 0.0), high)


def _joined(tables: list[pd.DataFrame], graph: RoadGraph) -> gpd.GeoDataFrame:
    """Join the tables to one, in the order of `DIFFERENCES`."""
    table = pd.concat([part for part in tables if len(part)], ignore_index=True)
    table = table.reindex(columns=[*_COLUMNS, "geometry"])
    table["rank"] = table["change"].map({name: rank for rank, name in enumerate(DIFFERENCES)})
    table = table.sort_values(["rank", "base_edge", "base_begin", "edge", "at_begin"], ignore_index=True)
    typed = table.drop(columns="rank").astype(_COLUMNS)
    typed["length"] = typed["length"].fillna(pd.Series(shapely.length(typed["geometry"].to_numpy()), typed.index))
    return gpd.GeoDataFrame(typed, geometry="geometry", crs=graph.crs)
