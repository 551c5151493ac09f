"""Features that a camera sees beside the road: lane markings and road boundaries, in three dimensions.

Strategy
--------
Markings follow the borders. Solid lines and boundaries are sampled at stations along every section; a sample is dropped
where it lies on the carriageway of another road at its height, which leaves junctions unpainted, ends the lines of two
roads that part where their carriageways part (the gore), and opens a guard rail for a ramp. What is left of a line
becomes one polyline for each unbroken stretch. Dashes are laid out by the country's pattern, each a polyline of its
own, and dropped by the same samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.simulation.lanes.frame import SectionFrame
from probe2road.simulation.lanes.lanes import LATERAL, lane_borders, lateral_offset
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["FEATURE_STYLES", "RoadFeatures", "road_features"]

FEATURE_STYLES = ("edge", "divider", "centre", "kerb", "guard_rail", "barrier")  # the first three are painted

_STATION = 3.0  # m; solid lines and boundaries are sampled this often
_DASH_POINTS = 3  # vertices of a dash
_MIN_LANE = 1.8  # m; a lane narrower than this, where it opens or closes, has no divider
_SAME_LEVEL = 3.0  # m; roads nearer than this in height share the ground
_MEDIAN_SHOULDER = 1.0  # m, from the lanes to the barrier in the median, or beside a bridge or in a tunnel
_CLEARED = 0.3  # m; a boundary this far beside another carriageway still counts as on it
_SHARED_EDGE = 0.5  # m; paint this near the edge of another carriageway is the edge of both
_CONTINUES = 30.0  # degrees; a section that changes heading by less from another goes on from it
# Boundaries come in blocks, each there with a probability: guard rails end and begin, kerbs are lowered for drives.
_BLOCKS = {"kerb": (25.0, 0.85), "guard_rail": (60.0, 0.75), "barrier": (200.0, 0.97)}  # m, probability
_FIRST_BOUNDARY = FEATURE_STYLES.index("kerb")


@dataclass(frozen=True)
class RoadFeatures:
    """Lane markings and road boundaries as m polylines of n vertices, in the CRS of the network.

    Attributes
    ----------
    xyz
        Vertices, shape ``(n, 3)``.
    offsets
        Polyline i owns ``xyz[offsets[i]:offsets[i + 1]]``, two vertices or more, shape ``(m + 1,)``.
    kind
        ``"lane_marking"`` or ``"road_boundary"``, shape ``(m,)``.
    style
        Index into `FEATURE_STYLES`, shape ``(m,)``.
    section
        Section id, shape ``(m,)``.
    """

    xyz: NDArray[np.float64]
    offsets: NDArray[np.int64]
    kind: NDArray[np.str_]
    style: NDArray[np.int8]
    section: NDArray[np.int64]


def road_features(network: RoadNetwork, *, rng: np.random.Generator | None = None) -> RoadFeatures:
    """Return the lane markings and road boundaries of a network, in three dimensions.

    Edges of the carriageway are solid; lanes of one direction are divided by the country's dashes; the directions of a
    two-way road by a solid line where it has more than two lanes or the country paints it so, else by dashes. Motorways
    and trunk roads have a barrier in the median and guard rails outside, bridges and tunnels barriers, all other roads
    kerbs. Nothing is painted within junctions.

    Parameters
    ----------
    network
        With heights.
    rng
        Decides where boundaries have gaps; seed 0 where not given.

    Returns
    -------
    RoadFeatures
        Empty for a network without sections.

    Examples
    --------
    Two edges and the dashes of one divider, 6 m with gaps of 12 m:

    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> network = network_from_sections([[(0, 0), (180, 0)]], crs="EPSG:32632", markings="DE")
    >>> features = road_features(network)
    >>> style = np.array(FEATURE_STYLES)[features.style]
    >>> int((style == "edge").sum()), int((style == "divider").sum())
    (2, 10)
    """
    frame = SectionFrame.from_network(network)
    lines = pd.concat([_painted_lines(network), _boundary_lines(network)], ignore_index=True)
    samples = _sample(frame, lines)
    samples["keep"] = ~_on_other_roads(network, frame, lines, samples) & (samples["width"] >= _MIN_LANE)
    samples["keep"] &= _present(lines, samples, rng if rng is not None else np.random.default_rng(0))
    solid = lines["dash"].isna().to_numpy()[samples["line"]]
    parts = (_runs(samples[solid]), _dashes(lines, samples, frame))
    xyz, count, line = (np.concatenate(part) for part in zip(*parts, strict=True))
    style = lines["style"].to_numpy()[line].astype(np.int8)
    return RoadFeatures(
        xyz,
        np.concatenate([[0], np.cumsum(count)]).astype(np.int64),
        np.where(style < _FIRST_BOUNDARY, "lane_marking", "road_boundary"),
        style,
        network.sections.index.to_numpy()[lines["row"].to_numpy()[line]],
    )


def _painted_lines(network: RoadNetwork) -> pd.DataFrame:
    """Return one row a marking: section ``row``, lateral columns, ``style``, ``dash`` and ``period`` (m, or NaN)."""
    borders, sections, paint = lane_borders(network), network.sections, network.markings
    row = pd.Index(sections.index).get_indexer(borders["section"])
    fast = sections["highway"].str.startswith(("motorway", "trunk")).to_numpy()[row]
    lanes = (sections["lanes_forward"] + sections["lanes_backward"]).to_numpy()[row]
    style = borders["style"].map(FEATURE_STYLES.index).to_numpy().astype(np.int64)
    dashed = (style == 1) | ((style == 2) & (lanes == 2) & (not paint.solid_centre))
    inset = np.where(style == 0, paint.edge_inset, 0.0) * np.where(borders["border"] == 0, 1.0, -1.0)
    moved = {name: borders[name] + inset for name in ("offset", "start_offset", "end_offset")}
    return borders.assign(
        row=row,
        style=style,
        dash=np.where(dashed, np.where(fast, paint.dash, paint.dash_slow), np.nan),
        period=np.where(dashed, np.where(fast, paint.dash + paint.gap, paint.dash_slow + paint.gap_slow), np.nan),
        **moved,
    )


def _boundary_lines(network: RoadNetwork) -> pd.DataFrame:
    """Return one row for each boundary: the outermost borders, moved outwards."""
    borders, sections, paint = lane_borders(network), network.sections, network.markings
    edges = borders[borders["style"] == "edge"].reset_index(drop=True)
    row = pd.Index(sections.index).get_indexer(edges["section"])
    fast = sections["highway"].str.startswith(("motorway", "trunk")).to_numpy()[row]
    structure = (sections["bridge"] | sections["tunnel"]).to_numpy()[row]
    is_left = (edges["border"] == 0).to_numpy()
    one_way = (sections["lanes_backward"] == 0).to_numpy()[row]
    link = sections["highway"].str.endswith("_link").to_numpy()[row]
    median = one_way & ~link & (is_left == (network.driving_side == "right"))
    style = np.select([structure | (fast & median), fast], ["barrier", "guard_rail"], "kerb")
    shoulder = np.where(fast, np.where(median | structure, _MEDIAN_SHOULDER, paint.shoulder), paint.kerb)
    outwards = np.where(is_left, -shoulder, shoulder)
    moved = {name: edges[name] + outwards for name in ("offset", "start_offset", "end_offset")}
    codes = np.array([FEATURE_STYLES.index(name) for name in style], dtype=np.int64)
    return edges.assign(row=row, style=codes, dash=np.nan, period=np.nan, **moved)


def _sample(frame: SectionFrame, lines: pd.DataFrame) -> pd.DataFrame:
    """Sample every line at the stations of its section: ``line``, ``station``, ``s``, ``x``, ``y``, ``z``, ``width``.

    ``station`` numbers the stations of all sections; ``width`` is the distance to the nearer neighbouring border (m).
    """
    row = lines["row"].to_numpy()
    count = np.ceil(frame.length / _STATION).astype(np.int64) + 1
    first = np.cumsum(count) - count
    line = np.repeat(np.arange(len(lines)), count[row])
    start = np.cumsum(count[row]) - count[row]
    k = np.arange(len(line)) - start[line]
    s = frame.length[row[line]] * k / (count[row[line]] - 1)
    offset = lateral_offset(lines[[*LATERAL]].iloc[line], s, frame.length[row[line]])
    xyz = frame.positions(row[line], s, offset)
    style = lines["style"].to_numpy()
    inner = (style[line] == 1) | (style[line] == 2)
    width = np.full(len(line), np.inf)
    for neighbour in (-1, 1):
        # Lines of one section follow each other, so the same station of the next border is one section's stations on.
        other = np.flatnonzero(inner) + neighbour * count[row[line[inner]]]
        width[inner] = np.minimum(width[inner], np.abs(offset[other] - offset[inner]))
    table = {"line": line, "station": first[row[line]] + k, "s": s, "x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2]}
    return pd.DataFrame(table | {"width": width})


def _on_other_roads(
    network: RoadNetwork, frame: SectionFrame, lines: pd.DataFrame, samples: pd.DataFrame
) -> NDArray[np.bool_]:
    """Tell which samples lie on the carriageway of another road at the same level."""
    plan = shapely.force_2d(network.sections.geometry.to_numpy())
    sections = network.sections
    half = ((sections["lanes_forward"] + sections["lanes_backward"]) * sections["lane_width"] / 2).to_numpy()
    reach = half + network.markings.shoulder + 1.0
    places = samples.drop_duplicates("station").sort_values("station")
    row = lines["row"].to_numpy()[places["line"]]
    centre = frame.positions(row, places["s"].to_numpy(), np.zeros(len(places)))
    # Pairs of a station and another section whose carriageways may overlap there.
    at, other = shapely.STRtree(plan).query(
        shapely.points(centre[:, :2]), predicate="dwithin", distance=reach[row] + half.max(initial=0.0)
    )
    apart = (other != row[at]) & ~_continues(network, row[at], other)
    at, other = at[apart], other[apart]
    station_pairs = pd.DataFrame({"station": at, "other": other})
    pairs = samples[["station", "x", "y", "z"]].reset_index(names="sample").merge(station_pairs, on="station")
    row = pairs["other"].to_numpy()
    xy = pairs[["x", "y"]].to_numpy()
    s = shapely.line_locate_point(plan[row], shapely.points(xy))
    lateral = frame.lateral(row, s, xy)
    edges = lane_borders(network)
    edges = edges[edges["style"] == "edge"].assign(row=lambda table: sections.index.get_indexer(table["section"]))
    left, right = (
        lateral_offset(edge.set_index("row")[[*LATERAL]].loc[row], s, frame.length[row])
        for edge in (edges[edges["border"] == 0], edges[edges["border"] > 0])
    )
    beyond = (s <= 0.0) | (s >= frame.length[row])
    # Beyond the end of a road only the disc around its last point belongs to it: the middle of a junction.
    end = frame.positions(row, s, np.zeros(len(row)))
    in_disc = np.hypot(*(xy - end[:, :2]).T) < half[row]
    painted = lines["style"].to_numpy()[samples["line"].to_numpy()[pairs["sample"]]] < _FIRST_BOUNDARY
    margin = np.where(painted, -_SHARED_EDGE, _CLEARED)
    inside = np.where(beyond, in_disc, (lateral > left - margin) & (lateral < right + margin))
    inside &= np.abs(pairs["z"].to_numpy() - end[:, 2]) < _SAME_LEVEL
    result = np.zeros(len(samples), dtype=bool)
    result[pairs["sample"].to_numpy()[inside]] = True
    return result


def _continues(network: RoadNetwork, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Tell which pairs of section rows continue each other."""
    moves = network.movements()
    moves = moves[moves["turn"].abs() < _CONTINUES]
    a, b = (network.sections.index.get_indexer(moves[f"{end}_section"]) for end in ("from", "to"))
    size = len(network.sections)
    known = np.unique(np.concatenate([a * size + b, b * size + a]))
    return np.isin(i * size + j, known)


def _present(lines: pd.DataFrame, samples: pd.DataFrame, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Draw where boundaries are present, block by block; markings are always present."""
    line, style = samples["line"].to_numpy(), lines["style"].to_numpy()
    length, share = np.full(len(FEATURE_STYLES), np.inf), np.ones(len(FEATURE_STYLES))
    for name, (block, probability) in _BLOCKS.items():
        length[FEATURE_STYLES.index(name)], share[FEATURE_STYLES.index(name)] = block, probability
    block = (samples["s"].to_numpy() / length[style[line]]).astype(np.int64)
    starts = np.diff(line, prepend=-1) != 0
    starts[1:] |= np.diff(block) != 0
    number = np.cumsum(starts) - 1
    return rng.random(int(starts.sum()))[number] < share[style[line]]


def _runs(samples: pd.DataFrame) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Cut lines into unbroken runs of two or more kept samples: return vertices, run lengths, and the line of a run."""
    line, keep = samples["line"].to_numpy(), samples["keep"].to_numpy()
    starts = keep.copy()
    starts[1:] &= ~keep[:-1] | (np.diff(line) != 0)
    run = np.cumsum(starts) - 1
    count = np.bincount(run[keep], minlength=int(starts.sum()))
    long = keep.copy()
    long[keep] = count[run[keep]] >= 2
    return samples.loc[long, ["x", "y", "z"]].to_numpy(), count[count >= 2], line[starts][count >= 2]


def _dashes(
    lines: pd.DataFrame, samples: pd.DataFrame, frame: SectionFrame
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Place dashes along dashed lines where the samples beside them are kept; return the same as `_runs`."""
    dashed = np.flatnonzero(lines["dash"].notna())
    row = lines["row"].to_numpy()[dashed]
    period, dash = (lines[name].to_numpy()[dashed] for name in ("period", "dash"))
    # Half a gap stays free at both ends, so that the pattern goes on through a node much as it does elsewhere.
    count = np.maximum((frame.length[row] + period - dash) // period, 0).astype(np.int64)
    slack = frame.length[row] - (count * period - (period - dash))
    which = np.repeat(np.arange(len(dashed)), count)
    k = np.arange(len(which)) - np.repeat(np.cumsum(count) - count, count)
    begin = slack[which] / 2.0 + k * period[which]
    line = dashed[which]
    # The samples at the station before its begin and after its end decide about a dash.
    first = np.searchsorted(samples["line"].to_numpy(), line)
    stations = np.searchsorted(samples["line"].to_numpy(), line, side="right") - first
    spacing = frame.length[row[which]] / (stations - 1)
    keep = samples["keep"].to_numpy()
    fine = np.ones(len(line), dtype=bool)
    for s in (begin, begin + dash[which]):
        fine &= keep[first + np.clip(np.round(s / spacing).astype(np.int64), 0, stations - 1)]
    line, begin, length = line[fine], begin[fine], dash[which][fine]
    s = (begin[:, None] + length[:, None] * np.linspace(0.0, 1.0, _DASH_POINTS)).ravel()
    owner = np.repeat(line, _DASH_POINTS)
    row = lines["row"].to_numpy()[owner]
    offset = lateral_offset(lines[[*LATERAL]].iloc[owner], s, frame.length[row])
    return frame.positions(row, s, offset), np.full(len(line), _DASH_POINTS), line
