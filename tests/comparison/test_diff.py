"""Each class of difference, on maps of a few roads; and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import shapely

from probe2road.comparison.diff import DIFFERENCES, DiffOptions, diff
from probe2road.errors import CRSError, InputError, OptionError
from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.io.graph_files import read_graph
from sketches import UTM, graph_of

CROSS = [[(-300, 0), (0, 0)], [(0, 0), (300, 0)], [(0, -300), (0, 0)], [(0, 0), (0, 300)]]


def driven(
    lines: list, *, forward: int | list[int] = 30, backward: int | list[int] = 30, turns: list | None = None
) -> RoadGraph:
    """Return a graph with counts, and turns (from edge, node, to edge, count)."""
    n = len(lines)
    ahead, back = np.broadcast_to(forward, n), np.broadcast_to(backward, n)
    counts = pd.DataFrame({"forward": ahead, "backward": back, "support": ahead + back})
    graph = graph_from_lines(lines, crs=UTM, attributes=counts)
    table = pd.DataFrame(turns or [], columns=["from_edge", "via_node", "to_edge", "count"]).astype("int64")
    return replace(graph, turns=table)


def changes(ours: RoadGraph, base: RoadGraph, **options: float) -> dict[str, pd.DataFrame]:
    found = diff(ours, base, options=DiffOptions(**options))
    assert (found["probability"].between(0, 1)).all()
    assert not shapely.has_z(found.geometry.to_numpy()).any()
    assert (found.geometry.length > 0).all()
    assert [name for name in DIFFERENCES if name in set(found["change"])] == list(dict.fromkeys(found["change"]))
    return {name: rows.reset_index(drop=True) for name, rows in found.groupby("change")}


def test_a_map_that_agrees_is_confirmed_and_nothing_else() -> None:
    found = changes(driven(CROSS), graph_of(*[[(x + 1, y) for x, y in line] for line in CROSS]))
    assert set(found) == {"confirmed"}
    assert found["confirmed"]["base_edge"].tolist() == [0, 1, 2, 3]
    assert found["confirmed"]["distance"].tolist() == pytest.approx([0, 0, 1, 1])
    assert found["confirmed"]["support"].tolist() == pytest.approx([60] * 4, rel=0.1)
    assert found["confirmed"][["base_begin", "base_end"]].to_numpy().tolist() == [[0, 1]] * 4


def test_a_road_is_cut_where_the_map_has_no_counterpart() -> None:
    found = changes(driven([[(0, 0), (400, 0)]]), graph_of([(0, 0), (250, 0)], [(250, 0), (250, 300)]))
    assert set(found) == {"confirmed", "added", "undriven"}
    (added,) = found["added"].itertuples()
    assert added.edge == 0
    assert added.at_begin == pytest.approx(250 / 400, abs=0.04)
    assert added.at_end == 1
    assert added.length == pytest.approx(150, abs=16)
    assert (added.support, added.along, added.against) == (60, 30, 30)
    assert found["undriven"]["base_edge"].tolist() == [1]


def test_a_road_beside_its_place_has_moved() -> None:
    found = changes(driven([[(0, 0), (400, 0)]]), graph_of([(0, 12), (400, 12)]))
    assert set(found) == {"moved"}
    assert found["moved"]["distance"].tolist() == [12]
    assert found["moved"].shape[0] == 1


def test_a_carriageway_that_lacks_is_not_the_one_beside_it() -> None:
    ours = driven([[(0, 0), (400, 0)], [(400, 12), (0, 12)]], backward=0)
    base = replace(graph_of([(0, 0), (400, 0)]))
    base = replace(base, edges=base.edges.assign(oneway="yes"))
    found = changes(ours, base)
    assert set(found) == {"confirmed", "added"}
    assert found["added"]["edge"].tolist() == [1]
    assert found["added"]["oneway"].tolist() == ["yes"]


def test_one_line_of_ours_stands_for_two_carriageways() -> None:
    base = graph_of([(0, -4), (400, -4)], [(400, 4), (0, 4)])
    base = replace(base, edges=base.edges.assign(oneway="yes"))
    found = changes(driven([[(0, 0), (400, 0)]]), base)
    assert set(found) == {"confirmed"}
    assert found["confirmed"][["along", "against"]].to_numpy().tolist() == [[30, 0], [30, 0]]


@pytest.mark.parametrize(
    ("said", "forward", "backward", "oneway"), [("yes", 0, 40, "-1"), ("yes", 40, 40, "no"), (None, 3000, 0, "yes")]
)
def test_a_road_is_driven_another_way(said: str | None, forward: int, backward: int, oneway: str) -> None:
    base = graph_of([(0, 0), (400, 0)])
    base = replace(base, edges=base.edges.assign(oneway=pd.array([said], "str")))
    found = changes(driven([[(0, 1), (400, 1)]], forward=forward, backward=backward), base)
    assert set(found) == {"confirmed", "direction_changed"}
    (row,) = found["direction_changed"].itertuples()
    assert (row.oneway, row.along, row.against) == (oneway, forward, backward)
    assert row.geometry.coords[0][0] == (400 if oneway == "-1" else 0)


def test_a_few_drives_say_nothing_of_a_direction() -> None:
    found = changes(driven([[(0, 1), (400, 1)]], forward=3, backward=0), graph_of([(0, 0), (400, 0)]))
    assert set(found) == {"confirmed"}


def test_a_turn_that_drives_make_is_no_way_on_the_map() -> None:
    turns = [(0, 1, 1, 20), (0, 1, 3, 20), (2, 1, 3, 20)]
    base = graph_of([(-300, 0), (0, 0)], [(0, 0), (300, 0)], [(0, -300), (0, 0)], [(0, 12), (0, 300)])
    found = changes(driven(CROSS, turns=turns), base)
    assert set(found) == {"confirmed", "connection_added"}
    (row,) = found["connection_added"].itertuples()
    assert row.count == 20
    assert row.dead_end_distance == pytest.approx(12)
    assert 3 in {row.base_edge, row.other_base_edge}
    assert row.geometry.distance(shapely.Point(0, 0)) < 1


def test_roads_that_the_map_joins_pass_over_each_other() -> None:
    ours = driven([[(-300, 0, 0), (300, 0, 0)], [(0, -300, 7), (0, 300, 7)]])
    found = changes(ours, graph_of(*CROSS))
    assert set(found) == {"confirmed", "level_conflict"}
    (row,) = found["level_conflict"].itertuples()
    assert row.clearance == 7
    assert row.expected == pytest.approx(30 * 30 / 120)
    flat = driven([[(-300, 0), (300, 0)], [(0, -300), (0, 300)]])
    assert set(changes(flat, graph_of(*CROSS))) == {"confirmed", "connection_missing"}


def test_a_road_that_many_passed_by_and_none_drove_may_be_closed() -> None:
    lines = [[(0, 0), (200, 0)], [(200, 0), (600, 0)], [(600, 0), (900, 0)]]
    base = graph_of(*lines, [(200, 0), (400, 200), (600, 0)])
    busy, quiet = (changes(driven(lines, forward=n, backward=n), base) for n in (150, 4))
    assert set(busy) == {"confirmed", "suspect_closed"}
    assert busy["suspect_closed"]["base_edge"].tolist() == [3]
    assert busy["suspect_closed"]["expected"].iloc[0] > 50
    assert set(quiet) == {"confirmed", "undriven"}


def test_a_road_without_drives_is_never_called_wrong() -> None:
    base = graph_of([(0, 0), (400, 0)], [(400, 0), (400, 900)], [(400, 900), (0, 900)])
    found = changes(driven([[(0, 0), (400, 0)]], forward=500, backward=500), base)
    assert set(found) == {"confirmed", "undriven"}
    assert found["undriven"]["expected"].tolist() == [0, 0]


def test_what_is_improbable_is_not_listed() -> None:
    lines = [[(0, 0), (400, 0)], [(400, 0), (400, 60)]]
    ours = driven(lines, forward=1, backward=0)
    assert "added" in changes(ours, graph_of(lines[0]))
    assert "added" not in changes(ours, graph_of(lines[0]), min_probability=0.95)
    with pytest.raises(OptionError, match="min_probability is 2"):
        DiffOptions(min_probability=2)


def test_the_base_may_have_another_metric_crs() -> None:
    east, north = 446_000.0, 4_636_000.0
    ours = driven([[(east + x, north + y) for x, y in line] for line in CROSS])
    base = graph_from_lines(ours.edges.geometry.to_numpy(), crs=UTM).to_crs("EPSG:32617")
    assert set(changes(ours, base)) == {"confirmed"}


def test_what_cannot_be_compared_is_refused() -> None:
    ours = driven(CROSS)
    with pytest.raises(InputError, match="the base is in another place, at"):
        diff(ours, graph_of([(900_000, 0), (900_300, 0)]))
    with pytest.raises(InputError, match="the base has no roads"):
        diff(ours, empty_graph(UTM))
    with pytest.raises(InputError, match="the graph has no roads"):
        diff(empty_graph(UTM), ours)
    with pytest.raises(InputError, match="the graph has no counts of drives"):
        diff(graph_of(*CROSS), ours)
    degrees = replace(ours, edges=ours.edges.set_crs("EPSG:4326", allow_override=True))
    with pytest.raises(CRSError):
        diff(degrees, ours)


def test_a_base_without_ids_is_numbered_and_ids_beyond_64_bits_are_refused(tmp_path: Path) -> None:
    ours = driven(CROSS)
    ours.edges[["geometry"]].to_file(tmp_path / "lines.gpkg", layer="roads")
    found = diff(ours, read_graph(tmp_path / "lines.gpkg"))
    assert found["base_edge"].tolist() == [0, 1, 2, 3]
    assert found["osmid"].isna().all()
    huge = ours.edges.reset_index().astype({"edge": "float64"}).assign(edge=[1e19, 1.1e19, 1.2e19, 1.3e19])
    huge.to_parquet(tmp_path / "huge.parquet")
    with pytest.raises(InputError, match=r"column 'edge' holds ids beyond 2\*\*63"):
        read_graph(tmp_path / "huge.parquet")
