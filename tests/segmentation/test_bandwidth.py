import numpy as np
import pandas as pd
import pytest

from probe2road.fleet.contract import Fleet
from probe2road.raster.counts import fleet_grid
from probe2road.segmentation.bandwidth import estimate_bandwidth, lateral_spread
from sketches import fleet_of


def road(offsets, *, heading=30.0, length=900.0, seed=0):
    """Traces along a straight road, one for each lateral offset (m), driven in random directions."""
    rng = np.random.default_rng(seed)
    along, (east, north) = np.arange(0.0, length, 18.0), (np.sin(np.radians(heading)), np.cos(np.radians(heading)))
    traces = []
    for offset in offsets:
        at = along if rng.random() < 0.5 else along[::-1]
        traces.append(np.stack([446000 + at * east + offset * north, 4636000 + at * north - offset * east], axis=1))
    return fleet_of(*traces)


def spread_of(fleet):
    return lateral_spread(fleet, fleet_grid(fleet))


@pytest.mark.parametrize("sigma", [0.5, 2.0, 5.0])
def test_the_spread_is_that_of_the_traces(sigma):
    offsets = np.random.default_rng(1).normal(0, sigma, 60)
    assert spread_of(road(offsets)) == pytest.approx(offsets.std(), rel=0.1)


def test_carriageways_apart_are_not_mixed():
    rng = np.random.default_rng(2)
    offsets = np.concatenate([rng.normal(-9, 1, 30), rng.normal(9, 1, 30)])
    assert spread_of(road(offsets)) < 1.3


def test_a_crossing_street_does_not_count():
    rng = np.random.default_rng(3)
    straight, across = (road(rng.normal(0, 1, 30), heading=heading) for heading in (0.0, 90.0))
    both = pd.concat([straight.traces, across.traces.assign(trace_id=across.traces["trace_id"] + 100)])
    assert spread_of(Fleet(both, straight.points, straight.crs)) < 1.3


def test_precise_traces_get_a_fine_kernel_and_noisy_ones_a_broad_one():
    rng = np.random.default_rng(4)
    fine, broad = (road(rng.normal(0, sigma, 50)) for sigma in (0.5, 6.0))
    assert estimate_bandwidth(fine, fleet_grid(fine)) == 3.0
    assert 12.0 <= estimate_bandwidth(broad, fleet_grid(broad)) <= 15.0


def test_too_few_traces_to_tell():
    fleet = road([0.0, 1.0])
    assert np.isnan(spread_of(fleet))
    assert estimate_bandwidth(fleet, fleet_grid(fleet)) == 5.0


def test_standing_vehicles_only():
    fleet = fleet_of([(446000.0, 4636000.0)] * 20)
    assert estimate_bandwidth(fleet, fleet_grid(fleet)) == 5.0
