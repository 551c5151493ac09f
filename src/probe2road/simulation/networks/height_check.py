"""Measurement of the heights of a network: clearances, grades, changes of grade, continuity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.simulation.networks.crossings import find_crossings
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.networks.profile import ProfileOptions, bends, grade_limits, steps, vertex_unknowns

__all__ = ["HeightReport", "check_heights"]

_NEAR = 400.0  # m; a crossing this near can be why a grade is steep


@dataclass(frozen=True)
class HeightReport:
    """The measured heights of a network, and the violations of their limits.

    Attributes
    ----------
    crossings
        ``upper``, ``lower``, ``x``, ``y``, ``kind``, ``rule`` as in `Crossings.table`, and ``clearance`` (m).
    violations
        ``kind`` (``"clearance"``, ``"grade"``, ``"radius"``), ``section``, ``other`` (-1 where none), ``x``, ``y``,
        ``value``, ``limit``, ``cause``. One row for each pair of sections, or for each section, at its worst place.
    max_grade
        Steepest grade of each section (rise over run), indexed like the sections.
    min_radius
        Smallest vertical radius of each section (m), ends included, indexed like the sections.
    max_gap
        Largest difference in height (m) between a node and a section end at it.
    """

    crossings: pd.DataFrame
    violations: pd.DataFrame
    max_grade: pd.Series
    min_radius: pd.Series
    max_gap: float


def check_heights(network: RoadNetwork, *, options: ProfileOptions | None = None) -> HeightReport:
    """Measure clearances, grades, vertical radii and continuity from the geometry alone.

    Listed as violations are clearances below ``options.clearance``, grades beyond the limit of the class by more than
    ``options.grade_tolerance``, and radii below ``options.least_radius``.

    Examples
    --------
    A flat network with a bridge fails:

    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> lines = [[(0, 0), (200, 0)], [(100, -90), (100, 90)]]
    >>> network = network_from_sections(lines, crs="EPSG:32616", layer=[0, 1])
    >>> check_heights(network).violations[["kind", "section", "other", "value", "limit"]].values.tolist()
    [['clearance', 1, 0, 0.0, 5.5]]
    """
    options = options or ProfileOptions()
    xyz, offsets = network.vertices()
    crossings = find_crossings(network)
    table = crossings.table.assign(clearance=crossings.clearance(xyz[:, 2]))
    row, vertex, grade, limit = _grades(network, xyz, offsets)
    steep = _worst_places(network, xyz, row, vertex, grade, limit + options.grade_tolerance)
    steep = steep.assign(kind="grade", limit=steep["limit"] - options.grade_tolerance)
    owner, middle, curvature = _curvatures(network, xyz, offsets)
    bent = _worst_places(network, xyz, owner, middle, curvature, np.full(len(owner), 1.0 / options.least_radius))
    bent = bent.assign(kind="radius", value=1.0 / bent["value"], limit=1.0 / bent["limit"])
    low = table[table["clearance"] < options.clearance].sort_values("clearance").drop_duplicates(["upper", "lower"])
    low = low.assign(kind="clearance", value=low["clearance"], limit=options.clearance)
    low = low.rename(columns={"upper": "section", "lower": "other"})
    columns = ["kind", "section", "other", "x", "y", "value", "limit"]
    violations = pd.concat([part[columns] for part in (low, steep, bent)], ignore_index=True)
    violations["cause"] = pd.Series(_causes(violations, table), index=violations.index, dtype="str")
    sections = network.sections.index
    largest = pd.Series(grade).groupby(row).max().reindex(range(len(sections)), fill_value=0.0)
    sharpest = pd.Series(curvature).groupby(owner).max().reindex(range(len(sections)), fill_value=0.0)
    return HeightReport(
        table,
        violations,
        pd.Series(largest.to_numpy(), index=sections, name="max_grade"),
        pd.Series(1.0 / np.maximum(sharpest.to_numpy(), 1e-9), index=sections, name="min_radius"),
        _largest_gap(network, xyz, offsets),
    )


def _grades(
    network: RoadNetwork, xyz: NDArray[np.float64], offsets: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return section row, first vertex, grade and its limit for every step."""
    vertex, row, step = steps(xyz, offsets)
    return row, vertex, np.abs(xyz[vertex + 1, 2] - xyz[vertex, 2]) / step, grade_limits(network)[row]


def _curvatures(
    network: RoadNetwork, xyz: NDArray[np.float64], offsets: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the section row, the middle vertex and the vertical curvature (1/m) of every bend."""
    unknown = vertex_unknowns(network, offsets)
    vertex, _, step = steps(xyz, offsets)
    before, middle, after, first, second = bends(network, offsets, unknown, vertex, step)
    z, place, owner = (np.zeros(int(unknown.max(initial=-1)) + 1, dtype) for dtype in (float, np.int64, np.int64))
    z[unknown], place[unknown] = xyz[:, 2], np.arange(len(xyz))
    owner[unknown] = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    change = (z[after] - z[middle]) / second - (z[middle] - z[before]) / first
    return owner[middle], place[middle], np.abs(change) / ((first + second) / 2.0)


def _worst_places(
    network: RoadNetwork,
    xyz: NDArray[np.float64],
    row: NDArray[np.int64],
    vertex: NDArray[np.int64],
    value: NDArray[np.float64],
    limit: NDArray[np.float64],
) -> pd.DataFrame:
    """Return for each section the place where a value exceeds its limit the most, if any."""
    table = pd.DataFrame({"row": row, "vertex": vertex, "value": value, "limit": limit})[value > limit]
    table = table.sort_values("value", ascending=False).drop_duplicates("row").sort_values("row")
    x, y = xyz[table["vertex"], 0], xyz[table["vertex"], 1]
    return table.assign(section=network.sections.index.to_numpy()[table["row"]], other=-1, x=x, y=y)


def _largest_gap(network: RoadNetwork, xyz: NDArray[np.float64], offsets: NDArray[np.int64]) -> float:
    height = pd.Series(shapely.get_z(network.nodes.geometry.to_numpy()), index=network.nodes.index)
    gaps = [
        np.abs(xyz[vertex, 2] - height.loc[network.sections[end]].to_numpy()).max(initial=0.0)
        for end, vertex in (("u", offsets[:-1]), ("v", offsets[1:] - 1))
    ]
    return float(max(gaps))


def _causes(violations: pd.DataFrame, crossings: pd.DataFrame) -> list[str]:
    """Return the cause of each violation in the input."""
    ambiguous = crossings[crossings["rule"] == "ambiguous"]
    doubtful = set(ambiguous["upper"]) | set(ambiguous["lower"])
    places = crossings[["x", "y"]].to_numpy()
    causes = []
    for row in violations.itertuples():
        away = np.hypot(*(places - [row.x, row.y]).T)
        near = away.min(initial=np.inf)
        if row.section in doubtful or row.other in doubtful:
            causes.append("equal layers where the roads cross, neither bridge nor tunnel")
        elif row.kind == "clearance":
            causes.append("the roads cross too close to where they join")
        elif near < _NEAR and crossings["rule"].iloc[int(away.argmin())] == "ambiguous":
            causes.append("next to a crossing with equal layers, neither bridge nor tunnel")
        elif near < _NEAR:
            causes.append(f"too little road to reach the height of a crossing {near:.0f} m away")
        else:
            causes.append("terrain")
    return causes
