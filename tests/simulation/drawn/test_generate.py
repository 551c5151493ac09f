from __future__ import annotations

import numpy as np
import pytest
import shapely
from scipy import sparse
from scipy.sparse import csgraph

from probe2road.errors import OptionError
from probe2road.graph.check import check_graph
from probe2road.simulation.drawn.curves import Pose, dubins, hermite, path_length, wander
from probe2road.simulation.drawn.generate import INTERCHANGES, generate_corridor, generate_interchange, generate_town
from probe2road.simulation.networks.height_check import check_heights
from probe2road.simulation.networks.network import RoadNetwork, check_network

SCENES = {kind: lambda kind=kind, **o: generate_interchange(kind, **o) for kind in INTERCHANGES} | {
    "corridor": generate_corridor,
    "wide_corridor": lambda **o: generate_corridor(lanes=(5, 9), **o),
    "grid": lambda **o: generate_town(regular=True, **o),
    "old_town": lambda **o: generate_town(regular=False, **o),
}
LEAST_RADIUS = {"motorway": 800.0, "trunk": 800.0, "motorway_link": 38.0, "trunk_link": 38.0}  # m


def radii(network: RoadNetwork, highway: str) -> np.ndarray:
    """Plan radius (m) over steps of about 20 m along the sections of a class."""
    found = []
    for line in network.sections.loc[network.sections["highway"] == highway].geometry:
        s = np.arange(0.0, line.length, 20.0)
        xy = shapely.get_coordinates(shapely.line_interpolate_point(line, s))
        if len(xy) > 3:
            heading = np.unwrap(np.arctan2(*np.diff(xy, axis=0).T[::-1]))
            found.append(20.0 / np.maximum(np.abs(np.diff(heading)), 1e-9))
    return np.concatenate(found) if found else np.full(1, np.inf)


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(("seed", "side"), [(1, "right"), (2, "left"), (3, "right")])
def test_scenes_pass_every_check(scene, seed, side):
    network = SCENES[scene](rng=np.random.default_rng(seed), driving_side=side)
    check_network(network)
    check_graph(network.reference_graph())
    report = check_heights(network)
    assert len(report.violations) == 0, report.violations.to_string()
    assert not (report.crossings["rule"] == "ambiguous").any()
    assert network.driving_side == side
    assert (network.sections["osm_way"] == -1).all()


@pytest.mark.parametrize("scene", SCENES)
def test_scenes_are_deterministic(scene):
    first, second = (SCENES[scene](rng=np.random.default_rng(8)).vertices()[0] for _ in range(2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, SCENES[scene](rng=np.random.default_rng(9)).vertices()[0])


@pytest.mark.parametrize("scene", [*INTERCHANGES, "corridor"])
def test_curves_are_drivable(scene):
    for seed in range(3):
        network = SCENES[scene](rng=np.random.default_rng(seed))
        for highway, least in LEAST_RADIUS.items():
            # The taper of an auxiliary lane bends the line, not the lanes: half a lane within 80 m.
            assert radii(network, highway).min() > min(least, 300.0) * 0.9, (scene, seed, highway)
        moves = network.movements()
        highways = network.sections["highway"]
        ends = [highways[moves[end]].str.startswith("motorway").to_numpy() for end in ("from_section", "to_section")]
        fast = ends[0] & ends[1]
        assert np.abs(moves.loc[fast, "turn"].to_numpy()).max(initial=0.0) < 20.0


@pytest.mark.parametrize("scene", SCENES)
def test_every_road_can_be_reached(scene):
    network = SCENES[scene](rng=np.random.default_rng(5))
    nodes = network.nodes.index
    u, v = (nodes.get_indexer(network.sections[end]) for end in ("u", "v"))
    graph = sparse.csr_array((np.ones(len(u)), (u, v)), shape=(len(nodes), len(nodes)))
    parts, _ = csgraph.connected_components(graph, directed=False)
    # Roads that only cross, and the carriageways of a road without a junction, stay apart.
    apart = {"shallow_overpass": 4, "double_deck": 3, "merge_beside_bridge": 3, "weaving": 2}
    assert parts <= apart.get(scene, 8 if "corridor" in scene else 1)


@pytest.mark.parametrize(
    ("kind", "leaving", "joining", "bridges"),
    [("diamond", 2, 2, 1), ("cloverleaf", 8, 8, 2), ("stack", 8, 8, 6), ("trumpet", 3, 4, 2)],
)
def test_interchanges_have_their_ramps(kind, leaving, joining, bridges):
    network = generate_interchange(kind, rng=np.random.default_rng(3))
    is_link = network.sections["highway"] == "motorway_link"
    links, main = network.sections[is_link], network.sections[network.sections["highway"] == "motorway"]
    # The fourth ramp of the trumpet is where the carriageway from the south goes on, which is not an exit.
    through = set(main["u"]) & set(main["v"])
    assert links["u"].isin(through).sum() == leaving
    assert links["v"].isin(through).sum() + (kind == "trumpet") == joining
    assert network.sections["bridge"].sum() >= bridges


def test_auxiliary_lanes_lie_before_exits_and_behind_entries():
    network = generate_interchange("weaving", rng=np.random.default_rng(3))
    main = network.sections[network.sections["highway"] == "motorway"]
    counts = main.sort_values("u").groupby(main.geometry.map(lambda line: line.coords[0][1] > 0))["lanes_forward"]
    for _, lanes in counts:
        assert len(lanes) == 3
        assert lanes.iloc[1] == lanes.iloc[0] + 1 == lanes.iloc[2] + 1


def test_left_hand_traffic_is_the_mirror_image():
    right = generate_interchange("trumpet", rng=np.random.default_rng(3))
    left = generate_interchange("trumpet", rng=np.random.default_rng(3), driving_side="left")
    a, b = right.vertices()[0], left.vertices()[0]
    assert np.allclose(a[:, 0], b[:, 0])
    assert np.allclose(a[:, 1], -b[:, 1])


@pytest.mark.parametrize("angle", [15.0, 90.0])
def test_overpass_angle(angle):
    network = generate_interchange("shallow_overpass", rng=np.random.default_rng(1), angle=angle)
    line = network.sections.loc[network.sections["bridge"]].geometry.iloc[0]
    (x0, y0, _), (x1, y1, _) = line.coords[0], line.coords[-1]
    measured = np.degrees(np.arctan2(abs(y1 - y0), abs(x1 - x0)))
    assert measured == pytest.approx(angle, abs=0.5)


def test_roundabout_is_one_way_around():
    for side, sign in (("right", 1.0), ("left", -1.0)):
        network = generate_interchange("roundabout", rng=np.random.default_rng(1), driving_side=side)
        ring = network.sections[network.sections["roundabout"]]
        assert (ring["lanes_backward"] == 0).all()
        for line in ring.geometry:
            (x0, y0, _), (x1, y1, _) = line.coords[:2]
            assert sign * (x0 * y1 - x1 * y0) > 0  # counterclockwise in right-hand traffic


@pytest.mark.parametrize("regular", [True, False])
def test_towns_have_one_level(regular):
    network = generate_town(rng=np.random.default_rng(1), regular=regular, blocks=5)
    assert len(check_heights(network).crossings) == 0
    assert {"secondary", "residential"} <= set(network.sections["highway"])


@pytest.mark.parametrize("lanes", [(2, 4), (5, 9)])
def test_carriageways_of_a_corridor_stay_apart(lanes):
    for seed in range(3):
        sections = generate_corridor(rng=np.random.default_rng(seed), lanes=lanes).sections
        motorway = sections[sections["highway"] == "motorway"]
        assert motorway["lanes_forward"].between(lanes[0], lanes[1] + 1).all()  # one more beside a ramp
        width = motorway["lanes_forward"].to_numpy() * 3.65
        first, second = np.triu_indices(len(motorway), 1)
        lines = motorway.geometry.to_numpy()
        apart = shapely.distance(lines[first], lines[second])
        abreast = apart > 1.0  # others follow each other
        assert (apart - (width[first] + width[second]) / 2)[abreast].min() > 0.0


def test_bad_options_are_refused():
    rng = np.random.default_rng(0)
    with pytest.raises(OptionError, match="kind of interchange 'clover' is unknown"):
        generate_interchange("clover", rng=rng)
    with pytest.raises(OptionError, match="angle 5 does not fit"):
        generate_interchange("shallow_overpass", rng=rng, angle=5)
    with pytest.raises(OptionError, match="only shallow_overpass takes one"):
        generate_interchange("stack", rng=rng, angle=45)
    with pytest.raises(OptionError, match="driving side"):
        generate_interchange("stack", rng=rng, driving_side="both")
    with pytest.raises(OptionError, match="length is 10"):
        generate_corridor(rng=rng, length=10)
    with pytest.raises(OptionError, match=r"lanes are \(4, 2\)"):
        generate_corridor(rng=rng, lanes=(4, 2))
    with pytest.raises(OptionError, match="blocks is 1"):
        generate_town(rng=rng, blocks=1)


@pytest.mark.parametrize("word", ["LL", "RR", "LR", "RL"])
def test_dubins_arrives(word):
    start, end = Pose(0, 0, 0.3), Pose(150, 60, 2.0)
    path = dubins(start, end, radius=20.0, word=word)
    assert np.allclose(path[[0, -1]], [start.xy, end.xy], atol=1e-6)
    for (a, b), heading in (((0, 1), 0.3), ((-2, -1), 2.0)):
        dx, dy = path[b] - path[a]
        assert abs((np.arctan2(dy, dx) - heading + np.pi) % (2 * np.pi) - np.pi) < 0.06


def test_dubins_refuses_what_does_not_fit():
    with pytest.raises(OptionError, match="no LR path"):
        dubins(Pose(0, 0, 0), Pose(50, 180, 0), radius=100.0, word="LR")


def test_hermite_is_straight_where_it_can_be():
    path = hermite(Pose(0, 0, 0), Pose(100, 0, 0))
    assert np.abs(path[:, 1]).max() < 1e-9
    assert path_length(path) == pytest.approx(100)


def test_wander_keeps_its_radius():
    path = wander(np.random.default_rng(2), 3000.0, radius=500.0)
    heading = np.unwrap(np.arctan2(*np.diff(path, axis=0).T[::-1]))
    assert np.abs(np.diff(heading)).max() <= 2.0 / 500.0 + 1e-9
