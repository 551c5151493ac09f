"""Growth of alignment with the number of drives: time and memory.

    python benchmarks/bench_align.py --drives 25 100 500 1000 2000

Simulated drives with the errors of the preset `mixed` on one-way roads of 2 km with two lanes, 400 m apart. There is a
road for each 25 drives, so that the network grows with the fleet and every place is passed as often: the whole becomes
more tiles, not denser ones. `--roads` keeps the network as it is instead, and the density grows. Each number of drives
is measured in a process of its own, after a small run that compiles. Prints roads, tiles, poses, CPU-seconds, poses a
CPU-second, and the peak memory of the process, and of that what was there before alignment began.
"""

from __future__ import annotations

import argparse
import multiprocessing
import resource
import time
from dataclasses import astuple, dataclass

from probe2road.alignment.align import align
from probe2road.simulation.fleet_simulation import simulate
from probe2road.simulation.networks.network import network_from_sections

DRIVES_A_ROAD = 25
LENGTH, APART = 2000.0, 400.0  # m


@dataclass(frozen=True)
class Measured:
    """One line of the table."""

    roads: int
    tiles: int
    poses: int
    cpu: float  # s
    peak: float  # MB
    before: float  # MB


def measure(n_drives: int, n_roads: int) -> Measured:
    """Align so many drives on so many roads."""
    sections = [[(0.0, APART * road), (LENGTH, APART * road)] for road in range(n_roads)]
    network = network_from_sections(sections, crs="EPSG:32616", lanes_forward=2)
    align(simulate(network, n_drives=4, seed=0).fleet)
    fleet = simulate(network, n_drives=n_drives, seed=1).fleet
    before = peak_memory()
    cpu = time.process_time()
    tiles = align(fleet).report.tiles
    return Measured(n_roads, tiles, len(fleet.traces), time.process_time() - cpu, peak_memory(), before)


def peak_memory() -> float:
    """The most that this process has had so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    """Measure each number of drives and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, nargs="+", default=[25, 100, 500, 1000, 2000])
    parser.add_argument("--roads", type=int, help=f"one for each {DRIVES_A_ROAD} drives without it")
    given = parser.parse_args()
    print("drives roads tiles    poses   CPU-s  poses/s  peak MB  before MB")
    for n_drives in given.drives:
        n_roads = given.roads or -(-n_drives // DRIVES_A_ROAD)
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            roads, tiles, poses, cpu, peak, before = astuple(pool.apply(measure, (n_drives, n_roads)))
        print(
            f"{n_drives:6d} {roads:5d} {tiles:5d} {poses:8d} {cpu:7.1f} {poses / cpu:8.0f} {peak:8.0f} {before:10.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
