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
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import linalg

from probe2road.simulate.crossings import Crossings, find_crossings
from probe2road.simulate.network import CLASS_DEFAULTS, RoadNetwork

__all__ = ["HeightOptions", "HeightReport", "Terrain", "check_heights", "solve_heights"]

logger = logging.getLogger(__name__)

_MIN_STEP = 0.5  # m; vertices nearer than this count as this far apart, so that grades stay finite
_THROUGH = 60.0  # degrees; the grade continues from one section to the next where the heading changes by less


@dataclass(frozen=True)
class HeightOptions:
    """What a height profile must keep, and how smooth it is."""

    clearance: float = 5.5  # m, from road surface to road surface
    margin: float = 0.05  # m, solved for on top of the clearance
    terrain_relief: float = 12.0  # m, standard deviation of the terrain
    terrain_scale: float = 2500.0  # m, its shortest wavelength
    smoothing: float = 70.0  # m, over which a disturbance fades into the terrain
    grade_tolerance: float = 0.005  # rise over run by which a grade may pass its limit before it is listed
    vertical_radius: float = 400.0  # m; a grade changes at most this fast: 1 / radius for each metre
    lift: float = 30.0  # weight of the terrain below which an open road is kept from sinking, relative to rising
    max_steps: int = 60  # Newton steps
    raised_pull: float = 0.05  # weight of the terrain under bridges and tunnels, relative to open road


@dataclass(frozen=True)
class HeightReport:
    """The heights of a network, checked.

    Attributes
    ----------
    crossings
        ``upper``, ``lower``, ``x``, ``y``, ``kind``, ``rule`` as in `Crossings.table`, and ``clearance`` (m).
    violations
        ``kind`` (``"clearance"``, ``"grade"``), ``section``, ``other`` (-1 where none), ``x``, ``y``, ``value``,
        ``limit``, ``cause``. One row for each pair of sections, or for each section, at its worst place.
    max_grade
        Steepest grade of each section (rise over run), indexed like the sections.
    max_gap
        Largest difference in height (m) between a node and a section end at it.
    """

    crossings: pd.DataFrame
    violations: pd.DataFrame
    max_grade: pd.Series
    max_gap: float


@dataclass(frozen=True)
class Terrain:
    """A smooth random surface: a sum of plane waves."""

    wave: NDArray[np.float64]  # (k, 2), rad per m
    phase: NDArray[np.float64]  # (k,), rad
    amplitude: NDArray[np.float64]  # (k,), m
    base: float  # m

    @classmethod
    def from_rng(cls, rng: np.random.Generator, *, relief: float, scale: float, waves: int = 24) -> Terrain:
        """Draw a surface of a standard deviation (m) with wavelengths from ``scale`` (m) to four times that."""
        length = scale * 4.0 ** rng.random(waves)
        angle = rng.uniform(0.0, 2 * np.pi, waves)
        wave = (2 * np.pi / length)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        amplitude = length / np.sqrt(np.sum(length**2) / 2.0) * relief
        return cls(wave, rng.uniform(0.0, 2 * np.pi, waves), amplitude, 10.0 + 3.0 * relief)

    def height(self, xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Evaluate at positions (m), shape ``(n, 2)``; the surface repeats nowhere, so any metric CRS will do."""
        total = np.full(len(xy), self.base)
        for wave, phase, amplitude in zip(self.wave, self.phase, self.amplitude, strict=True):
            total += amplitude * np.sin(xy @ wave + phase)
        return total


@dataclass(frozen=True)
class _Problem:
    """The sparse rows of a height problem over v unknowns; r rows each.

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
    network: RoadNetwork, *, rng: np.random.Generator, options: HeightOptions | None = None
) -> RoadNetwork:
    """Give every vertex of a network a height.

    Parameters
    ----------
    network
        Its heights are ignored, its plan geometry is kept.
    rng
        Shapes the terrain.
    options
        What to keep; `HeightOptions` where not given.

    Returns
    -------
    RoadNetwork
        The same network with new heights in sections and nodes.

    Examples
    --------
    >>> from probe2road.simulate.network import network_from_sections
    >>> lines = [[(0, 0), (900, 0)], [(450, -400), (450, 400)]]
    >>> network = network_from_sections(lines, crs="EPSG:32616", bridge=[False, True])
    >>> report = check_heights(solve_heights(network, rng=np.random.default_rng(1)))
    >>> bool(report.crossings["clearance"].min() >= 5.5), len(report.violations)
    (True, 0)
    """
    options = options or HeightOptions()
    started = time.perf_counter()
    crossings = find_crossings(network)
    xyz, offsets = network.vertices()
    unknown = _unknowns(network, offsets)
    problem = _problem(network, xyz, offsets, unknown, crossings, options, rng)
    z, steps = _minimise(problem, options)
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
        steps,
        time.perf_counter() - started,
    )
    return replace(network, sections=sections, nodes=nodes)


def check_heights(network: RoadNetwork, *, options: HeightOptions | None = None) -> HeightReport:
    """Measure clearances, grades and continuity from the geometry alone.

    Examples
    --------
    A flat network with a bridge fails:

    >>> from probe2road.simulate.network import network_from_sections
    >>> lines = [[(0, 0), (200, 0)], [(100, -90), (100, 90)]]
    >>> network = network_from_sections(lines, crs="EPSG:32616", layer=[0, 1])
    >>> check_heights(network).violations[["kind", "section", "other", "value", "limit"]].values.tolist()
    [['clearance', 1, 0, 0.0, 5.5]]
    """
    options = options or HeightOptions()
    xyz, offsets = network.vertices()
    crossings = find_crossings(network)
    table = crossings.table.assign(clearance=crossings.clearance(xyz[:, 2]))
    a, owner, step = _steps(xyz, offsets)
    grade = np.abs(xyz[a + 1, 2] - xyz[a, 2]) / step
    limit = _grade_limits(network)
    worst = pd.Series(grade).groupby(owner).max().reindex(range(len(network.sections)), fill_value=0.0)
    steepest = pd.Series(worst.to_numpy(), index=network.sections.index, name="max_grade")
    place = pd.Series(shapely.get_z(network.nodes.geometry.to_numpy()), index=network.nodes.index)
    gaps = [
        np.abs(xyz[vertex, 2] - place.loc[network.sections[end]].to_numpy()).max(initial=0.0)
        for end, vertex in (("u", offsets[:-1]), ("v", offsets[1:] - 1))
    ]
    too_steep = np.flatnonzero(grade > limit[owner] + options.grade_tolerance)
    steep = pd.DataFrame({"row": owner[too_steep], "value": grade[too_steep], "vertex": a[too_steep]})
    steep = steep.sort_values("value", ascending=False).drop_duplicates("row").sort_values("row")
    rows = pd.DataFrame(
        {
            "kind": "grade",
            "section": network.sections.index.to_numpy()[steep["row"]],
            "other": -1,
            "x": xyz[steep["vertex"], 0],
            "y": xyz[steep["vertex"], 1],
            "value": steep["value"].to_numpy(),
            "limit": limit[steep["row"]],
        }
    )
    low = table[table["clearance"] < options.clearance].sort_values("clearance").drop_duplicates(["upper", "lower"])
    clear = low.assign(kind="clearance", section=low["upper"], other=low["lower"], value=low["clearance"])
    violations = pd.concat([clear.assign(limit=options.clearance)[rows.columns], rows], ignore_index=True)
    violations["cause"] = _causes(network, violations, table)
    return HeightReport(table, violations, steepest, float(max(gaps)))


def _unknowns(network: RoadNetwork, offsets: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the unknown of every vertex: node rows first, then the inner vertices of all sections."""
    rows = pd.Index(network.nodes.index)
    inner = np.ones(offsets[-1], dtype=bool)
    inner[offsets[:-1]], inner[offsets[1:] - 1] = False, False
    unknown = np.cumsum(inner) - 1 + len(rows)
    unknown[offsets[:-1]] = rows.get_indexer(network.sections["u"])
    unknown[offsets[1:] - 1] = rows.get_indexer(network.sections["v"])
    return unknown.astype(np.int64)


def _steps(
    xyz: NDArray[np.float64], offsets: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return first vertex, section row and plan length (m) of every step between neighbouring vertices."""
    is_last = np.zeros(len(xyz), dtype=bool)
    is_last[offsets[1:] - 1] = True
    a = np.flatnonzero(~is_last)
    owner = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets) - 1)
    return a, owner, np.maximum(np.hypot(*(xyz[a + 1, :2] - xyz[a, :2]).T), _MIN_STEP)


def _grade_limits(network: RoadNetwork) -> NDArray[np.float64]:
    return np.array([CLASS_DEFAULTS[highway].max_grade for highway in network.sections["highway"]])


def _problem(
    network: RoadNetwork,
    xyz: NDArray[np.float64],
    offsets: NDArray[np.int64],
    unknown: NDArray[np.int64],
    crossings: Crossings,
    options: HeightOptions,
    rng: np.random.Generator,
) -> _Problem:
    """Lay out terrain, grade, change of grade and clearance over the unknowns."""
    size = int(unknown.max()) + 1
    a, owner, step = _steps(xyz, offsets)
    raised = (network.sections["bridge"] | network.sections["tunnel"]).to_numpy()[owner]
    share = np.where(raised, options.raised_pull, 1.0) * step / 2.0
    pull = np.asarray(np.bincount(unknown[a], share, size) + np.bincount(unknown[a + 1], share, size), float)
    is_raised = np.bincount(unknown[a], raised, size) + np.bincount(unknown[a + 1], raised, size) > 0
    place = np.zeros((size, 2))
    place[unknown] = xyz[:, :2]
    terrain = Terrain.from_rng(rng, relief=options.terrain_relief, scale=options.terrain_scale).height(place)
    before, middle, after, first, second = _bends(network, offsets, unknown, a, step)
    mean = (first + second) / 2.0
    bend = _rows([before, middle, after], [1.0 / first, -1.0 / first - 1.0 / second, 1.0 / second], size)
    up, w = crossings.upper_vertex, crossings.upper_weight
    down, x = crossings.lower_vertex, crossings.lower_weight
    places = [unknown[up], unknown[up + 1], unknown[down], unknown[down + 1]]
    return _Problem(
        terrain=terrain,
        pull=pull,
        open_road=~is_raised,
        bend=bend,
        bend_weight=options.smoothing**4 / mean,
        bend_limit=mean / options.vertical_radius,
        steep=_rows([unknown[a], unknown[a + 1]], [-np.ones(len(a)), np.ones(len(a))], size),
        steep_limit=_grade_limits(network)[owner] * step,
        clear=_rows(places, [1 - w, w, x - 1, -x], size),
        clear_weight=np.where(crossings.table["rule"] == "ambiguous", _DOUBTFUL_WEIGHT, _CLEAR_WEIGHT),
    )


def _bends(
    network: RoadNetwork,
    offsets: NDArray[np.int64],
    unknown: NDArray[np.int64],
    a: NDArray[np.int64],
    step: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the unknowns of three vertices in a row and the two steps between, inside sections and through nodes."""
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


def _rows(columns: list[NDArray[np.int64]], values: list[NDArray[np.float64]], size: int) -> sparse.csr_array:
    """Assemble a sparse matrix; each position within a row has one array of columns and one of values."""
    count = len(columns[0])
    row = np.tile(np.arange(count), len(columns))
    return sparse.csr_array((np.concatenate(values), (row, np.concatenate(columns))), shape=(count, size))


_CLEAR_WEIGHT = 3e7  # per m of missing clearance, squared
_DOUBTFUL_WEIGHT = 1e4  # the same where the order is ambiguous
_STEEP_WEIGHT = 1e5  # per m of rise beyond the limit, squared
_FULL_STEPS = 12
_SETTLED = 1e-3  # m; the steps end when no height moves more
_BEND_FACTOR = 30.0  # bends beyond the limit weigh this much more than those within


def _minimise(problem: _Problem, options: HeightOptions) -> tuple[NDArray[np.float64], int]:
    """Minimise the piecewise quadratic by Newton steps; return heights and the number of steps."""
    z, steps, moved = problem.terrain.copy(), 0, np.inf
    while moved > _SETTLED and steps < options.max_steps:
        matrix, right = _active_system(problem, z, options)
        solution = _solve(matrix, right)
        moved = float(np.abs(solution - z).max(initial=0.0))
        # Full steps settle within ten or so, or swing between two sets of active terms; half steps end the swing.
        z, steps = (solution if steps < _FULL_STEPS else (z + solution) / 2.0), steps + 1
    return z, steps


def _active_system(
    problem: _Problem, z: NDArray[np.float64], options: HeightOptions
) -> tuple[sparse.csr_array, NDArray[np.float64]]:
    """Assemble the normal equations of the terms that are active at z."""
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


def _causes(network: RoadNetwork, violations: pd.DataFrame, crossings: pd.DataFrame) -> list[str]:
    """Say for each violation what in the input leads to it."""
    ambiguous = crossings[crossings["rule"] == "ambiguous"]
    doubtful = set(ambiguous["upper"]) | set(ambiguous["lower"])
    crossing = set(crossings["upper"]) | set(crossings["lower"])
    length = network.sections.length
    causes = []
    for kind, section, other in zip(violations["kind"], violations["section"], violations["other"], strict=True):
        if section in doubtful or other in doubtful:
            causes.append("equal layers at a crossing")
        elif kind == "clearance":
            causes.append("the roads join too close to where they cross")
        elif section in crossing:
            causes.append(f"a section of {length[section]:.0f} m must reach a crossing")
        else:
            causes.append("approach of a neighbouring crossing")
    return causes


def _series(geometry: NDArray[np.object_], like: gpd.GeoDataFrame) -> gpd.GeoSeries:
    return gpd.GeoSeries(geometry, index=like.index, crs=like.crs)
