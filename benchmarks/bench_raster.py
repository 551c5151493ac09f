"""Rasterisation: segments per second, for the 20 m segments of a highway drive at 1 Hz.

Usage: python benchmarks/bench_raster.py [--fixes 4000000]
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import pandas as pd

from probe2road.crs import parse_crs
from probe2road.fleet.columns import POINT_KINDS
from probe2road.fleet.contract import Fleet, trace_breaks
from probe2road.raster.counts import fleet_grid, rasterize

FIXES_PER_DRIVE = 500
STEP = 20.0  # m
AREA = 4000.0  # m


def highway_fleet(n_fixes: int) -> Fleet:
    """Drives with gently turning headings, folded into the area like a ball between cushions."""
    rng = np.random.default_rng(0)
    n_drives = n_fixes // FIXES_PER_DRIVE
    heading = rng.uniform(0, 2 * np.pi, (n_drives, 1)) + np.cumsum(rng.normal(0, 0.02, (n_drives, FIXES_PER_DRIVE)), 1)
    folded = [
        AREA - np.abs((rng.uniform(0, AREA, (n_drives, 1)) + np.cumsum(STEP * turn(heading), 1)) % (2 * AREA) - AREA)
        for turn in (np.sin, np.cos)
    ]
    seconds = np.tile(np.arange(FIXES_PER_DRIVE), n_drives)
    traces = pd.DataFrame(
        {
            "trace_id": np.repeat(np.arange(n_drives), FIXES_PER_DRIVE),
            "t": pd.to_datetime(seconds, unit="s", utc=True).astype("datetime64[ns, UTC]"),
            "x": folded[0].ravel(),
            "y": folded[1].ravel(),
            "z": 0.0,
        }
    )
    points = traces.iloc[:0].assign(kind=pd.Categorical([], categories=POINT_KINDS))
    return Fleet(traces, points, parse_crs("EPSG:32616"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fixes", type=int, default=4_000_000)
    fleet = highway_fleet(parser.parse_args().fixes)
    grid = fleet_grid(fleet)
    rasterize(fleet, grid)  # compiles
    breaks = best(lambda: trace_breaks(fleet))
    whole = best(lambda: rasterize(fleet, grid))
    counts = rasterize(fleet, grid)[0]
    n = len(fleet.traces)
    print(f"{n / 1e6:.0f} M segments of {STEP:.0f} m into {grid.rows} x {grid.cols} pixels, one core")
    print(f"{'all of rasterize':30} {whole:6.2f} s  {n / whole / 1e6:6.1f} M segments/s")
    print(f"{'of which finding breaks':30} {breaks:6.2f} s")
    print(f"{'without':30} {whole - breaks:6.2f} s  {n / (whole - breaks) / 1e6:6.1f} M segments/s")
    print(f"{'pixels counted':30} {counts.sum() / n:6.1f} per segment")


def best(function: object, repeats: int = 3) -> float:
    """Shortest of several runs, seconds."""
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        function()  # type: ignore[operator]
        times.append(time.perf_counter() - started)
    return min(times)


if __name__ == "__main__":
    main()
