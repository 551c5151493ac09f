from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from probe2road.benchmark.sets.residual import ResidualModel, align_drives
from probe2road.errors import OptionError
from probe2road.fleet.contract import fleet_from_tables
from probe2road.simulation.fleet_simulation import simulate
from probe2road.simulation.networks.network import network_from_sections

MODEL = ResidualModel()


@pytest.fixture(scope="module")
def made():
    """Thirty drives along 8 km of straight road that runs north-east."""
    network = network_from_sections([[(0, 0), (5700, 5700)]], crs="EPSG:32616", lanes_forward=2)
    return simulate(network, n_drives=30, seed=5)


@pytest.fixture(scope="module")
def aligned(made):
    return align_drives(made.fleet.traces, made.fleet.points, made.poses, MODEL, seed=5)


def road_errors(traces, poses):
    """Error of each pose: to the right of the road, along it, upwards."""
    error = traces[["x", "y", "z"]].to_numpy() - poses[["x", "y", "z"]].to_numpy()
    right, ahead = np.array([1.0, -1.0]) / np.sqrt(2), np.array([1.0, 1.0]) / np.sqrt(2)
    return np.column_stack([error[:, :2] @ right, error[:, :2] @ ahead, error[:, 2]])


def by_drive(values, poses):
    """Mean of a column over 100 m of road: rows are places, columns are drives."""
    place = ((poses["x"] + poses["y"]) / np.sqrt(2) // 100).astype(int)
    table = pd.DataFrame({"place": place, "drive": poses["trace_id"], "value": values})
    return table.pivot_table("value", "place", "drive")


@pytest.mark.parametrize(("column", "sigma"), [(0, MODEL.lateral_sigma), (1, MODEL.longitudinal_sigma), (2, 0.15)])
def test_drives_differ_from_each_other_by_what_the_model_says(made, aligned, column, sigma):
    errors = by_drive(road_errors(aligned[0], made.poses)[:, column], made.poses)
    spread = errors.sub(errors.mean(axis=1), axis=0)
    assert np.sqrt((spread**2).mean().mean()) == pytest.approx(sigma, rel=0.2)


def test_what_drives_share_is_a_metre_and_varies_over_a_kilometre(made, aligned):
    errors = road_errors(aligned[0], made.poses)
    shared = [by_drive(errors[:, column], made.poses).mean(axis=1) for column in (0, 1)]
    size = np.sqrt(np.mean(shared[0] ** 2 + shared[1] ** 2))
    assert 0.4 < size < 1.6  # sqrt(2) * 0.7 m on average; a road is a dozen independent places
    step = np.abs(np.diff(shared[0]))
    assert step.max() < 0.25


def test_errors_of_a_drive_are_smooth(made, aligned):
    errors = road_errors(aligned[0], made.poses)
    same = made.poses["trace_id"].diff().eq(0).to_numpy()
    assert np.abs(np.diff(errors[:, 0], prepend=0.0))[same].max() < 0.06  # of which 0.03 is rounding to centimetres


def test_points_move_with_the_pose_that_saw_them(made, aligned):
    raw_points, moved = made.fleet.points, aligned[1]
    rows = made.fleet.traces.reset_index().merge(
        raw_points.reset_index()[["trace_id", "t", "index"]], on=["trace_id", "t"], suffixes=("", "_point")
    )
    for table, points, tolerance in ((made.fleet.traces, raw_points, 0.0), (aligned[0], moved, 0.0)):
        assert len(table) == len(made.poses)
        assert len(points) == len(raw_points) + tolerance
    offset = {}
    for name, table, points in (("raw", made.fleet.traces, raw_points), ("aligned", aligned[0], moved)):
        pose = table.loc[rows["index"]]
        delta = points.loc[rows["index_point"], ["x", "y"]].to_numpy() - pose[["x", "y"]].to_numpy()
        bearing = np.degrees(np.arctan2(delta[:, 0], delta[:, 1])) - pose["heading"].to_numpy()
        offset[name] = np.hypot(*delta.T), (bearing + 180.0) % 360.0 - 180.0
    np.testing.assert_allclose(offset["raw"][0], offset["aligned"][0], atol=0.03)
    np.testing.assert_allclose(offset["raw"][1], offset["aligned"][1], atol=0.5)
    assert np.abs(offset["raw"][1]).max() < 40  # ahead, within the field of view


def test_aligned_points_lie_closer_together_than_raw_ones(made, aligned):
    """Spread of the right edge line's points across the road, place by place: the truth is one line."""

    def spread(points):
        right = (points["x"] - points["y"]) / np.sqrt(2)
        edge = points.assign(right=right, place=(points["x"] + points["y"]) // 100)
        edge = edge[(points["kind"] == "lane_marking") & right.between(1.8, 6.0)]
        return edge.groupby("place")["right"].agg(lambda values: np.subtract(*np.percentile(values, [75, 25]))).median()

    assert spread(aligned[1]) < 0.4
    assert spread(aligned[1]) < 0.5 * spread(made.fleet.points)


def test_aligned_data_is_fleet_data(made, aligned):
    fleet = fleet_from_tables(*aligned, crs="EPSG:32616")
    assert fleet.n_traces == 30
    assert set(aligned[0]["accuracy"]) == {round(MODEL.accuracy, 2)}


def test_drives_may_be_aligned_in_any_portions(made, aligned):
    for portion in (made.poses["trace_id"] < 7, made.poses["trace_id"] >= 7):
        ids = made.poses["trace_id"][portion].unique()
        points = made.fleet.points[made.fleet.points["trace_id"].isin(ids)]
        traces, moved = align_drives(made.fleet.traces[portion], points, made.poses[portion], MODEL, seed=5)
        pd.testing.assert_frame_equal(traces, aligned[0][portion])
        np.testing.assert_array_equal(moved[["x", "y"]], aligned[1].loc[points.index, ["x", "y"]])


def test_inputs_stay_as_they_are_and_the_seed_decides(made, aligned):
    before = made.fleet.traces.copy()
    other, _ = align_drives(made.fleet.traces, made.fleet.points, made.poses, MODEL, seed=6)
    pd.testing.assert_frame_equal(made.fleet.traces, before)
    assert not other["x"].equals(aligned[0]["x"])


@pytest.mark.parametrize("options", [{"drive_length": 0.0}, {"place_sigma": -1.0}, {"lateral_sigma": float("nan")}])
def test_senseless_models_are_refused(options):
    with pytest.raises(OptionError, match=next(iter(options))):
        ResidualModel(**options)
