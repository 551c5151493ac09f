from __future__ import annotations

import numpy as np
import pytest
import shapely

from probe2road.simulation.drawn.generate import INTERCHANGES, generate_interchange
from probe2road.simulation.lanes.features import FEATURE_STYLES, RoadFeatures, road_features
from probe2road.simulation.lanes.frame import SectionFrame
from probe2road.simulation.lanes.lanes import lane_borders, lane_offsets, lateral_offset
from probe2road.simulation.networks.network import RoadNetwork, network_from_sections

CRS = "EPSG:32632"


def lines_of(features: RoadFeatures, style: str) -> list[np.ndarray]:
    chosen = np.flatnonzero(features.style == FEATURE_STYLES.index(style))
    return [features.xyz[features.offsets[i] : features.offsets[i + 1]] for i in chosen]


@pytest.mark.parametrize(
    ("side", "forward", "backward", "offsets", "directions"),
    [
        ("right", 3, 0, [-3.0, 0.0, 3.0], [1, 1, 1]),
        ("right", 2, 1, [-3.0, 0.0, 3.0], [-1, 1, 1]),
        ("left", 2, 1, [-3.0, 0.0, 3.0], [1, 1, -1]),
        ("left", 1, 1, [-1.5, 1.5], [1, -1]),
    ],
)
def test_lanes_lie_on_their_driving_side(side, forward, backward, offsets, directions):
    columns = {"lanes_forward": forward, "lanes_backward": backward, "lane_width": 3.0}
    network = network_from_sections([[(0, 0), (99, 0)]], crs=CRS, driving_side=side, **columns)
    lanes = lane_offsets(network)
    assert lanes["offset"].tolist() == offsets
    assert lanes["direction"].tolist() == directions
    assert lanes["start_offset"].tolist() == offsets


@pytest.mark.parametrize(("side", "inner"), [("right", 0), ("left", -1)])
def test_the_outer_lane_ends_where_the_road_narrows(side, inner):
    lines = [[(0, 0), (300, 0)], [(300, 0), (600, 0)]]
    network = network_from_sections(lines, crs=CRS, lanes_forward=[3, 2], lane_width=4.0, driving_side=side)
    borders = lane_borders(network)
    wide, narrow = (borders[borders["section"] == k] for k in (0, 1))
    assert sorted(set(wide["end_offset"])) == narrow["start_offset"].tolist() == [-4.0, 0.0, 4.0]
    assert wide["end_offset"].iloc[inner] == narrow["start_offset"].iloc[inner]


def test_a_two_way_road_keeps_its_centre_line_where_it_widens():
    lines = [[(0, 0), (300, 0)], [(600, 0), (300, 0)]]  # drawn against each other
    columns = {"lanes_forward": [1, 1], "lanes_backward": [1, 2], "lane_width": 4.0, "highway": "primary"}
    network = network_from_sections(lines, crs=CRS, **columns)
    borders = lane_borders(network)
    centres = borders[borders["style"] == "centre"]
    assert centres["end_offset"].tolist() == [0.0, 0.0]
    assert centres["offset"].tolist() == [0.0, 2.0]
    assert sorted(set(borders.loc[borders["section"] == 1, "end_offset"])) == [-4.0, 0.0, 4.0]


@pytest.mark.parametrize(("side", "sign"), [("right", -1.0), ("left", 1.0)])
@pytest.mark.parametrize("joins", [False, True])
def test_a_ramp_leaves_and_joins_the_outer_lane(side, sign, joins):
    ramp = [(300, 0), (400, 8 * sign), (600, 60 * sign)]
    lines = [[(0, 0), (300, 0)], [(300, 0), (600, 0)], ramp]
    if joins:
        lines = [[(600 - x, y) for x, y in line[::-1]] for line in lines]
    columns = {"highway": ["motorway"] * 2 + ["motorway_link"], "lane_width": 4.0}
    network = network_from_sections(lines, crs=CRS, driving_side=side, **columns)
    borders = lane_borders(network)
    end = "end_offset" if joins else "start_offset"
    assert borders.loc[borders["section"] == 2, end].tolist() == ([0.0, 4.0] if side == "right" else [-4.0, 0.0])
    assert borders.loc[borders["section"] == 1, end].tolist() == [-4.0, 0.0, 4.0]


def network_gaps(network: RoadNetwork) -> np.ndarray:
    """Distance (m) from the start of every lane of a through movement to the nearest lane end before it."""
    lanes, frame = lane_offsets(network), SectionFrame.from_network(network)
    row = network.sections.index.get_indexer(lanes["section"])
    start = frame.positions(row, np.zeros(len(row)), lanes["start_offset"].to_numpy())
    end = frame.positions(row, frame.length[row], lanes["end_offset"].to_numpy())
    moves = network.movements().query("abs(turn) < 20 and from_direction == 1 and to_direction == 1")
    gaps = []
    for move in moves.itertuples():
        a = end[(lanes["section"] == move.from_section).to_numpy()]
        b = start[(lanes["section"] == move.to_section).to_numpy()]
        distance = np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
        gaps.append(distance.min(axis=0 if len(b) <= len(a) else 1).max())
    return np.array(gaps)


@pytest.mark.parametrize("kind", INTERCHANGES)
@pytest.mark.parametrize("side", ["right", "left"])
def test_lanes_go_on_through_nodes(kind, side):
    network = generate_interchange(kind, rng=np.random.default_rng(4), driving_side=side)
    # Lane widths of motorway and ramp differ by 0.1 m; a lane that opens starts half a lane aside.
    assert network_gaps(network).max() < 1.9


@pytest.mark.parametrize(("country", "dash", "period"), [("DE", 6.0, 18.0), ("US", 3.05, 12.19), ("JP", 8.0, 20.0)])
def test_dashes_follow_the_country(country, dash, period):
    network = network_from_sections([[(0, 0), (900, 0)]], crs=CRS, markings=country)
    dashes = lines_of(road_features(network), "divider")
    lengths = [line[-1, 0] - line[0, 0] for line in dashes]
    starts = np.array([line[0, 0] for line in dashes])
    assert np.allclose(lengths, dash)
    assert np.allclose(np.diff(starts), period)
    assert np.allclose([line[:, 1] for line in dashes], 0.0)


def test_edges_and_boundaries_lie_beside_the_lanes():
    network = network_from_sections([[(0, 0, 7), (900, 0, 7)]], crs=CRS, lane_width=4.0, markings="DE")
    features = road_features(network)
    edges = sorted(float(line[0, 1]) for line in lines_of(features, "edge"))
    assert edges == [-3.75, 3.75]  # 0.25 m within a carriageway of 8 m
    assert {float(line[0, 1]) for line in lines_of(features, "barrier")} == {5.0}  # in the median, to the left
    assert {float(line[0, 1]) for line in lines_of(features, "guard_rail")} == {-6.5}
    assert np.allclose(features.xyz[:, 2], 7.0)
    assert features.offsets[-1] == len(features.xyz)
    assert set(features.kind) == {"lane_marking", "road_boundary"}


def test_guard_rails_have_gaps_and_bridges_have_none_at_the_side():
    columns = {"bridge": [False, True], "layer": [0, 1]}
    lines = [[(0, 0), (6000, 0)], [(0, 99), (160, 99)]]
    features = road_features(network_from_sections(lines, crs=CRS, **columns))
    rails = lines_of(features, "guard_rail")
    built = sum(line[-1, 0] - line[0, 0] for line in rails)
    assert 0.6 * 6000 < built < 0.9 * 6000
    assert {int(s) for s in features.section[features.style == FEATURE_STYLES.index("guard_rail")]} == {0}


def test_nothing_is_painted_through_junctions():
    lines = [[(-200, 0), (0, 0)], [(0, 0), (200, 0)], [(0, -200), (0, 0)], [(0, 0), (0, 200)]]
    network = network_from_sections(lines, crs=CRS, highway="primary", lanes_backward=1, markings="DE")
    features = road_features(network)
    # Carriageways are 6.8 m wide: the square in the middle is free, but for the edge of the crossing road.
    middle = shapely.box(-2.8, -2.8, 2.8, 2.8)
    assert not shapely.intersects_xy(middle, features.xyz[:, :2]).any()
    assert len(lines_of(features, "edge")) == 8
    assert len(lines_of(features, "kerb")) >= 8


def test_bridges_keep_their_paint_over_the_road_below():
    lines = [[(-200, 0, 0), (200, 0, 0)], [(0, -200, 6), (0, 200, 6)]]
    network = network_from_sections(lines, crs=CRS, layer=[0, 1], bridge=[False, True])
    edges = lines_of(road_features(network), "edge")
    assert len(edges) == 4
    assert all(np.hypot(*(line[-1] - line[0])[:2]) == pytest.approx(400) for line in edges)


def test_gore_lines_end_where_carriageways_part():
    network = generate_interchange("weaving", rng=np.random.default_rng(2))
    features = road_features(network)
    frame, borders = SectionFrame.from_network(network), lane_borders(network)
    sections = network.sections
    painted = features.kind == "lane_marking"
    owner = np.repeat(np.arange(len(painted)), np.diff(features.offsets))
    xy, of = features.xyz[painted[owner], :2], features.section[owner[painted[owner]]]
    ramps = sections.index[sections["highway"] == "motorway_link"]
    plan = shapely.force_2d(sections.geometry.to_numpy())
    for ramp in ramps:
        k = sections.index.get_loc(ramp)
        s = shapely.line_locate_point(plan[k], shapely.points(xy))
        rows = np.full(len(xy), k)
        lateral = frame.lateral(rows, s, xy)
        edges = borders[(borders["section"] == ramp)]
        low, high = (lateral_offset(edges.iloc[[i] * len(xy)], s, frame.length[rows]) for i in (0, len(edges) - 1))
        within = (lateral > low + 0.6) & (lateral < high - 0.6) & (s > 1) & (s < frame.length[k] - 1)
        assert not (within & (of != ramp)).any()


def test_frame_is_continuous_through_a_bend():
    lines = [[(0, 0), (100, 0)], [(200, 100), (100, 0)]]  # the second is drawn against the first
    network = network_from_sections(lines, crs=CRS)
    frame = SectionFrame.from_network(network)
    a = frame.positions(np.array([0]), np.array([100.0]), np.array([3.0]))
    b = frame.positions(np.array([1]), np.array([999.0]), np.array([-3.0]))
    assert np.allclose(a, b)


def test_features_of_no_network_are_empty():
    network = network_from_sections([[(0, 0), (90, 0)]], crs=CRS)
    empty = RoadNetwork(
        network.nodes.iloc[:0], network.sections.iloc[:0], "right", network.markings, network.restrictions
    )
    features = road_features(empty)
    assert len(features.xyz) == 0
    assert features.offsets.tolist() == [0]
