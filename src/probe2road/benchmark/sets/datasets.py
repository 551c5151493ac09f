"""The data sets of the open benchmark: roads, fleet, seed, splits, and purpose of each.

The roles follow the paper: one city to train and test on, two cities that only ever test. What may choose anything
(weights, thresholds, options) is said by the role, and boston, hannover and tokyo_shibuya never do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from probe2road.benchmark.sets.reference import MAIN_ROADS, PRIMARY_ROADS, main_roads
from probe2road.errors import MissingFileError, OptionError
from probe2road.simulation.drawn.generate import INTERCHANGES, generate_corridor, generate_interchange, generate_town
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.networks.osm import read_network
from probe2road.simulation.networks.road_classes import CLASS_DEFAULTS
from probe2road.simulation.presets import PRESETS, Preset, find_preset

__all__ = ["DATASETS", "GROUPS", "OSM_NOTICE", "Dataset", "find_dataset", "find_datasets", "load_network"]

OSM_NOTICE = (
    "Contains information from OpenStreetMap, (c) OpenStreetMap contributors, which is made available under the "
    "Open Database License (ODbL) 1.0: https://www.openstreetmap.org/copyright"
)


@dataclass(frozen=True)
class Dataset:
    """The definition of a data set; the same definition makes the same data."""

    name: str
    role: str  # one line: what it is for
    network: str  # file in the folder of extracts, or "generate:KIND:SEED"
    drive_km: float  # km driven in all
    seed: int  # of the fleet
    preset: str = "mixed"
    roads: Literal["main", "all"] = "main"  # of an extract: main roads with the beginnings of primary ones, or all
    zipf_exponent: float = 0.7  # of the demand; the preset's 1 lets a few origins, and so the seed, decide too much
    splits: Mapping[str, int] = field(default_factory=dict)  # tiles of each split; empty where it is used as a whole
    split_seed: int = 0  # draws the blocks of tiles

    @property
    def generated(self) -> bool:
        """Tell whether the roads need no external data."""
        return self.network.startswith("generate:")

    @property
    def fleet(self) -> Preset:
        """Return the preset of the data set, with the demand of the benchmark."""
        preset = find_preset(self.preset)
        return replace(preset, demand=replace(preset.demand, zipf_exponent=self.zipf_exponent))


_TRAIN = "training of the shipped model"

# Kilometres: so many that a main road has some hundred drives and a quiet ramp a few or none. The columbus set then
# takes a few hundred megabytes.
_CITIES = (
    Dataset(
        "columbus",
        "the role of San Jose: training, validation and test by tile",
        "columbus.osm.pbf",
        10_000.0,
        1,
        splits={"train": 110, "validation": 16, "test": 12},
    ),
    Dataset("boston", "the role of San Francisco: test only, complex and stacked", "boston.osm.pbf", 8_000.0, 2),
    Dataset("hannover", "the role of Tokyo: test only, another country, simpler", "hannover.osm.pbf", 10_000.0, 3),
    Dataset("tokyo_shibuya", "test only: stacked, left-hand traffic", "tokyo_shibuya.osm.pbf", 800.0, 4),
    Dataset("rhein_neckar", _TRAIN, "rhein_neckar.osm.pbf", 10_000.0, 5),
    Dataset("porto", _TRAIN, "porto.osm.pbf", 12_000.0, 6),
    Dataset("milan", "validation of the shipped model", "milan.osm.pbf", 6_000.0, 7),
)
_STREETS = (
    Dataset("london_streets", _TRAIN, "streets_london.osm.pbf", 500.0, 11, roads="all"),
    Dataset("munich_streets", _TRAIN, "streets_munich.osm.pbf", 500.0, 12, roads="all"),
    Dataset("rhein_neckar_roads", _TRAIN, "rhein_neckar.osm.pbf", 12_000.0, 13, roads="all"),
)
_SIDES = (("right", "DE"), ("left", "JP"))  # of the first and the second network of a kind
_WIDE_LANES = (5, 9)  # through lanes of a wide carriageway; beside its ramps there is one more
_INTERCHANGES = tuple(
    Dataset(f"interchange-{kind}-{seed}", _TRAIN, f"generate:{kind}:{seed}", 500.0, 100 + seed)
    for kind in INTERCHANGES
    for seed in (1, 2)
)
_CORRIDORS = tuple(Dataset(f"corridor-{n}", _TRAIN, f"generate:corridor:{n}", 1_000.0, 200 + n) for n in (1, 2, 3, 4))
_WIDE = (
    Dataset("pasadena", _TRAIN, "pasadena.osm.pbf", 400.0, 14),
    *(Dataset(f"wide_corridor-{n}", _TRAIN, f"generate:wide_corridor:{n}", 1_500.0, 250 + n) for n in (1, 2, 3, 4)),
)
_TOWNS = tuple(
    Dataset(f"{kind}-{seed}", _TRAIN, f"generate:{kind}:{seed}", 500.0, 300 + seed)
    for kind in ("town", "old_town")
    for seed in (1, 2, 3, 4)
)

DATASETS: Mapping[str, Dataset] = {
    data.name: data for data in (*_CITIES, *_STREETS, *_INTERCHANGES, *_CORRIDORS, *_WIDE, *_TOWNS)
}

GROUPS: Mapping[str, tuple[str, ...]] = {
    "cities": tuple(data.name for data in _CITIES),
    "test": ("boston", "hannover", "tokyo_shibuya"),
    "streets": tuple(data.name for data in _STREETS),
    "interchanges": tuple(data.name for data in _INTERCHANGES),
    "corridors": tuple(data.name for data in _CORRIDORS),
    "wide": tuple(data.name for data in _WIDE),
    "towns": tuple(data.name for data in _TOWNS),
}


def find_dataset(name: str) -> Dataset:
    """Return a data set by name; ``NAME-PRESET`` has the same roads and drives with another preset.

    Raises
    ------
    OptionError
        If there is none of that name.

    Examples
    --------
    >>> find_dataset("columbus").preset, find_dataset("columbus-phone").preset
    ('mixed', 'phone')
    >>> find_dataset("atlantis")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: there is no data set 'atlantis'; use columbus, boston, ..., or a name with -PRESET
    """
    base, _, preset = name.rpartition("-")
    if name in DATASETS:
        return DATASETS[name]
    if base in DATASETS and preset in PRESETS:
        return replace(DATASETS[base], name=name, preset=preset)
    known = ", ".join([data.name for data in _CITIES] + [name for name in GROUPS if name not in ("cities", "test")])
    raise OptionError(f"there is no data set {name!r}", fix=f"use {known}, or a name with -PRESET")


def find_datasets(names: list[str]) -> list[Dataset]:
    """Return data sets by name or by group, each once, in the given order; without a name, all cities.

    Raises
    ------
    OptionError
        If there is none of a name.

    Examples
    --------
    >>> [data.name for data in find_datasets(["boston", "test"])]
    ['boston', 'hannover', 'tokyo_shibuya']
    """
    single = [member for name in names or ["cities"] for member in GROUPS.get(name, (name,))]
    return [find_dataset(name) for name in dict.fromkeys(single)]


def load_network(data: Dataset, folder: str | Path) -> RoadNetwork:
    """Read or generate the roads of a data set.

    Of the main roads of an extract, motorways, trunk roads and their links are kept, and primary roads where they
    meet them.

    Parameters
    ----------
    data
        The definition.
    folder
        Where the extracts are; not looked at for generated roads.

    Raises
    ------
    InputError
        If the extract is not there or cannot be read.
    """
    if not data.generated:
        path = Path(folder) / data.network
        if not path.is_file():
            raise MissingFileError(
                "there is no such extract", where=path, fix='name the folder of extracts, for example data="extracts"'
            )
        if data.roads == "all":
            return read_network(path, highways=tuple(CLASS_DEFAULTS))
        return main_roads(read_network(path, highways=(*MAIN_ROADS, *PRIMARY_ROADS)))
    _, kind, seed = data.network.split(":")
    rng = np.random.default_rng(int(seed))
    side, country = _SIDES[(int(seed) - 1) % 2]
    if kind == "corridor":
        return generate_corridor(rng=rng, driving_side=side, country=country)
    if kind == "wide_corridor":
        return generate_corridor(rng=rng, lanes=_WIDE_LANES, driving_side=side, country=country)
    if kind in ("town", "old_town"):
        return generate_town(rng=rng, regular=kind == "town", driving_side=side, country=country)
    return generate_interchange(kind, rng=rng, driving_side=side, country=country)
