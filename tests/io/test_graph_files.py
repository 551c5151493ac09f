"""The files are what their formats say, seen by the programs that will open them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import duckdb
import geopandas as gpd
import osmium
import pandas as pd
import pyarrow.parquet as pq
import pyogrio
import pytest
import shapely

from probe2road.crs import local_crs
from probe2road.errors import CRSError, InputError, OutputError
from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.graph.tables import TURN_DTYPES
from probe2road.io.graph_files import read_graph, write_graph
from probe2road.io.graph_readers import read_vector_graph
from probe2road.io.osm_writer import OsmOptions
from sketches import EAST, NORTH, UTM


@pytest.fixture
def tee() -> RoadGraph:
    """Three edges at one junction, one with heights, one without support, and two turns."""
    lines = [
        [(EAST, NORTH), (EAST + 100, NORTH)],
        [(EAST + 100, NORTH, 180.0), (EAST + 200, NORTH, 181.5)],
        [(EAST + 100, NORTH), (EAST + 100, NORTH + 80)],
    ]
    attributes = pd.DataFrame({"support": pd.array([7, 3, None], "Int64"), "score": [0.9, 0.8, None]})
    graph = graph_from_lines(lines, crs=UTM, attributes=attributes)
    return replace(graph, turns=pd.DataFrame([(0, 1, 1, 4), (0, 1, 2, 2)], columns=list(TURN_DTYPES)))


def test_geopackage_has_three_layers_and_missing_values(tee: RoadGraph, tmp_path: Path) -> None:
    write_graph(tee, tmp_path / "roads.gpkg")
    assert dict(pyogrio.list_layers(tmp_path / "roads.gpkg")) == {
        "edges": "LineString Z",
        "nodes": "Point",
        "turns": None,
    }
    edges = gpd.read_file(tmp_path / "roads.gpkg", layer="edges")
    assert edges.crs.to_epsg() == 32616
    assert edges["support"].isna().tolist() == [False, False, True]
    assert len(pyogrio.read_dataframe(tmp_path / "roads.gpkg", layer="turns")) == 2


def test_geoparquet_is_version_1_1_with_a_covering(tee: RoadGraph, tmp_path: Path) -> None:
    write_graph(tee, tmp_path / "roads.parquet")
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "roads.nodes.parquet",
        "roads.parquet",
        "roads.turns.parquet",
    ]
    geo = json.loads(pq.read_schema(tmp_path / "roads.parquet").metadata[b"geo"])
    assert geo["version"] == "1.1.0"
    assert geo["columns"]["geometry"]["covering"]["bbox"]["xmin"] == ["bbox", "xmin"]
    assert geo["columns"]["geometry"]["crs"]["id"] == {"authority": "EPSG", "code": 32616}


def test_duckdb_and_geopandas_open_the_geoparquet(tee: RoadGraph, tmp_path: Path) -> None:
    write_graph(tee, tmp_path / "roads.parquet")
    sql = f"select e.edge, e.length, t.count from '{tmp_path}/roads.parquet' e join '{tmp_path}/roads.turns.parquet' t"
    with duckdb.connect() as connection:
        rows = connection.execute(f"{sql} on t.to_edge = e.edge order by e.edge").fetchall()
    assert rows == [(1, 100.0, 4), (2, 80.0, 2)]
    assert gpd.read_parquet(tmp_path / "roads.parquet", bbox=(EAST, NORTH, EAST + 50, NORTH))["edge"].tolist() == [0]


def test_geoparquet_edges_alone_are_a_graph(tee: RoadGraph, tmp_path: Path) -> None:
    write_graph(tee, tmp_path / "roads.parquet")
    for name in ("nodes", "turns"):
        (tmp_path / f"roads.{name}.parquet").unlink()
    graph = read_graph(tmp_path / "roads.parquet")
    assert graph.nodes.geometry.geom_equals(tee.nodes.geometry).all()
    assert graph.turns.empty


def test_flatgeobuf_has_an_index_and_turns_as_text(tee: RoadGraph, tmp_path: Path) -> None:
    write_graph(tee, tmp_path / "roads.fgb")
    near = gpd.read_file(tmp_path / "roads.fgb", bbox=(EAST + 150, NORTH - 1, EAST + 160, NORTH + 1))
    assert near["edge"].tolist() == [1]
    assert pyogrio.read_info(tmp_path / "roads.fgb")["capabilities"]["fast_spatial_filter"]
    table = gpd.read_file(tmp_path / "roads.fgb").set_index("edge")
    assert table.loc[0, "turns"] == "1@1:4 2@1:2"


def test_geojson_is_rfc_7946(tee: RoadGraph, tmp_path: Path) -> None:
    write_graph(tee, tmp_path / "roads.geojson")
    document = json.loads((tmp_path / "roads.geojson").read_text())
    assert document["type"] == "FeatureCollection"
    assert "crs" not in document
    assert document["probe2road"] == {"crs": "EPSG:32616"}
    first, second, _ = document["features"]
    assert [len(position) for position in first["geometry"]["coordinates"]] == [2, 2]
    assert [len(position) for position in second["geometry"]["coordinates"]] == [3, 3]
    lon, lat = first["geometry"]["coordinates"][0]
    assert (lon, lat) == pytest.approx((-87.6508, 41.8741), abs=1e-4)
    assert first["properties"]["support"] == 7
    assert document["features"][2]["properties"]["support"] is None
    assert gpd.read_file(tmp_path / "roads.geojson").crs.name == "WGS 84"


@pytest.mark.parametrize("name", ["roads.osm", "roads.osm.pbf"])
def test_osmium_reads_ways_that_share_the_junction(tee: RoadGraph, tmp_path: Path, name: str) -> None:
    one_way = replace(
        tee, edges=tee.edges.assign(forward=pd.array([9, 0, 9], "Int64"), backward=pd.array([0, 9, 9], "Int64"))
    )
    write_graph(one_way, tmp_path / name, osm=OsmOptions(dialect="editor"))
    ways = {
        way.id: ([node.ref for node in way.nodes], dict(way.tags))
        for way in osmium.FileProcessor(str(tmp_path / name), osmium.osm.WAY)
    }
    nodes = {
        node.id: (node.lon, node.lat, dict(node.tags))
        for node in osmium.FileProcessor(str(tmp_path / name), osmium.osm.NODE)
    }
    assert set(ways) == {-1, -2, -3}
    assert ways[-1][0][-1] == ways[-2][0][-1] == ways[-3][0][0]
    assert max(nodes) < 0
    assert nodes[ways[-2][0][-2]][2] == {"ele": "181.500"}
    tags = [tags for _, tags in ways.values()]
    assert [row["highway"] for row in tags] == ["road"] * 3
    assert [row.get("oneway") for row in tags] == ["yes", "yes", None]
    assert tags[0]["probe2road:origin"] == "segmentation"


def test_the_local_projection_of_a_run_survives_every_format(tmp_path: Path) -> None:
    crs = local_crs([8.0, 16.5], [48.0, 48.0])
    graph = graph_from_lines([[(1000, 2000), (1100, 2000)]], crs=crs)
    for suffix in (".gpkg", ".parquet", ".fgb", ".geojson", ".graphml", ".osm", ".osm.pbf"):
        write_graph(graph, tmp_path / f"roads{suffix}")
        back = read_graph(tmp_path / f"roads{suffix}")
        assert (back.crs, back.crs.name) == (crs, crs.name), suffix


def reference_lines(**columns: list[object]) -> gpd.GeoDataFrame:
    lines = [
        shapely.LineString([(EAST, NORTH), (EAST + 50, NORTH)]),
        shapely.LineString([(EAST + 50, NORTH), (EAST, NORTH + 50)]),
    ]
    return gpd.GeoDataFrame({**columns}, geometry=lines, crs=UTM)


@pytest.mark.parametrize("suffix", [".gpkg", ".fgb", ".shp", ".parquet"])
def test_plain_lines_become_a_reference_graph(tmp_path: Path, suffix: str) -> None:
    table = reference_lines(u=[501, 502], v=[502, 503], trips_near=[4, 213])
    table.to_parquet(tmp_path / "city.parquet") if suffix == ".parquet" else table.to_file(tmp_path / f"city{suffix}")
    graph = read_graph(tmp_path / f"city{suffix}")
    assert sorted(map(tuple, graph.edges[["origin", "trips_near"]].to_numpy())) == [
        ("reference", 4),
        ("reference", 213),
    ]
    assert sorted(graph.degrees()) == [1, 1, 2]
    assert graph.edges["support"].isna().all()


def test_geojson_with_the_old_named_crs_is_read_in_that_crs(tmp_path: Path) -> None:
    features = [
        {"type": "Feature", "properties": {"u": 1, "v": 2, "trips_near": 4}, "geometry": geometry.__geo_interface__}
        for geometry in reference_lines().geometry
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32616"}}
    document = {"type": "FeatureCollection", "crs": crs, "features": features}
    (tmp_path / "city.geojson").write_text(json.dumps(document))
    graph = read_graph(tmp_path / "city.geojson")
    assert graph.crs.to_epsg() == 32616
    assert graph.edges.geometry.iloc[0].coords[0] == (EAST, NORTH)
    assert graph.edges["trips_near"].tolist() == [4, 4]


def test_degrees_are_projected_to_the_local_crs(tmp_path: Path) -> None:
    reference_lines().to_crs("EPSG:4326").to_file(tmp_path / "city.geojson")
    graph = read_graph(tmp_path / "city.geojson")
    assert graph.crs.to_epsg() == 32616
    assert graph.length == pytest.approx(50 + 50 * 2**0.5, abs=0.05)


def test_a_file_without_crs_needs_one(tmp_path: Path) -> None:
    table = reference_lines()
    with pytest.warns(UserWarning, match="'crs' was not provided"):
        pyogrio.write_dataframe(table.set_crs(None, allow_override=True), tmp_path / "city.fgb")
    with pytest.raises(CRSError, match=r"city\.fgb: no CRS; say which one it is"):
        read_graph(tmp_path / "city.fgb")
    assert read_graph(tmp_path / "city.fgb", crs=UTM).crs.to_epsg() == 32616
    table.to_file(tmp_path / "known.fgb")
    with pytest.raises(CRSError, match="is in WGS 84 / UTM zone 16N, not in EPSG:2100"):
        read_graph(tmp_path / "known.fgb", crs="EPSG:2100")


def test_feet_are_refused(tmp_path: Path) -> None:
    reference_lines().to_crs("EPSG:3435").to_file(tmp_path / "city.gpkg")
    with pytest.raises(CRSError, match=r"coordinates are in US survey foot"):
        read_graph(tmp_path / "city.gpkg")


def test_the_layer_is_named_where_there_are_several(tmp_path: Path) -> None:
    for layer in ("rivers", "streets"):
        pyogrio.write_dataframe(reference_lines(), tmp_path / "city.gpkg", layer=layer, append=layer == "streets")
    with pytest.raises(
        InputError,
        match=r"has several layers, and none is called 'edges' \(there are: rivers, streets\); .* layer=.rivers",
    ):
        read_graph(tmp_path / "city.gpkg")
    with pytest.raises(InputError, match="has no layer 'roads'"):
        read_vector_graph(tmp_path / "city.gpkg", layer="roads")
    assert len(read_graph(tmp_path / "city.gpkg", layer="streets").edges) == 2


def test_points_are_not_roads(tmp_path: Path) -> None:
    gpd.GeoDataFrame(geometry=[shapely.Point(EAST, NORTH)], crs=UTM).to_file(tmp_path / "stops.gpkg")
    with pytest.raises(InputError, match=r"stops\.gpkg: holds no lines \(Point\); give a file with road centrelines"):
        read_graph(tmp_path / "stops.gpkg")


def test_siblings_of_another_graph_are_noticed(tee: RoadGraph, tmp_path: Path) -> None:
    write_graph(tee, tmp_path / "roads.parquet")
    write_graph(graph_from_lines([[(0, 0), (1, 0)]], crs=UTM), tmp_path / "other.parquet")
    (tmp_path / "other.nodes.parquet").replace(tmp_path / "roads.nodes.parquet")
    with pytest.raises(InputError, match=r"roads\.nodes\.parquet, is of another graph; take both from one run"):
        read_graph(tmp_path / "roads.parquet")


def test_siblings_of_one_graph_share_a_mark_that_its_content_decides(tee: RoadGraph, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        (tmp_path / folder).mkdir()
        write_graph(tee, tmp_path / folder / "roads.parquet")
    for file in (tmp_path / "one").iterdir():
        assert file.read_bytes() == (tmp_path / "two" / file.name).read_bytes()
    assert len({pd.read_parquet(file).attrs["probe2road_graph"] for file in (tmp_path / "one").iterdir()}) == 1


PRIVATE = ["gps_time", "start_time", "track_id", "imei", "session", "plate", "driver", "session_id", "License Plate"]


@pytest.mark.parametrize("name", PRIVATE)
def test_private_columns_are_refused_by_name(tee: RoadGraph, tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match="may identify drives"):
        write_graph(replace(tee, edges=tee.edges.assign(**{name: "x"})), tmp_path / "roads.gpkg")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["name", "tracks", "vehicle_support", "speed", "maxspeed", "surface", "trips_near"])
def test_other_columns_are_not(tee: RoadGraph, tmp_path: Path, name: str) -> None:
    write_graph(replace(tee, edges=tee.edges.assign(**{name: "x"})), tmp_path / "roads.gpkg")
