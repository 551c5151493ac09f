"""The whole simulator: the contract of what comes out, and that a seed is a fleet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from probe2road.errors import OptionError
from probe2road.fleet.contract import fleet_from_tables, trace_breaks
from probe2road.graph.check import check_graph
from probe2road.simulation.fleet_simulation import simulate, simulate_chunks
from probe2road.simulation.networks.network import network_from_sections
from probe2road.simulation.presets import PRESETS, find_preset, read_preset
from sketches import UTM


@pytest.fixture(scope="module")
def network():
    """A motorway with an exit, and a tunnel behind it."""
    lines = [
        [(0, 0), (2000, 0)],
        [(2000, 0), (3000, 0)],
        [(3000, 0), (4500, 0)],
        [(4500, 0), (6000, 0)],
        [(2000, 0), (2300, -30), (2600, -150)],
    ]
    highway = ["motorway"] * 4 + ["motorway_link"]
    tunnel = [False, False, True, False, False]
    return network_from_sections(lines, crs=UTM, highway=highway, lanes_forward=[3, 3, 3, 3, 1], tunnel=tunnel)


@pytest.fixture(scope="module")
def made(network):
    return simulate(network, n_drives=12, seed=3)


def test_the_fleet_keeps_its_contract(made):
    fleet = made.fleet
    again = fleet_from_tables(fleet.traces, fleet.points, crs=fleet.crs, keep_crs=True)
    pd.testing.assert_frame_equal(again.traces, fleet.traces)
    assert len(again.points) == len(fleet.points)
    assert int(trace_breaks(fleet).sum()) == fleet.n_traces == 12


def test_truth_stands_beside_the_data(made):
    traces, poses = made.fleet.traces, made.poses
    assert (traces["trace_id"] == poses["trace_id"]).all()
    assert (traces["t"] == poses["t"]).all()
    error = np.hypot(traces["x"] - poses["x"], traces["y"] - poses["y"])
    assert 0.3 < error.median() < 4.0
    assert error.groupby(traces["trace_id"]).median().std() > 0.1  # every drive has its own bias
    assert set(poses["section"]) <= set(made.reference.edges.index)


def test_points_are_recorded_in_the_frame_of_the_fused_pose(made):
    """A marking seen from the true pose lies near y = const; recorded, it is off by the vehicle's own error."""
    key = ["trace_id", "t"]
    points = made.fleet.points.merge(made.fleet.traces, on=key, suffixes=("", "_pose"))
    points = points.merge(made.poses, on=key, suffixes=("", "_true"))
    straight = points[(points["section"].isin([0, 1])) & (points["kind"] == "lane_marking")]
    shift = straight["y_pose"] - straight["y_true"]
    lines = np.array([-5.225, -1.825, 1.825, 5.225])  # edges 0.25 m inside the border, dividers

    def off(y):
        return np.abs(y.to_numpy()[:, None] - lines).min(axis=1)

    assert np.median(off(straight["y"] - shift)) < 0.25
    assert np.median(off(straight["y"] - shift)) < 0.6 * np.median(off(straight["y"]))


def test_counts_of_drives_are_those_of_the_routes(made):
    check_graph(made.reference)
    edges = made.reference.edges
    for section, driven in made.routes.groupby("section"):
        assert edges.loc[section, "support"] == driven["trace_id"].nunique()
        assert edges.loc[section, "forward"] == len(driven)
    # Poses lie in a section wherever a route lists it.
    listed = set(zip(made.routes["trace_id"], made.routes["section"], strict=True))
    assert set(zip(made.poses["trace_id"], made.poses["section"], strict=True)) == listed
    turns = made.reference.turns
    assert turns["count"].sum() == (made.routes["via_node"] >= 0).sum()


def test_a_seed_is_a_fleet_whatever_the_chunks_and_workers(network, made):
    for options in ({"chunk_drives": 5}, {"chunk_drives": 4, "workers": 2}):
        chunks = list(simulate_chunks(network, n_drives=12, seed=3, **options))
        for name, whole in (("traces", made.fleet.traces), ("points", made.fleet.points), ("poses", made.poses)):
            joined = pd.concat([getattr(chunk, name) for chunk in chunks], ignore_index=True)
            pd.testing.assert_frame_equal(joined, whole)


def test_another_seed_is_another_fleet(network, made):
    other = simulate(network, n_drives=1, seed=4)
    assert not np.array_equal(other.poses["t"].iloc[:5], made.poses["t"].iloc[:5])


def test_later_drives_need_no_earlier_ones(network, made):
    (chunk,) = simulate_chunks(network, n_drives=2, seed=3, first_drive=7)
    expected = made.fleet.traces[made.fleet.traces["trace_id"].isin([7, 8])].reset_index(drop=True)
    pd.testing.assert_frame_equal(chunk.traces, expected)


def test_kilometres_end_with_the_drive_that_reaches_them(network):
    chunks = list(simulate_chunks(network, drive_km=20.0, seed=3, chunk_drives=4))
    lengths = np.concatenate([chunk.length for chunk in chunks])
    assert lengths.sum() >= 20_000 > lengths[:-1].sum()
    assert chunks[-1].traces["trace_id"].max() == chunks[-1].points["trace_id"].max() == len(lengths) - 1


def test_drives_of_one_vehicle_share_its_number(made):
    vehicle = made.fleet.traces.groupby("trace_id")["vehicle_id"].unique().str[0]
    assert vehicle.tolist() == [0] * 4 + [1] * 4 + [2] * 4


def test_a_phone_has_sparse_fixes_no_points_and_no_sky_in_tunnels(network):
    made = simulate(network, preset="phone", n_drives=40, seed=1)
    assert len(made.fleet.points) == 0
    assert not (made.poses["section"] == 2).any()
    interval = made.fleet.traces.groupby("trace_id")["t"].diff().dt.total_seconds()
    middle = interval.groupby(made.fleet.traces["trace_id"]).median()
    assert middle.min() >= 0.9
    assert middle.max() <= 33.0
    assert middle.max() > 5 * middle.min()


def test_odometry_carries_on_in_tunnels_and_drifts(network):
    made = simulate(network, n_drives=60, seed=2)
    error = np.hypot(made.fleet.traces["x"] - made.poses["x"], made.fleet.traces["y"] - made.poses["y"])
    inside = made.poses["section"] == 2
    assert inside.any()
    entered = error[inside].groupby(made.poses["trace_id"][inside]).first()
    left = error[inside].groupby(made.poses["trace_id"][inside]).last()
    assert (left - entered).abs().median() > 0.3
    assert made.fleet.traces["accuracy"][inside].max() > made.fleet.traces["accuracy"][~inside].median()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "amount must be given once"),
        ({"n_drives": 1, "drive_km": 1.0}, "amount must be given once"),
        ({"n_drives": 0}, "n_drives is 0"),
        ({"drive_km": -1.0}, "drive_km is -1"),
        ({"n_drives": 1, "workers": 0}, "workers is 0"),
        ({"n_drives": 1, "preset": "sunny"}, "preset 'sunny' is unknown"),
    ],
)
def test_bad_amounts_are_refused(network, options, message):
    with pytest.raises(OptionError, match=message):
        simulate(network, **options)


def test_a_preset_file_changes_what_it_names(tmp_path):
    path = tmp_path / "wide.toml"
    changes = ['base = "open_sky"', "[camera]", "far = 60", "[recording]", "fix_interval = [2, 4]"]
    path.write_text("\n".join([*changes, "[surroundings.exposure]", "motorway = 1"]))
    preset = find_preset(path)
    assert preset.name == "wide"
    assert preset.camera == replace(PRESETS["open_sky"].camera, far=60.0)
    assert preset.recording.fix_interval == (2.0, 4.0)
    assert preset.surroundings.exposure == {"motorway": 1.0}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("base = 'sunny'", "base 'sunny' is unknown"),
        ("[camera]\nzoom = 3", "there is no option 'zoom'"),
        ("[camera]\nfar = 'wide'", "camera: far is 'wide'; use a number above 0"),
        ("[lidar]\nrange = 3", "there is no option 'lidar'"),
        ("base = 'phone'\n[camera]\nfar = 3", "camera: there is no near and no half_angle"),
        ("[camera", "is not TOML"),
    ],
)
def test_a_bad_preset_file_is_refused(tmp_path, text, message):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    with pytest.raises(OptionError, match=message):
        read_preset(path)


def test_a_missing_preset_file_is_refused(tmp_path):
    with pytest.raises(OptionError, match="cannot be read"):
        find_preset(tmp_path / "none.toml")
