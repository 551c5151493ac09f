"""Do labels from map matching agree with the true drive counts, and do two matchers agree with each other?

Usage: python experiments/labels_agreement.py [--data ../shared/data] [--osrm FOLDER] [--only NAME]

A simulated fleet is matched to the reference centrelines, without heights, as manual labels have none, and those pieces
are kept that at least 4 traces drive: by our matcher, and by OSRM. Lengths kept are compared with those that at least 4
drives truly passed. The tables of docs/results/labels.md are the output; about 5 minutes on one core.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.errors import MissingExtraError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.labels import LabelOptions, cut_reference, label
from probe2road.matching.osrm import find_osrm
from probe2road.simulation.drawn.generate import generate_interchange
from probe2road.simulation.fleet_simulation import SimulatedFleet, simulate
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.networks.osm import read_network

# Drives: few enough that many roads are driven about four times, where the count decides.
DRIVES: Mapping[str, int] = {"cloverleaf": 25, "tokyo_shibuya": 120}
PRESETS = ("mixed", "phone")
MIN_TRACES = 4


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    default = os.environ.get("PROBE2ROAD_DATA", str(Path(__file__).parents[2] / "shared" / "data"))
    parser.add_argument("--data", type=Path, default=Path(default))
    parser.add_argument("--osrm", type=Path, help="folder of OSRM, if not where find_osrm looks")
    parser.add_argument("--only", choices=DRIVES)
    parser.add_argument("--seed", type=int, default=5)
    arguments = parser.parse_args()
    try:
        find_osrm(arguments.osrm)
        matchers: tuple[str, ...] = ("own", "osrm")
    except MissingExtraError as error:
        print(f"{error}\n")
        matchers = ("own",)
    print("| network | preset | one-way known | labels | against | km | precision | recall | count off by | s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in [arguments.only] if arguments.only else DRIVES:
        network = network_of(name, arguments.data, arguments.seed)
        if network is None:
            continue
        for preset in PRESETS:
            result = simulate(network, preset=preset, n_drives=DRIVES[name], seed=arguments.seed)
            for directed in (True, False):
                compare(
                    f"{name} | {preset} | {'yes' if directed else 'no'}", result, directed, matchers, arguments.osrm
                )


def network_of(name: str, data: Path, seed: int) -> RoadNetwork | None:
    """Draw or read a network; None where its file is absent."""
    if name == "cloverleaf":
        return generate_interchange(name, rng=np.random.default_rng(seed))
    path = data / "osm" / f"{name}.osm.pbf"
    return read_network(path) if path.is_file() else None


def compare(title: str, result: SimulatedFleet, directed: bool, matchers: tuple[str, ...], folder: Path | None) -> None:
    """Print the rows of one fleet."""
    reference = in_plan(result.reference, directed)
    pieces = cut_reference(reference)
    truth = result.reference.edges["support"].loc[pieces.edges["reference_edge"]].to_numpy(np.int64)
    counts, seconds = {"truth": truth}, {}
    for matcher in matchers:
        options = LabelOptions(min_traces=0, matcher=matcher, osrm_folder=folder)
        start = perf_counter()
        labelled = label(reference, result.fleet, options=options)
        seconds[matcher] = perf_counter() - start
        counts[matcher] = labelled.edges["support"].reindex(pieces.edges.index).to_numpy(np.int64)
    length = pieces.edges["length"].to_numpy()
    pairs = [(matcher, "truth") for matcher in matchers] + [("own", "osrm")] * (len(matchers) == 2)
    for one, other in pairs:
        kept, wanted = counts[one] >= MIN_TRACES, counts[other] >= MIN_TRACES
        both = length[kept & wanted].sum()
        off = float(np.abs(counts[one] - counts[other]).mean())
        cells = f"{length[kept].sum() / 1000:.1f} | {share(both, length[kept]):.4f} | {share(both, length[wanted]):.4f}"
        spent = f"{seconds[one]:.1f}" if other == "truth" else ""
        print(f"| {title} | {one} | {other} | {cells} | {off:.3f} | {spent} |", flush=True)


def share(both: float, length: NDArray[np.float64]) -> float:
    """Length in common as a share of the length of one side."""
    return float(both / length.sum()) if len(length) else float("nan")


def in_plan(reference: RoadGraph, directed: bool) -> RoadGraph:
    """Take heights and counts out of a reference, and one-way flags if so wished."""
    edges = reference.edges.set_geometry(shapely.force_2d(reference.edges.geometry.to_numpy()), crs=reference.crs)
    edges = edges.assign(
        **{name: pd.array([pd.NA] * len(edges), "Int64") for name in ("support", "forward", "backward")}
    )
    nodes = reference.nodes.set_geometry(shapely.force_2d(reference.nodes.geometry.to_numpy()), crs=reference.crs)
    return replace(reference, nodes=nodes, edges=edges if directed else edges.drop(columns="oneway"))


if __name__ == "__main__":
    main()
