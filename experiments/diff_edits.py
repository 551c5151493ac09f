"""Differences that were put into a map on purpose: are they found, and do the probabilities hold?

The true road graph of a simulated city is edited: roads are removed, added, shifted, turned round and disconnected,
and bridges are joined to the roads below. `probe2road.diff` compares the result with a graph built from the drives.
Every row that it lists is judged, every edit is looked for, and both are counted by class. Run it as

    python experiments/diff_edits.py GRAPH REFERENCE --output FOLDER [--edits 500] [--seed 1] [--fit MAPS]

GRAPH is what `probe2road build` made of a data set of the benchmark, REFERENCE its `reference.gpkg`. ``--fit`` prints
the coefficients of `probe2road.comparison.probability` that fit these edits best.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import KDTree
from shapely.ops import substring

from probe2road.comparison.diff import DiffOptions, diff
from probe2road.comparison.probability import FEATURES, evidence_features
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.io.graph_files import read_graph
from probe2road.metrics.junctions import crossings_without_node
from probe2road.metrics.network import Network, network_from_graph

KINDS = ("remove", "add", "shift", "reverse", "disconnect", "join")
SHORTEST = {"remove": 60.0, "shift": 150.0, "reverse": 60.0, "disconnect": 80.0}  # m of an edge that is edited so
DRIVEN = 4  # drives that the shipped build needs before it keeps a road
LONG = 150.0  # m of an edited road, from which on it is long
NEAR = 60.0  # m from an edit at a place to the row that finds it
COVERED = 0.5  # share of an edited road that the rows must cover
FOUND_AS = {
    "remove": ("added",),
    "add": ("suspect_closed",),
    "shift": ("moved",),
    "reverse": ("direction_changed",),
    "disconnect": ("connection_added",),
    "join": ("connection_missing", "level_conflict"),
}
MODEL_OF = {"confirmed": "moved", "undriven": "suspect_closed", "level_conflict": "connection_missing"}
CALIBRATED = ("moved", "added", "suspect_closed", "direction_changed", "connection_added", "connection_missing")


@dataclass(frozen=True)
class Edits:
    """An edited map, and what was done: ``kind``, ``edge`` (id; NA for a join), ``x``, ``y``, ``support``, the line."""

    base: RoadGraph
    table: gpd.GeoDataFrame


def edit_map(truth: RoadGraph, n_edits: int, *, seed: int) -> Edits:
    """Edit a map, the same number of times in each way as far as there is room; no two edits share a node."""
    rng = np.random.default_rng(seed)
    edges = truth.edges.copy()
    nodes = {int(node): point for node, point in truth.nodes.geometry.items()}
    network, quota = network_from_graph(truth), n_edits // len(KINDS)
    degrees, used, rows = truth.degrees(), set[int](), []
    edges, joined = _join_bridges(truth, edges, nodes, network, quota, rng)
    for row in joined:
        used |= row.pop("nodes")
    rows += joined
    order = rng.permutation(truth.edges.index.to_numpy())
    kinds = [kind for kind in SHORTEST for _ in range(quota)]
    rng.shuffle(kinds)
    for edge in order:
        if not kinds or edge not in edges.index:
            continue
        old = edges.loc[edge]
        ends = {int(old["u"]), int(old["v"])}
        fits = [k for k, kind in enumerate(kinds) if _fits(kind, old, degrees)]
        if ends & used or not fits:
            continue
        kind = kinds.pop(fits[0])
        used |= ends
        rows.append(_edit(kind, int(edge), old, edges, nodes, rng))
        if kind == "remove":
            edges = edges.drop(index=edge)
    edges, added = _add_roads(truth, edges, quota, rng)
    rows += added
    points = gpd.GeoDataFrame(
        geometry=list(nodes.values()), index=pd.Index(nodes.keys(), name="node", dtype="int64"), crs=truth.crs
    ).sort_index()
    points = points.loc[points.index.isin(np.unique(edges[["u", "v"]]))]
    edges = finish_edges(edges.assign(support=pd.NA, forward=pd.NA, backward=pd.NA))
    table = gpd.GeoDataFrame(rows, geometry="geometry", crs=truth.crs)
    return Edits(replace(truth, nodes=points, edges=edges, turns=empty_turns()), table)


def _fits(kind: str, old: pd.Series, degrees: pd.Series) -> bool:
    """Tell whether an edge can be edited in a way."""
    if old["length"] < SHORTEST[kind]:
        return False
    if kind == "reverse":
        return bool(old["oneway"])
    return kind != "disconnect" or degrees[old["u"]] > 1


def _edit(
    kind: str,
    edge: int,
    old: pd.Series,
    edges: gpd.GeoDataFrame,
    nodes: dict[int, shapely.Point],
    rng: np.random.Generator,
) -> dict[str, Any]:
    """Edit one edge in place, and return what was done."""
    line = old.geometry
    place = line.interpolate(0.5, normalized=True)
    if kind == "shift":
        edges.loc[edge, "geometry"] = _shifted(line, rng.choice([-1, 1]) * rng.uniform(6, 15))
    elif kind == "reverse":
        edges.loc[edge, ["u", "v"]] = [old["v"], old["u"]]
        edges.loc[edge, "geometry"] = line.reverse()
    elif kind == "disconnect":
        place = shapely.Point(line.coords[0])
        cut = substring(line, rng.uniform(8, 15), line.length)
        new = max(nodes) + 1
        nodes[new] = shapely.Point(cut.coords[0])
        edges.loc[edge, "u"] = new
        edges.loc[edge, "geometry"] = cut
    where = {"x": place.x, "y": place.y, "support": int(old["support"]), "node": int(old["u"])}
    return {"kind": kind, "edge": edge, **where, "geometry": shapely.force_2d(line)}


def _shifted(line: shapely.LineString, by: float) -> shapely.LineString:
    """Return a line that lies metres to the left; it leaves its ends and comes back to them over 30 m."""
    at = np.linspace(0, line.length, max(int(line.length / 10), 2) + 1)
    xyz = np.array([line.interpolate(s).coords[0] for s in at])
    step = np.gradient(xyz[:, :2], axis=0)
    left = np.column_stack([-step[:, 1], step[:, 0]]) / np.maximum(np.hypot(*step.T), 1e-9)[:, None]
    fade = np.clip(np.minimum(at, line.length - at) / 30.0, 0, 1)
    xyz[:, :2] += by * fade[:, None] * left
    return shapely.LineString(xyz)


def _join_bridges(
    truth: RoadGraph,
    edges: gpd.GeoDataFrame,
    nodes: dict[int, shapely.Point],
    network: Network,
    quota: int,
    rng: np.random.Generator,
) -> tuple[gpd.GeoDataFrame, list[dict[str, Any]]]:
    """Join pairs of roads where they cross on two levels: both are cut there, and share a new node."""
    i, j, xy = crossings_without_node(network, 4.0)
    used = set[int]()
    rows: list[dict[str, Any]] = []
    parts: list[pd.Series] = []
    ids, lines = truth.edges.index.to_numpy(), truth.edges.geometry.to_numpy()
    for k in rng.permutation(len(i)):
        pair = [int(i[k]), int(j[k])]
        at = [lines[row].project(shapely.Point(xy[k])) for row in pair]
        if (
            len(rows) == quota
            or used & set(pair)
            or min(min(s, lines[r].length - s) for s, r in zip(at, pair, strict=True)) < 20
        ):
            continue
        used |= set(pair)
        node, own = max(nodes) + 1, truth.edges.iloc[pair]
        nodes[node] = shapely.Point(xy[k])
        for row, s in zip(pair, at, strict=True):
            old = truth.edges.iloc[row]
            for half, (low, high) in enumerate(((0, s), (s, lines[row].length))):
                part = old.copy()
                part["v" if half == 0 else "u"] = node
                coordinates = np.array(shapely.force_2d(substring(lines[row], low, high)).coords)
                coordinates[-1 if half == 0 else 0] = xy[k]
                part["geometry"] = shapely.LineString(coordinates)
                parts.append(part)
        place = {"x": xy[k, 0], "y": xy[k, 1], "support": int(own["support"].min()), "node": node}
        near = [substring(lines[row], s - 20.0, s + 20.0) for row, s in zip(pair, at, strict=True)]
        crossing = shapely.force_2d(shapely.MultiLineString(near))
        around = {int(end) for end in own[["u", "v"]].to_numpy().ravel()}
        rows.append({"kind": "join", "edge": pd.NA, **place, "geometry": crossing, "nodes": around})
    kept = edges.drop(index=ids[sorted(used)])
    if parts:
        new = gpd.GeoDataFrame(parts, geometry="geometry", crs=edges.crs)
        new.index = pd.RangeIndex(ids.max() + 1, ids.max() + 1 + len(new), name="edge")
        kept = pd.concat([kept, new.astype(edges.dtypes.drop("geometry").to_dict())])
    return kept, rows


def _add_roads(
    truth: RoadGraph, edges: gpd.GeoDataFrame, quota: int, rng: np.random.Generator
) -> tuple[gpd.GeoDataFrame, list[dict[str, Any]]]:
    """Add two-way roads that do not exist, between nodes 100 to 600 m apart."""
    xy = shapely.get_coordinates(truth.nodes.geometry.to_numpy())
    ids, tree = truth.nodes.index.to_numpy(), shapely.STRtree(truth.edges.geometry.to_numpy())
    near = KDTree(xy).query_ball_point(xy, 600.0)
    used, next_id = set[int](), int(edges.index.max()) + 1
    rows: list[dict[str, Any]] = []
    parts: list[pd.Series] = []
    for start in rng.permutation(len(xy)):
        far = [stop for stop in near[start] if np.hypot(*(xy[stop] - xy[start])) > 100 and stop not in used]
        if len(rows) == quota or start in used or not far:
            continue
        line = None
        for stop in rng.permutation(far)[:15]:
            middle = (xy[start] + xy[stop]) / 2 + rng.normal(scale=0.1 * np.hypot(*(xy[stop] - xy[start])), size=2)
            tried = shapely.LineString([xy[start], middle, xy[stop]])
            spots = shapely.line_interpolate_point(tried, np.arange(0, tried.length, 10.0))
            beside = np.unique(tree.query(spots, predicate="dwithin", distance=25.0)[0])
            if 10.0 * len(beside) <= 0.2 * tried.length + 50.0:
                line = tried
                break
        if line is None:
            continue
        used |= {int(start), int(stop)}
        at_ends = truth.edges[
            truth.edges["u"].isin([ids[start], ids[stop]]) | truth.edges["v"].isin([ids[start], ids[stop]])
        ]
        old = truth.edges.iloc[0].copy()
        old[["u", "v", "geometry", "oneway", "highway"]] = [
            ids[start],
            ids[stop],
            line,
            False,
            at_ends["highway"].mode()[0],
        ]
        for name in ("bridge", "tunnel", "layer"):
            old[name] = 0
        parts.append(old)
        place = {"x": middle[0], "y": middle[1], "support": int(at_ends["support"].max()), "node": int(ids[start])}
        rows.append({"kind": "add", "edge": next_id + len(rows), **place, "geometry": line})
    new = gpd.GeoDataFrame(parts, geometry="geometry", crs=edges.crs)
    new.index = pd.RangeIndex(next_id, next_id + len(new), name="edge")
    return pd.concat([edges, new.astype(edges.dtypes.drop("geometry").to_dict())]), rows


def judge(found: gpd.GeoDataFrame, edits: gpd.GeoDataFrame) -> NDArray[np.bool_]:
    """Tell which rows are true."""
    of = {kind: edits[edits["kind"] == kind] for kind in KINDS}
    true = np.zeros(len(found), bool)
    change, base_edge = found["change"], found["base_edge"]
    removed = of["remove"].geometry.buffer(12.0).union_all()
    xy = shapely.get_coordinates(shapely.get_point(found.geometry.to_numpy(), 1))
    for row in range(len(found)):
        match change.iloc[row]:
            case "confirmed":
                true[row] = base_edge.iloc[row] not in set(of["shift"]["edge"])
            case "moved":
                true[row] = base_edge.iloc[row] in set(of["shift"]["edge"])
            case "added":
                line = found.geometry.iloc[row]
                true[row] = line.intersection(removed).length > COVERED * line.length
            case "undriven":
                true[row] = base_edge.iloc[row] not in set(of["add"]["edge"])
            case "suspect_closed":
                true[row] = base_edge.iloc[row] in set(of["add"]["edge"])
            case "direction_changed":
                true[row] = base_edge.iloc[row] in set(of["reverse"]["edge"])
            case "connection_added":  # a road that was removed is not connected either
                true[row] = _is_near(xy[row], of["disconnect"]) or found.geometry.iloc[row].intersects(removed)
            case _:  # a road that does not exist is not connected either
                ends = {base_edge.iloc[row], found["other_base_edge"].iloc[row]}
                true[row] = _is_near(xy[row], of["join"]) or bool(ends & set(of["add"]["edge"]))
    return true


def _is_near(place: NDArray[np.float64], edits: pd.DataFrame) -> bool:
    return bool((np.hypot(edits["x"] - place[0], edits["y"] - place[1]) <= NEAR).any())


def find(edits: gpd.GeoDataFrame, found: gpd.GeoDataFrame) -> NDArray[np.bool_]:
    """Tell which edits are found."""
    hit = np.zeros(len(edits), bool)
    for row, edit in enumerate(edits.itertuples()):
        same = found[found["change"].isin(FOUND_AS[edit.kind])]
        if edit.kind == "remove":
            own = same[same.intersects(edit.geometry.buffer(12.0))]
            covered = edit.geometry.intersection(own.buffer(12.0).union_all()).length if len(own) else 0.0
            hit[row] = covered > COVERED * edit.geometry.length
        elif edit.kind in ("disconnect", "join"):
            xy = shapely.get_coordinates(shapely.get_point(same.geometry.to_numpy(), 1))
            hit[row] = bool(len(xy)) and bool((np.hypot(*(xy - [edit.x, edit.y]).T) <= NEAR).any())
        else:
            own = same[same["base_edge"] == edit.edge]
            hit[row] = own["length"].sum() > COVERED * edit.geometry.length
    return hit


def in_graph(edits: gpd.GeoDataFrame, graph: RoadGraph) -> NDArray[np.bool_]:
    """Tell of which edits the graph has the road: what it does not have cannot be told from it."""
    lines = graph.edges.geometry.to_numpy()
    tree = shapely.STRtree(lines)
    seen = np.zeros(len(edits), bool)
    for row, (kind, line) in enumerate(zip(edits["kind"], edits.geometry, strict=True)):
        own = shapely.union_all(lines[tree.query(line.buffer(4.0))]).buffer(4.0)
        seen[row] = kind == "add" or line.intersection(own).length > 0.8 * line.length
    return seen


def report(
    found: gpd.GeoDataFrame, true: NDArray[np.bool_], edits: gpd.GeoDataFrame, hit: NDArray[np.bool_]
) -> pd.DataFrame:
    """Return precision and recall by kind of edit."""
    long = edits["kind"].isin(["disconnect", "join"]).to_numpy() | (edits.geometry.length >= LONG).to_numpy()
    rows, there = [], edits["in_graph"].to_numpy(bool)
    for kind, changes in FOUND_AS.items():
        listed = found["change"].isin(changes).to_numpy()
        own = (edits["kind"] == kind).to_numpy()
        seen = own & (edits["support"] >= DRIVEN).to_numpy()
        rows.append(
            {
                "edit": kind,
                "found as": " or ".join(changes),
                "listed": int(listed.sum()),
                "precision": true[listed].mean() if listed.any() else np.nan,
                "edits": int(own.sum()),
                "recall of all": hit[own].mean() if own.any() else np.nan,
                "driven": int(seen.sum()),
                "recall of driven": hit[seen].mean() if seen.any() else np.nan,
                "in the graph": int((seen & there).sum()),
                "recall in the graph": hit[seen & there].mean() if (seen & there).any() else np.nan,
                "long": int((seen & there & long).sum()),
                "recall of long": hit[seen & there & long].mean() if (seen & there & long).any() else np.nan,
            }
        )
    return pd.DataFrame(rows)


def reliability(found: gpd.GeoDataFrame, true: NDArray[np.bool_]) -> tuple[pd.DataFrame, float]:
    """Return a table of probability and truth in bins, and the mean distance between the two, weighted by rows."""
    p = found["probability"].to_numpy()
    bins = np.clip(np.digitize(p, [0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.01]) - 1, 0, 5)
    table = (
        pd.DataFrame({"bin": bins, "probability": p, "true": true})
        .groupby("bin")
        .agg(rows=("true", "size"), probability=("probability", "mean"), true=("true", "mean"))
    )
    return table, float(((table["probability"] - table["true"]).abs() * table["rows"]).sum() / table["rows"].sum())


def fit(found: gpd.GeoDataFrame, true: NDArray[np.bool_]) -> dict[str, tuple[float, ...]]:
    """Fit the logistic models: maximum likelihood, with a weak pull towards 0."""
    model = found["change"].replace(MODEL_OF)
    fitted = {}
    for name in CALIBRATED:
        rows = (model == name).to_numpy()
        # The other half of a model says the opposite: confirmed is not moved.
        truth = np.where(found["change"][rows].isin(["confirmed", "undriven"]), ~true[rows], true[rows]).astype(float)
        features = evidence_features(found[rows])[list(FEATURES[name])].to_numpy(float)

        def loss(w: NDArray[np.float64], x: NDArray[np.float64] = features, y: NDArray[np.float64] = truth) -> float:
            z = w[0] + x @ w[1:]
            return float(np.logaddexp(0, z).sum() - (y * z).sum() + 0.05 * (w**2).sum())

        best = minimize(loss, np.zeros(features.shape[1] + 1))
        fitted[name] = tuple(round(float(w), 2) for w in best.x)
        print(f"{name}: {int(truth.sum())} of {len(truth)} true, {fitted[name]}")
    return fitted


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graph", type=Path)
    parser.add_argument("reference", type=Path)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--edits", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fit", type=int, default=0, help="so many edited maps, from the seed on")
    given = parser.parse_args()
    given.output.mkdir(parents=True, exist_ok=True)
    graph = read_graph(given.graph)
    reference = read_graph(given.reference).to_crs(graph.crs)
    edits = edit_map(reference, given.edits, seed=given.seed)
    edits.table["in_graph"] = in_graph(edits.table, graph)
    if given.fit:
        tables, truths = [], []
        for seed in range(given.seed, given.seed + given.fit):
            more = edit_map(reference, given.edits, seed=seed)
            every = diff(graph, more.base, options=DiffOptions(min_probability=1e-9, min_expected=0.5))
            tables.append(every)
            truths.append(judge(every, more.table))
        fit(pd.concat(tables, ignore_index=True), np.concatenate(truths))
        return
    found = diff(graph, edits.base)
    true, hit = judge(found, edits.table), find(edits.table, found)
    table = report(found, true, edits.table, hit)
    bins, error = reliability(found, true)
    print(table.round(3).to_string(index=False))
    print(bins.round(3).to_string(), f"\nreliability: {error:.3f}")
    for change, rows in found.groupby("change"):
        share = true[rows.index].mean()
        print(f"{change}: {len(rows)} rows, probability {rows['probability'].mean():.3f}, true {share:.3f}")
    found.assign(true=true).to_file(given.output / "found.gpkg", layer="differences")
    edits.table.assign(found=hit).to_file(given.output / "edits.gpkg", layer="edits")
    table.to_csv(given.output / "classes.csv", index=False)
    bins.to_csv(given.output / "reliability.csv")
    (given.output / "summary.json").write_text(json.dumps({"reliability": error, "seed": given.seed}))


if __name__ == "__main__":
    main()
