"""Lanes in plan: the position of each lane on its section, and how it continues on the next section.

Away from its ends a section carries its lanes side by side, symmetric about its line. At an end they take the place
that `lane_ends` finds for them, and move from there to their own along a taper. Borders, and with them lanes, are
lateral offsets in metres, positive to the right of ``u`` to ``v``.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from probe2road.simulation.lanes.lane_ends import adapted_ends
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["LATERAL", "fade", "lane_borders", "lane_offsets", "lateral_offset", "taper_length"]

# The columns that say where a lane or border lies along its section.
LATERAL = ("offset", "start_offset", "end_offset", "start_taper", "end_taper")

_TAPER_SECONDS = 2.5  # s; a lane moves to its place within this time at the speed limit
_TAPER_LENGTHS = (20.0, 80.0)  # m; and within these bounds


def lane_offsets(network: RoadNetwork) -> pd.DataFrame:
    """Return the lateral position of every lane's centre along its section.

    Parameters
    ----------
    network
        Sections may have any number of lanes.

    Returns
    -------
    DataFrame
        One row a lane, ordered by section and from left to right as seen from u to v: ``section``, ``lane`` (0 is the
        leftmost), ``direction`` (+1 drives from u to v, -1 from v to u), ``offset`` (m, positive to the right of u to
        v), ``start_offset``, ``end_offset`` (the same at u and at v), ``start_taper``, ``end_taper`` (m over which
        they pass into ``offset``). `lateral_offset` evaluates them.

    Examples
    --------
    Right-hand traffic drives on the right half of a two-way road:

    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> road = {"crs": "EPSG:32616", "highway": "secondary", "lanes_backward": 1, "lane_width": 3.0}
    >>> lane_offsets(network_from_sections([[(0, 0), (90, 0)]], **road))[["direction", "offset"]].values.tolist()
    [[-1.0, -1.5], [1.0, 1.5]]
    >>> mirrored = network_from_sections([[(0, 0), (90, 0)]], driving_side="left", **road)
    >>> lane_offsets(mirrored)[["direction", "offset"]].values.tolist()
    [[1.0, -1.5], [-1.0, 1.5]]
    """
    borders = lane_borders(network)
    inner = (borders["section"] == borders["section"].shift(-1)).to_numpy()  # rows that have a border to their right
    left, right = borders[inner].reset_index(drop=True), borders.shift(-1)[inner].reset_index(drop=True)
    table = left[["section"]].assign(lane=left["border"])
    forward = network.sections["lanes_forward"].reindex(table["section"]).to_numpy()
    backward = network.sections["lanes_backward"].reindex(table["section"]).to_numpy()
    if network.driving_side == "right":
        table["direction"] = np.where(table["lane"] >= backward, 1, -1)
    else:
        table["direction"] = np.where(table["lane"] < forward, 1, -1)
    for column in ("offset", "start_offset", "end_offset"):
        table[column] = (left[column] + right[column]) / 2.0
    return table.assign(start_taper=left["start_taper"], end_taper=left["end_taper"])


def lane_borders(network: RoadNetwork) -> pd.DataFrame:
    """Return the lateral position of every lane border along its section, including the edges of the carriageway.

    Returns
    -------
    DataFrame
        One row a border, ordered by section and from left to right as seen from u to v: ``section``, ``border`` (0 is
        the left edge), ``offset``, ``start_offset``, ``end_offset``, ``start_taper``, ``end_taper`` as in
        `lane_offsets`, and ``style``: ``"edge"``, ``"divider"`` (between lanes of one direction) or ``"centre"``
        (between the directions).

    Examples
    --------
    A third lane opens at the outer edge of a motorway with two:

    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> lines = [[(0, 0), (300, 0)], [(300, 0), (600, 0)]]
    >>> network = network_from_sections(lines, crs="EPSG:32616", lanes_forward=[2, 3], lane_width=4.0)
    >>> borders = lane_borders(network)
    >>> borders.loc[borders["section"] == 1, ["start_offset", "offset"]].values.tolist()
    [[-4.0, -6.0], [0.0, -2.0], [4.0, 2.0], [4.0, 6.0]]
    """
    sections = network.sections
    count = (sections["lanes_forward"] + sections["lanes_backward"]).to_numpy()
    row = np.repeat(np.arange(len(sections)), count + 1)
    border = np.arange(len(row)) - np.repeat(np.cumsum(count + 1) - (count + 1), count + 1)
    width, lanes = sections["lane_width"].to_numpy()[row], count[row]
    offset = (border - lanes / 2.0) * width
    table = pd.DataFrame({"section": sections.index.to_numpy()[row], "border": border, "offset": offset})
    length = sections.length.to_numpy()
    taper = taper_length(sections["speed_limit"].to_numpy(), length)
    adapted = adapted_ends(network)
    for end in ("start", "end"):
        rule = adapted[adapted["end"] == end].drop_duplicates("section").set_index("section").reindex(table["section"])
        placed = rule["base"].to_numpy() + border * rule["step"].to_numpy()
        placed = np.clip(placed, rule["low"].to_numpy(), rule["high"].to_numpy())
        table[f"{end}_offset"] = np.where(np.isfinite(placed), placed, offset)
    middle = sections["lanes_backward" if network.driving_side == "right" else "lanes_forward"].to_numpy()[row]
    two_way = (sections["lanes_backward"] > 0).to_numpy()[row]
    style = np.where((border == 0) | (border == lanes), "edge", "divider")
    style = np.where(two_way & (border == middle) & (style == "divider"), "centre", style)
    return table.assign(start_taper=taper[row], end_taper=taper[row], style=style)


def lateral_offset(table: pd.DataFrame, s: ArrayLike, length: ArrayLike) -> NDArray[np.float64]:
    """Evaluate rows of `lane_offsets` or `lane_borders` at distances along their sections.

    Parameters
    ----------
    table
        n rows.
    s
        Distance from u along the section (m), shape ``(n,)``.
    length
        Length of the section (m), shape ``(n,)``.

    Returns
    -------
    ndarray
        Lateral offset (m), shape ``(n,)``, with a continuous first derivative.

    Examples
    --------
    >>> row = pd.DataFrame({"offset": [2.0], "start_offset": [0.0], "end_offset": [2.0]})
    >>> row = row.assign(start_taper=50.0, end_taper=50.0)
    >>> [float(lateral_offset(row, s, 300.0)[0]) for s in (0.0, 25.0, 50.0, 300.0)]
    [0.0, 1.0, 2.0, 2.0]
    """
    s, length = np.asarray(s, float), np.asarray(length, float)
    column = {name: table[name].to_numpy() for name in LATERAL}
    start = (column["start_offset"] - column["offset"]) * fade(s / np.maximum(column["start_taper"], 1e-9))
    end = (column["end_offset"] - column["offset"]) * fade((length - s) / np.maximum(column["end_taper"], 1e-9))
    return np.asarray(column["offset"] + start + end)


def taper_length(speed_limit: ArrayLike, length: ArrayLike) -> NDArray[np.float64]:
    """Return the length (m) over which lanes move to their position at each end of a section.

    Examples
    --------
    >>> taper_length([5.0, 20.0, 40.0, 40.0], [500.0, 500.0, 500.0, 60.0]).tolist()
    [20.0, 50.0, 80.0, 30.0]
    """
    wanted = np.clip(np.asarray(speed_limit, float) * _TAPER_SECONDS, *_TAPER_LENGTHS)
    return np.minimum(wanted, np.asarray(length, float) / 2.0)


def fade(t: ArrayLike) -> NDArray[np.float64]:
    """Return a smooth step from 1 at 0 to 0 at 1.

    Examples
    --------
    >>> fade([-1.0, 0.0, 0.5, 1.0]).tolist()
    [1.0, 1.0, 0.5, 0.0]
    """
    x = np.clip(np.asarray(t, float), 0.0, 1.0)
    return np.asarray(1.0 - x * x * (3.0 - 2.0 * x))
