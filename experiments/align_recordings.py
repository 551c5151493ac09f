"""Alignment of single real drives: is the aligned pose nearer to the reference than the receiver's?

    python experiments/align_recordings.py --data ../shared/data/gnss

Nagoya: a single-point GNSS solution at 1 Hz among tall buildings, with a reference at 5 Hz. I-280: a consumer receiver
at 10 Hz on a motorway, one minute. One drive has nobody to agree with, so this measures what smoothing with odometry
alone gives. Odometry is heading and speed of the recording: in Nagoya those of the reference, because the receiver's
file has none; on I-280 the receiver's own. Both count from true north and are turned to the north of the projection,
which differs by 1.1 degrees in Nagoya and by 0.3 on I-280.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from probe2road.alignment.align import align
from probe2road.crs import WGS84, transform
from probe2road.fleet.contract import Fleet, fleet_from_tables

GPS_EPOCH = pd.Timestamp("1980-01-06", tz="UTC")


def nagoya(folder: Path) -> tuple[Fleet, np.ndarray, np.ndarray]:
    """The drive, and the reference: seconds (n,) and x, y in the CRS of the drive (n, 2)."""
    reference = pd.read_csv(folder / "reference.csv", skipinitialspace=True)
    reference.columns = [name.split(" (")[0] for name in reference.columns]
    rover = pd.read_csv(folder / "rover_1Hz_spp.pos", comment="%", sep=r"\s+", header=None)
    seconds = _tow(rover)
    at = reference["GPS TOW"].to_numpy()
    speed = np.hypot(reference["East Velocity"], reference["North Velocity"])
    heading = np.degrees(np.unwrap(np.radians(reference["Heading"])))
    week = float(reference["GPS Week"].iloc[0]) * 604800.0
    table = pd.DataFrame(
        {"trace_id": 1, "t": GPS_EPOCH + pd.to_timedelta(week + seconds, unit="s"), "x": rover[3], "y": rover[2]}
        | {"z": rover[4], "speed": np.interp(seconds, at, speed), "heading": np.interp(seconds, at, heading) % 360.0}
        | {"accuracy": np.hypot(rover[7], rover[8]) / np.sqrt(2.0)}
    )
    fleet = fleet_from_tables(table, crs="EPSG:4326")
    x, y = transform(reference["Longitude"].to_numpy(), reference["Latitude"].to_numpy(), WGS84, fleet.crs)
    return fleet, week + at, np.column_stack([x, y])


def i280(folder: Path) -> tuple[Fleet, np.ndarray, np.ndarray]:
    """As `nagoya`."""
    reference = pd.read_csv(folder / "pose_20hz.csv")
    rover = pd.read_csv(folder / "ublox_10hz.csv").drop_duplicates("boot_time_s")
    seconds = rover["boot_time_s"].to_numpy()
    table = pd.DataFrame(
        {"trace_id": 1, "t": GPS_EPOCH + pd.to_timedelta(seconds, unit="s")}
        | {"x": rover["longitude_deg"], "y": rover["latitude_deg"], "z": rover["altitude_m"]}
        | {"speed": rover["speed_m_s"], "heading": rover["bearing_deg"], "accuracy": 1.5}
    )
    fleet = fleet_from_tables(table, crs="EPSG:4326")
    longitude, latitude = reference["longitude_deg"].to_numpy(), reference["latitude_deg"].to_numpy()
    x, y = transform(longitude, latitude, WGS84, fleet.crs)
    return fleet, reference["boot_time_s"].to_numpy(), np.column_stack([x, y])


def _tow(rover: pd.DataFrame) -> np.ndarray:
    """Seconds of the GPS week from the date and time of an RTKLIB solution."""
    t = pd.to_datetime(rover[0] + " " + rover[1], utc=True)
    return ((t - GPS_EPOCH).dt.total_seconds() % 604800.0).to_numpy()


def distances(fleet: Fleet, seconds: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Horizontal distance of every fix that the reference covers, m."""
    at = ((fleet.traces["t"] - GPS_EPOCH).dt.total_seconds()).to_numpy()
    covered = (at >= seconds[0]) & (at <= seconds[-1])
    x, y = (np.interp(at, seconds, reference[:, axis]) for axis in (0, 1))
    return np.hypot(fleet.traces["x"] - x, fleet.traces["y"] - y).to_numpy()[covered]


def main() -> None:
    """Print the error of both recordings before and after."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/gnss"))
    data = parser.parse_args().data
    for name, read, folder in (("Nagoya", nagoya, "nagoya"), ("I-280", i280, "comma2k19_i280")):
        fleet, seconds, reference = read(data / folder)
        result = align(fleet)
        status = result.report.drives.iloc[0]
        print(f"{name}: {len(fleet.traces)} fixes, {status['status']} {status['reason']}")
        for label, part in (("before", fleet), ("after", result.fleet)):
            error = distances(part, seconds, reference)
            p50, p95 = np.percentile(error, [50, 95])
            print(
                f"  {label:6s} mean {error.mean():6.2f}  rms {np.sqrt((error**2).mean()):6.2f}  p50 {p50:6.2f}", end=""
            )
            print(f"  p95 {p95:6.2f}  max {error.max():6.2f} m")


if __name__ == "__main__":
    main()
