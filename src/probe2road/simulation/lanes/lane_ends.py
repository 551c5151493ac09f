"""The lanes at joins of sections: which section keeps its lanes, and where on it the lanes of others start or end.

Strategy
--------
At an end the lanes of a section may have to meet other lanes: where a motorway of three lanes continues with two,
where a ramp leaves from the outer lane while both lines start at one node, where two carriageways become one road.
There one section is the host and keeps its lanes; the others adapt: the borders of their lanes start at lateral
positions of the host. Where one road parts into several the host is the one before, where several join it is the one
after, and where one follows one it is the narrower. A border that finds no place on the host starts at the host's
edge, so that a new lane opens from zero width. At crossroads nothing adapts.
"""

from __future__ import annotations

import numpy as np
import pandas as pd

from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["adapted_ends"]

_THROUGH = 60.0  # degrees; lanes connect where the heading changes by less than this


def adapted_ends(network: RoadNetwork) -> pd.DataFrame:
    """Find the ends of sections whose lanes are aligned with those of another section.

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
    """Distribute the guest sections of each host from its left to its right edge, in the order of their turns."""
    key = [f"{host}_section", f"{host}_direction", "via_node"]
    # To the right leaves what turns right at the node; from the right comes what has to turn right to go on.
    groups = moves.groupby(key)["turn"]
    rank, size = groups.rank(method="first") - 1.0, groups.transform("size")
    share = np.where(size > 1, rank / np.maximum(size - 1.0, 1.0), float(lone_right))
    left, right, step = (moves[f"{host}_{name}"].to_numpy() for name in ("left", "right", "width"))
    base = left + share * (right - left - moves[f"{guest}_count"].to_numpy() * step)
    table = pd.DataFrame({"section": moves[f"{guest}_section"], "base": base, "step": step, "low": left, "high": right})
    return table.assign(end=end)


def _two_way_ends(moves: pd.DataFrame, left_hand: bool) -> pd.DataFrame:
    """Align the centre lines of two consecutive two-way sections with different lane counts."""
    both = moves[~moves["from_one_way"] & ~moves["to_one_way"]]
    pair = ["from_section", "to_section", "via_node"]
    alone = both.groupby(["from_section", "from_direction", "via_node"])["turn"].transform("size") == 1
    both = both[alone & (both.groupby(["to_section", "to_direction", "via_node"])["turn"].transform("size") == 1)]
    back = both.rename(columns={"from_section": "to_section", "to_section": "from_section"})
    back = back.rename(columns={"from_count": "to_back_count", "to_count": "from_back_count"})
    both = both.merge(back[[*pair, "from_back_count", "to_back_count"]], on=pair)
    both["host_lanes"] = both["from_count"] + both["from_back_count"]
    both["guest_lanes"] = both["to_count"] + both["to_back_count"]
    both = both[(both["guest_lanes"] > both["host_lanes"]) & (both["from_section"] != both["to_section"])]
    host_lanes, guest_lanes = both["host_lanes"], both["guest_lanes"]
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
