"""The presets of the fleet simulator: all numbers in one place, with their sources.

Numbers that were fitted name the recording; those that nobody measured are marked as chosen. `experiments/fit_gnss.py`
repeats the fits, and docs/results/calibration.md compares the outcome with the recordings.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from probe2road.bounds import NotNegative, Positive
from probe2road.errors import OptionError
from probe2road.options import changed_by, checked, read_toml
from probe2road.simulation.driving.routes import DemandModel
from probe2road.simulation.driving.speeds import DriverModel
from probe2road.simulation.sensors.camera import CameraModel
from probe2road.simulation.sensors.gnss import GnssModel
from probe2road.simulation.sensors.odometry import FusionModel, OdometryModel

__all__ = ["PRESETS", "Preset", "RecordingModel", "SurroundingsModel", "find_preset", "read_preset"]


@dataclass(frozen=True)
@checked
class SurroundingsModel:
    """How much the surroundings hide of the sky: a factor on the rate of multipath bursts, by road class."""

    exposure: Mapping[str, NotNegative[float]] = field(
        default_factory=lambda: {"motorway": 0.2, "motorway_link": 0.3, "trunk": 0.5, "trunk_link": 0.6}
    )
    other_exposure: NotNegative[float] = 1.0  # on all other classes
    spread: NotNegative[float] = 0.8  # of the logarithm, between road sections: all drives are bad at the same places


@dataclass(frozen=True)
@checked
class RecordingModel:
    """What a vehicle or phone records of a drive."""

    pose_spacing: Positive[float] = 2.5  # m between poses, and keyframes of the camera, of a moving vehicle
    standing_interval: Positive[float] = 1.0  # s between poses of a standing one
    fix_interval: tuple[Positive[float], Positive[float]] = (1.0, 30.0)  # s, of a phone, log-uniform over drives
    drives_per_vehicle: Positive[int] = 4  # consecutive drives that share a vehicle
    first_day: str = "2024-03-04T00:00:00Z"  # the fleet records from here on
    days: Positive[float] = 28.0  # for so long


@dataclass(frozen=True)
@checked
class Preset:
    """All parameters of the simulator for one kind of fleet."""

    name: str
    gnss: GnssModel
    fusion: FusionModel | None  # None: raw GNSS fixes without odometry
    odometry: OdometryModel
    camera: CameraModel | None  # None: no semantic points
    surroundings: SurroundingsModel = field(default_factory=SurroundingsModel)
    demand: DemandModel = field(default_factory=DemandModel)
    driver: DriverModel = field(default_factory=DriverModel)
    recording: RecordingModel = field(default_factory=RecordingModel)


# Fitted to the single-point solution of an urban drive in Nagoya: experiments/fit_gnss.py --fit.
_NAGOYA = GnssModel(
    slow_sigma=1.59,
    slow_time=163.0,
    fast_sigma=0.159,
    fast_time=29.8,
    white_sigma=0.0251,
    burst_rate=0.0333,
    burst_duration=16.3,
    burst_median=10.8,
    burst_spread=0.944,
    burst_time=27.6,
    burst_white=0.101,
    vertical_ratio=2.27,
    burst_vertical_ratio=2.24,
)

# The fast part fitted to a consumer receiver on I-280 (one minute, open sky); the slow part so that the mean horizontal
# error is the 1.45 m seen there (a Rayleigh mean is 1.25 sigma), its time constant chosen: the recording is too short.
# Bursts keep the shape fitted in Nagoya; the surroundings decide how many there are.
_OPEN_SKY = replace(
    _NAGOYA,
    slow_sigma=1.16,
    slow_time=900.0,
    fast_sigma=0.14,
    fast_time=6.0,
    white_sigma=0.1,
    burst_rate=0.0005,
    vertical_ratio=1.6,
)

# Chosen after the figures that builders of fleet maps give for production odometry: about 0.2 % of the distance after
# calibration, gyroscopes of 10 degrees an hour, 0.2 degrees per square root of an hour.
_ODOMETRY = OdometryModel(
    scale_sigma=0.002,
    heading_sigma=0.06,
    heading_time=15.0,
    gyro_bias=0.003,
    gyro_walk=0.004,
    height_walk=0.01,
)

# Chosen: a loosely coupled filter at the speed at which consumer receivers settle.
_FUSION = FusionModel(
    pull_time=12.0,
    vertical_pull_time=30.0,
    gate=4.0,
    trusted_sigma=2.0,
    min_trust=0.05,
    vehicle_bias=0.25,
)

# Optics of a production mono camera (EyeQ3 data sheet: 52 degrees over 1280 pixels); 5 to 10 points a dash in a pass is
# what the paper says of its fleet. All else chosen: no public recording holds such points.
_CAMERA = CameraModel(
    near=5.0,
    far=40.0,
    half_angle=26.0,
    height=1.35,
    pixel=0.76e-3,  # 2 tan(26 degrees) / 1280
    pixel_noise=0.7,
    lateral_noise=0.06,
    boundary_noise=2.5,
    height_noise=0.08,
    pitch_noise=0.25,
    pitch_time=0.5,
    yaw_bias=0.15,
    dash_points=7.8,
    solid_points=0.9,
    boundary_points=0.7,
    range_decay=14.0,
    lane_reach=2.6,
    lane_decay=2.0,
    boundary_reach=4.0,
    boundary_decay=4.0,
    boundary_found=60.0,
    boundary_lost=50.0,
    outage_every=4000.0,
    outage_length=120.0,
    traffic_share=0.25,
    traffic_length=300.0,
    false_rate=0.012,
    altitude_gate=1.5,
    altitude_slope=0.05,
)

_URBAN = replace(SurroundingsModel(), exposure={"motorway": 0.6, "motorway_link": 0.7, "trunk": 0.8}, spread=0.6)
# Among tall buildings a filter cannot afford to distrust what it has: it follows further, and worse fixes.
_URBAN_FUSION = replace(_FUSION, gate=8.0, trusted_sigma=4.0)
_MIXED_GNSS = replace(_OPEN_SKY, burst_rate=_NAGOYA.burst_rate)

PRESETS: Mapping[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset("open_sky", _OPEN_SKY, _FUSION, _ODOMETRY, _CAMERA),
        Preset("mixed", _MIXED_GNSS, _FUSION, _ODOMETRY, _CAMERA),
        Preset("urban_canyon", _NAGOYA, _URBAN_FUSION, _ODOMETRY, _CAMERA, _URBAN),
        Preset("phone", _NAGOYA, None, _ODOMETRY, None, _URBAN),
    )
}


def find_preset(name: str | Path | Preset) -> Preset:
    """Return a preset by name, or read one from a TOML file.

    Raises
    ------
    OptionError
        If there is no preset of that name.

    Examples
    --------
    >>> find_preset("mixed").recording.pose_spacing
    2.5
    >>> find_preset("sunny")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: preset 'sunny' is unknown; use open_sky, mixed, urban_canyon, phone or a TOML file
    """
    if isinstance(name, Preset):
        return name
    if str(name) in PRESETS:
        return PRESETS[str(name)]
    if str(name).endswith(".toml"):
        return read_preset(name)
    raise OptionError(f"preset {str(name)!r} is unknown", fix=f"use {', '.join(PRESETS)} or a TOML file")


def read_preset(path: str | Path) -> Preset:
    """Read a preset from a TOML file: the name of a base preset, and the fields that differ.

    ``base`` names the preset to start from (mixed where absent); each table (``gnss``, ``fusion``, ``odometry``,
    ``camera``, ``surroundings``, ``demand``, ``driver``, ``recording``) replaces fields of that name.

    Raises
    ------
    OptionError
        If the file cannot be read, is not TOML, or sets what a preset does not have.
    """
    content = read_toml(path)
    base = str(content.pop("base", "mixed"))
    if base not in PRESETS:
        raise OptionError(f"base {base!r} is unknown", where=path, fix=f"use {', '.join(PRESETS)}")
    return changed_by(PRESETS[base], {"name": Path(path).stem, **content}, where=path)
