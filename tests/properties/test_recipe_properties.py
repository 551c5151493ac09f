"""What must not change the graph: the order and direction of the traces, whole-pixel moves, the input's CRS.

Direction is judged before the refinement, where it is evidence: of one-way roads, and of which side of the middle
a vehicle drives on.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import shapely
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from probe2road.crs import parse_crs, transform
from probe2road.fleet.contract import fleet_from_tables
from probe2road.recipe import BuildOptions, build
from probe2road.segmentation.density import DensityOptions
from probe2road.segmentation.options import SegmentationOptions
from sketches import UTM, fleet_of

OPTIONS = BuildOptions(segmentation=SegmentationOptions(segmenter="density", density=DensityOptions(bandwidth=5.0)))
UNREFINED = replace(OPTIONS, refine=False)
FEW = settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.too_slow])


@st.composite
def tables(draw):
    """Drives along a few random straight roads, in whole and quarter metres."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    drives = []
    for road in range(draw(st.integers(1, 4))):
        start, heading = rng.uniform(0, 400, 2), rng.uniform(0, 2 * np.pi)
        for number in range(rng.integers(1, 6)):
            at = np.arange(0, rng.uniform(100, 400), 12.0)
            x = start[0] + at * np.cos(heading) + rng.normal(0, 1.0)
            y = start[1] + at * np.sin(heading) + rng.normal(0, 1.0)
            drives.append(pd.DataFrame({"trace_id": f"{road}/{number}", "t": np.arange(len(at)), "x": x, "y": y}))
    table = pd.concat(drives, ignore_index=True)
    return table.assign(x=446000 + (table["x"] * 4).round() / 4, y=4636000 + (table["y"] * 4).round() / 4)


def built(table, options=OPTIONS):
    return build(fleet_from_tables(table, crs=UTM, keep_crs=True), options=options)


def same(first, second, *, shift=(0.0, 0.0)):
    assert first.edges[["u", "v", "key"]].to_numpy().tolist() == second.edges[["u", "v", "key"]].to_numpy().tolist()
    moved = first.edges.geometry.translate(*shift)
    assert moved.geom_equals_exact(second.edges.geometry, 1e-6).all()


@FEW
@given(tables(), st.randoms(use_true_random=False))
def test_the_order_of_the_traces_does_not_matter(table, random):
    names = list(table["trace_id"].unique())
    shuffled = dict(zip(names, random.sample(names, len(names)), strict=True))
    same(built(table), built(table.assign(trace_id=table["trace_id"].map(shuffled))))


@FEW
@given(tables(), st.randoms(use_true_random=False))
def test_the_direction_of_the_traces_does_not_matter(table, random):
    turned = table.copy()
    for name in table["trace_id"].unique():
        if random.random() < 0.5:
            rows = table["trace_id"] == name
            turned.loc[rows, "t"] = -table.loc[rows, "t"]
    same(built(table, UNREFINED), built(turned, UNREFINED))


@FEW
@given(tables(), st.integers(-500, 500), st.integers(-500, 500))
def test_moving_the_traces_by_whole_pixels_moves_the_graph(table, east, north):
    moved = table.assign(x=table["x"] + east, y=table["y"] + north)
    same(built(table), built(moved), shift=(east, north))


@pytest.mark.parametrize("other", ["EPSG:32615", "EPSG:26971", "EPSG:4326"])
def test_the_crs_that_the_traces_come_in_does_not_matter(other):
    rng = np.random.default_rng(5)
    at = np.arange(0, 600, 12.0)
    here = fleet_of(*(np.stack([446000.3 + at, 4636000 + at / 3 + rng.normal()], axis=1) for _ in range(10)))
    x, y = transform(here.traces["x"].to_numpy(), here.traces["y"].to_numpy(), here.crs, parse_crs(other))
    there = fleet_from_tables(here.traces.assign(x=x, y=y), crs=other, target_crs=UTM)
    assert np.abs(here.traces[["x", "y"]].to_numpy() - there.traces[["x", "y"]].to_numpy()).max() < 0.01
    first = shapely.get_coordinates(build(here, options=OPTIONS).edges.geometry.segmentize(1.0))
    second = build(there, options=OPTIONS).edges.geometry.to_numpy()
    # A fix that changes pixels moves the graph by centimetres around it, and no farther.
    apart = shapely.distance(shapely.points(first), shapely.union_all(second))
    assert np.median(apart) < 0.01
    assert apart.max() < 0.5
