from __future__ import annotations

from pathlib import Path
from typing import Any

import pyogrio
import pytest
from pyproj import CRS

import probe2road as p2r
from probe2road.errors import CRSError, OptionError
from probe2road.io.formats import FleetFormat, GraphFormat
from probe2road.io.graph_writers import write_geopackage
from probe2road.options import options_from_table, read_toml
from sketches import graph_of

ROWS = "7;0;446000;4636000\n7;1;446009;4636000\n8;0;446000;4636500\n"


def drives(folder: Path) -> Path:
    path = folder / "drives.csv"
    path.write_text(ROWS)
    return path


NAMED = FleetFormat(
    columns={"trace_id": 0, "t": 1, "x": 2, "y": "3"}, crs="EPSG:32616", target_crs=32616, delimiter=";", header=False
)


def test_one_object_says_all_that_the_keywords_say(tmp_path: Path) -> None:
    fleet = p2r.read_fleet(drives(tmp_path), format=NAMED)
    spelled = p2r.read_fleet(
        drives(tmp_path), columns=NAMED.columns, crs="EPSG:32616", target_crs="EPSG:32616", delimiter=";", header=False
    )
    assert fleet.traces.equals(spelled.traces)
    assert fleet.crs == spelled.crs == CRS.from_epsg(32616)


def test_a_keyword_takes_the_place_of_its_field(tmp_path: Path) -> None:
    fleet = p2r.read_fleet(drives(tmp_path), format=NAMED, bbox=(446000.0, 4636000.0, 446005.0, 4637000.0))
    assert fleet.traces["trace_id"].tolist() == [7, 8]
    (tmp_path / "headed.csv").write_text(f"trip;t;x;y\n{ROWS}")
    again = p2r.read_fleet(tmp_path / "headed.csv", format=NAMED, header=True, columns={})
    assert again.traces["trace_id"].tolist() == [7, 7, 8]


def test_points_have_columns_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("7;446000;4636003;curb\n")
    both = FleetFormat(
        columns=NAMED.columns,
        point_columns={"trace_id": 0, "x": 1, "y": 2, "kind": 3},
        crs="EPSG:32616",
        delimiter=";",
        header=False,
    )
    fleet = p2r.read_fleet(drives(tmp_path), tmp_path / "points.csv", format=both)
    assert fleet.points["kind"].tolist() == ["road_boundary"]


def test_toml_says_it_in_the_same_words(tmp_path: Path) -> None:
    (tmp_path / "format.toml").write_text(
        'columns = { trace_id = 0, t = 1, x = 2, y = "3" }\ncrs = "EPSG:32616"\ntarget_crs = 32616\n'
        'delimiter = ";"\nheader = false\n'
    )
    assert options_from_table(read_toml(tmp_path / "format.toml"), FleetFormat) == NAMED
    assert options_from_table({"bbox": [0, 1, 2, 3]}, FleetFormat).bbox == (0.0, 1.0, 2.0, 3.0)
    assert options_from_table({"layer": "streets"}, GraphFormat) == GraphFormat(layer="streets")


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"column": {}}, "there is no option 'column'"),
        ({"bbox": [0, 1, 2]}, "bbox"),
        ({"bbox": [2, 0, 1, 3]}, "bbox .* is no box"),
        ({"crs": 3.5}, "crs is 3.5; use CRS, text, a whole number or None"),
        ({"header": "no"}, "header is 'no'; use true or false"),
        ({"delimiter": "::"}, "delimiter '::' is not one character"),
    ],
)
def test_toml_is_checked(table: dict[str, Any], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        options_from_table(table, FleetFormat, where="build.toml: format")


@pytest.mark.parametrize("kind", [FleetFormat, GraphFormat])
@pytest.mark.parametrize("field", ["crs", "target_crs"])
def test_no_format_has_a_crs_that_is_none(kind: type, field: str) -> None:
    with pytest.raises(CRSError, match="'EPSG:1' is not a coordinate reference system"):
        kind(**{field: "EPSG:1"})


def test_a_graph_has_a_format_too(tmp_path: Path) -> None:
    graph = graph_of([(446000, 4636000), (446100, 4636000)])
    write_geopackage(graph, tmp_path / "roads.gpkg")
    table = pyogrio.read_dataframe(tmp_path / "roads.gpkg", layer="edges")[["geometry"]]
    for layer in ("rivers", "streets"):
        pyogrio.write_dataframe(table, tmp_path / "city.gpkg", layer=layer, append=layer == "streets")
    streets = GraphFormat(layer="streets", target_crs="EPSG:32615")
    assert p2r.read_graph(tmp_path / "city.gpkg", format=streets).crs.to_epsg() == 32615
    assert p2r.read_graph(tmp_path / "city.gpkg", format=streets, target_crs=32616).crs.to_epsg() == 32616
