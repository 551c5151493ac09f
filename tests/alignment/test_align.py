"""The whole alignment, on roads that are known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from probe2road.alignment.align import AlignOptions, add_drives, align
from probe2road.cli.main import main
from probe2road.errors import InputError, MissingExtraError, OptionError
from probe2road.fleet.contract import Fleet
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.fleet_writer import write_fleet

pytest.importorskip("gtsam", reason="alignment needs the extra 'align'")

LANES = [-1.8, 1.8] * 4


def spread(errors: np.ndarray) -> float:
    return float(np.median(np.abs(errors - np.median(errors))))


def test_drives_come_together_where_gnss_is_on_average(road: Any) -> None:
    fleet = road.biased(LANES)
    before = road.lateral(fleet, LANES)
    result = align(fleet)
    after = road.lateral(result.fleet, LANES)
    assert np.ptp(after) < 0.2
    assert spread(after) < spread(before) / 4.0
    assert abs(np.median(after)) < 3.0 / np.sqrt(len(LANES))  # three sigma of the mean
    assert result.report.spread_after < result.report.spread_before / 4.0
    assert (result.report.drives["status"] == "aligned").all()


def test_only_poses_move_and_points_move_with_them(road: Any) -> None:
    fleet = road.biased(LANES[:4])
    kept = fleet.traces.copy()
    moved = align(fleet).fleet
    assert fleet.traces.equals(kept)
    unmoved = ["trace_id", "t", "speed", "accuracy"]
    assert moved.traces[unmoved].equals(fleet.traces[unmoved])
    for column in ("trace_id", "t", "kind"):
        assert moved.points[column].equals(fleet.points[column])
    fix = fleet.traces.set_index(["trace_id", "t"])
    seen = [pd.MultiIndex.from_frame(fleet.points[["trace_id", "t"]])]
    reach = [
        np.hypot(*(part.points[axis].to_numpy() - table.loc[seen[0], axis].to_numpy() for axis in "xy"))
        for part, table in ((fleet, fix), (moved, moved.traces.set_index(["trace_id", "t"])))
    ]
    assert np.allclose(*reach, atol=1e-6)


@pytest.mark.parametrize("off", [-3.6, 3.6])
def test_a_drive_one_lane_off_is_not_locked_to_the_neighbouring_lane(road: Any, off: float) -> None:
    rng = np.random.default_rng(3)
    biases = [*0.4 * rng.standard_normal((9, 2)), (0.0, off)]
    lanes = [-1.8, 1.8] * 5
    drives = [road.drive(k, rng, lane=lanes[k], bias=(*biases[k], 0.0)) for k in range(10)]
    after = road.lateral(align(road.fleet(drives)).fleet, lanes)
    assert np.ptp(after) < 0.5


def test_a_drive_that_alone_uses_a_lane_extends_the_road(road: Any) -> None:
    """All others are in the right lane and see little of the left one; nothing there may look like its own lane."""
    rng = np.random.default_rng(4)
    wide = {"markings": (-3.6, 0.0, 3.6, 7.2), "boundaries": (-5.6, 9.2)}
    lanes = [-1.8] * 8 + [5.4]
    biases = 0.4 * rng.standard_normal((9, 2))
    drives = [road.drive(k, rng, lane=lanes[k], bias=(*biases[k], 0.0), **wide) for k in range(9)]
    after = road.lateral(align(road.fleet(drives)).fleet, lanes)
    assert np.ptp(after) < 1.75


def test_stacked_roads_do_not_attract_each_other(road: Any) -> None:
    """Two decks 8 m apart, the upper one 1.5 m to the side: each stays where its drives are."""
    rng = np.random.default_rng(5)
    decks = np.arange(12) % 2
    drives = [
        road.drive(k, rng, level=8.0 * decks[k], bias=(*0.5 * rng.standard_normal(2), rng.standard_normal()),
                   markings=np.array((-3.6, 0.0, 3.6)) + 1.5 * decks[k], lane=-1.8 + 1.5 * decks[k])
        for k in range(12)
    ]  # fmt: skip
    result = align(road.fleet(drives)).fleet
    after = road.lateral(result, -1.8 + 1.5 * decks)
    height = result.traces.groupby("trace_id")["z"].median().to_numpy()
    for deck in (0, 1):
        assert np.ptp(after[decks == deck]) < 0.5
        assert np.ptp(height[decks == deck]) < 1.0
    assert abs(np.diff([np.median(height[decks == deck]) for deck in (0, 1)])[0] - 8.0) < 2.0


def test_crossing_and_opposite_roads_do_not_attract_each_other(road: Any) -> None:
    rng = np.random.default_rng(6)
    turns = [0.0, np.pi, np.pi / 2.0]
    fleet = road.fleet([road.drive(k, rng, turn=turn) for k, turn in enumerate(turns)])
    result = align(fleet)
    assert result.report.drives["points"].tolist() == [0, 0, 0]
    assert result.report.drives["shift"].max() < 0.1


def test_drives_without_camera_are_drawn_to_the_others_paths(road: Any) -> None:
    lanes = [0.0] * 9
    rng = np.random.default_rng(7)
    biases = 0.5 * rng.standard_normal((9, 2))
    biases[8] = (0.0, 8.0)
    drives = [road.drive(k, rng, lane=0.0, bias=(*biases[k], 0.0), sees=False) for k in range(9)]
    fleet = road.fleet(drives)
    result = align(fleet)
    assert set(result.report.drives["status"]) == {"by path"}
    assert abs(road.lateral(result.fleet, lanes)[8]) < 7.0
    assert np.isnan(result.report.spread_after)


def test_missing_columns_and_heights_are_made_up_for(road: Any) -> None:
    fleet = road.biased(LANES[:6])
    bare = replace(fleet, traces=fleet.traces.drop(columns=["heading", "speed", "accuracy"]).assign(z=np.nan))
    moved = align(bare).fleet
    assert np.ptp(road.lateral(moved, LANES[:6])) < 0.3
    assert moved.traces["z"].isna().all()


def test_one_drive_without_heights_is_aligned_with_the_others(road: Any) -> None:
    fleet = road.biased(LANES[:6])
    flat = fleet.traces.assign(z=fleet.traces["z"].where(fleet.traces["trace_id"] != 3))
    result = align(replace(fleet, traces=flat))
    assert np.ptp(road.lateral(result.fleet, LANES[:6])) < 0.3
    assert result.fleet.traces["z"].isna().sum() == (flat["trace_id"] == 3).sum()


def test_bad_drives_are_reported_and_do_no_harm(road: Any) -> None:
    rng = np.random.default_rng(8)
    drives = [road.drive(k, rng, lane=LANES[k], bias=rng.standard_normal(3)) for k in range(7)]
    traces, points = drives[6]
    drives[6] = (traces.assign(x=2.0 * traces["x"].mean() - traces["x"]), points)
    fleet = road.fleet(drives)
    result = align(fleet)
    last = result.report.drives.iloc[6]
    assert (last["status"], last["reason"]) == ("rejected", "heading contradicts the course")
    stays = fleet.traces["trace_id"] == 6
    assert result.fleet.traces[stays].equals(fleet.traces[stays])
    assert np.ptp(road.lateral(result.fleet, [*LANES[:6], 0.0])[:6]) < 0.3
    dropped = align(fleet, options=AlignOptions(keep_rejected=False)).fleet
    assert 6 not in set(dropped.traces["trace_id"]) | set(dropped.points["trace_id"])


def test_tiles_join_without_a_seam_and_workers_change_nothing(road: Any) -> None:
    fleet = road.biased(LANES[:4], length=600.0)
    options = AlignOptions(tile=400.0, margin=100.0)
    result = align(fleet, options=options)
    assert result.report.tiles >= 2
    assert np.ptp(road.lateral(result.fleet, LANES[:4])) < 0.3
    move = result.fleet.traces["y"] - fleet.traces["y"]
    same = fleet.traces["trace_id"].diff() == 0
    assert move.diff()[same].abs().max() < 0.1
    parallel = align(fleet, options=options, workers=2)
    for axis in "xyz":
        assert np.allclose(parallel.fleet.traces[axis], result.fleet.traces[axis], rtol=0.0, atol=0.01)


def test_an_interrupted_run_goes_on(road: Any, tmp_path: Path) -> None:
    fleet = road.biased(LANES[:4], length=900.0)
    options = AlignOptions(tile=400.0, margin=100.0)
    whole = align(fleet, options=options)

    def stop(stage: str, done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        align(fleet, options=options, workspace=tmp_path / "work", progress=stop)
    assert len(list((tmp_path / "work").glob("tile-*"))) == 2
    resumed = align(fleet, options=options, workspace=tmp_path / "work")
    for axis in "xyz":
        assert np.allclose(resumed.fleet.traces[axis], whole.fleet.traces[axis], rtol=0.0, atol=0.01)


def test_new_drives_join_an_aligned_fleet_that_stays(road: Any) -> None:
    rng = np.random.default_rng(9)
    drives = [road.drive(k, rng, lane=LANES[k % 8], bias=rng.standard_normal(3)) for k in range(10)]
    first = align(road.fleet(drives[:8])).fleet
    result = add_drives(first, road.fleet(drives[8:]))
    old = result.fleet.traces["trace_id"] < 8
    pd.testing.assert_frame_equal(result.fleet.traces[old].reset_index(drop=True), first.traces)
    assert np.ptp(road.lateral(result.fleet, (LANES * 2)[:10])) < 0.4
    assert result.report.drives["status"].tolist() == ["held"] * 8 + ["aligned"] * 2


def test_ids_must_be_new(road: Any) -> None:
    fleet = road.biased(LANES[:2])
    with pytest.raises(InputError, match="2 trace ids are in both fleets"):
        add_drives(fleet, fleet)


def test_bad_options_are_refused(road: Any) -> None:
    with pytest.raises(OptionError, match="workers is 0"):
        align(road.biased(LANES[:2]), workers=0)
    with pytest.raises(OptionError, match="margin"):
        AlignOptions(tile=100.0, margin=60.0)


def test_without_gtsam_the_message_says_what_to_install(road: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "gtsam", None)
    with pytest.raises(MissingExtraError, match=r"probe2road\[align\]"):
        align(road.biased(LANES[:2]))


def test_command_line_aligns_adds_and_reports(road: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    fleet = road.biased(LANES[:4], length=300.0)
    late = fleet.traces["trace_id"] == 3
    for name, chosen in (("early", ~late), ("late", late)):
        ids = fleet.traces.loc[chosen, "trace_id"]
        points = fleet.points[fleet.points["trace_id"].isin(ids)].reset_index(drop=True)
        write_fleet(Fleet(fleet.traces[chosen].reset_index(drop=True), points, fleet.crs), f"{name}.parquet")
    commands = [
        ["align", "early.parquet", "--points", "early.points.parquet", "-o", "one.parquet", "--report", "report"],
        ["align", "late.parquet", "--points", "late.points.parquet", "-o", "two.parquet", "--add-to", "one.parquet"],
    ]
    for command in commands:
        with pytest.raises(SystemExit) as stop:
            main(command)
        assert stop.value.code == 0
    summary = json.loads((tmp_path / "report" / "report.json").read_text(encoding="utf-8"))
    assert summary["aligned"] == 3
    assert sorted(path.name for path in (tmp_path / "report").iterdir()) == [
        "alignment.png", "drives.csv", "report.json", "residuals.csv",
    ]  # fmt: skip
    both = read_fleet("two.parquet", "two.points.parquet")
    assert (both.n_traces, len(both.points)) == (4, len(fleet.points))
    assert np.ptp(road.lateral(both, LANES[:4])) < 0.4
    assert not list(tmp_path.glob(".*.probe2road"))
