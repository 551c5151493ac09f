"""GEO and iTOPO of the graphs built from raw, from aligned and from true poses of a data set.

    python experiments/alignment_graphs.py sets/boston --aligned boston.parquet --workspaces work

Each version of the fleet is built with the default options of `probe2road.build` and scored against the roads that at
least four drives passed. "true" is the raw fleet moved to its true poses, its points moved rigidly with them: what
alignment could give at best, with the errors that the camera has of its own. "modelled" is the model of one in the set,
true poses with the residual errors of `probe2road.benchmark.sets.residual`. Prints one line of a Markdown table for
each.
"""

from __future__ import annotations

import argparse
import logging
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq

from probe2road import build, evaluate, read_graph
from probe2road.alignment.tiling import moved_fleet
from probe2road.benchmark.sets.prepare import check_dataset
from probe2road.benchmark.sets.recording import Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.fleet.contract import Fleet
from probe2road.io.fleet_reader import read_fleet_files

METRICS = ("geo", "itopo")


def at_true_poses(fleet: Fleet, poses: Path) -> Fleet:
    """A raw fleet moved to where its vehicles were."""
    table = pq.read_table(poses)
    ids = fleet.traces["trace_id"].to_numpy()
    if not np.array_equal(table.column("trace_id").to_numpy(), ids):
        raise SystemExit(f"{poses} does not hold the poses of the fleet, row by row")
    place = table.column("geometry").combine_chunks()
    shift = np.zeros((len(ids), 4))
    for column, axis in ((0, "x"), (1, "y"), (3, "z")):
        shift[:, column] = place.field(axis).to_numpy(zero_copy_only=False) - fleet.traces[axis].to_numpy()
    # Headings count clockwise, directions counter-clockwise.
    shift[:, 2] = np.radians(fleet.traces["heading"].to_numpy() - table.column("heading").to_numpy())
    return moved_fleet(fleet, shift)


def versions(recording: Recording, aligned: Path | None) -> Iterator[tuple[str, Fleet]]:
    """The fleets to build from, one at a time."""
    yield "raw", read_fleet_files(recording.drives)
    if aligned:
        yield "aligned", read_fleet_files(aligned)
    yield "modelled", read_fleet_files(recording.modelled)
    yield "true", at_true_poses(read_fleet_files(recording.drives), recording.poses)


def main() -> None:
    """Build and score every version."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="a prepared data set")
    parser.add_argument("--aligned", type=Path, help="what `probe2road align` made of its drives")
    parser.add_argument("--workspaces", type=Path, required=True, help="folder that keeps the stages of each build")
    given = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    check_dataset(given.folder)
    recording = Recording(given.folder)
    reference = labelled_reference(read_graph(recording.reference))
    print("| poses | GEO F1/P/R | iTOPO F1/P/R | km | s |")
    print(f"|{'---|' * 5}")
    given.workspaces.mkdir(parents=True, exist_ok=True)
    for name, fleet in versions(recording, given.aligned):
        started = time.perf_counter()
        graph = build(fleet, workspace=given.workspaces / f"{given.folder.name}-{name}")
        seconds = time.perf_counter() - started
        plain = replace(graph, turns=graph.turns.iloc[:0])
        scores: pd.DataFrame = evaluate(plain, reference, metrics=METRICS).set_index("metric")
        cells = [
            "/".join(f"{scores.loc[metric, part]:.3f}" for part in ("f1", "precision", "recall")) for metric in METRICS
        ]
        print(f"| {name} | {' | '.join(cells)} | {graph.length / 1000:.0f} | {seconds:.0f} |", flush=True)


if __name__ == "__main__":
    main()
