from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.errors import OptionError
from probe2road.graph.check import check_graph
from probe2road.graph.direction import (
    DirectionOptions,
    counted_direction,
    driving_direction,
    in_driving_direction,
    tagged_direction,
    told_direction,
)
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.tables import TURN_DTYPES
from sketches import graph_of


@pytest.fixture
def tee() -> RoadGraph:
    """Three streets that meet at node 1, the second with heights."""
    return graph_of([(0, 0), (100, 0)], [(100, 0, 5), (180, 0, 6), (200, 0, 9)], [(100, 0), (100, 80)])


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        (1, ["yes", "Yes", "true", "1", "1.0", "F", "f", "FT", True, 1, 1.0, " yes "]),
        (-1, ["-1", "-1.0", "reverse", "REVERSE", "T", "TF", "tf", -1, -1.0]),
        (0, ["no", "false", "0", "0.0", "B", "reversible", "alternating", False, 0, 0.0]),
        (None, ["", "perhaps", "-1; yes", "2", None, float("nan")]),
    ],
)
def test_words_of_openstreetmap_and_of_gis_files(direction: int | None, words: list[object]) -> None:
    for word in words:
        told = told_direction(pd.Series([word]))
        assert told.isna()[0] if direction is None else told[0] == direction, word


def test_no_words_say_nothing() -> None:
    assert told_direction(pd.Series([], dtype="str")).tolist() == []
    assert tagged_direction(pd.DataFrame(index=range(2))).isna().all()


@pytest.mark.parametrize(
    ("tags", "direction"),
    [
        ({"highway": "motorway"}, 1),
        ({"highway": "motorway_link"}, 1),
        ({"highway": "trunk"}, None),
        ({"highway": "residential", "junction": "roundabout"}, 1),
        ({"highway": "residential", "junction": "circular"}, 1),
        ({"highway": "motorway", "oneway": "no"}, 0),
        ({"highway": "motorway", "oneway": "-1"}, -1),
        ({"highway": "motorway", "oneway": "reversible"}, 0),
        ({"highway": "motorway", "oneway": "perhaps"}, 1),
        ({"highway": "trunk", "oneway": "yes"}, 1),
    ],
)
def test_motorways_and_roundabouts_imply_a_direction(tags: dict[str, str], direction: int | None) -> None:
    assert tagged_direction(pd.DataFrame([tags])).tolist() == [pd.NA if direction is None else direction]


def test_nine_drives_the_same_way_make_an_edge_one_way() -> None:
    counts = pd.DataFrame({"forward": [9, 8, 0, 0, 200, 5, 0], "backward": [0, 0, 9, 8, 2, 5, 0]})
    assert driving_direction(counts).tolist() == [1, 0, -1, 0, 1, 0, 0]
    assert counted_direction(counts).isna().tolist() == [False, True, False, True, False, False, True]
    surer = DirectionOptions(min_confidence=0.95)
    assert counted_direction(counts, options=surer).isna().tolist()[:3] == [True, True, True]


def test_what_is_told_outranks_the_counts(tee: RoadGraph) -> None:
    edges = tee.edges.assign(forward=pd.array([9, 0, None], "Int64"), backward=pd.array([0, 9, None], "Int64"))
    assert driving_direction(edges).tolist() == [1, -1, 0]
    assert driving_direction(edges.assign(oneway=["no", None, "-1"])).tolist() == [0, -1, -1]
    assert driving_direction(edges.assign(oneway=[False, True, False])).tolist() == [0, 1, 0]
    assert driving_direction(edges.assign(oneway=["reversible", "perhaps", "TF"])).tolist() == [0, -1, -1]


def test_weighed_evidence_outranks_bare_counts(tee: RoadGraph) -> None:
    counted = tee.edges.assign(forward=[20, 20, 20], backward=[0, 0, 0])
    assert driving_direction(counted).tolist() == [1, 1, 1]
    weighed = counted.assign(oneway=["yes", None, None], oneway_confidence=[0.95, 0.8, np.nan])
    assert driving_direction(weighed).tolist() == [1, 0, 1]  # nobody weighed the third


def test_a_turned_edge_is_the_same_road(tee: RoadGraph) -> None:
    turns = pd.DataFrame([(0, 1, 1, 5)], columns=list(TURN_DTYPES))
    further = {
        "lanes:forward": [1, 2, 3],
        "lanes:backward": [4, 5, 6],
        "kerb_left": list("abc"),
        "kerb_right": list("def"),
    }
    edges = tee.edges.assign(oneway=["yes", "-1", None], forward=[9, 1, 3], backward=[0, 8, 4], **further)
    graph = replace(tee, edges=in_driving_direction(edges), turns=turns)
    check_graph(graph)
    assert graph.edges.index.tolist() == [0, 1, 2]
    assert graph.edges[["u", "v", "key", "forward", "backward"]].to_numpy().tolist() == [
        [0, 1, 0, 9, 0],
        [2, 1, 0, 8, 1],
        [1, 3, 0, 3, 4],
    ]
    assert graph.edges["oneway"].tolist()[:2] == ["yes", "yes"]
    assert shapely.get_coordinates(graph.edges.geometry[1], include_z=True)[:, 2].tolist() == [9, 6, 5]
    assert graph.edges.loc[1, list(further)].tolist() == [5, 2, "e", "b"]
    assert graph.edges.loc[0, list(further)].tolist() == [1, 4, "a", "d"]
    assert graph.edges.dtypes.equals(edges.dtypes)
    assert edges["u"].tolist() == [0, 1, 1]  # the input is as it was


def test_turning_twice_changes_nothing(tee: RoadGraph) -> None:
    once = in_driving_direction(tee.edges.assign(oneway=["-1", "no", "-1"]))
    assert in_driving_direction(once) is once
    assert in_driving_direction(tee.edges) is tee.edges


def test_counts_alone_turn_an_edge(tee: RoadGraph) -> None:
    turned = in_driving_direction(tee.edges.assign(forward=[0, 0, 9], backward=[9, 8, 0]))
    assert turned[["forward", "backward"]].to_numpy().tolist() == [[9, 0], [0, 8], [9, 0]]
    assert "oneway" not in turned


@pytest.mark.parametrize(
    ("words", "turned"),
    [
        ([-1, 1, 0], [1, 1, 0]),
        ([-1.0, 1.0, np.nan], [1.0, 1.0, np.nan]),
        (["T", "F", "B"], ["F", "F", "B"]),
        (["tf", "FT", None], ["FT", "FT", None]),
        (["Reverse", "reversible", "no"], ["yes", "reversible", "no"]),
    ],
)
def test_a_turned_edge_says_so_in_the_words_of_its_column(
    tee: RoadGraph, words: list[object], turned: list[object]
) -> None:
    edges = in_driving_direction(tee.edges.assign(oneway=words))
    pd.testing.assert_series_equal(edges["oneway"], tee.edges.assign(oneway=turned)["oneway"])
    assert edges["u"].tolist() == [1, 1, 1]


def test_a_loop_is_turned_too() -> None:
    ring = [(0, 0), (9, 0), (9, 9), (0, 0)]
    graph = graph_of(ring)
    turned = in_driving_direction(graph.edges.assign(oneway="-1"))
    assert shapely.get_coordinates(turned.geometry).tolist() == [[*map(float, place)] for place in reversed(ring)]


@pytest.mark.parametrize("wrong", [{"wrong_way": 0.0}, {"min_confidence": 1.0}, {"imbalance": 0.0}])
def test_options_out_of_range(wrong: dict[str, float]) -> None:
    with pytest.raises(OptionError, match=next(iter(wrong))):
        DirectionOptions(**wrong)
