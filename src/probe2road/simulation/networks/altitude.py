"""Heights for a road network: smooth over gentle terrain, clear wherever one road passes over another.

Strategy
--------
The height of every vertex is an unknown; ends that share a node share it, so the profile is continuous. The profile
minimises a convex function: the squared distance to the terrain plus the squared change of grade (which spreads a
bridge's rise over its approaches), with quadratic penalties for the part by which a clearance falls short, a grade is
too steep, or a grade changes too fast. The penalties are one-sided, so the function is piecewise quadratic: each Newton
step solves the sparse normal equations of the penalties that are active, and a few steps settle which those are. The
weight of clearance exceeds that of grade by orders of magnitude: where a bridge is too short for its road class, the
grade gives way, and `check_heights` lists the place. Only where the input does not say which road is above does the
clearance give way.
"""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, replace

import geopandas as gpd
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

from probe2road.simulation.networks.crossings import Crossings, find_crossings
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.networks.profile import ProfileOptions, bends, grade_limits, steps, vertex_unknowns
from probe2road.simulation.networks.terrain import Terrain

__all__ = ["ProfileOptions", "solve_heights"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Problem:
    """The sparse rows of a least-squares problem for heights, with v unknowns and r rows each.

    ``steep`` and ``bend`` are two-sided: their absolute value is limited.
    """

    terrain: NDArray[np.float64]  # (v,), m
    pull: NDArray[np.float64]  # (v,), weight of the terrain: m of road that a vertex stands for, where it pulls
    open_road: NDArray[np.bool_]  # (v,), neither bridge nor tunnel: sinking below the terrain costs more
    bend: sparse.csr_array  # (r, v), change of grade
    bend_weight: NDArray[np.float64]  # (r,)
    bend_limit: NDArray[np.float64]  # (r,)
    steep: sparse.csr_array  # (r, v), rise
    steep_limit: NDArray[np.float64]  # (r,), m
    clear: sparse.csr_array  # (r, v), height over the road beneath
    clear_weight: NDArray[np.float64]  # (r,)


def solve_heights(
    network: RoadNetwork, *, rng: np.random.Generator, options: ProfileOptions | None = None
) -> RoadNetwork:
    """Compute the height of every vertex of a network.

    Parameters
    ----------
    network
        Its heights are ignored, its plan geometry is kept.
    rng
        Shapes the terrain.
    options
        What to keep; `ProfileOptions` where not given.

    Returns
    -------
    RoadNetwork
        The same network with new heights in sections and nodes.

    Examples
    --------
    >>> from probe2road.simulation.networks.height_check import check_heights
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> lines = [[(0, 0), (900, 0)], [(450, -400), (450, 400)]]
    >>> network = network_from_sections(lines, crs="EPSG:32616", bridge=[False, True])
    >>> report = check_heights(solve_heights(network, rng=np.random.default_rng(1)))
    >>> bool(report.crossings["clearance"].min() >= 5.5), len(report.violations)
    (True, 0)
    """
    options = options or ProfileOptions()
    started = time.perf_counter()
    crossings = find_crossings(network)
    xyz, offsets = network.vertices()
    unknown = vertex_unknowns(network, offsets)
    problem = _problem(network, xyz, offsets, unknown, crossings, options, rng)
    z, rounds = _minimise(problem, options)
    xyz[:, 2] = z[unknown]
    owner = np.repeat(np.arange(len(network.sections)), np.diff(offsets))
    sections = network.sections.set_geometry(_series(shapely.linestrings(xyz, indices=owner), network.sections))
    place = shapely.get_coordinates(network.nodes.geometry.to_numpy())
    points = shapely.points(np.column_stack([place, z[: len(place)]]))
    nodes = network.nodes.set_geometry(_series(points, network.nodes))
    logger.info(
        "solved %d heights with %d crossings and %d stacked places in %d steps, %.1f s",
        len(z),
        int((crossings.table["kind"] == "crossing").sum()),
        int((crossings.table["kind"] == "stacked").sum()),
        rounds,
        time.perf_counter() - started,
    )
    return replace(network, sections=sections, nodes=nodes)


def _problem(
    network: RoadNetwork,
    xyz: NDArray[np.float64],
    offsets: NDArray[np.int64],
    unknown: NDArray[np.int64],
    crossings: Crossings,
    options: ProfileOptions,
    rng: np.random.Generator,
) -> _Problem:
    """Set up the terms for terrain, grade, change of grade and clearance in the unknowns."""
    size = int(unknown.max()) + 1
    first_vertex, owner, step = steps(xyz, offsets)
    start, stop = unknown[first_vertex], unknown[first_vertex + 1]
    raised = (network.sections["bridge"] | network.sections["tunnel"]).to_numpy()[owner]
    share = np.where(raised, options.raised_pull, 1.0) * step / 2.0
    pull = np.asarray(np.bincount(start, share, size) + np.bincount(stop, share, size), float)
    is_raised = np.bincount(start, raised, size) + np.bincount(stop, raised, size) > 0
    place = np.zeros((size, 2))
    place[unknown] = xyz[:, :2]
    terrain = Terrain.from_rng(rng, relief=options.terrain_relief, scale=options.terrain_scale).height(place)
    before, middle, after, first, second = bends(network, offsets, unknown, first_vertex, step)
    mean = (first + second) / 2.0
    bend = _rows([before, middle, after], [1.0 / first, -1.0 / first - 1.0 / second, 1.0 / second], size)
    upper, upper_weight = crossings.upper_vertex, crossings.upper_weight
    lower, lower_weight = crossings.lower_vertex, crossings.lower_weight
    places = [unknown[upper], unknown[upper + 1], unknown[lower], unknown[lower + 1]]
    return _Problem(
        terrain=terrain,
        pull=pull,
        open_road=~is_raised,
        bend=bend,
        bend_weight=options.smoothing**4 / mean,
        bend_limit=mean / options.vertical_radius,
        steep=_rows([start, stop], [-np.ones(len(start)), np.ones(len(start))], size),
        steep_limit=grade_limits(network)[owner] * step,
        clear=_rows(places, [1 - upper_weight, upper_weight, lower_weight - 1, -lower_weight], size),
        clear_weight=np.where(crossings.table["rule"] == "ambiguous", _DOUBTFUL_WEIGHT, _CLEAR_WEIGHT),
    )


def _rows(columns: list[NDArray[np.int64]], values: list[NDArray[np.float64]], size: int) -> sparse.csr_array:
    """Build a sparse matrix from arrays of columns and values, one pair for each position within a row."""
    count = len(columns[0])
    row = np.tile(np.arange(count), len(columns))
    return sparse.csr_array((np.concatenate(values), (row, np.concatenate(columns))), shape=(count, size))


_CLEAR_WEIGHT = 3e7  # per m of missing clearance, squared
_DOUBTFUL_WEIGHT = 1e4  # the same where the order is ambiguous
_STEEP_WEIGHT = 1e5  # per m of rise beyond the limit, squared
_FULL_STEPS = 12
_SETTLED = 1e-3  # m; the steps end when no height moves more
_BEND_FACTOR = 30.0  # bends beyond the limit weigh this much more than those within


def _minimise(problem: _Problem, options: ProfileOptions) -> tuple[NDArray[np.float64], int]:
    """Minimise the piecewise quadratic by Newton steps; return heights and the number of steps."""
    z, rounds, moved = problem.terrain.copy(), 0, np.inf
    while moved > _SETTLED and rounds < options.max_steps:
        matrix, right = _active_system(problem, z, options)
        solution = _solve(matrix, right)
        moved = float(np.abs(solution - z).max(initial=0.0))
        # Full steps settle within ten or so, or swing between two sets of active terms; half steps end the swing.
        z, rounds = (solution if rounds < _FULL_STEPS else (z + solution) / 2.0), rounds + 1
    return z, rounds


def _active_system(
    problem: _Problem, z: NDArray[np.float64], options: ProfileOptions
) -> tuple[sparse.csr_array, NDArray[np.float64]]:
    """Return the normal equations of the terms that are active at z."""
    pull = problem.pull * np.where(problem.open_road & (z < problem.terrain), options.lift, 1.0)
    matrix = sparse.diags_array(pull) + problem.bend.T @ sparse.diags_array(problem.bend_weight) @ problem.bend
    right = pull * problem.terrain
    rise, change, height = problem.steep @ z, problem.bend @ z, problem.clear @ z
    target = np.full(len(height), options.clearance + options.margin)
    for rows, active, weight, bound in (
        (problem.steep, np.abs(rise) > problem.steep_limit, _STEEP_WEIGHT, np.copysign(problem.steep_limit, rise)),
        (
            problem.bend,
            np.abs(change) > problem.bend_limit,
            _BEND_FACTOR * problem.bend_weight,
            np.copysign(problem.bend_limit, change),
        ),
        (problem.clear, height < target, problem.clear_weight, target),
    ):
        chosen = np.flatnonzero(active)
        penalty = np.broadcast_to(weight, active.shape)[chosen]
        part = rows[chosen]
        matrix = matrix + part.T @ sparse.diags_array(penalty) @ part
        right = right + part.T @ (penalty * bound[chosen])
    return matrix, right


def _solve(matrix: sparse.csr_array, right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Solve a sparse symmetric positive definite system."""
    options = {"SymmetricMode": True}
    factor = linalg.splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.asarray(factor.solve(right))


def _series(geometry: NDArray[np.object_], like: gpd.GeoDataFrame) -> gpd.GeoSeries:
    return gpd.GeoSeries(geometry, index=like.index, crs=like.crs)
