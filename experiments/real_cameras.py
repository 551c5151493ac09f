"""Build graphs from real drives with real camera lanes, and compare that of a quarter of the drives with the others'.

Usage: python experiments/real_cameras.py FOLDER --aligned aligned.parquet [--picture docs/img/real-camera.png]

FOLDER holds drives.parquet of the UAH-DriveSet, and `--aligned` names what `probe2road align` made of it, its points
beside it. Prints the rows of docs/results/real-traces.md for traces alone and for aligned drives with cameras: nodes,
junctions and dead ends of the graph of all drives, and GEO F1 at 6 m of the graph of every fourth drive against that of
the others.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from probe2road import build, read_fleet
from probe2road.draw.picture import draw_graph
from probe2road.fleet.contract import Fleet
from probe2road.metrics.geo import geo


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--aligned", type=Path, required=True)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    seen = options.aligned.with_suffix(".points.parquet")
    fleets = {
        "traces alone": read_fleet(options.folder / "drives.parquet"),
        "camera, aligned": read_fleet(options.aligned, seen),
    }
    print("| built from | nodes | junctions | dead ends | km | GEO of a quarter against the others |")
    print("|---|---|---|---|---|---|")
    for name, fleet in fleets.items():
        graph = build(fleet)
        degrees = graph.degrees()
        few, others = build(part(fleet, fourth=True)), build(part(fleet, fourth=False))
        score = geo(few, others.to_crs(few.crs))
        kinds = f"{len(graph.nodes)} | {(degrees >= 3).sum()} | {(degrees == 1).sum()}"
        print(f"| {name} | {kinds} | {graph.length / 1000:.1f} | {score.f1:.3f} |", flush=True)
        if options.picture is not None and len(fleet.points):
            draw_graph(graph, options.picture)


def part(fleet: Fleet, *, fourth: bool) -> Fleet:
    """Return every fourth drive, or the others."""
    kept = fleet.ids[[(number % 4 == 0) == fourth for number in range(fleet.n_traces)]]
    traces = fleet.traces[fleet.traces["trace_id"].isin(kept)].reset_index(drop=True)
    points = fleet.points[fleet.points["trace_id"].isin(kept)].reset_index(drop=True)
    return replace(fleet, traces=traces, points=points)


if __name__ == "__main__":
    main()
