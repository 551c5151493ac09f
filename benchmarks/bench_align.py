"""Growth of alignment with the number of drives: time and memory.

    python benchmarks/bench_align.py --drives 50 100 200 400 800 1600 2000

Four one-way roads of 2 km with two lanes carry simulated drives with the errors of the preset `mixed`. Each number of
drives is measured in a process of its own, after a small run that compiles. Prints poses, CPU-seconds, poses a
CPU-second, and the peak memory of the process.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time

from probe2road.align import align
from probe2road.simulate.fleet_simulation import simulate
from probe2road.simulate.network import network_from_sections

ROADS = [[(0.0, 400.0 * road), (2000.0, 400.0 * road)] for road in range(4)]


def measure(n_drives: int) -> tuple[int, float, float]:
    """Poses, CPU-seconds and peak memory (MB) of one alignment."""
    network = network_from_sections(ROADS, crs="EPSG:32616", lanes_forward=2)
    align(simulate(network, n_drives=4, seed=0).fleet)
    fleet = simulate(network, n_drives=n_drives, seed=1).fleet
    cpu = time.process_time()
    align(fleet)
    cpu = time.process_time() - cpu
    return len(fleet.traces), cpu, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    """Measure each number of drives and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, nargs="+", default=[50, 100, 200, 400, 800, 1600, 2000])
    print("drives    poses   CPU-s  poses/s  peak MB")
    for n_drives in parser.parse_args().drives:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            poses, cpu, peak = pool.apply(measure, (n_drives,))
        print(f"{n_drives:6d} {poses:8d} {cpu:7.1f} {poses / cpu:8.0f} {peak:8.0f}", flush=True)


if __name__ == "__main__":
    main()
