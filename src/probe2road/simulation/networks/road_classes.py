"""Defaults of road classes and countries where tags are missing: lanes, widths, speeds, grades, paint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from probe2road.errors import OptionError

__all__ = ["CLASS_DEFAULTS", "MARKING_STYLES", "MarkingStyle", "RoadClass", "marking_style"]


@dataclass(frozen=True)
class RoadClass:
    """The properties of an OSM highway class where tags are missing."""

    lanes_oneway: int  # lanes of a one-way carriageway
    lanes_twoway: int  # lanes of a two-way carriageway, both directions together
    lane_width: float  # m
    speed_limit: float  # m/s
    max_grade: float  # rise over run


# Lanes: the commonest tagged value of each class in seven extracts. Widths: RAA/RAL (Germany) and the AASHTO Green
# Book, rounded between the two. Grades: RAA 2008 table 14 (motorways 4 % to 6 %), RAL 2012 (5.5 % to 8 %), and the
# 8 % that AASHTO allows on ramps of up to 50 km/h.
CLASS_DEFAULTS: Mapping[str, RoadClass] = {
    "motorway": RoadClass(2, 4, 3.65, 110 / 3.6, 0.05),
    "motorway_link": RoadClass(1, 2, 3.75, 60 / 3.6, 0.08),
    "trunk": RoadClass(2, 2, 3.50, 90 / 3.6, 0.06),
    "trunk_link": RoadClass(1, 2, 3.60, 50 / 3.6, 0.08),
    "primary": RoadClass(2, 2, 3.40, 60 / 3.6, 0.07),
    "primary_link": RoadClass(1, 2, 3.50, 50 / 3.6, 0.08),
    "secondary": RoadClass(1, 2, 3.25, 50 / 3.6, 0.08),
    "secondary_link": RoadClass(1, 2, 3.40, 40 / 3.6, 0.08),
    "tertiary": RoadClass(1, 2, 3.10, 50 / 3.6, 0.09),
    "tertiary_link": RoadClass(1, 2, 3.10, 40 / 3.6, 0.09),
    "unclassified": RoadClass(1, 2, 3.00, 50 / 3.6, 0.10),
    "residential": RoadClass(1, 2, 2.90, 30 / 3.6, 0.10),
}


@dataclass(frozen=True)
class MarkingStyle:
    """How the roads of a country are marked."""

    country: str  # ISO 3166 code
    dash: float  # m, painted length of a lane divider on motorways and trunk roads
    gap: float  # m, between its dashes
    dash_slow: float  # m, on all other roads
    gap_slow: float  # m
    edge_inset: float = 0.25  # m, from the outer border of the outermost lane inwards to its edge line
    solid_centre: bool = False  # the directions of a two-lane road are divided by a solid line rather than by dashes
    shoulder: float = 2.5  # m, from the border of the lanes to a guard rail or barrier on motorways and trunk roads
    kerb: float = 0.5  # m, from the border of the lanes to a kerb on all other roads


MARKING_STYLES: Mapping[str, MarkingStyle] = {
    # MUTCD 2009 section 3A.06: 10 ft lines, 30 ft gaps
    "US": MarkingStyle("US", 3.05, 9.14, 3.05, 9.14, solid_centre=True, shoulder=3.0),
    # RMS-1 1993: 6 m / 12 m on motorways, 3 m / 6 m in towns
    "DE": MarkingStyle("DE", 6.0, 12.0, 3.0, 6.0),
    # Regolamento di esecuzione (DPR 495/1992) art. 138: type a 4.5 m / 7.5 m, type b 3 m / 4.5 m
    "IT": MarkingStyle("IT", 4.5, 7.5, 3.0, 4.5),
    # Norma de Marcas Rodoviarias (JAE 1995): 4 m / 10 m outside, 3 m / 4 m inside towns
    "PT": MarkingStyle("PT", 4.0, 10.0, 3.0, 4.0),
    # Expressways 8 m / 12 m, ordinary roads 5 m / 5 m (Japan Society of Traffic Engineers, road marking manual)
    "JP": MarkingStyle("JP", 8.0, 12.0, 5.0, 5.0, shoulder=1.5),
    # TSRGD 2016 diagram 1005: 2 m / 7 m above 40 mph, 2 m / 4 m below
    "GB": MarkingStyle("GB", 2.0, 7.0, 2.0, 4.0, shoulder=3.0),
}


def marking_style(country: str) -> MarkingStyle:
    """Return the marking style of a country.

    Raises
    ------
    OptionError
        If none is known for it.

    Examples
    --------
    >>> marking_style("DE").gap
    12.0
    """
    if country not in MARKING_STYLES:
        known = ", ".join(MARKING_STYLES)
        raise OptionError(f"no marking style for country {country!r}", where="markings", fix=f"use one of {known}")
    return MARKING_STYLES[country]
