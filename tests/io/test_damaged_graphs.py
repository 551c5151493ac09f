"""Graph files with damage that once ended in a traceback: each gives one error that names the file."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Callable
from pathlib import Path

import geopandas as gpd
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio
import pytest
import shapely

from probe2road.errors import InputError, Probe2RoadError
from probe2road.graph.roadgraph import graph_from_lines
from probe2road.io.describe import describe_file
from probe2road.io.graph_files import read_graph, write_graph

EAST, NORTH = 500000.0, 5316000.0


def written(path: Path) -> Path:
    """Write a small graph and return its path."""
    lines = [[(EAST, NORTH), (EAST + 90, NORTH)], [(EAST + 90, NORTH), (EAST + 90, NORTH + 50)]]
    write_graph(graph_from_lines(lines, crs="EPSG:32632"), path)
    return path


def refusal(path: Path) -> str:
    """Return the message of the error; describing says the same as reading."""
    with pytest.raises(Probe2RoadError) as caught:
        read_graph(path)
    with pytest.raises(Probe2RoadError):
        describe_file(path)
    told = str(caught.value)
    assert told.startswith(f"{path}: ")
    assert len(told) < 600
    return told


def read_or_refused(path: Path) -> None:
    """Read a file that some versions of the parsers can read; fails on any error that is not ours."""
    with contextlib.suppress(Probe2RoadError):
        read_graph(path)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("ALTER TABLE nodes RENAME COLUMN node TO other", "the table of the nodes is damaged"),
        ("UPDATE nodes SET node = 'x'", "node ids are not unique"),
        ("UPDATE edges SET u = NULL", "the columns of the edges are damaged"),
        ("UPDATE edges SET geom = NULL WHERE edge = 1", "1 edges are no LineString (first: row 1)"),
        ("UPDATE nodes SET geom = NULL WHERE node = 1", "1 nodes are no Point (first: row 1)"),
        ("UPDATE turns SET from_edge = 'x'", None),
        ("UPDATE gpkg_spatial_ref_sys SET definition = 'undefined'", None),
        ("DROP TABLE nodes", None),
    ],
)
def test_geopackage(tmp_path: Path, change: str, told: str | None) -> None:
    path = written(tmp_path / "own.gpkg")
    with sqlite3.connect(path) as database:
        for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
            database.execute(f'DROP TRIGGER "{name}"')
        database.execute(change)
    database.close()
    if told is None:
        read_or_refused(path)
    else:
        assert told in refusal(path)


@pytest.mark.parametrize("place", [1e12, -1e300])
def test_geojson_with_coordinates_that_are_nowhere(tmp_path: Path, place: float) -> None:
    path = tmp_path / "ref.geojson"
    geometry = {"type": "LineString", "coordinates": [[9.0, 48.0], [place, 48.0]]}
    features = [{"type": "Feature", "properties": {}, "geometry": geometry}]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    assert "are no positions" in refusal(path)


def test_geojson_of_ours_with_a_point_among_its_edges(tmp_path: Path) -> None:
    path = written(tmp_path / "own.geojson")
    content = json.loads(path.read_text())
    content["features"][0]["geometry"] = {"type": "Point", "coordinates": [9.0, 48.0]}
    lines = [f'{{"type": "FeatureCollection", "probe2road": {json.dumps(content["probe2road"])},', '"features": ']
    path.write_text("\n".join(lines) + json.dumps(content["features"]) + "}")
    assert "1 edges are no LineString (first: row 0)" in refusal(path)


def with_metadata(path: Path, key: bytes, change: Callable[[str], str]) -> None:
    """Change what is said of a Parquet file in its footer."""
    table = pq.read_table(path)
    metadata = dict(table.schema.metadata)
    metadata[key] = change(metadata[key].decode()).encode()
    pq.write_table(table.replace_schema_metadata(metadata), path)


@pytest.mark.parametrize(
    ("key", "change"),
    [
        (b"pandas", lambda text: text.replace("numpy_type", "numpy_tune")),
        (b"pandas", lambda text: text.replace("int64", "in|64")),
        (b"pandas", lambda text: text[:-9]),
        (b"geo", lambda text: text.replace("GeographicCRS", "GeographicCRX").replace("Transverse", "Traverse")),
        (b"geo", lambda text: text[:-9]),
        (b"geo", lambda text: text.replace('"geometry"', '"elsewhere"')),
    ],
)
def test_parquet_with_a_damaged_footer(tmp_path: Path, key: bytes, change: Callable[[str], str]) -> None:
    path = written(tmp_path / "own.parquet")
    with_metadata(path, key, change)
    read_or_refused(path)


def test_parquet_with_damaged_geometry_or_nodes(tmp_path: Path) -> None:
    path = written(tmp_path / "own.parquet")
    table = pq.read_table(path)
    at = table.schema.get_field_index("geometry")
    short = [value.as_py()[:-3] for value in table["geometry"]]
    pq.write_table(table.set_column(at, table.schema.field(at), pa.array(short, table.schema.field(at).type)), path)
    assert "cannot be read as GeoParquet" in refusal(path)
    path = written(tmp_path / "own.parquet")
    nodes = tmp_path / "own.nodes.parquet"
    table = pq.read_table(nodes)
    renamed = table.rename_columns(["other" if name == "node" else name for name in table.column_names])
    pq.write_table(renamed.replace_schema_metadata(table.schema.metadata), nodes)
    assert "the table of the nodes is damaged" in refusal(path)


def test_shapefile_with_a_coordinate_that_is_no_number(tmp_path: Path) -> None:
    import geopandas as gpd

    path = tmp_path / "ref.shp"
    gpd.GeoDataFrame(geometry=[shapely.LineString([(EAST, NORTH), (EAST + 9, NORTH)])], crs="EPSG:32632").to_file(path)
    content = bytearray(path.read_bytes())
    content[-8:] = b"\x00\x00\x00\x00\x00\x00\xf8\x7f"
    path.write_bytes(content)
    assert "are no positions" in refusal(path)


def test_flatgeobuf_with_a_damaged_crs(tmp_path: Path) -> None:
    path = written(tmp_path / "own.fgb")
    content = path.read_bytes()
    assert pyogrio.read_info(path)["crs"] is not None
    for start in range(0, 400, 3):
        path.write_bytes(content[:start] + b"\xff\x00\x7f" + content[start + 3 :])
        read_or_refused(path)


@pytest.mark.parametrize("tag", ['lat="]]>"', 'id="x"'])
def test_osm_with_a_node_that_is_nowhere(tmp_path: Path, tag: str) -> None:
    path = tmp_path / "own.osm"
    way = '<way id="-1"><nd ref="-1"/><nd ref="-2"/><tag k="highway" v="road"/></way>'
    path.write_text(f'<osm version="0.6"><node id="-1" lat="48" lon="9"/><node id="-2" lon="9" {tag}/>{way}</osm>')
    refusal(path)


def test_an_answer_of_overpass_beyond_the_earth_is_refused(tmp_path: Path) -> None:
    way = '{"type": "way", "id": 7, "nodes": [1, 2], "tags": {"highway": "service"}}'
    nodes = [f'{{"type": "node", "id": {n}, "lat": 48.0, "lon": {lon}}}' for n, lon in ((1, "9.0"), (2, "1e308"))]
    path = tmp_path / "roads.json"
    path.write_text(f'{{"osm3s": {{}}, "elements": [{", ".join([*nodes, way])}]}}')
    with pytest.raises(InputError, match=r"1e\+308, 48 is no longitude and latitude"):
        read_graph(path)


def test_an_empty_line_among_others_is_passed_over(tmp_path: Path) -> None:
    lines = [shapely.LineString(), shapely.LineString([(446000, 4636000), (446100, 4636000)])]
    path = tmp_path / "roads.fgb"
    gpd.GeoDataFrame(geometry=lines, crs="EPSG:32616").to_file(path, SPATIAL_INDEX="NO")
    assert len(read_graph(path).edges) == 1
