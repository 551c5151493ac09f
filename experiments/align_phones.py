"""Real phones with a camera: how far do drives lie from each other across the road, before and after alignment?

    python experiments/align_phones.py FOLDER [--aligned FILE]

FOLDER holds drives.parquet and drives.points.parquet of the UAH-DriveSet: 40 drives of six cars, a fix a second,
markings of the own lane, no boundaries, on a motorway and on a road with a lane for each direction. There is no
reference; the drives are compared with each other. Every 25 m of each direction, the place at which each drive crosses
is measured from the mean of all, where five drives or more pass. Prints, for each road: the median of that distance,
the root mean square, the share beyond 1.75 m (half a lane) and beyond 5 m, and the number of crossings. Drives of the
motorway use several lanes, so that some of their spread is true; those of the other road use one.

`--aligned` measures a file that `probe2road align` wrote in place of aligning.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from probe2road.alignment.align import align
from probe2road.fleet.contract import Fleet
from probe2road.io.fleet_reader import read_fleet

ROADS = ("MOTORWAY", "SECONDARY")  # the last word of the ids
PLACE = 25.0  # m between the places along a road
REACH = 20.0  # m to either side
ANGLE = 25.0  # degrees between drives of one direction
STEP = 2.0  # m between positions of a drive
LONGEST = 150.0  # m; a longer step is a gap
LEAST = 5  # drives at a place


def driven(fleet: Fleet, road: str) -> pd.DataFrame:
    """Positions every 2 m along the drives of a road, straight between fixes, with directions in radians."""
    traces = fleet.traces
    leg = np.diff(traces[["x", "y"]].to_numpy(), axis=0)
    length = np.hypot(*leg.T)
    of_road = traces["trace_id"].str.contains(road).to_numpy()[1:]
    whole = (fleet.owner[1:] == fleet.owner[:-1]) & (length > 0) & (length < LONGEST) & of_road
    rows = np.flatnonzero(whole)
    count = np.ceil(length[rows] / STEP).astype(int)
    row = np.repeat(rows, count)
    share = (np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)) / np.repeat(count, count)
    x, y = (traces[axis].to_numpy()[row] + share * leg[row, i] for i, axis in enumerate("xy"))
    whose = traces["trace_id"].str.split("/").str[0].to_numpy()[row]
    return pd.DataFrame({"drive": whose, "x": x, "y": y, "angle": np.arctan2(leg[row, 1], leg[row, 0])})


def places(drives: pd.DataFrame) -> np.ndarray:
    """One place for each square of 25 m and eighth of the compass that was driven: x, y, angle, shape ``(p, 3)``."""
    key = [np.floor(drives["x"] / PLACE), np.floor(drives["y"] / PLACE), np.round(drives["angle"] / (np.pi / 4)) % 8]
    parts = drives.assign(east=np.cos(drives["angle"]), north=np.sin(drives["angle"])).groupby(key)
    middle = parts[["x", "y"]].median().to_numpy()
    return np.column_stack([middle, np.arctan2(parts["north"].mean(), parts["east"].mean())])


def crossings(drives: pd.DataFrame, at: np.ndarray) -> pd.DataFrame:
    """Where each drive passes each place, m to the left: columns place, drive, left."""
    tree = cKDTree(drives[["x", "y"]].to_numpy())
    near = tree.query_ball_point(at[:, :2], REACH)
    place = np.repeat(np.arange(len(at)), [len(part) for part in near])
    found = drives.iloc[np.concatenate(near).astype(int)]
    east, north, angle = (found[name].to_numpy() - at[place, i] for i, name in enumerate(("x", "y", "angle")))
    cos, sin = np.cos(at[place, 2]), np.sin(at[place, 2])
    along, left = cos * east + sin * north, cos * north - sin * east
    alike = np.abs((angle + np.pi) % (2 * np.pi) - np.pi) < np.radians(ANGLE)
    table = pd.DataFrame({"place": place, "drive": found["drive"].to_numpy(), "along": np.abs(along), "left": left})
    table = table[alike & (np.abs(along) < 1.5 * STEP)].sort_values("along", kind="stable")
    return table.drop_duplicates(["place", "drive"])


def spread(table: pd.DataFrame) -> dict[str, float]:
    """The printed figures of one road."""
    by_place = table.groupby("place")["left"]
    off = (table["left"] - by_place.transform("mean"))[by_place.transform("size") >= LEAST].abs()
    return {
        "median": float(off.median()),
        "rms": float(np.sqrt((off**2).mean())),
        "> 1.75 m": float((off > 1.75).mean()),
        "> 5 m": float((off > 5.0).mean()),
        "crossings": len(off),
    }


def main() -> None:
    """Print a line for each road, before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--aligned", type=Path)
    given = parser.parse_args()
    raw = read_fleet(given.folder / "drives.parquet", given.folder / "drives.points.parquet")
    if given.aligned:
        aligned = read_fleet(given.aligned).to_crs(raw.crs)
    else:
        result = align(raw)
        aligned = result.fleet
        print(result.report)
    rows = {}
    for road in ROADS:
        at = places(driven(raw, road))
        for label, fleet in (("before", raw), ("after", aligned)):
            rows[road, label] = spread(crossings(driven(fleet, road), at))
    print(pd.DataFrame(rows).T.round(3).to_string())


if __name__ == "__main__":
    main()
