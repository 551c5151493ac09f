from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import hypothesis.strategies as st
import numpy as np
import pandas as pd
from hypothesis import given, settings

from probe2road.fleet.contract import fleet_from_tables, trace_breaks
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.fleet_writer import write_fleet
from probe2road.io.wkb import point_coordinates
from sketches import UTM

ids = st.text("abc0/ -é", min_size=1, max_size=4)


@st.composite
def tables(draw: st.DrawFn) -> pd.DataFrame:
    """Drives with unique times within each trace."""
    names = draw(st.lists(ids, min_size=1, max_size=4, unique=True))
    parts = []
    for name in names:
        t = sorted(draw(st.sets(st.integers(0, 5000), min_size=1, max_size=12)))
        rng = np.random.default_rng(draw(st.integers(0, 999)))
        part = {"trace_id": name, "t": np.array(t) / 8 + 1.7e9, "x": 446e3 + rng.normal(0, 500, len(t))}
        parts.append(pd.DataFrame(part).assign(y=4636e3 + rng.normal(0, 500, len(t)), z=rng.normal(180, 5, len(t))))
    return pd.concat(parts, ignore_index=True)


@settings(max_examples=25, deadline=None)
@given(tables(), st.randoms(use_true_random=False))
def test_row_order_does_not_matter(table: pd.DataFrame, random: object) -> None:
    order = list(range(len(table)))
    random.shuffle(order)  # type: ignore[attr-defined]
    expected = fleet_from_tables(table, crs=UTM, keep_crs=True)
    shuffled = fleet_from_tables(table.iloc[order], crs=UTM, keep_crs=True)
    pd.testing.assert_frame_equal(shuffled.traces, expected.traces)


@settings(max_examples=25, deadline=None)
@given(tables())
def test_writing_and_reading_back_is_the_identity(table: pd.DataFrame) -> None:
    points = table.assign(kind=np.where(table["z"] > 180, "lane_marking", "road_boundary")).drop(columns="t")
    fleet = fleet_from_tables(table, points, crs=UTM)
    with TemporaryDirectory() as folder:
        traces_file, points_file = write_fleet(fleet, Path(folder, "drives.parquet"))
        back = read_fleet(traces_file, points_file)
    pd.testing.assert_frame_equal(back.traces, fleet.traces, check_exact=True)
    pd.testing.assert_frame_equal(back.points, fleet.points, check_exact=True)
    assert back.crs == fleet.crs


@settings(max_examples=25, deadline=None)
@given(tables())
def test_text_and_parquet_give_the_same_fleet(table: pd.DataFrame) -> None:
    table = table.assign(trace_id="a" + table["trace_id"].str.strip())  # no two ids that differ in blanks only
    table = table.drop_duplicates(["trace_id", "t"])
    with TemporaryDirectory() as folder:
        table.to_csv(Path(folder, "drives.csv"), index=False)
        table.to_parquet(Path(folder, "drives.parquet"), index=False)
        text = read_fleet(Path(folder, "drives.csv"), crs=UTM)
        parquet = read_fleet(Path(folder, "drives.parquet"), crs=UTM)
    pd.testing.assert_frame_equal(text.traces, parquet.traces, check_exact=True)


@settings(max_examples=25, deadline=None)
@given(tables())
def test_every_trace_starts_with_a_break_and_moving_everything_changes_none(table: pd.DataFrame) -> None:
    fleet = fleet_from_tables(table, crs=UTM, keep_crs=True)
    breaks = trace_breaks(fleet)
    assert breaks[fleet.starts[:-1]].all()
    moved = fleet_from_tables(table.assign(x=table["x"] + 512, y=table["y"] - 1024), crs=UTM, keep_crs=True)
    np.testing.assert_array_equal(trace_breaks(moved), breaks)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.tuples(*[st.floats(-1e7, 1e7)] * 3), min_size=1, max_size=20),
    st.booleans(),
    st.integers(0, 1),
    st.integers(1, 3),
)
def test_wkb_is_read_as_shapely_reads_it(
    rows: list[tuple[float, float, float]], has_z: bool, byte_order: int, first: int
) -> None:
    import pyarrow as pa
    import shapely

    coordinates = np.array(rows)[:, : 2 + has_z]
    wkb = shapely.to_wkb(shapely.points(coordinates), byte_order=byte_order, output_dimension=2 + has_z, flavor="iso")
    column = pa.chunked_array([pa.array(wkb), pa.array(wkb).slice(first)])  # the second chunk starts inside its buffer
    read = point_coordinates(column, name="geometry")
    expected = np.vstack([coordinates, coordinates[first:]])
    np.testing.assert_array_equal(np.column_stack(list(read.values())), expected)
