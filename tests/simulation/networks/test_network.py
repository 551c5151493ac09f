from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.errors import CRSError, InputError, OptionError
from probe2road.graph.check import check_graph
from probe2road.simulation.networks.network import check_network, network_from_sections
from probe2road.simulation.networks.osm import read_network
from sketches import UTM


def osm_file(path: Path, nodes: dict[int, tuple[float, float]], ways: list[tuple], relations: str = "") -> Path:
    """Write an .osm file: node id to (metres east, metres north) of 40 N 83 W, ways as (id, nodes, tags)."""
    lines = ["<osm version='0.6'>"]
    for node, (x, y) in nodes.items():
        lines.append(f"<node id='{node}' version='1' lat='{40 + y / 111000:.7f}' lon='{-83 + x / 85000:.7f}'/>")
    for way, refs, tags in ways:
        body = "".join(f"<nd ref='{ref}'/>" for ref in refs)
        body += "".join(f"<tag k='{key}' v='{value}'/>" for key, value in tags.items())
        lines.append(f"<way id='{way}' version='1'>{body}</way>")
    path.write_text("\n".join([*lines, relations, "</osm>"]))
    return path


LINE = {1: (0, 0), 2: (200, 0), 3: (400, 0), 4: (200, -200)}


def read_tags(tmp_path: Path, **tags: str) -> pd.Series:
    tags = {key.replace("__", ":"): value for key, value in tags.items()}
    network = read_network(osm_file(tmp_path / "a.osm", LINE, [(7, [1, 2], {"highway": "primary"} | tags)]))
    return network.sections.iloc[0]


@pytest.mark.parametrize(
    ("tags", "forward", "backward"),
    [
        ({}, 1, 1),
        ({"oneway": "yes"}, 2, 0),
        ({"lanes": "4"}, 2, 2),
        ({"lanes": "3"}, 2, 1),
        ({"lanes": "1"}, 1, 1),
        ({"lanes": "3", "oneway": "yes"}, 3, 0),
        ({"lanes": "5", "lanes__forward": "3", "lanes__backward": "2"}, 3, 2),
        ({"lanes": "5", "lanes__backward": "1"}, 4, 1),
        ({"highway": "motorway"}, 2, 0),
        ({"highway": "motorway", "oneway": "no"}, 2, 2),
        ({"highway": "motorway_link"}, 1, 0),
        ({"junction": "roundabout", "highway": "secondary"}, 1, 0),
    ],
)
def test_lanes_from_tags(tmp_path, tags, forward, backward):
    section = read_tags(tmp_path, **tags)
    assert (section.lanes_forward, section.lanes_backward) == (forward, backward)


@pytest.mark.parametrize(
    ("value", "speed"),
    [("50", 50 / 3.6), ("55 mph", 55 * 0.44704), ("none", 130 / 3.6), ("signals", 60 / 3.6), ("DE:urban", 60 / 3.6)],
)
def test_speed_from_tags(tmp_path, value, speed):
    assert read_tags(tmp_path, maxspeed=value).speed_limit == pytest.approx(speed)


def test_reversed_oneway_is_drawn_in_driving_direction(tmp_path):
    section = read_tags(tmp_path, oneway="-1")
    assert (section.u, section.v) == (2, 1)
    assert section.lanes_backward == 0


def test_ways_are_split_where_they_meet(tmp_path):
    ways = [(7, [1, 2, 3], {"highway": "primary"}), (8, [4, 2], {"highway": "secondary"})]
    network = read_network(osm_file(tmp_path / "a.osm", LINE, ways))
    assert network.sections[["u", "v", "osm_way"]].to_numpy().tolist() == [[1, 2, 7], [2, 3, 7], [4, 2, 8]]
    check_network(network)
    assert shapely.get_num_coordinates(network.sections.geometry.to_numpy()).min() >= 21  # 200 m, 10 m apart


def test_way_that_crosses_itself_is_split(tmp_path):
    nodes = {1: (0, 0), 2: (100, 0), 3: (200, 0), 4: (200, 100), 5: (100, 100), 6: (100, -100)}
    ways = [(7, [1, 2, 3, 4, 5, 2, 6], {"highway": "primary"})]
    network = read_network(osm_file(tmp_path / "a.osm", nodes, ways))
    assert network.sections[["u", "v"]].to_numpy().tolist() == [[1, 2], [2, 2], [2, 6]]


def test_bad_input_is_repaired_counted_and_logged(tmp_path, caplog):
    ways = [
        (1, [1, 99, 2], {"highway": "primary", "layer": "abc", "lanes": "2;3"}),
        (2, [3], {"highway": "primary"}),
        (3, [98, 97, 3], {"highway": "secondary"}),
        (4, [2, 2, 3], {"highway": "primary", "maxspeed": "fast", "lanes": "0"}),
        (5, [1, 4], {"highway": "footway"}),
    ]
    with caplog.at_level(logging.INFO):
        network = read_network(osm_file(tmp_path / "bad.osm", LINE, ways))
    assert network.sections["osm_way"].tolist() == [1, 4]
    assert network.sections["layer"].tolist() == [0, 0]
    assert network.sections["lanes_forward"].tolist() == [1, 1]
    report = network.report
    assert (report.ways, report.missing_nodes, report.short_ways) == (4, 3, 2)
    assert dict(report.bad_tags) == {"layer=abc": 1, "lanes=2;3": 1, "maxspeed=fast": 1, "lanes=0": 1}
    assert "3 positions missing, 2 ways too short, 4 tag values without sense" in caplog.text
    check_network(network)


def test_no_road_is_an_error(tmp_path):
    with pytest.raises(InputError, match="no road of class motorway, motorway_link"):
        read_network(osm_file(tmp_path / "empty.osm", {}, []))
    footway = osm_file(tmp_path / "foot.osm", LINE, [(1, [1, 2], {"highway": "footway"})])
    with pytest.raises(InputError, match="no road of class"):
        read_network(footway)


@pytest.mark.parametrize("content", [b"", b"<osm version='0.6'><way", b"not an osm file"])
@pytest.mark.parametrize("name", ["a.osm", "a.osm.pbf"])
def test_unreadable_file_is_an_error(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=r"a\.osm"):
        read_network(tmp_path / name)


def restriction(value: str) -> str:
    return (
        "<relation id='1' version='1'><member type='way' ref='7' role='from'/><member type='node' ref='2' role='via'/>"
        "<member type='way' ref='8' role='to'/><tag k='type' v='restriction'/>"
        f"<tag k='restriction' v='{value}'/></relation>"
    )


@pytest.mark.parametrize(
    ("value", "targets", "unusable"),
    [(None, [1, 2], 0), ("no_right_turn", [1], 0), ("only_right_turn", [2], 0), ("give_way", [1, 2], 1)],
)
def test_turn_restrictions(tmp_path, value, targets, unusable):
    ways = [
        (7, [1, 2], {"highway": "primary"}),
        (9, [2, 3], {"highway": "primary"}),
        (8, [2, 4], {"highway": "primary"}),
    ]
    network = read_network(osm_file(tmp_path / "a.osm", LINE, ways, restriction(value) if value else ""))
    moves = network.movements()
    assert moves.loc[moves["from_section"] == 0, "to_section"].tolist() == targets
    assert network.report.bad_restrictions == unusable


@pytest.mark.parametrize(
    ("shift", "side", "country"), [((0, 0), "right", "US"), ((222.7, -4.4), "left", "JP"), ((80, 12), "left", "GB")]
)
def test_driving_side_from_the_position(tmp_path, shift, side, country):
    path = osm_file(tmp_path / "a.osm", LINE, [(7, [1, 2], {"highway": "primary"})])
    text = path.read_text()
    for node, (x, y) in LINE.items():
        old = f"lat='{40 + y / 111000:.7f}' lon='{-83 + x / 85000:.7f}'"
        text = text.replace(old, f"lat='{40 + y / 111000 + shift[1]:.7f}' lon='{-83 + x / 85000 + shift[0]:.7f}'", 1)
        assert node
    path.write_text(text)
    network = read_network(path)
    assert (network.driving_side, network.markings.country) == (side, country)
    assert read_network(path, driving_side="right", country="DE").markings.country == "DE"


def test_movements_leave_out_the_way_back():
    #      2
    #      |
    # 0 -- 1 -- 3      all two-way
    lines = [[(-99, 0), (0, 0)], [(0, 99), (0, 0)], [(0, 0), (99, 0)]]
    network = network_from_sections(lines, crs=UTM, highway="primary", lanes_backward=1)
    moves = network.movements()
    assert len(moves) == 6
    assert not (moves["from_section"] == moves["to_section"]).any()
    right = moves[(moves["from_section"] == 1) & (moves["to_section"] == 0)]["turn"].item()
    assert right == pytest.approx(90.0)  # southwards, then west


def test_a_loop_may_be_driven_around():
    square = [(0, 0), (90, 0), (90, 90), (0, 90), (0, 0)]
    moves = network_from_sections([square], crs=UTM, lanes_backward=1).movements()
    assert moves[["from_direction", "to_direction"]].to_numpy().tolist() == [[-1, -1], [1, 1]]


def test_reference_graph_keeps_heights_and_structure():
    lines = [[(0, 0, 5), (90, 0, 7)], [(90, 0, 7), (180, 0, 9)]]
    network = network_from_sections(lines, crs=UTM, bridge=[False, True], layer=[0, 1])
    graph = network.reference_graph()
    check_graph(graph)
    assert graph.edges["bridge"].tolist() == [False, True]
    assert graph.edges["section"].tolist() == graph.edges.index.tolist()
    assert shapely.get_coordinates(graph.edges.geometry.iloc[1], include_z=True)[-1, 2] == 9


def test_inputs_are_not_mutated_and_ends_meet():
    lines = [[(0, 0, 1.0), (90, 0, 1.0)], [(90.004, 0, 3.0), (180, 0, 3.0)]]
    network = network_from_sections(lines, crs=UTM)
    check_network(network)
    xyz, offsets = network.vertices()
    assert xyz[offsets[1] - 1].tolist() == xyz[offsets[1]].tolist() == [90, 0, 1.0]


def test_faults_are_reported_together():
    network = network_from_sections([[(0, 0), (90, 0)]], crs=UTM)
    network.sections["lanes_forward"] = 0
    network.sections["speed_limit"] = np.nan
    with pytest.raises(InputError, match=r"2 faults(.|\n)*no forward lane(.|\n)*no positive speed"):
        check_network(network)


def test_bad_options_are_refused():
    with pytest.raises(OptionError, match="driving side 'middle'"):
        network_from_sections([[(0, 0), (90, 0)]], crs=UTM, driving_side="middle")
    with pytest.raises(OptionError, match="highway class 'path'"):
        network_from_sections([[(0, 0), (90, 0)]], crs=UTM, highway="path")
    with pytest.raises(OptionError, match="country 'XX'"):
        network_from_sections([[(0, 0), (90, 0)]], crs=UTM, markings="XX")
    with pytest.raises(CRSError, match="degrees"):
        network_from_sections([[(0, 0), (1, 0)]], crs="EPSG:4326")
