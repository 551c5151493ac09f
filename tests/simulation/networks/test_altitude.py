from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from probe2road.simulation.networks.altitude import solve_heights
from probe2road.simulation.networks.crossings import find_crossings
from probe2road.simulation.networks.height_check import check_heights
from probe2road.simulation.networks.network import RoadNetwork, network_from_sections
from probe2road.simulation.networks.osm import read_network
from probe2road.simulation.networks.profile import ProfileOptions
from probe2road.simulation.networks.terrain import Terrain
from sketches import UTM

DATA = Path(os.environ.get("PROBE2ROAD_DATA", Path(__file__).parents[4] / "shared" / "data")) / "osm"

EAST = [(-800, 0), (800, 0)]
NORTH = [(0, -800), (0, 800)]


def solve(lines, **columns) -> RoadNetwork:
    return solve_heights(network_from_sections(lines, crs=UTM, **columns), rng=np.random.default_rng(3))


@pytest.mark.parametrize(
    ("columns", "upper", "rule"),
    [
        ({"layer": [2, 1]}, 0, "layer"),
        ({"layer": [-1, 0]}, 1, "layer"),
        ({"bridge": [True, False]}, 0, "bridge"),
        ({"tunnel": [True, False]}, 1, "bridge"),
        ({"layer": [1, 0], "bridge": [False, True]}, 0, "layer"),
        ({"highway": ["motorway", "primary_link"]}, 1, "ambiguous"),
        ({}, 1, "ambiguous"),
    ],
)
def test_order_at_a_crossing(columns, upper, rule):
    network = solve([EAST, NORTH], **columns)
    table = check_heights(network).crossings
    table = table[table["kind"] == "crossing"]
    assert table[["upper", "rule"]].values.tolist() == [[upper, rule]]
    assert table["clearance"].item() >= 5.5


@pytest.mark.parametrize("angle", [15, 40, 90])
def test_clearance_holds_over_the_whole_width(angle):
    # Half a carriageway beside the crossing point, the roads still overlap: 14 m along at 15 degrees.
    c, s = 800 * np.cos(np.radians(angle)), 800 * np.sin(np.radians(angle))
    network = solve([EAST, [(-c, -s), (c, s)]], layer=[0, 1], lanes_forward=[3, 2])
    report = check_heights(network)
    assert (report.crossings["kind"] == "stacked").sum() >= 2
    assert report.crossings["clearance"].min() >= 5.5
    assert len(report.violations) == 0


def test_stacked_roads_without_a_crossing_point():
    lines = [EAST, [(-900, 1), (900, 1)]]
    report = check_heights(solve(lines, layer=[0, 1], bridge=[False, True]))
    assert set(report.crossings["kind"]) == {"stacked"}
    assert len(report.crossings) > 140
    assert report.crossings["clearance"].min() >= 5.5


def test_roads_that_part_are_not_stacked():
    # The ramp is tagged as a bridge from the node on, but cannot be 5.5 m up where it leaves.
    lines = [[(-800, 0), (0, 0)], [(0, 0), (800, 0)], [(0, 0), (90, -5), (600, -220)]]
    network = network_from_sections(lines, crs=UTM, layer=[0, 0, 1], bridge=[False, False, True])
    assert len(find_crossings(network).table) == 0


def test_twin_bridges_are_not_stacked_on_each_other():
    lines = [[(x, y), (x + 300, y)] for y in (0, 7) for x in (0, 300, 600)]
    network = network_from_sections(lines, crs=UTM, layer=[0, 1, 0] * 2, bridge=[False, True, False] * 2)
    assert len(find_crossings(network).table) == 0


def test_roads_that_meet_do_not_cross():
    lines = [[(-99, 0), (0, 0)], [(0, 0), (99, 0)], [(0, 99), (0, 0)], [(0, 0), (0, -99)]]
    assert len(find_crossings(network_from_sections(lines, crs=UTM)).table) == 0


def test_a_bridge_that_is_too_short_gives_up_its_grade_and_says_so():
    # The road above ends in junctions with the road below, 60 m from where it crosses it.
    lines = [[(-60, 0), (0, 0), (60, 0)], [(-60, 0), (0, -60), (0, 60), (60, 0)]]
    report = check_heights(solve(lines, layer=[0, 1]))
    assert report.crossings.loc[report.crossings["kind"] == "crossing", "clearance"].min() >= 5.5
    assert set(report.violations["kind"]) <= {"grade", "radius"}
    assert (report.violations.loc[report.violations["kind"] == "grade", "value"] > 0.05).all()
    assert report.violations["cause"].str.contains("too little road to reach the height of a crossing").all()


def test_grades_and_radii_stay_within_limits():
    lines = [EAST, NORTH, [(-800, 300), (800, 300)]]
    report = check_heights(solve(lines, layer=[0, 1, 2], highway=["motorway", "primary", "motorway"]))
    assert report.max_grade.max() <= 0.075
    assert report.min_radius.min() >= 300
    assert report.max_gap == 0.0
    assert len(report.violations) == 0


def test_heights_do_not_depend_on_the_order_of_sections():
    lines, layers = [EAST, NORTH, [(-800, 300), (800, 300)]], [0, 1, 2]
    first = solve(lines, layer=layers)
    second = solve(lines[::-1], layer=layers[::-1])
    (a, starts), (b, others) = first.vertices(), second.vertices()
    assert np.allclose(a[: starts[1]], b[others[2] :], atol=5e-3)


def test_same_seed_same_heights():
    assert np.array_equal(solve([EAST, NORTH]).vertices()[0], solve([EAST, NORTH]).vertices()[0])


def test_options_set_clearance_and_relief():
    network = network_from_sections([EAST, NORTH], crs=UTM, layer=[0, 1])
    options = ProfileOptions(clearance=8.0, terrain_relief=0.0)
    solved = solve_heights(network, rng=np.random.default_rng(0), options=options)
    report = check_heights(solved, options=options)
    assert 8.0 <= report.crossings["clearance"].min() < 8.5
    flat = solve_heights(
        network_from_sections([EAST], crs=UTM), rng=np.random.default_rng(0), options=ProfileOptions(terrain_relief=0.0)
    )
    assert np.ptp(flat.vertices()[0][:, 2]) < 1e-6


def test_terrain_is_gentle():
    terrain = Terrain.from_rng(np.random.default_rng(5), relief=12.0, scale=2500.0)
    rng = np.random.default_rng(6)
    xy = rng.uniform(0, 50_000, (4000, 2))
    slope = np.abs(terrain.height(xy + np.array([1.0, 0.0])) - terrain.height(xy))
    assert np.std(terrain.height(xy)) == pytest.approx(12.0, rel=0.25)
    assert slope.max() < 0.06


CITIES = ["tokyo_shibuya"] + [
    pytest.param(city, marks=pytest.mark.slow)
    for city in ("columbus", "rhein_neckar", "porto", "milan", "boston", "hannover")
]
# Milan: an underpass (ways 303748593, 303748594, layer -1) and the bridge above it (163655054, layer 1) share the
# nodes 2726838727 and 2726838728, so the bridge would have to rise 5.5 m within 11 m.
FAULTY_PLACES = {"milan": (513_554.0, 5_040_970.0)}


@pytest.mark.parametrize("city", CITIES)
def test_real_networks(city):
    path = DATA / f"{city}.osm.pbf"
    if not path.is_file():
        pytest.skip(f"{path.name} is absent; set PROBE2ROAD_DATA")
    network = read_network(path)
    report = check_heights(network)
    assert report.max_gap == 0.0
    violations = report.violations[~report.violations["cause"].str.contains("equal layers")]
    if city in FAULTY_PLACES:
        x, y = FAULTY_PLACES[city]
        violations = violations[np.hypot(violations["x"] - x, violations["y"] - y) > 150]
    assert len(violations) == 0, violations.to_string()
    sure = report.crossings[report.crossings["rule"] != "ambiguous"]
    assert sure["clearance"].min() >= 5.5
    assert (report.crossings["kind"] == "crossing").sum() >= 20


def test_tokyo_viaduct_clears_the_street_below_it():
    path = DATA / "tokyo_shibuya.osm.pbf"
    if not path.is_file():
        pytest.skip(f"{path.name} is absent; set PROBE2ROAD_DATA")
    network = read_network(path)
    assert network.driving_side == "left"
    stacked = check_heights(network).crossings.query("kind == 'stacked'")
    assert len(stacked) > 400  # vertices at most 10 m apart
    assert stacked["clearance"].min() >= 5.5
