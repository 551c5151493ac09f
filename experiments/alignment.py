"""What alignment does to simulated raw fleets, measured against their true poses.

    python experiments/alignment.py sets/columbus --area 327000 4424000 329000 4425500 --every 4
    python experiments/alignment.py --simulate open_sky --area 327000 4424000 329000 4425500 --km 120
    python experiments/alignment.py sets/boston --aligned sets/boston/aligned.parquet sets/boston/modelled.parquet

The first form aligns a part of a prepared data set, the second one drives the Columbus network in that area anew and
aligns that, and the third one scores files that `probe2road align` wrote, or the modelled data of the set, as a whole.
Prints, before and after: the error of trajectories (root mean square, m), the median lateral error, the same where 15
drives or more pass, the median error along, the robust standard deviation between the drives at a place (25 m of one
road) of the lateral, the longitudinal and the vertical error, the share of drives of which more than half is nearer to
the neighbouring lane than to its own, as the others see it, and the share of all poses that are; then the share of
poses at places where all drives together, in the median, are off by more than half a lane, or by more than 2.5 m in
height. The last two columns count what the shares are of: drives that five or more pass with somewhere, and their poses
there. `--picture` draws the busiest place.
"""

from __future__ import annotations

import argparse
import logging
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import shapely

from probe2road.alignment.align import align
from probe2road.alignment.report import draw_alignment
from probe2road.benchmark.sets.datasets import find_dataset, load_network
from probe2road.benchmark.sets.recording import Recording
from probe2road.fleet.contract import Fleet
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.fleet_writer import points_path
from probe2road.simulation.fleet_simulation import simulate

HALF_LANE = 1.75  # m
HALF_DECK = 2.5  # m
PLACE = 25.0  # m
FEW, MANY = 5, 15  # drives at a place


def recorded(folder: Path, area: tuple[float, float, float, float], every: int) -> tuple[Fleet, pd.DataFrame]:
    """Every n-th drive of a data set within an area, and its true poses, row by row."""
    recording = Recording(folder)
    fleet = read_fleet(recording.drives, points_path(recording.drives), bbox=area)
    keep = [table["trace_id"] % every == 0 for table in (fleet.traces, fleet.points)]
    traces, points = fleet.traces[keep[0]].reset_index(drop=True), fleet.points[keep[1]].reset_index(drop=True)
    truth = true_poses(recording, [("trace_id", "in", traces["trace_id"].unique().tolist())])
    return Fleet(traces, points, fleet.crs), traces[["trace_id", "t"]].merge(truth, on=["trace_id", "t"], how="left")


def true_poses(recording: Recording, filters: list[tuple[str, str, list[int]]] | None = None) -> pd.DataFrame:
    """True poses of a data set, with `x`, `y` and `z` for their geometry."""
    table = pq.read_table(recording.poses, filters=filters)
    place = table.column("geometry").combine_chunks()
    axes = {axis: place.field(axis).to_numpy(zero_copy_only=False) for axis in "xyz"}
    return table.drop_columns(["geometry"]).to_pandas().assign(**axes)


def simulated(
    preset: str, area: tuple[float, float, float, float], km: float, data: Path
) -> tuple[Fleet, pd.DataFrame]:
    """Drives of a preset on the part of the Columbus network that lies in an area, and their true poses."""
    definition = find_dataset(f"columbus-{preset}")
    network = load_network(definition, data)
    inside = network.sections.geometry.intersects(shapely.box(*area))
    sections = network.sections[inside]
    turns = network.restrictions
    kept = turns["from_section"].isin(sections.index) & turns["to_section"].isin(sections.index)
    nodes = network.nodes.loc[sorted({*sections["u"], *sections["v"]})]
    part = replace(network, sections=sections, nodes=nodes, restrictions=turns[kept])
    made = simulate(part, preset=definition.fleet, drive_km=km, seed=5)
    return made.fleet, made.poses


def errors(fleet: Fleet, truth: pd.DataFrame) -> pd.DataFrame:
    """Errors of every fix in the frame of the true pose, and its place."""
    theta = np.pi / 2.0 - np.radians(truth["heading"].to_numpy())
    east, north, up = (fleet.traces[axis].to_numpy() - truth[axis].to_numpy() for axis in "xyz")
    return pd.DataFrame(
        {
            "drive": fleet.traces["trace_id"],
            "left": np.cos(theta) * north - np.sin(theta) * east,
            "ahead": np.cos(theta) * east + np.sin(theta) * north,
            "up": up,
            "section": truth["section"],
            "quarter": np.round(theta / (np.pi / 2.0)),
            "column": truth["x"] // PLACE,
            "row": truth["y"] // PLACE,
        }
    )


def figures(table: pd.DataFrame) -> dict[str, float]:
    """One line of the printed table."""
    places = table.groupby(["section", "quarter", "column", "row"])
    drives = places["drive"].transform("nunique")
    shared = drives >= FEW
    middle = places[["left", "ahead", "up"]].transform("median")[shared]
    between = {name: table[name][shared] - middle[name] for name in middle}
    off = between["left"].abs() > HALF_LANE
    drives_off = off.groupby(table["drive"][shared]).mean() > 0.5
    busy = table["left"][drives >= MANY].abs()
    return {
        "ATE": float(np.sqrt((table["left"] ** 2 + table["ahead"] ** 2).mean())),
        "lateral": float(table["left"].abs().median()),
        f"lateral, {MANY}+": float(busy.median()),
        "along": float(table["ahead"].abs().median()),
        **{f"spread {name}": 1.4826 * float(values.abs().median()) for name, values in between.items()},
        "drives off": float(drives_off.mean()),
        "poses off": float(off.mean()),
        "places off": float((middle["left"].abs() > HALF_LANE).mean()),
        "places up": float((middle["up"].abs() > HALF_DECK).mean()),
        "of drives": len(drives_off),
        "of poses": len(off),
    }


def score_files(folder: Path, paths: list[Path]) -> pd.DataFrame:
    """The table for the raw data of a set and for aligned files of it, none of which is in memory with another."""
    recording = Recording(folder)
    truth = true_poses(recording)
    columns = {}
    for path in (recording.drives, *paths):
        fleet = read_fleet(path)
        if not fleet.traces[["trace_id", "t"]].equals(truth[["trace_id", "t"]]):
            raise SystemExit(f"{path} does not hold the fixes of {folder}, row by row")
        columns[str(path)] = figures(errors(fleet, truth))
    return pd.DataFrame(columns)


def align_and_score(fleet: Fleet, truth: pd.DataFrame, picture: Path | None) -> pd.DataFrame:
    """Align a fleet; the table before and after."""
    cpu = time.process_time()
    result = align(fleet)
    cpu = time.process_time() - cpu
    print(f"{fleet.n_traces} drives, {len(fleet.traces)} poses, {len(fleet.points)} points; {cpu:.1f} CPU-s")
    print(result.report.summary)
    if picture:
        draw_alignment(fleet, result.fleet, picture)
    return pd.DataFrame({"before": figures(errors(fleet, truth)), "after": figures(errors(result.fleet, truth))})


def main() -> None:
    """Print the table of one fleet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="a prepared data set")
    parser.add_argument("--aligned", type=Path, nargs="+", help="files to score")
    parser.add_argument("--simulate", dest="preset")
    parser.add_argument("--area", type=float, nargs=4, help="what to align: left bottom right top")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--km", type=float, default=120.0)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/osm"))
    parser.add_argument("--picture", type=Path)
    given = parser.parse_args()
    if (given.folder is None) == (given.preset is None) or (given.area is None) == (given.aligned is None):
        parser.error("give a data set or --simulate, and --area, or for a data set --aligned")
    logging.basicConfig(format="%(message)s")
    if given.aligned:
        table = score_files(given.folder, given.aligned)
    elif given.preset:
        table = align_and_score(*simulated(given.preset, tuple(given.area), given.km, given.data), given.picture)
    else:
        table = align_and_score(*recorded(given.folder, tuple(given.area), given.every), given.picture)
    with pd.option_context("display.width", 200, "display.max_columns", None):
        print(table.T.round(4).to_string())


if __name__ == "__main__":
    main()
