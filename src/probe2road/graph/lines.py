"""Lines of a map before they become a graph: one line for each street, cut where another line ends on it.

Maps in GIS files differ in two ways from a graph. Many have a line for each direction of a street: those are brought
together. And in many a through road is drawn past the side streets that end on its vertices: it is cut there, as ways
of OpenStreetMap are cut at the nodes they share. Lines that merely cross stay apart, as bridges do.
"""

from __future__ import annotations

import logging

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray
from scipy.spatial import KDTree

from probe2road.graph.direction import told_direction

__all__ = ["cut_at_ends", "one_line_each"]

logger = logging.getLogger(__name__)

_SAME_PLACE = 1e-3  # m; vertices of the two directions of a street are this near
_SAME_HEIGHT = 2.0  # m; an end that lies higher or lower than this is on another level


def one_line_each(lines: NDArray[np.object_], attributes: pd.DataFrame) -> tuple[NDArray[np.object_], pd.DataFrame]:
    """Replace two lines through the same places in opposite directions by one.

    The first of the two stays, with its attributes. Its ``oneway`` says that it is open both ways where the two were
    one-way in opposite directions. Lines drawn twice in the same direction are left as they are.

    Parameters
    ----------
    lines
        LineStrings, shape (n,).
    attributes
        One row for each, a column ``oneway`` where the map has one.

    Examples
    --------
    >>> there = shapely.LineString([(0, 0), (50, 5), (100, 0)])
    >>> lines, rows = one_line_each(np.array([there, there.reverse()]), pd.DataFrame({"oneway": ["yes", "yes"]}))
    >>> len(lines), rows["oneway"].tolist()
    (1, ['no'])
    """
    if not len(lines):
        return lines, attributes
    whole = shapely.transform(lines, lambda places: np.round(places / _SAME_PLACE))  # without heights; may be empty
    drawn, back = shapely.to_wkb(whole), shapely.to_wkb(shapely.reverse(whole))
    number = pd.factorize(np.concatenate([drawn, back]))[0]
    drawn, back = number[: len(lines)], number[len(lines) :]
    street = np.minimum(drawn, back)
    # A ring that equals its own reverse is no pair, and two lines in the same direction are no opposites.
    table = pd.DataFrame({"street": street, "along": drawn <= back})
    rank = table.groupby(["street", "along"]).cumcount()
    table["pair"] = rank
    partner = table[drawn != back].reset_index(names="row").groupby(["street", "pair"])["row"].agg(["min", "max"])
    partner = partner[partner["min"] != partner["max"]].sort_values("min")
    if partner.empty:
        return lines, attributes
    first, second = partner["min"].to_numpy(), partner["max"].to_numpy()
    if "oneway" in attributes:
        told = told_direction(attributes["oneway"]).fillna(0).to_numpy(np.int64)
        # Against the direction of the second line is along the first.
        open_both = (told[first] == 0) | (told[second] == 0) | (told[first] == told[second])
        attributes = attributes.assign(oneway=_opened(attributes["oneway"], first[open_both & (told[first] != 0)]))
    kept = np.ones(len(lines), bool)
    kept[second] = False
    logger.info("%d streets have a line for each direction; each becomes one line", len(first))
    return lines[kept], attributes[kept]


def _opened(oneway: pd.Series, rows: NDArray[np.int64]) -> pd.Series:
    """Set rows to "both directions", in the vocabulary of the column."""
    if not len(rows):
        return oneway
    numeric = pd.api.types.is_numeric_dtype(oneway.dtype)
    result = oneway.copy()
    result.iloc[rows] = 0 if numeric and not pd.api.types.is_bool_dtype(oneway.dtype) else False if numeric else "no"
    return result


def cut_at_ends(lines: NDArray[np.object_], *, snap: float) -> tuple[NDArray[np.object_], NDArray[np.int64]]:
    """Cut lines at the inner vertices at which other lines end.

    Parameters
    ----------
    lines
        LineStrings, shape (n,).
    snap
        Metres within which an end lies on a vertex.

    Returns
    -------
    parts, line
        The parts in the order of the lines, and the row of the line that each is of. An end on another level, where
        both have heights, cuts nothing.

    Examples
    --------
    >>> main = shapely.LineString([(0, 0), (50, 0), (100, 0)])
    >>> over = shapely.LineString([(20, -50), (20, 50)])
    >>> side = shapely.LineString([(50, 0), (50, 40)])
    >>> parts, line = cut_at_ends(np.array([main, over, side]), snap=0.01)
    >>> line.tolist(), [part.length for part in parts]
    ([0, 0, 1, 2], [50.0, 50.0, 100.0, 40.0])
    """
    if not len(lines):
        return lines, np.zeros(0, np.int64)
    has_z = bool(shapely.has_z(lines).any())
    coordinates, owner = shapely.get_coordinates(lines, include_z=True, return_index=True)
    begins = np.diff(owner, prepend=-1) != 0
    finishes = np.append(begins[1:], True)
    inner, ends = np.flatnonzero(~begins & ~finishes), coordinates[begins | finishes]
    cut = np.zeros(len(owner), bool)
    if len(inner):
        tree = KDTree(ends[:, :2])
        near = tree.query_ball_point(coordinates[inner, :2], snap)
        met = np.fromiter((len(found) > 0 for found in near), bool, len(inner))
        if has_z:
            for row in np.flatnonzero(met):
                apart = np.abs(ends[near[row], 2] - coordinates[inner[row], 2])
                met[row] = bool((~(apart > _SAME_HEIGHT)).any())  # NaN where a height is unknown
        cut[inner[met]] = True
    if not cut.any():
        return lines, np.arange(len(lines))
    # Every vertex that is cut is drawn twice: as the last of one part and the first of the next.
    repeats = np.where(cut, 2, 1)
    starts = np.repeat(begins, repeats)
    starts[np.cumsum(repeats)[cut] - 1] = True
    part = np.cumsum(starts) - 1
    drawn = np.repeat(coordinates, repeats, axis=0)
    parts = shapely.linestrings(drawn if has_z else drawn[:, :2], indices=part)
    line = np.repeat(owner, repeats)[starts]
    if has_z:
        flat = ~shapely.has_z(lines)[line]
        parts = np.where(flat, shapely.force_2d(parts), parts)
    logger.info("%d lines are cut at %d vertices on which other lines end", len(np.unique(owner[cut])), int(cut.sum()))
    return parts, line
