"""Routing engines drive on the files for them: over bridges, along one-way streets, through turns that are made."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import osmium
import pandas as pd
import pytest
from routers import ENGINES, Route, Router

from probe2road.crs import WGS84, transform
from probe2road.errors import MissingExtraError, OptionError
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.io.osm_writer import OsmOptions
from sketches import EAST, NORTH, UTM

# A main road from west to east (0, 1) with a crossing street at x = 400 (2, 3), a road on a bridge over it at x = 200
# (4), which a one-way street (5) joins to the street in the north, and a long way round (6, 7) in the south.
LINES = [
    [(0, 0, 0), (400, 0, 0)],
    [(400, 0, 0), (800, 0, 0)],
    [(400, -300, 0), (400, 0, 0)],
    [(400, 0, 0), (400, 300, 0)],
    [(200, -300, 7), (200, 300, 7)],
    [(200, 300, 7), (400, 300, 0)],
    [(200, -300, 7), (400, -300, 0)],
    [(400, -300, 0), (800, -300, 0), (800, 0, 0)],
]
ONEWAY = [None, None, None, None, None, "yes", None, None]
SPEED = [20.0, 20.0, 10.0, 10.0, 15.0, 10.0, 10.0, 10.0]
# At (400, 0) nobody turns from the south to the west, nor from the west to the north.
MADE = {(0, 1): 60, (1, 0): 60, (2, 3): 40, (3, 2): 40} | dict.fromkeys(
    [(0, 2), (2, 1), (1, 2), (1, 3), (3, 1), (3, 0)], 20
)


@pytest.fixture(scope="module")
def graph() -> RoadGraph:
    lines = [[(EAST + x, NORTH + y, z) for x, y, z in line] for line in LINES]
    attributes = pd.DataFrame({"oneway": pd.array(ONEWAY, dtype="str"), "speed": SPEED})
    made = graph_from_lines(lines, crs=UTM, attributes=attributes)
    (crossing,) = set(made.edges.loc[0, ["u", "v"]]) & set(made.edges.loc[1, ["u", "v"]])
    turns = [(start, crossing, end, count) for (start, end), count in sorted(MADE.items())]
    return replace(made, turns=pd.DataFrame(turns, columns=["from_edge", "via_node", "to_edge", "count"]))


@pytest.fixture(scope="module", params=sorted(ENGINES))
def route(
    request: pytest.FixtureRequest, graph: RoadGraph, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Router]:
    folder = tmp_path_factory.mktemp(request.param)
    write_graph(graph, folder / "roads.osm.pbf")
    with ExitStack() as stack:
        try:
            router = stack.enter_context(ENGINES[request.param](folder / "roads.osm.pbf"))
        except (MissingExtraError, FileNotFoundError) as error:
            pytest.skip(str(error))
        yield router


def drive(route: Router, *places: tuple[float, float]) -> Route:
    x, y = np.array(places, float).T
    found = route(np.column_stack(transform(x + EAST, y + NORTH, UTM, WGS84)))
    assert found is not None
    return found


def test_a_bridge_is_driven_over_without_a_turn_onto_the_road_below(route: Router) -> None:
    over = drive(route, (200, -250), (200, 250))
    assert over.length == pytest.approx(500, abs=3)
    down = drive(route, (200, -50), (100, 0))
    assert down.length > 500  # 112 m as the crow flies, and no way between the two roads there


def test_a_one_way_street_is_driven_along_and_not_against(route: Router) -> None:
    assert drive(route, (220, 300), (380, 300)).length == pytest.approx(160, abs=3)
    assert drive(route, (380, 300), (220, 300)).length > 1000


def test_turns_that_were_made_are_open_and_those_that_nobody_made_are_not(route: Router) -> None:
    assert drive(route, (400, -100), (500, 0)).length == pytest.approx(200, abs=3)  # to the right
    assert drive(route, (400, -100), (300, 0)).length > 500  # to the left, which nobody did
    assert drive(route, (300, 0), (400, 100)).length > 500


def test_speeds_of_drives_decide_how_long_it_takes(route: Router) -> None:
    fast, slow = drive(route, (20, 0), (380, 0)), drive(route, (400, -280), (400, -20))
    assert fast.length / fast.seconds > 1.4 * slow.length / slow.seconds


class _Content(osmium.SimpleHandler):
    """The objects of a file, in its order."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.nodes: list[int] = []
        self.ways: dict[int, dict[str, str]] = {}
        self.relations: list[tuple[dict[str, str], dict[str, int]]] = []
        self.apply_file(str(path))

    def node(self, node: osmium.osm.Node) -> None:
        self.nodes.append(node.id)

    def way(self, way: osmium.osm.Way) -> None:
        self.ways[way.id] = dict(way.tags)

    def relation(self, relation: osmium.osm.Relation) -> None:
        self.relations.append((dict(relation.tags), {member.role: member.ref for member in relation.members}))


def test_ids_for_routers_are_positive_and_ascend_from_the_first(graph: RoadGraph, tmp_path: Path) -> None:
    path = tmp_path / "roads.osm.pbf"
    write_graph(graph, path, osm=OsmOptions(first_id=5000))
    content = _Content(path)
    assert content.nodes == list(range(5000, 5000 + len(content.nodes)))
    assert list(content.ways) == list(range(5000, 5008))
    assert {tags["highway"] for tags in content.ways.values()} == {"unclassified"}
    assert [tags.get("layer") for tags in content.ways.values()] == [None] * 4 + ["1"] + [None] * 3
    assert content.ways[5000]["maxspeed"] == "72"
    kinds = {(member["from"] - 5000, member["to"] - 5000): tags["restriction"] for tags, member in content.relations}
    assert kinds == {(0, 3): "no_left_turn", (2, 0): "no_left_turn"}
    pd.testing.assert_frame_equal(read_graph(path).turns, graph.turns)


def test_routers_get_the_more_probable_direction_of_what_few_drove(graph: RoadGraph, tmp_path: Path) -> None:
    counts = {"forward": [4, 0, 4, 0], "backward": [0, 4, 4, 0]}
    seen = replace(graph, edges=graph.edges.iloc[:4].assign(oneway=None, **counts), turns=graph.turns.iloc[:0])
    for name, expected in (("roads.osm.pbf", ["yes", "-1", None, None]), ("roads.osm", [None] * 4)):
        write_graph(seen, tmp_path / name)
        assert [tags.get("oneway") for tags in _Content(tmp_path / name).ways.values()] == expected
        assert read_graph(tmp_path / name).edges["forward"].tolist() == counts["forward"]


@pytest.mark.parametrize("suffix", [".osm", ".osc"])
def test_editors_get_new_objects_of_unknown_class(graph: RoadGraph, tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"roads{suffix}"
    write_graph(graph, path)
    content = _Content(path)
    assert max(content.nodes) == -1
    assert list(content.ways) == list(range(-1, -9, -1))
    assert {tags["highway"] for tags in content.ways.values()} == {"road"}
    assert not any("maxspeed" in tags or "layer" in tags for tags in content.ways.values())
    assert content.relations == []


def test_a_dialect_can_be_asked_for(graph: RoadGraph, tmp_path: Path) -> None:
    write_graph(graph, tmp_path / "roads.osm", osm=OsmOptions(dialect="router"))
    assert min(_Content(tmp_path / "roads.osm").nodes) == 1


def test_what_a_map_says_goes_before_what_was_seen(graph: RoadGraph, tmp_path: Path) -> None:
    told = replace(graph, edges=graph.edges.assign(highway="primary", layer="2"))
    write_graph(told, tmp_path / "roads.osm.pbf")
    tags = _Content(tmp_path / "roads.osm.pbf").ways[1]
    assert (tags["highway"], tags["layer"]) == ("primary", "2")


def test_ids_that_are_too_large_are_refused(graph: RoadGraph, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"first_id is 9223372036854775800; use ids below"):
        write_graph(graph, tmp_path / "roads.osm.pbf", osm=OsmOptions(first_id=2**63 - 8))
    assert not list(tmp_path.iterdir())
