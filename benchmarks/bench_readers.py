"""Fixes per second of every reader, on drives generated in a temporary folder.

Run as ``python benchmarks/bench_readers.py [N_FIXES]``. Each line is the best of three runs with a warm file cache:
the whole of `read_fleet`, and how much of it the checks and the projection (`fleet_from_tables`) take.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from pyproj import CRS

from probe2road.crs import WGS84, transform
from probe2road.fleet.contract import fleet_from_tables
from probe2road.io.fleet_reader import read_fleet

UTM = CRS.from_epsg(32616)
FIXES_PER_TRACE = 1000


def make_drives(n: int, rng: np.random.Generator) -> pd.DataFrame:
    """Make drives of one fix a second at about 15 m/s, in UTM."""
    trace = np.arange(n) // FIXES_PER_TRACE
    within = np.arange(n) % FIXES_PER_TRACE
    angle = rng.uniform(0, 2 * np.pi, trace[-1] + 1)[trace]
    x = np.round(446_000 + 15 * within * np.cos(angle) + rng.normal(0, 3, n), 2)
    y = np.round(4_636_000 + 15 * within * np.sin(angle) + rng.normal(0, 3, n), 2)
    t = pd.to_datetime(1_714_550_400 + trace * 60 + within, unit="s", utc=True)
    return pd.DataFrame({"trace_id": trace, "t": t, "x": x, "y": y, "speed": np.round(rng.normal(15, 2, n), 1)})


def write_gpx(drives: pd.DataFrame, path: Path) -> None:
    """Write the drives as one GPX with a segment each."""
    lines = ['<?xml version="1.0"?>', '<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk>']
    times = drives["t"].dt.strftime("%Y-%m-%dT%H:%M:%SZ")
    for _, rows in drives.assign(time=times).groupby("trace_id"):
        lines.append("<trkseg>")
        lines += [
            f'<trkpt lat="{lat:.7f}" lon="{lon:.7f}">\n  <ele>180.5</ele>\n  <time>{stamp}</time>\n</trkpt>'
            for lon, lat, stamp in zip(rows["x"], rows["y"], rows["time"], strict=True)
        ]
        lines.append("</trkseg>")
    path.write_text("\n".join([*lines, "</trk></gpx>"]))


def best_of(call: Callable[[], Any], runs: int = 3) -> float:
    """Return the shortest of some run times in seconds."""
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def main(n: int) -> None:
    """Write the files, read them, print the table."""
    metres = make_drives(n, np.random.default_rng(0))
    lon, lat = transform(metres["x"].to_numpy(), metres["y"].to_numpy(), UTM, WGS84)
    degrees = metres.assign(x=np.round(lon, 7), y=np.round(lat, 7))
    lon_lat = degrees.rename(columns={"x": "lon", "y": "lat"})
    words = metres.assign(trace_id="drive-" + metres["trace_id"].astype(str).str.zfill(12))
    geometry = gpd.points_from_xy(metres["x"], metres["y"])
    geo = gpd.GeoDataFrame(metres.drop(columns=["x", "y"]), geometry=geometry, crs=UTM)
    gpx = degrees.iloc[: n // 4]
    epoch = metres.assign(t=metres["t"].dt.as_unit("s").astype("int64"))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        metres.to_parquet(folder / "metres.parquet", index=False)
        words.to_parquet(folder / "words.parquet", index=False)
        lon_lat.to_parquet(folder / "degrees.parquet", index=False)
        geo.to_parquet(folder / "wkb.parquet", index=False)
        geo.to_parquet(folder / "geoarrow.parquet", index=False, geometry_encoding="geoarrow", schema_version="1.1.0")
        epoch.to_csv(folder / "epoch.csv", index=False)
        lon_lat.to_csv(folder / "iso.csv", index=False)
        epoch.to_csv(folder / "epoch.csv.gz", index=False)
        write_gpx(gpx, folder / "drives.gpx")
        cases: list[tuple[str, str, int, Any]] = [
            ("Parquet, metres", "metres.parquet", n, UTM),
            ("Parquet, metres, text ids", "words.parquet", n, UTM),
            ("Parquet, lon/lat", "degrees.parquet", n, None),
            ("GeoParquet, WKB, metres", "wkb.parquet", n, None),
            ("GeoParquet, struct, metres", "geoarrow.parquet", n, None),
            ("CSV, metres, epoch", "epoch.csv", n, UTM),
            ("CSV, lon/lat, ISO times", "iso.csv", n, None),
            ("CSV gz, metres, epoch", "epoch.csv.gz", n, UTM),
            ("GPX, 4 lines a point", "drives.gpx", len(gpx), None),
        ]
        print(f"{'input':30} {'fixes':>9} {'seconds':>8} {'fixes/s':>12}")
        rows = [
            (title, fixes, best_of(partial(read_fleet, folder / file, crs=crs))) for title, file, fixes, crs in cases
        ]
    rows += [
        ("checks alone, metres", n, best_of(lambda: fleet_from_tables(metres, crs=UTM))),
        ("checks alone, text ids", n, best_of(lambda: fleet_from_tables(words, crs=UTM))),
        ("checks and projection, lon/lat", n, best_of(lambda: fleet_from_tables(degrees, crs=WGS84))),
    ]
    for title, fixes, seconds in rows:
        print(f"{title:30} {fixes:9d} {seconds:8.3f} {fixes / seconds:12,.0f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000)
