"""Properties of alignment on small random fleets: what it must not depend on, and what it must leave alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from random import Random

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe2road.alignment.align import add_drives, align
from probe2road.fleet.contract import Fleet, fleet_from_tables

pytest.importorskip("gtsam", reason="alignment needs the extra 'align'")

CENTRE = np.array([446_000.0, 4_636_000.0])
LINES = {"lane_marking": (-3.6, 0.0, 3.6), "road_boundary": (-5.6, 5.6)}  # m to the left of a straight road
# Peaks, gates and bins decide by yes or no, so rounding in the last digit can move a few drives by centimetres.
CENTIMETRES = 0.2  # m
FEW = settings(max_examples=6, deadline=None, derandomize=True)


def straight_fleet(seed: int, n_drives: int, sigma: float, length: float = 240.0) -> Fleet:
    """Drives in one lane of a straight road through the centre, each a little off in its own way."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    ahead = np.arange(0.0, length, 5.0)
    traces, points = [], []
    for drive in range(n_drives):
        lane, bias = -1.8, sigma * rng.standard_normal(3)
        t = pd.Timestamp("2024-03-04", tz="UTC") + pd.to_timedelta(ahead / 10.0 + 1000.0 * drive, unit="s")
        x, y = placed(ahead - length / 2.0, np.full(len(ahead), lane), angle)
        traces.append(
            pd.DataFrame({"trace_id": drive, "t": t, "x": x + bias[0], "y": y + bias[1], "z": bias[2]})
            .assign(heading=(90.0 - np.degrees(angle)) % 360.0, speed=10.0, accuracy=1.5)
        )  # fmt: skip
        for kind, offsets in LINES.items():
            row = np.repeat(np.arange(len(ahead)), 3)
            left = rng.choice(offsets, len(row)) + 0.08 * rng.standard_normal(len(row))
            x, y = placed(ahead[row] - length / 2.0 + rng.uniform(5.0, 25.0, len(row)), left, angle)
            seen = {"trace_id": drive, "t": t[row], "x": x + bias[0], "y": y + bias[1], "z": bias[2], "kind": kind}
            points.append(pd.DataFrame(seen))
    return fleet_from_tables(pd.concat(traces), pd.concat(points), crs="EPSG:32616")


def placed(ahead: np.ndarray, left: np.ndarray, angle: float) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates of places along and to the left of a road through the centre."""
    cos, sin = np.cos(angle), np.sin(angle)
    return CENTRE[0] + cos * ahead - sin * left, CENTRE[1] + sin * ahead + cos * left


def turned(fleet: Fleet, angle: float, away: tuple[float, float]) -> Fleet:
    """The same fleet turned about the centre (radians counter-clockwise) and moved (m)."""
    cos, sin = np.cos(angle), np.sin(angle)
    tables = []
    for table in (fleet.traces, fleet.points):
        east, north = table["x"] - CENTRE[0], table["y"] - CENTRE[1]
        x, y = CENTRE[0] + away[0] + cos * east - sin * north, CENTRE[1] + away[1] + sin * east + cos * north
        tables.append(table.assign(x=x, y=y))
    heading = (fleet.traces["heading"] - np.degrees(angle)) % 360.0
    return replace(fleet, traces=tables[0].assign(heading=heading), points=tables[1])


def apart(one: Fleet, other: Fleet) -> float:
    """The largest distance between poses of the same rows, m."""
    return float(np.hypot(one.traces["x"] - other.traces["x"], one.traces["y"] - other.traces["y"]).max())


def only(fleet: Fleet, ids: Iterable[int]) -> Fleet:
    """Some drives of a fleet."""
    tables = [table[table["trace_id"].isin(ids)].reset_index(drop=True) for table in (fleet.traces, fleet.points)]
    return Fleet(*tables, fleet.crs)


def seen_from(fleet: Fleet) -> np.ndarray:
    """Points in the frame of the pose that they were seen from: m ahead, to the left and above, shape (p, 3)."""
    keys = ["trace_id", "t"]
    poses = fleet.traces[[*keys, "x", "y", "z", "heading"]]
    part = fleet.points.merge(poses, on=keys, suffixes=("", "_pose"), validate="m:1")
    east, north, up = (part[axis] - part[f"{axis}_pose"] for axis in "xyz")
    sin, cos = np.sin(np.radians(part["heading"])), np.cos(np.radians(part["heading"]))
    return np.column_stack([east * sin + north * cos, north * sin - east * cos, up])


fleets = st.builds(straight_fleet, st.integers(0, 10_000), st.integers(2, 5), st.floats(0.2, 1.0))


@FEW
@given(fleets, st.floats(-3.0, 3.0), st.tuples(st.floats(-9e3, 9e3), st.floats(-9e3, 9e3)))
def test_a_fleet_turned_and_moved_is_aligned_alike(fleet: Fleet, angle: float, away: tuple[float, float]) -> None:
    assert apart(turned(align(fleet).fleet, angle, away), align(turned(fleet, angle, away)).fleet) < CENTIMETRES


@FEW
@given(fleets, st.randoms(use_true_random=False))
def test_the_names_of_drives_and_their_order_do_not_matter(fleet: Fleet, random: Random) -> None:
    ids = np.arange(fleet.n_traces)
    random.shuffle(ids)
    tables = [table.assign(trace_id=ids[table["trace_id"]]) for table in (fleet.traces, fleet.points)]
    renamed = align(fleet_from_tables(*tables, crs=fleet.crs)).fleet
    back = renamed.traces.assign(trace_id=np.argsort(ids)[renamed.traces["trace_id"]]).sort_values(["trace_id", "t"])
    assert apart(align(fleet).fleet, replace(renamed, traces=back.reset_index(drop=True))) < 0.3  # a bin of the search


@FEW
@given(st.integers(0, 10_000), st.integers(2, 5))
def test_drives_that_agree_hardly_move(seed: int, n_drives: int) -> None:
    fleet = straight_fleet(seed, n_drives, 0.0)
    assert apart(fleet, align(fleet).fleet) < 0.4  # of the noise of few sights, and a bin of the search


@FEW
@given(fleets)
def test_rows_stay_and_points_move_rigidly_with_their_poses(fleet: Fleet) -> None:
    moved = align(fleet).fleet
    changed = ["x", "y", "z", "heading"]
    pd.testing.assert_frame_equal(moved.traces.drop(columns=changed), fleet.traces.drop(columns=changed))
    pd.testing.assert_frame_equal(moved.points.drop(columns=changed[:3]), fleet.points.drop(columns=changed[:3]))
    assert np.allclose(seen_from(fleet), seen_from(moved), rtol=0.0, atol=1e-6)


@FEW
@given(st.integers(0, 10_000))
def test_drives_of_an_aligned_fleet_never_move(seed: int) -> None:
    fleet = straight_fleet(seed, 4, 1.0)
    early, late = only(fleet, range(3)), only(fleet, [3])
    both = add_drives(early, late).fleet
    kept = only(both, range(3))
    pd.testing.assert_frame_equal(kept.traces, early.traces)
    pd.testing.assert_frame_equal(kept.points, early.points)
