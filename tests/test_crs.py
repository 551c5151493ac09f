from __future__ import annotations

import numpy as np
import pytest
from pyproj import CRS

from probe2road.crs import WGS84, is_true_to_scale, local_crs, parse_crs, require_metric, same_crs, transform
from probe2road.errors import CRSError


@pytest.mark.parametrize(
    ("lon", "lat", "epsg"),
    [
        ([-87.65], [41.87], 32616),
        ([151.2, 151.3], [-33.9, -33.8], 32756),
        ([5.7, 6.2], [50.0, 50.1], 32631),  # reaches 0.2 degrees into the next zone
        ([179.9, -179.9], [-17.0, -17.1], 32701),  # across the antimeridian
        ([179.6, 179.9], [65.0, 65.1], 32660),
        ([np.nan, 9.0], [np.nan, 48.0], 32632),
    ],
)
def test_local_crs_is_utm_where_the_data_fits_a_zone(lon: list[float], lat: list[float], epsg: int) -> None:
    assert local_crs(lon, lat).to_epsg() == epsg


@pytest.mark.parametrize(
    ("lon", "lat", "method"),
    [([8.0, 16.5], [48.0, 48.0], "Transverse Mercator"), ([10.0, 20.0], [85.0, 85.5], "Stereographic")],
)
def test_local_crs_follows_the_data_where_utm_does_not(lon: list[float], lat: list[float], method: str) -> None:
    crs = local_crs(lon, lat)
    assert method in crs.coordinate_operation.method_name
    assert require_metric(crs) == crs
    x, y = transform(np.array(lon), np.array(lat), WGS84, crs)
    assert np.isfinite([x, y]).all()
    assert abs(float(np.mean(x))) < 5000.0  # the origin is in the middle of the data
    assert CRS.from_json(crs.to_json()) == crs  # it survives a file


@pytest.mark.parametrize(("lon", "lat"), [([], []), ([np.nan], [1.0]), ([0.0], [95.0])])
def test_local_crs_refuses_no_position_and_impossible_ones(lon: list[float], lat: list[float]) -> None:
    with pytest.raises(CRSError):
        local_crs(lon, lat)


@pytest.mark.parametrize(
    ("crs", "message"),
    [(None, "no CRS"), (WGS84, "degrees"), (CRS.from_epsg(2263), "foot")],
)
def test_the_gate_refuses_what_is_not_metres(crs: CRS | None, message: str) -> None:
    with pytest.raises(CRSError, match=message):
        require_metric(crs, where="graph")


def test_parse_crs_names_what_it_cannot_read() -> None:
    with pytest.raises(CRSError, match=r"drives.csv: 'EPSG:1' is not a coordinate reference system"):
        parse_crs("EPSG:1", where="drives.csv")


def test_transform_keeps_x_east_whatever_the_axis_order() -> None:
    x, y = transform([-87.65], [41.87], WGS84, CRS.from_epsg(32616))
    lon, lat = transform(x, y, CRS.from_epsg(32616), WGS84)
    assert (round(float(lon[0]), 9), round(float(lat[0]), 9)) == (-87.65, 41.87)


def test_two_metric_crs_agree_on_distances() -> None:
    x, y = transform([-87.65, -87.66], [41.87, 41.88], WGS84, CRS.from_epsg(32616))
    there = transform(x, y, CRS.from_epsg(32616), local_crs([-87.65, -80.0], [41.87, 41.87]))
    back = transform(*there, local_crs([-87.65, -80.0], [41.87, 41.87]), CRS.from_epsg(32616))
    np.testing.assert_allclose(back, [x, y], atol=1e-3)


def test_scale_and_sameness() -> None:
    assert is_true_to_scale(CRS.from_epsg(2100), [23.8], [38.1])
    assert not is_true_to_scale(CRS.from_epsg(3857), [23.8], [38.1])
    assert same_crs(parse_crs("OGC:CRS84"), WGS84)
    assert not same_crs(CRS.from_epsg(32616), CRS.from_epsg(32617))
