"""A straight road with known markings, and vehicles that see it with known errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe2road.fleet.contract import Fleet, fleet_from_tables
from sketches import UTM

ORIGIN = np.array([446_000.0, 4_636_000.0])
MARKINGS, BOUNDARIES = (-3.6, 0.0, 3.6), (-5.6, 5.6)  # m to the left of the middle of a road with two lanes
Drive = tuple[pd.DataFrame, pd.DataFrame]  # traces, points
SPEED, STEP = 10.0, 5.0  # m/s, m between fixes


def drive(
    number: int,
    rng: np.random.Generator,
    *,
    lane: float = -1.8,
    bias: Sequence[float] = (0.0, 0.0, 0.0),
    length: float = 450.0,
    level: float = 0.0,
    sees: bool = True,
    markings: Sequence[float] = MARKINGS,
    boundaries: Sequence[float] = BOUNDARIES,
    turn: float = 0.0,
) -> Drive:
    """Tables of a drive along a straight road, which leads east, or elsewhere after a turn (radians) of everything."""
    ahead = np.arange(0.0, length, STEP)
    n = len(ahead)
    t = pd.Timestamp("2024-03-04", tz="UTC") + pd.to_timedelta(ahead / SPEED + 1000.0 * number, unit="s")
    body = np.column_stack([ahead, np.full(n, lane)])
    rows = np.repeat(np.arange(n), 8)
    lines = rng.choice([*markings, *boundaries], len(rows))
    rows, lines = (part[np.abs(lines - lane) < 6.0] for part in (rows, lines))
    seen = np.column_stack([ahead[rows] + rng.uniform(5.0, 25.0, len(rows)), lines + rng.normal(0.0, 0.08, len(rows))])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    place = [ORIGIN + part @ rotation.T + np.asarray(bias)[:2] for part in (body, seen)]
    traces = pd.DataFrame(
        {"trace_id": number, "t": t, "x": place[0][:, 0], "y": place[0][:, 1], "z": level + bias[2]}
        | {"heading": 90.0 - np.degrees(turn), "speed": SPEED, "accuracy": 1.5}
    )
    kind = np.where(np.isin(lines, boundaries), "road_boundary", "lane_marking")
    points = pd.DataFrame(
        {"trace_id": number, "t": t[rows], "x": place[1][:, 0], "y": place[1][:, 1], "z": level + bias[2], "kind": kind}
    )
    return traces, points if sees else points.iloc[:0]


def fleet_of(drives: Sequence[Drive]) -> Fleet:
    """One fleet of all drives."""
    traces, points = (pd.concat(tables, ignore_index=True) for tables in zip(*drives, strict=True))
    return fleet_from_tables(traces, points if len(points) else None, crs=UTM)


@dataclass(frozen=True)
class Road:
    """What tests need to make fleets on the road, and to measure them."""

    origin: np.ndarray
    drive: Callable[..., Drive]
    fleet: Callable[[Sequence[Drive]], Fleet]

    def biased(self, lanes: Sequence[float], *, sigma: float = 1.0, seed: int = 1, **kept: Any) -> Fleet:
        """Drives in given lanes, each with a bias of its own."""
        rng = np.random.default_rng(seed)
        biases = sigma * rng.standard_normal((len(lanes), 3))
        return fleet_of([drive(k, rng, lane=lane, bias=biases[k], **kept) for k, lane in enumerate(lanes)])

    def lateral(self, fleet: Fleet, lanes: Sequence[float]) -> np.ndarray:
        """Median error of each drive to the left of the road, m."""
        y = fleet.traces.groupby("trace_id")["y"].median().to_numpy()
        return y - self.origin[1] - np.asarray(lanes)


@pytest.fixture(scope="session")
def road() -> Road:
    return Road(ORIGIN, drive, fleet_of)
