"""The error model of a GNSS receiver: its statistics, and how well they match the recordings."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from probe2road.errors import OptionError
from probe2road.simulation.presets import PRESETS
from probe2road.simulation.sensors.gnss import GnssModel, gnss_errors

CALM = GnssModel(1.0, 60.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 2.0, 1.0)
BURSTS = replace(CALM, slow_sigma=0.1, burst_rate=0.05, burst_duration=20.0, burst_median=10.0, burst_spread=0.0)


def test_slow_error_has_the_variance_and_correlation_it_was_given():
    # 400 independent minutes rather than one long one: their spread is known.
    runs = np.array([gnss_errors([0.0, 60.0], CALM, rng=np.random.default_rng(k)).error for k in range(400)])
    assert runs[:, 0, 0].std() == pytest.approx(1.0, abs=0.12)
    assert runs[:, 0, 2].std() == pytest.approx(2.0, abs=0.24)  # the vertical ratio
    correlation = (runs[:, 0, :2] * runs[:, 1, :2]).mean() / (runs[:, :, :2] ** 2).mean()
    assert correlation == pytest.approx(np.exp(-1.0), abs=0.1)


def test_uneven_steps_are_exact():
    coarse, fine = np.array([0.0, 30.0]), np.array([0.0, 1.0, 2.0, 30.0])

    def correlation(t):
        ends = np.array([gnss_errors(t, CALM, rng=np.random.default_rng(k)).error[[0, -1], 0] for k in range(600)])
        return np.corrcoef(ends.T)[0, 1]

    assert correlation(coarse) == pytest.approx(np.exp(-0.5), abs=0.1)
    assert correlation(fine) == pytest.approx(np.exp(-0.5), abs=0.1)


@pytest.mark.parametrize("interval", [0.1, 1.0, 30.0])
def test_share_of_time_in_bursts_does_not_depend_on_the_interval(interval):
    errors = gnss_errors(np.arange(4000) * interval * 5, BURSTS, rng=np.random.default_rng(3))
    assert errors.blocked.mean() == pytest.approx(0.5, abs=0.12)  # rate 0.05, duration 20 s: half the time


def test_no_bursts_without_exposure_and_the_receiver_suspects_them():
    exposure = np.repeat([0.0, 1.0], 5000)
    errors = gnss_errors(np.arange(10000.0), BURSTS, rng=np.random.default_rng(4), exposure=exposure)
    assert not errors.blocked[:5000].any()
    size = np.hypot(errors.error[:, 0], errors.error[:, 1])
    assert size[:5000].max() < 1.0
    assert np.median(size[errors.blocked]) > 5.0
    assert errors.sigma[errors.blocked].min() > errors.sigma[:5000].max()


def test_a_model_with_a_negative_size_is_refused():
    with pytest.raises(OptionError, match="slow_sigma is -1"):
        replace(CALM, slow_sigma=-1.0)
    with pytest.raises(OptionError, match="fast_time is 0"):
        replace(CALM, fast_time=0.0)


@pytest.fixture(scope="module")
def fit():
    path = Path(__file__).parents[3] / "experiments" / "fit_gnss.py"
    spec = importlib.util.spec_from_file_location("fit_gnss", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    if not module.data_folder().is_dir():
        pytest.skip(f"no recordings in {module.data_folder()}")
    return module


def test_nagoya_lies_within_what_the_phone_preset_makes(fit):
    table = fit.urban_table(fit.read_nagoya(fit.data_folder()), PRESETS["phone"].gnss)
    outside = table[(table["real"] < table["low"]) | (table["real"] > table["high"])]
    assert outside.empty, f"outside of nine in ten simulated recordings:\n{outside}"


def test_the_recording_reads_as_its_description_says(fit):
    nagoya = fit.read_nagoya(fit.data_folder())
    plan = np.hypot(nagoya.error[:, 0], nagoya.error[:, 1])
    assert np.percentile(plan, [50, 95]) == pytest.approx([2.9, 27.0], abs=0.3)  # ../shared/data/README.md
    sky = fit.read_open_sky(fit.data_folder())
    assert np.hypot(sky.error[:, 0], sky.error[:, 1]).mean() == pytest.approx(1.45, abs=0.01)


def test_the_open_minute_lies_within_what_the_open_sky_preset_makes(fit):
    table = fit.open_sky_table(fit.read_open_sky(fit.data_folder()), PRESETS["open_sky"].gnss)
    outside = table[(table["real"] < table["low"] - 0.02) | (table["real"] > table["high"] + 0.02)]
    assert outside.empty, f"outside of nine in ten simulated recordings:\n{outside}"
