from __future__ import annotations

import gzip
import logging
import os
from pathlib import Path

import geopandas as gpd
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from probe2road.crs import WGS84, transform
from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet, fleet_from_tables, trace_breaks
from probe2road.io.fleet_reader import read_fleet
from sketches import UTM

DATA = Path(os.environ.get("PROBE2ROAD_DATA", Path(__file__).parents[2] / ".." / "shared" / "data"))

METRES = pd.DataFrame(
    {
        "trip": [7, 7, 7, 8, 8],
        "t": pd.to_datetime([0, 1, 2, 10, 11], unit="s", origin="2024-05-01", utc=True).as_unit("ms"),
        "x": [446000.25, 446009.5, 446018.0, 446000.0, 446009.0],
        "y": [4636000.0, 4636000.5, 4636000.0, 4636500.0, 4636500.0],
        "speed": [9.0, 9.1, 9.0, 8.9, 9.0],
    }
)
EXPECTED = fleet_from_tables(METRES.rename(columns={"trip": "trace_id"}), crs=UTM).traces


def degrees() -> pd.DataFrame:
    lon, lat = transform(METRES["x"].to_numpy(), METRES["y"].to_numpy(), EXPECTED_CRS, WGS84)
    return METRES.assign(x=lon, y=lat).rename(columns={"x": "lon", "y": "lat"})


EXPECTED_CRS = fleet_from_tables(METRES.rename(columns={"trip": "trace_id"}), crs=UTM).crs


def geo(**columns: object) -> gpd.GeoDataFrame:
    z = columns.pop("z", None)
    points = gpd.points_from_xy(METRES["x"], METRES["y"], z)
    return gpd.GeoDataFrame(METRES.drop(columns=["x", "y"]).assign(**columns), geometry=points, crs=UTM)


def assert_expected(fleet: Fleet, atol: float = 0.0) -> None:
    pd.testing.assert_frame_equal(fleet.traces, EXPECTED, rtol=0, atol=atol)
    assert fleet.crs.to_epsg() == 32616


@pytest.mark.parametrize(
    "name", ["drives.csv", "drives.tsv", "drives.txt", "drives.csv.gz", "drives.parquet", "drives.pq"]
)
def test_every_table_format_gives_the_same_fleet(tmp_path: Path, name: str) -> None:
    if name.endswith(("parquet", "pq")):
        METRES.to_parquet(tmp_path / name)
    else:
        METRES.to_csv(tmp_path / name, index=False, sep="\t" if "tsv" in name else ";")
    assert_expected(read_fleet(tmp_path / name, crs=UTM))


def test_longitude_and_latitude_need_no_crs(tmp_path: Path) -> None:
    degrees().to_csv(tmp_path / "drives.csv", index=False)
    assert_expected(read_fleet(tmp_path / "drives.csv"), atol=1e-4)


@pytest.mark.parametrize("encoding", ["WKB", "geoarrow"])
@pytest.mark.parametrize("z", [None, 180.0])
def test_geoparquet_brings_its_crs(tmp_path: Path, encoding: str, z: float | None) -> None:
    path = tmp_path / "drives.parquet"
    frame = geo(z=None if z is None else np.full(5, z))
    frame.to_parquet(path, geometry_encoding=encoding, schema_version="1.1.0")
    fleet = read_fleet(path)
    assert fleet.traces["z"].isna().all() if z is None else (fleet.traces["z"] == z).all()
    assert_expected(Fleet(fleet.traces.assign(z=np.nan), fleet.points, fleet.crs))


def test_geoparquet_without_a_crs_entry_is_in_degrees(tmp_path: Path) -> None:
    path = tmp_path / "drives.parquet"
    geo().to_crs("OGC:CRS84").to_parquet(path)
    table = pq.read_table(path)
    metadata = table.schema.metadata
    without = metadata[b"geo"].replace(b'"crs":', b'"unused":')
    pq.write_table(table.replace_schema_metadata({**metadata, b"geo": without}), path)
    assert_expected(read_fleet(path), atol=1e-4)


def test_interleaved_points_of_geoarrow(tmp_path: Path) -> None:
    flat = pa.FixedSizeListArray.from_arrays(pa.array(METRES[["x", "y"]].to_numpy().ravel()), 2)
    table = pa.Table.from_pandas(METRES.drop(columns=["x", "y"])).append_column("geom", flat)
    pq.write_table(table, tmp_path / "drives.parquet")
    assert_expected(read_fleet(tmp_path / "drives.parquet", crs=UTM))


def test_text_without_header_and_with_a_column_map(tmp_path: Path) -> None:
    METRES.to_csv(tmp_path / "drives.txt", index=False, header=False, sep=" ", date_format="%Y-%m-%dT%H:%M:%SZ")
    columns = {"trace_id": 0, "t": 1, "x": 2, "y": 3, "speed": "4"}
    assert_expected(read_fleet(tmp_path / "drives.txt", crs=UTM, header=False, columns=columns))


@pytest.mark.parametrize(
    "times",
    [
        METRES["t"].dt.strftime("%Y-%m-%d %H:%M:%S"),
        METRES["t"].dt.tz_convert("Europe/Athens").astype(str),
        METRES["t"].dt.as_unit("s").astype("int64"),
        METRES["t"].dt.as_unit("ms").astype("int64"),
        METRES["t"].dt.as_unit("ns").astype("int64"),
    ],
    ids=["naive", "zone", "s", "ms", "ns"],
)
def test_every_form_of_time_is_read(tmp_path: Path, times: pd.Series) -> None:
    METRES.assign(t=times).to_csv(tmp_path / "drives.csv", index=False)
    METRES.assign(t=times).to_parquet(tmp_path / "drives.parquet")
    assert_expected(read_fleet(tmp_path / "drives.csv", crs=UTM))
    assert_expected(read_fleet(tmp_path / "drives.parquet", crs=UTM))


def test_ids_of_text_tables_are_integers_only_if_written_so(tmp_path: Path) -> None:
    path = tmp_path / "drives.csv"
    for ids, read in ((["7", "8"], [7, 8]), (["007", "7"], ["007", "7"]), (["1e5", "100000"], ["100000", "1e5"])):
        path.write_text("trip,x,y\n" + "".join(f"{name},446000,4636000\n" for name in ids))
        assert read_fleet(path, crs=UTM).traces["trace_id"].tolist() == read


def test_a_folder_is_read_as_one_data_set(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "day=2").mkdir()
    METRES.iloc[:2].to_csv(tmp_path / "a.csv", index=False)
    METRES.iloc[2:4].to_parquet(tmp_path / "day=2" / "b.parquet")
    METRES.iloc[4:].to_csv(tmp_path / "day=2" / "c.csv.gz", index=False)
    (tmp_path / "_SUCCESS.csv").write_text("")
    (tmp_path / "notes.md").write_text("unread")
    METRES.to_csv(tmp_path / "points.csv", index=False)
    with caplog.at_level(logging.INFO):
        assert_expected(read_fleet(tmp_path, crs=UTM))
    assert "left out 1 files of semantic points" in caplog.text
    assert "read 5 fixes of 2 traces" in caplog.text
    assert "found by name: trace_id=trip" in caplog.text
    assert_expected(read_fleet([tmp_path / "a.csv", tmp_path / "day=2"], crs=UTM))


def test_folder_names_count_as_columns_of_parquet(tmp_path: Path) -> None:
    for trip, rows in METRES.groupby("trip"):
        (tmp_path / f"trip={trip}").mkdir()
        rows.drop(columns="trip").to_parquet(tmp_path / f"trip={trip}" / "part-0.parquet")
    fleet = read_fleet(tmp_path, crs=UTM)
    assert fleet.traces["trace_id"].astype(int).tolist() == [7, 7, 7, 8, 8]


def test_a_file_without_ids_is_one_trace(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for trip, rows in METRES.groupby("trip"):
        rows.drop(columns="trip").to_csv(tmp_path / f"drive {trip}.csv", index=False)
    fleet = read_fleet(tmp_path, crs=UTM)
    assert fleet.traces["trace_id"].tolist() == ["drive 7"] * 3 + ["drive 8"] * 2
    assert "the file is one trace" in caplog.text


def test_numbers_and_words_as_ids_of_two_files(tmp_path: Path) -> None:
    METRES.iloc[:3].to_csv(tmp_path / "a.csv", index=False)
    METRES.iloc[3:].assign(trip="b").to_csv(tmp_path / "b.csv", index=False)
    assert read_fleet(tmp_path, crs=UTM).traces["trace_id"].tolist() == ["7"] * 3 + ["b"] * 2


def test_semantic_points(tmp_path: Path) -> None:
    METRES.to_csv(tmp_path / "drives.csv", index=False)
    points = METRES.drop(columns=["t", "speed"]).assign(Class=["lane line", "kerb", "1", "lane_marking", "Road Edge"])
    points.to_csv(tmp_path / "drives.points.csv", index=False)
    fleet = read_fleet(tmp_path / "drives.csv", tmp_path / "drives.points.csv", crs=UTM)
    kinds = ["lane_marking", "road_boundary", "lane_marking", "lane_marking", "road_boundary"]
    assert fleet.points["kind"].tolist() == kinds
    renamed = points.rename(columns={"Class": "what"})
    renamed.to_parquet(tmp_path / "what.parquet")
    again = read_fleet(
        tmp_path / "drives.csv", tmp_path / "what.parquet", crs=UTM, point_columns={"kind": "what", "t": ""}
    )
    pd.testing.assert_frame_equal(again.points, fleet.points)


def test_a_bbox_without_semantic_points(tmp_path: Path) -> None:
    METRES.to_csv(tmp_path / "drives.csv", index=False)
    METRES.assign(kind="lane_marking", y=4637000.0).to_csv(tmp_path / "points.csv", index=False)
    box = (445000.0, 4635000.0, 447000.0, 4636100.0)
    fleet = read_fleet(tmp_path / "drives.csv", tmp_path / "points.csv", crs=UTM, bbox=box)
    assert (len(fleet.traces), len(fleet.points)) == (3, 0)


def test_ids_in_bytes_and_decimals(tmp_path: Path) -> None:
    for ids in (pa.array([b"\x01\xff"] * 5, pa.binary(2)), pa.array([7] * 5, pa.decimal128(20, 0))):
        table = pa.Table.from_pandas(METRES.assign(t=METRES["t"] + pd.to_timedelta([0, 0, 0, 1, 1], unit="h")))
        pq.write_table(table.set_column(0, "trip", ids), tmp_path / "drives.parquet")
        assert read_fleet(tmp_path / "drives.parquet", crs=UTM).n_traces == 1


def test_points_may_be_in_another_crs_that_their_file_states(tmp_path: Path) -> None:
    degrees().to_csv(tmp_path / "drives.csv", index=False)
    geo(kind="lane_marking").to_parquet(tmp_path / "points.parquet")
    fleet = read_fleet(tmp_path / "drives.csv", tmp_path / "points.parquet")
    np.testing.assert_allclose(fleet.points[["x", "y"]], METRES[["x", "y"]], atol=1e-6)


@pytest.mark.parametrize("name", ["drives.csv", "drives.parquet", "wkb.parquet", "covered.parquet", "struct.parquet"])
def test_bbox_cuts_every_format_alike(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    match name:
        case "drives.csv":
            METRES.to_csv(path, index=False)
        case "drives.parquet":
            METRES.to_parquet(path)
        case "wkb.parquet":
            geo().to_parquet(path)
        case "covered.parquet":
            geo().to_parquet(path, write_covering_bbox=True)
        case _:
            geo().to_parquet(path, geometry_encoding="geoarrow", schema_version="1.1.0")
    fleet = read_fleet(path, crs=UTM, bbox=(446005.0, 4635000.0, 446018.0, 4636100.0))
    pd.testing.assert_frame_equal(fleet.traces, EXPECTED.iloc[1:3].reset_index(drop=True))


def test_bbox_skips_row_groups_of_native_points(tmp_path: Path) -> None:
    path = tmp_path / "drives.parquet"
    geo().to_parquet(path, geometry_encoding="geoarrow", schema_version="1.1.0", row_group_size=1)
    fragment = next(ds.dataset(path).get_fragments())
    assert fragment.subset(ds.field("geometry", "y") >= 4636500.0).num_row_groups == 2


@pytest.mark.parametrize("bbox", [(1, 2, 3), (3, 0, 1, 1), (0, float("nan"), 1, 1)])
def test_a_bbox_that_is_no_box_is_refused(tmp_path: Path, bbox: tuple[float, ...]) -> None:
    with pytest.raises(OptionError, match=r"bbox .*(is no box|use a list of 4 values)"):
        read_fleet(tmp_path, bbox=bbox)  # type: ignore[arg-type]


def test_a_delimiter_is_one_character(tmp_path: Path) -> None:
    METRES.to_csv(tmp_path / "drives.txt", index=False, sep="^")
    assert_expected(read_fleet(tmp_path / "drives.txt", crs=UTM, delimiter="^"))
    with pytest.raises(OptionError, match="is not one character"):
        read_fleet(tmp_path / "drives.txt", crs=UTM, delimiter="^^")


def test_the_byte_order_mark_blanks_and_quotes_of_spreadsheets(tmp_path: Path) -> None:
    text = '\ufeff"trip" , "t" , "x" , "y"\r\n"7",0,446000,4636000\r\n"7",1, 446009.0 ,4636000\r\n'
    (tmp_path / "drives.csv").write_bytes(text.replace('" , "', '","').encode())
    assert read_fleet(tmp_path / "drives.csv", crs=UTM).traces["x"].tolist() == [446000.0, 446009.0]


def test_text_longer_than_a_block_of_the_parser(tmp_path: Path) -> None:
    n = 60_000
    long = pd.DataFrame({"trip": np.arange(n) // 1000, "t": np.arange(n), "x": 446000.5, "y": 4636000.5})
    with gzip.open(tmp_path / "drives.csv.gz", "wt") as file:
        long.to_csv(file, index=False)
    fleet = read_fleet(tmp_path / "drives.csv.gz", crs=UTM)
    assert (len(fleet.traces), fleet.n_traces) == (n, 60)


@pytest.mark.skipif(not (DATA / "traces").is_dir(), reason="shared trace data absent; set PROBE2ROAD_DATA")
@pytest.mark.parametrize(
    ("name", "crs", "fixes", "traces", "share"),
    [("chicago_shuttle", "EPSG:32616", 118360, 889, 0.002), ("athens_small", "EPSG:2100", 2840, 129, 0.04)],
)
def test_real_feeds_are_read_and_do_not_fall_apart(name: str, crs: str, fixes: int, traces: int, share: float) -> None:
    fleet = read_fleet(DATA / "traces" / name / "traces.csv.gz", crs=crs)
    assert (len(fleet.traces), fleet.n_traces) == (fixes, traces)
    broken = trace_breaks(fleet).sum() - fleet.n_traces
    assert 0 < broken < share * (fixes - traces)
