"""Fit the GNSS error model to the real recordings, and show the two side by side.

    python experiments/fit_gnss.py            compare the packaged parameters with the recordings
    python experiments/fit_gnss.py --fit      search for the parameters first (ten minutes on one core)

Needs the recordings (``gnss/nagoya``, ``gnss/comma2k19_i280``) under ``../shared/data``, or where PROBE2ROAD_DATA says.
Writes the table to the log and the figure to ``docs/img/gnss-errors.png``.

Strategy
--------
Simulated method of moments: the model is run at the times of the recording with fixed seeds, the same statistics are
taken of both (quantiles of the horizontal and vertical error and of its change in one second, autocorrelations of the
error and of the error clipped at 8 m), and differential evolution lowers their distance. Quantiles are compared as
logarithms, so that the median counts as much as the tail. The minute of open sky says nothing about slow changes: of it
only the fast part is fitted, after removing the mean and the part of the error that follows speed (a late clock).
"""

from __future__ import annotations

import argparse
import logging
import os
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pyproj import Transformer
from scipy.optimize import differential_evolution

from probe2road.simulation.presets import PRESETS
from probe2road.simulation.sensors.gnss import GnssModel, gnss_errors

logger = logging.getLogger("fit_gnss")

ROOT = Path(__file__).resolve().parents[1]
LAGS = (1, 2, 5, 10, 20, 40)  # s
CLIP = 8.0  # m
REPLICAS = 24  # simulated recordings a cost is averaged over
WEIGHTS = {"horizontal": 1.0, "vertical": 0.7, "step": 0.5, "autocorrelation": 2.0, "vertical autocorrelation": 1.0}
BOUNDS = {  # of the search, in the unit of each field
    "slow_sigma": (0.3, 4.0),
    "slow_time": (20.0, 300.0),
    "fast_sigma": (0.1, 3.0),
    "fast_time": (2.0, 30.0),
    "white_sigma": (0.02, 0.5),
    "burst_rate": (0.003, 0.2),
    "burst_duration": (3.0, 120.0),
    "burst_median": (2.0, 30.0),
    "burst_spread": (0.2, 1.6),
    "burst_time": (1.0, 40.0),
    "burst_white": (0.02, 0.99),
    "vertical_ratio": (0.5, 4.0),
    "burst_vertical_ratio": (0.5, 4.0),
}


@dataclass(frozen=True)
class Recording:
    """Errors of n real fixes against the reference: east, north, up (m)."""

    t: NDArray[np.float64]  # (n,) s
    error: NDArray[np.float64]  # (n, 3)
    velocity: NDArray[np.float64]  # (n, 2) true, m/s


def data_folder() -> Path:
    """Return the folder of the recordings."""
    return Path(os.environ.get("PROBE2ROAD_DATA", ROOT.parent / "shared" / "data")) / "gnss"


def read_nagoya(folder: Path) -> Recording:
    """Read the urban drive: single-point positions at up to 1 Hz against an inertial reference at 5 Hz."""
    truth = pd.read_csv(folder / "nagoya" / "reference.csv", skipinitialspace=True)
    truth.columns = truth.columns.str.strip()
    fixes = pd.read_csv(folder / "nagoya" / "rover_1Hz_spp.pos", comment="%", sep=r"\s+", header=None)
    gps = pd.to_datetime(fixes[0] + " " + fixes[1]) - pd.Timestamp("1980-01-06")
    t = gps.dt.total_seconds().to_numpy() % (7 * 86400)
    place = truth[["Longitude (deg)", "Latitude (deg)", "Ellipsoid Height (m)"]].to_numpy()
    return _recording(t, fixes[[3, 2, 4]].to_numpy(), truth["GPS TOW (s)"].to_numpy(), place)


def read_open_sky(folder: Path) -> Recording:
    """Read the motorway minute: a consumer receiver at 10 Hz against a post-processed pose at 20 Hz."""
    truth = pd.read_csv(folder / "comma2k19_i280" / "pose_20hz.csv")
    fixes = pd.read_csv(folder / "comma2k19_i280" / "ublox_10hz.csv")
    place = truth[["longitude_deg", "latitude_deg", "ellipsoid_height_m"]].to_numpy()
    measured = fixes[["longitude_deg", "latitude_deg", "altitude_m"]].to_numpy()
    return _recording(fixes["boot_time_s"].to_numpy(), measured, truth["boot_time_s"].to_numpy(), place)


def _recording(
    t: NDArray[np.float64], measured: NDArray[np.float64], truth_t: NDArray[np.float64], truth: NDArray[np.float64]
) -> Recording:
    """Subtract the reference, interpolated in time, in a local east-north-up frame."""
    local = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={truth[0, 0]} +lat_0={truth[0, 1]} +h_0={truth[0, 2]}"
    )
    fixes, track = (np.stack(local.transform(*place.T), axis=1) for place in (measured, truth))
    at = np.stack([np.interp(t, truth_t, track[:, axis]) for axis in range(3)], axis=1)
    return Recording(t, fixes - at, np.gradient(at[:, :2], t, axis=0))


def without_latency(recording: Recording) -> tuple[Recording, float]:
    """Remove the mean, and the error in proportion to velocity that a late time stamp leaves; also return it (s)."""
    velocity = recording.velocity - recording.velocity.mean(axis=0)
    plan = recording.error[:, :2] - recording.error[:, :2].mean(axis=0)
    delay = float((plan * velocity).sum() / (velocity**2).sum())
    error = recording.error - recording.error.mean(axis=0)
    error[:, :2] = plan - delay * velocity
    return replace(recording, error=error), -delay


def autocorrelation(t: NDArray[np.float64], error: NDArray[np.float64], lags: tuple[int, ...]) -> NDArray[np.float64]:
    """Autocorrelation of an error vector ``(n, k)`` at uneven times: mean dot product over mean square."""
    centred = error - error.mean(axis=0)
    power = float((centred**2).sum()) / len(centred)
    values = []
    for lag in lags:
        partner = np.minimum(np.searchsorted(t, t + lag - 0.3), len(t) - 1)
        paired = np.abs(t[partner] - t - lag) <= 0.3
        values.append((centred[paired] * centred[partner[paired]]).sum(axis=1).mean() / power)
    return np.array(values)


def moments(t: NDArray[np.float64], error: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the statistics that the fit compares: quantiles as logarithms, then autocorrelations."""
    plan, height = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
    second = np.abs(np.diff(t) - 1.0) < 0.3
    step = np.hypot(*np.diff(error[:, :2], axis=0)[second].T)
    clipped = np.clip(error[:, :2], -CLIP, CLIP)
    return {
        "horizontal": np.log(np.percentile(plan, [25, 50, 75, 90, 95, 99])),
        "vertical": np.log(np.percentile(height, [50, 75, 90, 95])),
        "step": np.log(np.percentile(step, [50, 75, 90, 95])),
        "autocorrelation": np.concatenate([autocorrelation(t, e, LAGS) for e in (error[:, :2], clipped)]),
        "vertical autocorrelation": autocorrelation(t, error[:, 2:], (1, 5, 20)),
    }


def simulated_moments(model: GnssModel, t: NDArray[np.float64], seeds: range) -> dict[str, NDArray[np.float64]]:
    """Median of the statistics over simulated recordings."""
    runs = [moments(t, gnss_errors(t, model, rng=np.random.default_rng(seed)).error) for seed in seeds]
    return {name: np.median([run[name] for run in runs], axis=0) for name in WEIGHTS}


def fit_urban(recording: Recording) -> GnssModel:
    """Search for the parameters that match the urban recording."""
    target = moments(recording.t, recording.error)
    names = [entry.name for entry in fields(GnssModel)]

    def cost(logarithms: NDArray[np.float64]) -> float:
        model = GnssModel(*np.exp(logarithms))
        found = simulated_moments(model, recording.t, range(REPLICAS))
        return sum(WEIGHTS[name] ** 2 * float(((found[name] - target[name]) ** 2).sum()) for name in WEIGHTS)

    bounds = [tuple(np.log(BOUNDS[name])) for name in names]
    result = differential_evolution(cost, bounds, maxiter=90, popsize=10, seed=1, polish=False, init="sobol")
    logger.info("cost %.3f after %d evaluations", result.fun, result.nfev)
    return GnssModel(*(float(f"{value:.3g}") for value in np.exp(result.x)))


def urban_table(recording: Recording, model: GnssModel) -> pd.DataFrame:
    """Compare the urban recording with many simulated ones: median, and the range of nine in ten."""

    def row(t: NDArray[np.float64], error: NDArray[np.float64]) -> dict[str, float]:
        plan, height = np.hypot(error[:, 0], error[:, 1]), np.abs(error[:, 2])
        values = {f"horizontal p{q}, m": np.percentile(plan, q) for q in (50, 75, 90, 95, 99)}
        values |= {f"vertical p{q}, m": np.percentile(height, q) for q in (50, 95)}
        for lag, value in zip((1, 5, 20), autocorrelation(t, error[:, :2], (1, 5, 20)), strict=True):
            values[f"autocorrelation at {lag} s"] = value
        for lag, value in zip((1, 5, 20), autocorrelation(t, error[:, 2:], (1, 5, 20)), strict=True):
            values[f"vertical autocorrelation at {lag} s"] = value
        return values

    rng = range(1000, 1200)
    runs = pd.DataFrame(
        [row(recording.t, gnss_errors(recording.t, model, rng=np.random.default_rng(seed)).error) for seed in rng]
    )
    table = pd.DataFrame({"real": row(recording.t, recording.error), "simulated": runs.median()})
    return table.assign(low=runs.quantile(0.05), high=runs.quantile(0.95)).round(2)


def open_sky_table(recording: Recording, model: GnssModel) -> pd.DataFrame:
    """Compare the motorway minute with simulated minutes, both after removing their means."""
    steady, delay = without_latency(recording)
    logger.info("open sky: error in proportion to velocity, as of a time stamp %.3f s late, removed", delay)

    def row(t: NDArray[np.float64], error: NDArray[np.float64]) -> dict[str, float]:
        centred = error - error.mean(axis=0)
        values = {
            "mean horizontal error, m": float(np.hypot(*error[:, :2].T).mean()),
            "horizontal p95 about the mean, m": np.percentile(np.hypot(*centred[:, :2].T), 95),
            "vertical deviation about the mean, m": centred[:, 2].std(),
        }
        for lag, value in zip((1, 5, 20), autocorrelation(t, centred[:, :2], (1, 5, 20)), strict=True):
            values[f"autocorrelation at {lag} s"] = value
        return values

    calm = replace(model, burst_rate=0.0)
    runs = pd.DataFrame(
        [
            row(recording.t, gnss_errors(recording.t, calm, rng=np.random.default_rng(seed)).error)
            for seed in range(1000, 1200)
        ]
    )
    real = row(recording.t, steady.error)
    real["mean horizontal error, m"] = float(np.hypot(*recording.error[:, :2].T).mean())
    table = pd.DataFrame({"real": real, "simulated": runs.median()})
    return table.assign(low=runs.quantile(0.05), high=runs.quantile(0.95)).round(2)


def draw(recording: Recording, model: GnssModel, path: Path) -> None:
    """Plot distributions and autocorrelations, real against simulated."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    runs = [gnss_errors(recording.t, model, rng=np.random.default_rng(seed)).error for seed in range(1000, 1050)]
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
    share = np.linspace(0, 1, len(recording.t))
    for axis, title, columns in ((axes[0], "horizontal error", [0, 1]), (axes[1], "vertical error", [2])):
        for run in runs:
            axis.plot(np.sort(np.linalg.norm(run[:, columns], axis=1)), share, color="tab:orange", alpha=0.15, lw=0.8)
        axis.plot(np.sort(np.linalg.norm(recording.error[:, columns], axis=1)), share, color="black", lw=1.6)
        axis.set(xscale="log", xlim=(0.2, 200), xlabel=f"{title}, m", ylabel="share of fixes")
        axis.grid(alpha=0.3)
    lags = tuple(range(1, 61))
    for run in runs:
        axes[2].plot(lags, autocorrelation(recording.t, run[:, :2], lags), color="tab:orange", alpha=0.15, lw=0.8)
    axes[2].plot(lags, autocorrelation(recording.t, recording.error[:, :2], lags), color="black", lw=1.6)
    axes[2].set(xlabel="lag, s", ylabel="autocorrelation, horizontal", ylim=(-0.5, 1))
    axes[2].grid(alpha=0.3)
    figure.suptitle("Nagoya: real (black) and 50 simulated recordings (orange)")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main() -> None:
    """Run the comparison, after the fit if asked."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--fit", action="store_true", help="search for the parameters first")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "img" / "gnss-errors.png")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    folder = data_folder()
    if not folder.is_dir():
        parser.exit(2, f"{folder}: no recordings; set PROBE2ROAD_DATA to the folder that holds gnss/\n")
    urban, sky = read_nagoya(folder), read_open_sky(folder)
    model = fit_urban(urban) if options.fit else PRESETS["phone"].gnss
    logger.info("%s", model)
    logger.info("Nagoya, %d fixes\n%s", len(urban.t), urban_table(urban, model).to_string())
    logger.info("I-280, %d fixes\n%s", len(sky.t), open_sky_table(sky, PRESETS["open_sky"].gnss).to_string())
    draw(urban, model, options.figure)
    logger.info("wrote %s", options.figure)


if __name__ == "__main__":
    main()
