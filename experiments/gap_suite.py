"""Gap filling on simulated interchanges: how many true connections it restores, how many false ones it adds.

Run with ``python experiments/gap_suite.py``. A link is true where the road between its two ends is hardly longer than
the link itself; a dead end is a gap where the network does not end within 80 m.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import match
from probe2road.recipe import BuildOptions, build
from probe2road.refinement.gaps.fill import GapOptions, fill_gaps, gap_weights, prune_gaps
from probe2road.segmentation.options import SegmentationOptions
from probe2road.simulation.drawn.generate import INTERCHANGES, generate_interchange
from probe2road.simulation.fleet_simulation import simulate
from probe2road.simulation.presets import find_preset

OPTIONS = {"paper's rules": GapOptions(beside=0.0), "and edges beside": GapOptions()}
_NEAR = 12.0  # m from the end of a link to a road it may lie on
_DETOUR, _SLACK = 1.6, 15.0  # a link is true up to this factor and these metres more along the roads
_BORDER = 80.0  # m from a dead end of the network, where dead ends are no gaps


def road_distances(reference: RoadGraph) -> NDArray[np.float64]:
    """Return the shortest ways between all nodes, m."""
    nodes = reference.nodes.index
    u, v = (nodes.get_indexer(reference.edges[end]) for end in ("u", "v"))
    shortest = reference.edges.assign(u=u, v=v).groupby(["u", "v"])["length"].min()
    at = tuple(shortest.index.get_level_values(level).to_numpy() for level in (0, 1))
    return dijkstra(coo_array((shortest.to_numpy(), at), shape=(len(nodes), len(nodes))), directed=False)


def way(reference: RoadGraph, distances: NDArray[np.float64], a: shapely.Point, b: shapely.Point) -> float:
    """Return the shortest way between two places along roads near them, m."""
    lines = shapely.force_2d(reference.edges.geometry.to_numpy())
    ends = np.stack([reference.nodes.index.get_indexer(reference.edges[end]) for end in ("u", "v")], axis=1)
    best = np.inf
    for i in np.flatnonzero(shapely.distance(lines, a) <= _NEAR):
        s = lines[i].project(a)
        for j in np.flatnonzero(shapely.distance(lines, b) <= _NEAR):
            t = lines[j].project(b)
            if i == j:
                best = min(best, abs(s - t))
            to, on = np.array([s, lines[i].length - s]), np.array([t, lines[j].length - t])
            best = min(best, float((to[:, None] + distances[np.ix_(ends[i], ends[j])] + on).min()))
    return best


def true_links(links: pd.DataFrame, reference: RoadGraph, distances: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which gap edges join what is joined."""
    ways = [
        way(reference, distances, shapely.Point(line.coords[0]), shapely.Point(line.coords[-1]))
        for line in links.geometry
    ]
    return np.asarray(ways <= _DETOUR * links["length"].to_numpy() + _SLACK)


def measure(kind: str, preset: str, drives: int) -> list[dict[str, object]]:
    """Fill the gaps of one interchange built from traces, with every set of options."""
    network = generate_interchange(kind, rng=np.random.default_rng(1))
    simulated = simulate(network, preset=replace(find_preset(preset), camera=None), n_drives=drives, seed=1)
    reference, distances = simulated.reference, road_distances(simulated.reference)
    graph = build(
        simulated.fleet, options=BuildOptions(segmentation=SegmentationOptions(segmenter="density"), refine=False)
    )
    border = shapely.union_all(reference.nodes.geometry[reference.degrees() == 1].to_numpy())
    ends = graph.nodes[graph.degrees() == 1]
    inner = ends.index[ends.geometry.distance(border).fillna(np.inf) > _BORDER]
    rows: list[dict[str, object]] = []
    for name, options in OPTIONS.items():
        filled = fill_gaps(graph, options=options)
        links = filled.edges[filled.edges["origin"] == "gap"]
        true = true_links(links, reference, distances)
        steps = match(filled, simulated.fleet, edge_weights=gap_weights(filled)).steps
        through = steps[steps["entered"] & steps["left"]].groupby("edge")["trace_id"].nunique()
        kept = (through.reindex(links.index, fill_value=0) >= 4).to_numpy()
        pruned = prune_gaps(filled, steps)
        rows.append(
            {
                "kind": kind,
                "rules": name,
                "gap ends": len(inner),
                "ends joined": int(inner.isin(links.loc[true, ["u", "v"]].to_numpy().ravel()).sum()),
                "true links": int(true.sum()),
                "false links": int((~true).sum()),
                "true kept": int((true & kept).sum()),
                "false kept": int((~true & kept).sum()),
                "dead ends left": int((pruned.degrees() == 1).sum() - (len(ends) - len(inner))),
            }
        )
    return rows


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="+", default=list(INTERCHANGES), choices=INTERCHANGES)
    parser.add_argument("--preset", default="mixed")
    parser.add_argument("--drives", type=int, default=200)
    args = parser.parse_args()
    rows = [row for kind in args.kinds for row in measure(kind, args.preset, args.drives)]
    print(pd.DataFrame(rows).to_string(index=False))


if __name__ == "__main__":
    main()
