"""Speed, size and memory of the fleet simulator.

    python benchmarks/bench_simulate.py NETWORK.osm.pbf --km 2000

Prints kilometres of drives simulated per minute and core, Parquet bytes per kilometre, and the peak memory of a run
that holds one chunk at a time. The first drives, which compile, are not timed.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from probe2road.simulation.fleet_simulation import simulate_chunks
from probe2road.simulation.networks.osm import read_network
from probe2road.simulation.presets import PRESETS


def write(writers: dict[str, pq.ParquetWriter], name: str, table: pd.DataFrame, folder: Path) -> None:
    """Append a table to its Parquet file."""
    arrow = pa.Table.from_pandas(table, preserve_index=False)
    if name not in writers:
        writers[name] = pq.ParquetWriter(
            folder / f"{name}.parquet",
            arrow.schema,
            compression="zstd",
            use_dictionary=["trace_id", "vehicle_id", "kind", "section", "lane"],
            column_encoding={axis: "BYTE_STREAM_SPLIT" for axis in "xyz" if axis in table},
        )
    writers[name].write_table(arrow)


def main() -> None:
    """Measure one preset on one network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("--km", type=float, default=2000.0)
    parser.add_argument("--preset", choices=sorted(PRESETS), default="mixed")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()

    network = read_network(options.network)
    next(simulate_chunks(network, preset=options.preset, n_drives=2, seed=0))
    driven = points = poses = 0.0
    with tempfile.TemporaryDirectory() as folder:
        writers: dict[str, pq.ParquetWriter] = {}
        wall, cpu = time.perf_counter(), time.process_time()
        for chunk in simulate_chunks(
            network, preset=options.preset, drive_km=options.km, seed=1, workers=options.workers
        ):
            driven += chunk.length.sum() / 1000.0
            points, poses = points + len(chunk.points), poses + len(chunk.traces)
            for name in ("traces", "points", "poses"):
                write(writers, name, getattr(chunk, name), Path(folder))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        for writer in writers.values():
            writer.close()
        size = {path.stem: path.stat().st_size for path in sorted(Path(folder).glob("*.parquet"))}

    print(f"{options.network.name}, {options.preset}: {driven:.0f} km, {options.workers} worker(s)")
    print(f"  {driven / wall * 60:.0f} km a minute (wall, with writing), {driven / cpu * 60:.0f} km a CPU minute here")
    print(f"  {poses / driven:.0f} poses and {points / driven:.0f} points a km")
    print("  Parquet, kB a km: " + ", ".join(f"{name} {bytes_ / driven / 1000:.1f}" for name, bytes_ in size.items()))
    print(f"  peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
