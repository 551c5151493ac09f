"""Lanes in the plane of the road: where each one lies on its section, and how it meets the next section's.

Strategy
--------
Away from its ends a section carries its lanes side by side, symmetric about its line. At an end they may have to
meet other lanes: where a motorway of three lanes continues with two, where a ramp leaves from the outer lane while
both lines start at one node, where two carriageways become one road. There one section is the host and keeps its
lanes; the others adapt: the borders of their lanes start at given lateral positions of the host and move to their
own place along a taper. A border that finds no place on the host starts at the host's edge, so that a new lane opens
from zero width. Borders, and with them lanes, are lateral offsets in metres, positive to the right of ``u`` to ``v``.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from probe2road.simulate.network import RoadNetwork

__all__ = ["lane_borders", "lane_offsets", "lateral_offset"]

_THROUGH = 60.0  # degrees; lanes connect where the heading changes by less than this
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

    >>> from probe2road.simulate.network import network_from_sections
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
    """Return the lateral position of every lane border along its section, edges of the carriageway included.

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

    >>> from probe2road.simulate.network import network_from_sections
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
    taper = np.minimum(np.clip(sections["speed_limit"].to_numpy() * _TAPER_SECONDS, *_TAPER_LENGTHS), length / 2.0)
    adapted = _adapted_ends(network)
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
    column = {name: table[name].to_numpy() for name in table if str(name).endswith(("offset", "taper"))}
    start = (column["start_offset"] - column["offset"]) * _fade(s / np.maximum(column["start_taper"], 1e-9))
    end = (column["end_offset"] - column["offset"]) * _fade((length - s) / np.maximum(column["end_taper"], 1e-9))
    return np.asarray(column["offset"] + start + end)


def _fade(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Smooth step from 1 at 0 to 0 at 1."""
    t = np.clip(t, 0.0, 1.0)
    return 1.0 - t * t * (3.0 - 2.0 * t)


def _adapted_ends(network: RoadNetwork) -> pd.DataFrame:
    """Find the ends of sections whose lanes take their places from another section.

    Returns
    -------
    DataFrame
        ``section``, ``end`` (start, end); border j lies at ``base + j * step`` there, clipped to ``[low, high]``.
    """
    moves = network.movements()
    moves = moves[moves["turn"].abs() < _THROUGH]
    lanes = _travel_lanes(network)
    moves = moves.merge(lanes.add_prefix("from_"), on=["from_section", "from_direction"])
    moves = moves.merge(lanes.add_prefix("to_"), on=["to_section", "to_direction"])
    arrivals = moves.groupby(["to_section", "to_direction", "via_node"])["turn"].transform("size").to_numpy()
    exits = moves.groupby(["from_section", "from_direction", "via_node"])["turn"].transform("size").to_numpy()
    widens = (moves["to_count"] >= moves["from_count"]).to_numpy()
    diverge = (arrivals == 1) & ((exits > 1) | widens) & moves["to_one_way"].to_numpy()
    merge = (exits == 1) & ((arrivals > 1) | ((arrivals == 1) & ~widens)) & moves["from_one_way"].to_numpy()
    outer = network.driving_side == "left"
    leaving = _place(moves[diverge], host="from", guest="to", end="start", lone_right=outer)
    joining = _place(moves[merge & ~diverge], host="to", guest="from", end="end", lone_right=outer)
    return pd.concat([leaving, joining, _two_way_ends(moves, outer)], ignore_index=True)


def _travel_lanes(network: RoadNetwork) -> pd.DataFrame:
    """Count the lanes of each section in each driving direction, with their outer edges as seen in that direction."""
    sections = network.sections
    tables = []
    for direction, own, other in ((1, "lanes_forward", "lanes_backward"), (-1, "lanes_backward", "lanes_forward")):
        count, width = sections[own].to_numpy(), sections["lane_width"].to_numpy()
        half = (count + sections[other].to_numpy()) / 2.0 * width
        left = half - count * width if network.driving_side == "right" else -half
        table = pd.DataFrame({"section": sections.index, "direction": direction, "count": count, "width": width})
        one_way = (sections["lanes_backward"] == 0).to_numpy()
        tables.append(table.assign(left=left, right=left + count * width, one_way=one_way)[count > 0])
    return pd.concat(tables, ignore_index=True)


def _place(moves: pd.DataFrame, *, host: str, guest: str, end: str, lone_right: bool) -> pd.DataFrame:
    """Spread the guests of each host from its left to its right edge, in the order of their headings."""
    key = [f"{host}_section", f"{host}_direction", "via_node"]
    # A ramp that bends to the right leaves on the right; one that arrives bending to the right comes from the left.
    order = moves["turn"] if end == "start" else -moves["turn"]
    groups = moves.assign(order=order).groupby(key)["order"]
    rank, size = groups.rank(method="first") - 1.0, groups.transform("size")
    share = np.where(size > 1, rank / np.maximum(size - 1.0, 1.0), float(lone_right))
    left, right, step = (moves[f"{host}_{name}"].to_numpy() for name in ("left", "right", "width"))
    base = left + share * (right - left - moves[f"{guest}_count"].to_numpy() * step)
    table = pd.DataFrame({"section": moves[f"{guest}_section"], "base": base, "step": step, "low": left, "high": right})
    return table.assign(end=end)


def _two_way_ends(moves: pd.DataFrame, left_hand: bool) -> pd.DataFrame:
    """Align the centre lines of two two-way sections that continue each other with different lane counts."""
    both = moves[~moves["from_one_way"] & ~moves["to_one_way"]]
    pair = ["from_section", "to_section", "via_node"]
    alone = both.groupby(["from_section", "from_direction", "via_node"])["turn"].transform("size") == 1
    both = both[alone & (both.groupby(["to_section", "to_direction", "via_node"])["turn"].transform("size") == 1)]
    back = both.rename(columns={"from_section": "to_section", "to_section": "from_section"})
    back = back.rename(columns={"from_count": "to_back_count", "to_count": "from_back_count"})
    both = both.merge(back[[*pair, "from_back_count", "to_back_count"]], on=pair)
    host_lanes = both["from_count"] + both["from_back_count"]
    guest_lanes = both["to_count"] + both["to_back_count"]
    both = both[(guest_lanes > host_lanes) & (both["from_section"] != both["to_section"])]
    # In the frame of travel from host to guest; the guest's own frame is the same where it is drawn that way.
    low = both["from_left"] if left_hand else both["from_right"] - host_lanes * both["from_width"]
    high = low + host_lanes * both["from_width"]
    centre = both["from_right"] if left_hand else both["from_left"]
    base = centre - (both["to_count"] if left_hand else both["to_back_count"]) * both["from_width"]
    top = base + guest_lanes * both["from_width"]
    drawn = both["to_direction"].to_numpy() == 1
    return pd.DataFrame(
        {
            "section": both["to_section"],
            "end": np.where(drawn, "start", "end"),
            "base": np.where(drawn, base, -top),
            "step": both["from_width"],
            "low": np.where(drawn, low, -high),
            "high": np.where(drawn, high, -low),
        }
    )
