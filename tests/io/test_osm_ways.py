from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from probe2road.errors import InputError
from probe2road.io.osm import read_osm
from probe2road.io.osm_ways import OsmWays, read_heights, read_restrictions, read_ways, split_at_shared_nodes
from probe2road.simulation.networks.osm import read_network

NODES = (
    "<node id='1' lat='48.0' lon='9.0'><tag k='ele' v='412.5'/></node><node id='2' lat='48.0' lon='9.001'/>"
    "<node id='-3' lat='48.0' lon='9.002'><tag k='ele' v='high'/></node><node id='4'/>"
)
WAYS = (
    "<way id='7'><nd ref='1'/><nd ref='2'/><nd ref='-3'/><tag k='highway' v='primary'/><tag k='lanes' v='2'/></way>"
    "<way id='8'><nd ref='2'/><nd ref='4'/><nd ref='99'/><tag k='highway' v='service'/></way>"
    "<way id='9'><nd ref='1'/><nd ref='4'/><tag k='waterway' v='river'/></way>"
)


@pytest.fixture(params=[NODES + WAYS, WAYS + NODES], ids=["nodes first", "ways first"])
def extract(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    path = tmp_path / "a.osm"
    path.write_text(f"<osm version='0.6'>{request.param}</osm>")
    return path


def test_ways_nodes_and_heights_in_any_order_and_with_negative_ids(extract: Path) -> None:
    ways = read_ways(extract, None)
    assert ways.ids.tolist() == [7, 8]
    assert ways.tags == [{"highway": "primary", "lanes": "2"}, {"highway": "service"}]
    assert ways.refs.tolist() == [1, 2, -3, 2, 4, 99]
    assert ways.n_nodes.tolist() == [3, 3]
    assert ways.placed.tolist() == [True, True, True, True, False, False]
    assert ways.lon[:4].tolist() == [9.0, 9.001, 9.002, 9.001]
    assert ways.lat[:4].tolist() == [48.0] * 4
    np.testing.assert_array_equal(read_heights(extract, ways), [412.5, *[np.nan] * 5])


def test_classes_are_chosen(extract: Path) -> None:
    assert read_ways(extract, ["service"]).ids.tolist() == [8]
    assert read_ways(extract, []).ids.tolist() == []
    assert split_at_shared_nodes(read_ways(extract, [])).first.tolist() == []


def test_some_ways_and_some_vertices(extract: Path) -> None:
    ways = read_ways(extract, None)
    service = ways.select_ways(np.array([False, True]))
    assert (service.ids.tolist(), service.refs.tolist(), service.way.tolist()) == ([8], [2, 4, 99], [0, 0, 0])
    placed = ways.select_vertices(ways.placed)
    assert (placed.ids.tolist(), placed.n_nodes.tolist()) == ([7, 8], [3, 1])
    assert ways.tag_table(["lanes", "bridge"]).to_dict("list") == {"lanes": ["2", pytest.approx(np.nan, nan_ok=True)]}


def test_a_way_may_meet_itself() -> None:
    refs = [1, 2, 4, 3, 2, 6]
    nowhere = np.full(6, np.nan)
    parts = split_at_shared_nodes(OsmWays(np.array([7]), [{}], np.zeros(6, np.int64), np.array(refs), nowhere, nowhere))
    drawn = [[refs[k] for k in parts.vertex[a : b + 1]] for a, b in zip(parts.first, parts.last, strict=True)]
    assert drawn == [[1, 2], [2, 4, 3, 2], [2, 6]]


def test_restrictions_by_role_and_kind(tmp_path: Path) -> None:
    members = "".join(
        f"<member type='{kind}' ref='{ref}' role='{role}'/>"
        for kind, ref, role in [("way", 7, "from"), ("node", 2, "via"), ("way", 8, "to"), ("way", 9, "to")]
    )
    tags = "<tag k='type' v='{}'/><tag k='restriction' v='no_left_turn'/>"
    relations = "".join(
        f"<relation id='{n}'>{members}{tags.format(t)}</relation>" for n, t in [(1, "restriction"), (2, "route")]
    )
    path = tmp_path / "a.osm"
    path.write_text(f"<osm version='0.6'>{relations}</osm>")
    assert read_restrictions(path) == [("no_left_turn", {"from_w": [7], "via_n": [2], "to_w": [8, 9]})]


@pytest.mark.parametrize("read", [lambda path: read_ways(path, None), read_restrictions])
def test_damaged_files_are_our_error(tmp_path: Path, read) -> None:
    (tmp_path / "a.osm").write_text("<osm version='0.6'><way")
    with pytest.raises(InputError, match="cannot be read as OSM data"):
        read(tmp_path / "a.osm")


@pytest.mark.parametrize(
    ("tags", "two_way"),
    [
        ({"highway": "motorway", "oneway": "reversible"}, True),
        ({"highway": "motorway", "oneway": "perhaps"}, False),
        ({"highway": "primary", "oneway": "Yes"}, False),
        ({"highway": "primary", "oneway": "-1.0"}, False),
    ],
)
def test_reference_and_simulator_read_the_same_direction(tmp_path: Path, tags: dict[str, str], two_way: bool) -> None:
    body = "".join(f"<tag k='{key}' v='{value}'/>" for key, value in tags.items())
    way = f"<way id='7'><nd ref='1'/><nd ref='2'/>{body}</way>"
    path = tmp_path / "a.osm"
    path.write_text(f"<osm version='0.6'>{NODES}{way}</osm>")
    directed = read_osm(path).to_networkx()
    section = read_network(path).sections.iloc[0]
    assert len(directed.edges) == 1 + two_way
    assert (section["lanes_backward"] > 0) == two_way
    edges = [data["geometry"].coords[0] for *_, data in directed.edges(data=True) if not data["reversed"]]
    assert (edges[0][0] < min(data["x"] for _, data in directed.nodes(data=True)) + 1) == (section["u"] == 1)
