"""The grid of a height profile: its unknowns, the steps between them, and the bends between the steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.bounds import NotNegative, Positive
from probe2road.graph.ends import end_rows
from probe2road.options import checked
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.networks.road_classes import CLASS_DEFAULTS

__all__ = ["ProfileOptions", "bends", "grade_limits", "steps", "vertex_unknowns"]

_MIN_STEP = 0.5  # m; vertices nearer than this count as this far apart, so that grades stay finite
_THROUGH = 60.0  # degrees; the grade continues from one section to the next where the heading changes by less


@dataclass(frozen=True)
@checked
class ProfileOptions:
    """The limits of a height profile, and its smoothness."""

    clearance: NotNegative[float] = 5.5  # m, from road surface to road surface
    margin: NotNegative[float] = 0.05  # m, solved for on top of the clearance
    terrain_relief: NotNegative[float] = 12.0  # m, standard deviation of the terrain
    terrain_scale: Positive[float] = 2500.0  # m, its shortest wavelength
    smoothing: Positive[float] = 70.0  # m, over which a disturbance fades into the terrain
    grade_tolerance: NotNegative[float] = 0.005  # rise over run by which a grade may pass its limit before it is listed
    vertical_radius: Positive[float] = 400.0  # m; a grade changes at most this fast: 1 / radius for each metre
    least_radius: NotNegative[float] = 300.0  # m; a sharper vertical curve is listed
    lift: NotNegative[float] = 30.0  # weight of the terrain against sinking below it, relative to rising, on open road
    max_steps: Positive[int] = 60  # Newton steps
    raised_pull: NotNegative[float] = 0.05  # weight of the terrain under bridges and tunnels, relative to open road


def vertex_unknowns(network: RoadNetwork, offsets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the unknown of every vertex: node rows first, then the inner vertices of all sections."""
    inner = np.ones(offsets[-1], dtype=bool)
    inner[offsets[:-1]], inner[offsets[1:] - 1] = False, False
    unknown = np.cumsum(inner) - 1 + len(network.nodes)
    unknown[offsets[:-1]], unknown[offsets[1:] - 1] = end_rows(network.nodes, network.sections).T
    return unknown.astype(np.int64)


def steps(
    xyz: NDArray[np.float64], offsets: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return first vertex, section row and plan length (m) of every step between neighbouring vertices."""
    is_last = np.zeros(len(xyz), dtype=bool)
    is_last[offsets[1:] - 1] = True
    a = np.flatnonzero(~is_last)
    owner = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets) - 1)
    return a, owner, np.maximum(np.hypot(*(xyz[a + 1, :2] - xyz[a, :2]).T), _MIN_STEP)


def grade_limits(network: RoadNetwork) -> NDArray[np.float64]:
    """Return the steepest grade that the class of each section allows."""
    return np.array([CLASS_DEFAULTS[highway].max_grade for highway in network.sections["highway"]])


def bends(
    network: RoadNetwork,
    offsets: NDArray[np.int64],
    unknown: NDArray[np.int64],
    a: NDArray[np.int64],
    step: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return three consecutive unknowns and the two steps between them, inside sections and through nodes."""
    length = np.zeros(len(unknown))
    length[a] = step  # length of the step that starts at a vertex
    inner = np.flatnonzero(np.diff(a) == 1)
    b = a[inner] + 1
    triples = [(unknown[b - 1], unknown[b], unknown[b + 1], length[b - 1], length[b])]
    moves = network.movements()
    moves = moves[moves["turn"].abs() < _THROUGH]
    rows = pd.Index(network.sections.index)
    end = {}
    for name, towards in (("from", 1), ("to", -1)):
        row = rows.get_indexer(moves[f"{name}_section"])
        at_v = moves[f"{name}_direction"].to_numpy() == towards  # the node is at v
        other = np.where(at_v, offsets[row + 1] - 2, offsets[row] + 1)
        end[name] = unknown[other], length[np.where(at_v, other, offsets[row])]
    node = pd.Index(network.nodes.index).get_indexer(moves["via_node"])
    triples.append((end["from"][0], node.astype(np.int64), end["to"][0], end["from"][1], end["to"][1]))
    before, middle, after, first, second = (np.concatenate(part) for part in zip(*triples, strict=True))
    return before, middle, after, first, second
