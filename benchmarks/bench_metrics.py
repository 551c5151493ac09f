"""Time the metrics on two generated street graphs, and measure what is known to be wrong with GEO and iTOPO.

python benchmarks/bench_metrics.py [--km 500]
python benchmarks/bench_metrics.py --flaws
"""

from __future__ import annotations

import argparse
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from probe2road.graph.roadgraph import RoadGraph, graph_from_lines
from probe2road.metrics import METRICS, GeoOptions, ItopoOptions, comparable, evaluate, geo

BLOCK = 100.0  # m between corners
VERTEX = 10.0  # m between vertices, as on a vectorised skeleton


def street_lines(km: float, rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Streets on a jittered raster with a tenth of the blocks' sides missing, bent, with a vertex every 10 m."""
    size = int(np.sqrt(km * 1000.0 / BLOCK / 1.7)) + 1
    corners = BLOCK * np.stack(np.meshgrid(np.arange(size), np.arange(size), indexing="ij"), axis=-1)
    corners = corners + rng.normal(0, 8.0, corners.shape)
    share = np.linspace(0.0, 1.0, int(BLOCK / VERTEX) + 1)[:, None]
    lines = []
    for i in range(size):
        for j in range(size):
            for k, m in ((i + 1, j), (i, j + 1)):
                if k < size and m < size and rng.random() < 0.9:
                    straight = corners[i, j] * (1.0 - share) + corners[k, m] * share
                    lines.append(straight + np.sin(np.pi * share) * rng.normal(0, 3.0, 2))
    return lines


def graphs(km: float, *, noise: float = 1.5, seed: int = 0) -> tuple[RoadGraph, RoadGraph]:
    """Return a proposal and its reference: the same streets, a twentieth of each side's missing, one side noisy."""
    rng = np.random.default_rng(seed)
    lines = street_lines(km, rng)
    noisy = [line + np.sin(np.pi * np.linspace(0, 1, len(line)))[:, None] * rng.normal(0, noise, 2) for line in lines]
    kept = [rng.random(len(lines)) < 0.95 for _ in range(2)]
    proposal, reference = (
        [line for line, keep in zip(side, keeps, strict=True) if keep]
        for side, keeps in zip((noisy, lines), kept, strict=True)
    )
    return graph_from_lines(proposal, crs="EPSG:32616"), graph_from_lines(reference, crs="EPSG:32616")


def print_flaws() -> None:
    """Print GEO by the phase of a straight road, iTOPO by superfluous nodes, and the readings of both metrics."""
    reference = graph_from_lines([[(0, 0), (5000, 0)]], crs="EPSG:32616")
    print("GEO F1 of a straight road, by lateral offset: lowest, highest, mean over phases; range with phases=11")
    for offset in (3.0, 4.0, 5.0, 5.9):
        moved = [
            graph_from_lines([[(-phase, offset), (5000 - phase, offset)]], crs="EPSG:32616")
            for phase in np.arange(0.0, 11.0, 0.5)
        ]
        plain = [geo(road, reference).f1 for road in moved]
        pooled = [geo(road, reference, options=GeoOptions(phases=11)).f1 for road in moved]
        numbers = (min(plain), max(plain), float(np.mean(plain)), min(pooled), max(pooled))
        print(f"{offset:>6.1f} m" + "".join(f"{number:>8.3f}" for number in numbers))

    rng = np.random.default_rng(0)
    lines = street_lines(105.0, rng)
    bare = [line for line in lines if rng.random() < 0.7]
    stubs = [part for line in bare for part in (line[:6], line[5:], np.array([line[5], line[5] + 0.7]))]
    streets = graph_from_lines(lines, crs="EPSG:32616")
    for name, proposal in (("30 % missing", bare), ("and stubs", stubs)):
        table = evaluate(
            graph_from_lines(proposal, crs="EPSG:32616"), streets, metrics=["geo", "itopo", "itopo_strict"]
        )
        print(f"\n{name}\n{table[['metric', 'precision', 'recall', 'f1']].round(3)}\n{table['details'].iloc[1]}")

    readings: list[GeoOptions | ItopoOptions] = [
        *(GeoOptions(matching=how) for how in ("greedy", "global", "optimal")),
        GeoOptions(phases=11),
        ItopoOptions(),
        ItopoOptions(centre="node"),
        ItopoOptions(average="macro"),
    ]
    table = evaluate(*graphs(500.0), metrics=list(readings))
    print(f"\nreadings\n{table[['metric', 'precision', 'recall', 'f1', 'parameters']].round(4).to_string()}")


def main() -> None:
    """Print one line for each metric, or the flaws."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--km", type=float, default=500.0)
    parser.add_argument("--flaws", action="store_true", help="measure the known flaws instead of times")
    arguments = parser.parse_args()
    if arguments.flaws:
        print_flaws()
        return
    km = arguments.km
    small = graphs(5.0)
    evaluate(*small, metrics=list(METRICS))  # compile

    proposal, reference = graphs(km)
    print(f"proposal  {proposal}\nreference {reference}\n")
    print(f"{'metric':<16}{'seconds':>9}{'P':>8}{'R':>8}{'F1':>8}")
    started = perf_counter()
    merged = comparable(proposal, reference)
    print(f"{'normalisation':<16}{perf_counter() - started:>9.2f}")
    for metric in METRICS:
        started = perf_counter()
        table = evaluate(*merged, metrics=[metric], merge=False)
        seconds = perf_counter() - started
        row = table.iloc[-1]
        print(f"{metric:<16}{seconds:>9.2f}{row['precision']:>8.3f}{row['recall']:>8.3f}{row['f1']:>8.3f}")


if __name__ == "__main__":
    main()
