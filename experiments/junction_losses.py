"""Count the samples that iTOPO loses at junctions and dead ends, by what is wrong there.

Usage: python experiments/junction_losses.py GRAPH REFERENCE [--min-drives 4] [--places]

Every junction, fork and dead end of either graph whose surroundings do not match falls into the first class that holds:
"bridge": the reference has two roads there that cross without meeting; "road missing", "road too many": an arm has no
road of the other graph beside it; "other shape": the two graphs have different numbers of junctions within 25 m;
"ends off", "forks off", "junctions off": its partner lies more than 6 m away; "small offset": it lies nearer. Losses
are samples that one graph has and the other does not match, so the classes add up to all that is lost. Prints
Markdown; `--places` also prints the worst nodes of each class.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.io.graph_files import read_graph
from probe2road.metrics.itopo import ItopoOptions, Pairs, itopo_networks, itopo_pairs
from probe2road.metrics.network import Network, locate
from probe2road.metrics.normalise import comparable_networks

CLUSTER = 25.0  # m; junctions this close to one another have one shape together
ARM = 20.0  # m from a node at which its arms are looked up in the other graph
FLAT = 35.0  # degrees; a junction of three arms is a fork if two of them leave at a smaller angle
BRIDGE = 15.0  # m from a node to a crossing of the reference without a junction


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("graph", type=Path)
    parser.add_argument("reference", type=Path)
    parser.add_argument("--min-drives", type=int, default=4, help="drives of a road that counts")
    parser.add_argument("--places", action="store_true", help="also print the worst places")
    arguments = parser.parse_args()
    reference = labelled_reference(read_graph(arguments.reference), min_drives=arguments.min_drives)
    proposal, target = comparable_networks(read_graph(arguments.graph), reference)
    crossings, options = crossings_of(target), ItopoOptions()
    around_proposal, around_reference = itopo_pairs(proposal, target, options=options)
    losses = pd.concat(
        [
            classified(proposal, target, around_proposal, crossings, built=True),
            classified(target, proposal, around_reference, crossings, built=False),
        ]
    )
    score = itopo_networks(proposal, target, options)
    total = losses["loss"].sum()
    print(f"iTOPO {score.f1:.4f}, {total:.0f} samples lost\n")
    print(f"| what is wrong | nodes | samples | share |\n|{'---|' * 4}")
    table = losses.groupby("kind")["loss"].agg(["size", "sum"]).sort_values("sum", ascending=False)
    for kind, (nodes, lost) in table.iterrows():
        print(f"| {kind} | {nodes} | {lost} | {lost / total:.1%} |")
    if arguments.places:
        worst = losses.sort_values("loss", ascending=False).groupby("kind").head(8).sort_values("kind")
        print(worst.to_string(index=False))


def crossings_of(network: Network) -> NDArray[np.float64]:
    """Return where two lines of a network cross without a node, shape ``(n, 2)``."""
    first, second = shapely.STRtree(network.lines).query(network.lines, predicate="crosses")
    points = shapely.intersection(network.lines[first], network.lines[second])
    return shapely.get_coordinates(points[first < second])


def classified(
    network: Network, other: Network, pairs: Pairs, crossings: NDArray[np.float64], *, built: bool
) -> pd.DataFrame:
    """Give every node of a network whose surroundings do not match its class and its loss."""
    loss = pairs.proposal + pairs.reference - 2 * pairs.matched
    node = pairs.node[loss > 0]
    xy = network.node_xy[node]
    theirs = other.node_xy[(other.degree == 1) | (other.degree > 2)]
    ours = network.node_xy[pairs.node]
    alone = np.array([lonely_arms(network, other, row) > 0 for row in node])
    apart = cKDTree(theirs).query(xy)[0]
    counts = [cKDTree(points).query_ball_point(xy, CLUSTER, return_length=True) for points in (ours, theirs)]
    degree = network.degree[node]
    flat = np.array([smallest_angle(network, row) < FLAT for row in node])
    kind = np.select(
        [
            cKDTree(crossings).query(xy)[0] < BRIDGE if len(crossings) else np.zeros(len(xy), bool),
            alone & built,
            alone,
            counts[0] != counts[1],
            apart <= 6,
            degree == 1,
            (degree == 3) & flat,
        ],
        ["bridge", "road too many", "road missing", "other shape", "small offset", "ends off", "forks off"],
        "junctions off",
    )
    return pd.DataFrame(
        {"kind": kind, "loss": loss[loss > 0], "built": built, "x": xy[:, 0].round(), "y": xy[:, 1].round()}
    )


def lonely_arms(network: Network, other: Network, node: int) -> int:
    """Count the arms of a node that have no road of the other graph beside them."""
    edges = network.incident_edge[network.incident_first[node] : network.incident_first[node + 1]]
    along = np.minimum(ARM, network.length[edges] * 0.5)
    along = np.where(network.u[edges] == node, along, network.length[edges] - along)
    xy, _ = locate(network, edges, along)
    near = shapely.STRtree(other.lines).query(shapely.points(xy), predicate="dwithin", distance=6.0)[0]
    return len(xy) - len(np.unique(near))


def smallest_angle(network: Network, node: int) -> float:
    """Return the smallest angle between two arms of a node, degrees."""
    edges = network.incident_edge[network.incident_first[node] : network.incident_first[node + 1]]
    if len(edges) < 2:
        return 180.0
    along = np.minimum(15.0, network.length[edges] * 0.5)
    along = np.where(network.u[edges] == node, along, network.length[edges] - along)
    xy, _ = locate(network, edges, along)
    course = np.sort(np.degrees(np.arctan2(*(xy - network.node_xy[node]).T[::-1])))
    return float(np.diff(np.append(course, course[0] + 360.0)).min())


if __name__ == "__main__":
    main()
