"""What users hand in by mistake: each gives one error that names the file, the fault and the remedy."""

from __future__ import annotations

import gzip
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

from probe2road.errors import CRSError, InputError
from probe2road.io.fleet_reader import read_fleet
from sketches import UTM

GOOD = "trip,t,x,y\n1,0,446000,4636000\n1,1,446009,4636000\n"


def refusal(*source: Path, crs: str | None = UTM, **options: object) -> str:
    """Return the message of the error, which must be about the user's data."""
    with pytest.raises(InputError) as caught:
        read_fleet(source[0] if len(source) == 1 else list(source), crs=crs, **options)  # type: ignore[arg-type]
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b"", "the file is empty (0 bytes)"),
        ("a.csv", b"\n\n", "the file holds no text"),
        ("a.csv", b"trip,t,x,y\n", "no rows"),
        ("a.csv", b"trip,t,x,y", "no rows"),
        ("a.csv", b"\n\ntrip,t,x,y\n1,0,446000,4636000\n1,2,abc,4636000\n", "(line 5: abc)"),
        ("a.xlsx", b"PK", "the suffix '.xlsx' is not supported; supported are .parquet"),
        ("a.csv", b"trip,t,x\n1,0,446000\n", "no column for y (the columns are trip, t, x)"),
        ("a.csv", b"1,0,446000,4636000\n1,1,446009,4636000\n", "the first line holds numbers"),
        ("a.csv", GOOD.encode() + b"1,2,abc,4636000\n", "column 'x' is not a number in 1 of 3 rows (line 4: abc)"),
        ("a.csv", GOOD.encode() + b"1,2,,4636000\n", "column 'x' is empty or not finite in 1 of 3 rows (line 4: nan)"),
        (
            "a.csv",
            GOOD.encode() + b"1,2,inf,4636000\n",
            "column 'x' is empty or not finite in 1 of 3 rows (line 4: inf)",
        ),
        ("a.csv", GOOD.encode() + b"1,noon,446018,4636000\n", "column 't' is not a time in"),
        ("a.csv", GOOD.encode() + b",2,446018,4636000\n", "column 'trip' (trace_id) is empty in 1 of 3 rows"),
        ("a.csv", GOOD.encode() + b"1,2,446018\n1,3\n", "2 lines do not have 4 fields (line 4: 3, line 5: 2)"),
        ("a.csv", GOOD.encode() + b"1,1,446018,4636000\n", "repeat the time of the fix before at another place"),
        ("a.csv", GOOD.encode("utf-16"), "the text is UTF-16; save it as UTF-8"),
        ("a.csv", b"trip,t,x,y\xff\n1,0,1,1\n", "the first line is not UTF-8"),
        ("a.csv", GOOD.encode() + b"1,2,44\xdf,4636000\n", "column x is not UTF-8"),
        ("a.csv", GOOD.encode() + b"1,2,44\xdf\n", "the text is not UTF-8"),
        ("a.csv", GOOD.encode() + b"Stra\xdfe,2,446018,4636000\n", "not a readable text table"),
        ("a.csv", b"\x00\x01\x02PAR1" * 50, "the file is binary, not text"),
        ("a.csv", b"trip,x,x,y\n1,1,1,1\n", "several columns are called x"),
        ("a.csv.gz", gzip.compress(GOOD.encode() * 50, mtime=0)[:-20], "broken gzip"),
        ("a.csv.gz", gzip.compress(GOOD.encode(), mtime=0)[:20] + b"\xff" * 40, "broken gzip"),
        ("a.csv.gz", GOOD.encode(), "broken gzip"),
        ("a.parquet", GOOD.encode(), "not a readable Parquet file"),
        ("a.gpx", GOOD.encode(), "broken XML at line 1"),
    ],
)
def test_bad_files(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    told = refusal(tmp_path / name)
    assert message in told
    assert told.startswith(str(tmp_path / name))


def test_paths_that_hold_nothing(tmp_path: Path) -> None:
    assert "there is no such file or folder; check the path" in refusal(tmp_path / "nowhere")
    assert "the folder holds no supported file; supported are" in refusal(tmp_path)
    with pytest.raises(InputError, match="no files were given"):
        read_fleet([])


@pytest.mark.parametrize("keep", [8, 0.5, 0.99])
def test_truncated_parquet(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "a.parquet"
    pd.DataFrame({"trip": 1, "t": range(1000), "x": 446e3, "y": 4636e3}).to_parquet(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(keep) if keep > 1 else int(len(content) * keep)])
    assert "not a readable Parquet file" in refusal(path)


def test_parquet_with_a_damaged_page(tmp_path: Path) -> None:
    path = tmp_path / "a.parquet"
    rng = np.random.default_rng(0)
    pd.DataFrame({"trip": 1, "t": range(1000), "x": rng.normal(446e3, 9, 1000), "y": 4636e3}).to_parquet(path)
    content = bytearray(path.read_bytes())
    content[4:3000] = b"\xff" * 2996
    path.write_bytes(content)
    assert "not a readable Parquet file" in refusal(path)


def test_degrees_that_are_wrong(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("trip,lon,lat\n1,-87.65,41.87\n1,-87.65,95\n1,-87.65,41.87\n")
    assert "latitudes are outside -90..90 in 1 of 3 rows (line 3: 95.0)" in refusal(path, crs=None)
    path.write_text("trip,lat,lon\n1,-122.4,37.7\n1,-122.4,37.8\n")
    assert "longitude and latitude look swapped" in refusal(path, crs=None)
    path.write_text("trip,lat,lon\n1,-87.65,41.87\n")
    assert "longitude and latitude look swapped" in refusal(path, crs=None)


def test_all_faults_of_a_table_and_of_several_files_are_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("trip,t,x,y\n1,noon,abc,4636000\n")
    (tmp_path / "b.csv").write_text(GOOD)
    (tmp_path / "c.csv").write_text("trip,t,x,y\n")
    told = refusal(tmp_path)
    for part in ("2 of 3 files cannot be read", "a.csv: 2 faults", "'t' is not a time", "'x' is not a number", "c.csv"):
        assert part in told


def test_crs_missing_mixed_or_contradictory(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    with pytest.raises(CRSError, match=r'a.csv: no CRS; say which one it is, for example crs="EPSG:32616"'):
        read_fleet(tmp_path / "a.csv")
    points = gpd.GeoDataFrame({"trip": [1]}, geometry=gpd.points_from_xy([446e3], [4636e3]), crs=UTM)
    points.to_parquet(tmp_path / "utm.parquet")
    points.to_crs("EPSG:4326").to_parquet(tmp_path / "degrees.parquet")
    with pytest.raises(CRSError, match=r"mixed CRS: .*utm.parquet is in WGS 84 / UTM zone 16N, .* in WGS 84"):
        read_fleet([tmp_path / "utm.parquet", tmp_path / "degrees.parquet"])
    with pytest.raises(CRSError, match="the file is in WGS 84 / UTM zone 16N, which contradicts the CRS given"):
        read_fleet(tmp_path / "utm.parquet", crs="EPSG:32617")
    points.set_crs(None, allow_override=True).to_parquet(tmp_path / "none.parquet")
    with pytest.raises(CRSError, match="no CRS"):
        read_fleet(tmp_path / "none.parquet")


def test_no_fixes_in_the_bbox(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    pd.read_csv(tmp_path / "a.csv").to_parquet(tmp_path / "a.parquet")
    for name in ("a.csv", "a.parquet"):
        told = refusal(tmp_path / name, bbox=(0.0, 0.0, 1.0, 1.0))
        assert "no fixes inside bbox (0.0, 0.0, 1.0, 1.0)" in told
        assert "in the CRS of the data, WGS 84 / UTM zone 16N" in told


@pytest.mark.parametrize(
    ("geometry", "message"),
    [
        ([shapely.LineString([(0, 0), (1, 1)])], "geometries that are not all points"),
        ([shapely.Point(446e3, 4636e3), shapely.Point(446e3, 4636e3, 1.0)], "not all points of one kind"),
        ([shapely.Point(446e3, 4636e3), None], "column 'geometry' (x) is empty or not finite in 1 of 2 rows"),
        ([shapely.Point(446e3, 4636e3), shapely.Point()], "column 'geometry' (x) is empty or not finite in 1 of 2"),
    ],
)
def test_geometries_that_are_no_points(tmp_path: Path, geometry: list[object], message: str) -> None:
    frame = gpd.GeoDataFrame({"trip": range(len(geometry))}, geometry=geometry, crs=UTM)
    frame.to_parquet(tmp_path / "a.parquet")
    assert message in refusal(tmp_path / "a.parquet")


def test_semantic_points_that_are_wrong(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    points = tmp_path / "b.csv"
    points.write_text("trip,x,y,kind\n1,446000,4636000,tree\n1,446000,4636000,lane line\n")
    assert "b.csv: points: column 'kind' is one of lane_marking, road_boundary, not tree" in refusal(
        tmp_path / "a.csv", points=points
    )
    points.write_text("x,y\n446000,4636000\n")
    assert "no column for trace_id, kind" in refusal(tmp_path / "a.csv", points=points)
    (tmp_path / "b.gpx").write_text("<gpx/>")
    assert "GPX holds no semantic points" in refusal(tmp_path / "a.csv", points=tmp_path / "b.gpx")


def test_a_given_column_that_is_not_there(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(GOOD)
    assert "there is no column 'drive' (trace_id)" in refusal(tmp_path / "a.csv", columns={"trace_id": "drive"})


ODD_COLUMNS = {
    "list": pa.array([[1.0], [2.0]]),
    "bool": pa.array([True, False]),
    "timestamp": pa.array([0, 10**9], pa.timestamp("ns")),
    "duration": pa.array([0, 10**9], pa.duration("ns")),
    "struct": pa.array([{"a": 1}, {"a": 2}]),
    "missing": pa.nulls(2),
    "bytes": pa.array([b"\xff", b"b"]),
    "text": pa.array(["a", ""]),
    "words": pa.array(["a", "b"]).dictionary_encode(),
}


@pytest.mark.parametrize("kind", ODD_COLUMNS)
@pytest.mark.parametrize("column", ["t", "x", "y", "speed"])
def test_columns_of_odd_types(tmp_path: Path, column: str, kind: str) -> None:
    good = {"trip": [1, 1], "t": [0, 1], "x": [446e3, 446009.0], "y": [4636e3, 4636e3], "speed": [1.0, 2.0]}
    pq.write_table(pa.table({**good, column: ODD_COLUMNS[kind]}), tmp_path / "a.parquet")
    # What may be absent and was taken for its name alone does not refuse a file.
    if (column, kind) in {("t", "timestamp"), ("t", "missing")} or column == "speed":
        assert len(read_fleet(tmp_path / "a.parquet", crs=UTM).traces) == 2
    else:
        assert f"column '{column}' " in refusal(tmp_path / "a.parquet")


@pytest.mark.parametrize("kind", ["list", "struct", "missing", "text"])
def test_ids_of_odd_types(tmp_path: Path, kind: str) -> None:
    table = {"trip": ODD_COLUMNS[kind], "x": [446e3, 446009.0], "y": [4636e3, 4636e3]}
    pq.write_table(pa.table(table), tmp_path / "a.parquet")
    assert "column 'trip' (trace_id)" in refusal(tmp_path / "a.parquet")
