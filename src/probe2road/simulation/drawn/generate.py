"""Road networks without any external data: interchanges, highway corridors and towns.

What the generators draw has lanes, structures and heights like a network that was read, and passes the same checks.
The same ``rng`` state draws the same network.
"""

from __future__ import annotations

import logging

import numpy as np

from probe2road.errors import OptionError
from probe2road.simulation.drawn.corridors import draw_corridor
from probe2road.simulation.drawn.interchanges import DRAWINGS, draw_overpass
from probe2road.simulation.drawn.roads import Road, finish
from probe2road.simulation.drawn.towns import draw_town
from probe2road.simulation.networks.network import DRIVING_SIDES, RoadNetwork
from probe2road.simulation.networks.profile import ProfileOptions

__all__ = ["INTERCHANGES", "generate_corridor", "generate_interchange", "generate_town"]

logger = logging.getLogger(__name__)

INTERCHANGES = tuple(DRAWINGS)
# True to scale where the roads are drawn, around its origin; out at sea, far from any real road.
_CRS = "+proj=tmerc +lat_0=0 +lon_0=9 +datum=WGS84 +units=m +type=crs"
_SHALLOW = (15.0, 90.0)  # degrees


def generate_interchange(
    kind: str,
    *,
    rng: np.random.Generator,
    angle: float | None = None,
    driving_side: str = "right",
    country: str = "DE",
    crs: str = _CRS,
    heights: ProfileOptions | None = None,
) -> RoadNetwork:
    """Draw an interchange with random dimensions around the origin.

    Parameters
    ----------
    kind
        One of `INTERCHANGES`.
    rng
        Decides sizes, lanes and terrain.
    angle
        Of a ``"shallow_overpass"`` (degrees, 15 to 90); random where not given. Other kinds refuse it.
    driving_side
        ``"left"`` mirrors the drawing.
    country
        Country code of the marking style.
    crs
        Metric CRS to draw in.
    heights
        Options of the height profile.

    Returns
    -------
    RoadNetwork
        About one to three kilometres across.

    Raises
    ------
    OptionError
        If the kind, the driving side, or the angle is not one of those.

    Examples
    --------
    >>> network = generate_interchange("diamond", rng=np.random.default_rng(1))
    >>> sorted(set(network.sections["highway"]))
    ['motorway', 'motorway_link', 'primary']
    >>> generate_interchange("spaghetti", rng=np.random.default_rng(1))
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: kind of interchange 'spaghetti' is unknown; use one of diamond, cloverleaf, ...
    """
    if kind not in DRAWINGS:
        raise OptionError(f"kind of interchange {kind!r} is unknown", fix=f"use one of {', '.join(DRAWINGS)}")
    if angle is not None and (kind != "shallow_overpass" or not _SHALLOW[0] <= angle <= _SHALLOW[1]):
        raise OptionError(
            f"angle {angle:g} does not fit a {kind}", fix="only shallow_overpass takes one, from 15 to 90 degrees"
        )
    roads = DRAWINGS[kind](rng) if angle is None else draw_overpass(rng, angle)
    return _finish(roads, kind, rng, driving_side, country, crs, heights)


def generate_corridor(
    *,
    rng: np.random.Generator,
    length: float = 4000.0,
    lanes: tuple[int, int] = (2, 4),
    driving_side: str = "right",
    country: str = "DE",
    crs: str = _CRS,
    heights: ProfileOptions | None = None,
) -> RoadNetwork:
    """Draw a motorway of random curvature with exits, overpasses, and frontage roads or parallel carriageways.

    Parameters
    ----------
    length
        Of the motorway (m), at least 2,000.
    lanes
        Fewest and most through lanes of a carriageway; both carriageways get the same number.
    rng, driving_side, country, crs, heights
        As in `generate_interchange`.

    Raises
    ------
    OptionError
        If the length is too short, the lanes are no range, or the driving side is unknown.

    Examples
    --------
    >>> network = generate_corridor(rng=np.random.default_rng(1), length=2500.0)
    >>> bool(network.length > 5000.0)
    True
    """
    if not length >= 2000.0:
        raise OptionError(f"length is {length}", where="generate_corridor", fix="use 2000 m or more")
    if not 1 <= lanes[0] <= lanes[1]:
        raise OptionError(f"lanes are {lanes}", where="generate_corridor", fix="use 1 <= fewest <= most")
    return _finish(draw_corridor(rng, length, lanes), "corridor", rng, driving_side, country, crs, heights)


def generate_town(
    *,
    rng: np.random.Generator,
    regular: bool = True,
    blocks: int = 8,
    driving_side: str = "right",
    country: str = "DE",
    crs: str = _CRS,
    heights: ProfileOptions | None = None,
) -> RoadNetwork:
    """Draw the streets of a town at one level: a grid, or the irregular pattern of an old town.

    Parameters
    ----------
    regular
        Grid, or irregular.
    blocks
        Number of blocks along each side, 2 or more; a block measures about 110 m.
    rng, driving_side, country, crs, heights
        As in `generate_interchange`.

    Raises
    ------
    OptionError
        If there are fewer than two blocks, or the driving side is unknown.

    Examples
    --------
    >>> network = generate_town(rng=np.random.default_rng(1), blocks=3)
    >>> bool(network.sections["bridge"].any()), len(network.sections) > 12
    (False, True)
    """
    if blocks < 2:
        raise OptionError(f"blocks is {blocks}", where="generate_town", fix="use 2 or more")
    kind = "regular town" if regular else "irregular town"
    return _finish(draw_town(rng, regular, blocks), kind, rng, driving_side, country, crs, heights)


def _finish(
    roads: list[Road],
    kind: str,
    rng: np.random.Generator,
    driving_side: str,
    country: str,
    crs: str,
    heights: ProfileOptions | None,
) -> RoadNetwork:
    """Build the network and log its size."""
    if driving_side not in DRIVING_SIDES:
        raise OptionError(f"driving side {driving_side!r} is unknown", where="generate", fix="use right or left")
    network = finish(roads, rng=rng, driving_side=driving_side, country=country, crs=crs, heights=heights)
    logger.info("generated a %s: %d sections, %.1f km", kind, len(network.sections), network.length / 1000)
    return network
