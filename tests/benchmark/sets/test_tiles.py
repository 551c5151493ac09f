from __future__ import annotations

import numpy as np
import pytest
import shapely

from probe2road.benchmark.sets.datasets import find_dataset, load_network
from probe2road.benchmark.sets.tiles import motorway_tiles, split_area, split_tiles
from probe2road.errors import InputError, OptionError
from probe2road.simulation.networks.network import network_from_sections

COUNTS = {"train": 30, "validation": 6, "test": 5}


@pytest.fixture(scope="module")
def tiles():
    """A grid of motorways: every tile of 12 by 12 holds some."""
    lines = [[(0, at), (12_000, at)] for at in range(500, 12_000, 1000)]
    lines += [[(at + 37.0, 0), (at + 37.0, 12_000)] for at in range(500, 12_000, 3000)]
    return motorway_tiles(network_from_sections(lines, crs="EPSG:32616"))


@pytest.fixture(scope="module")
def split(tiles):
    return split_tiles(tiles, COUNTS, rng=np.random.default_rng(3), attempts=50)


def assert_apart(split):
    """No two tiles of different splits touch, not even at a corner."""
    used = split[split["split"] != ""]
    away = np.maximum(*(np.abs(np.subtract.outer(used[a].to_numpy(), used[a].to_numpy())) for a in ("column", "row")))
    differ = used["split"].to_numpy()[:, None] != used["split"].to_numpy()[None, :]
    assert away[differ].min() >= 2


def test_tiles_hold_all_motorway_once(tiles):
    assert len(tiles) == 144
    assert tiles["motorway"].sum() == pytest.approx(12 * 12_000 + 4 * 12_000)
    assert (tiles.geometry.area == 1e6).all()
    assert tiles["crossings"].sum() == 12 * 4


def test_only_motorways_make_tiles():
    network = network_from_sections(
        [[(0, 0), (900, 0)], [(0, 5000), (900, 5000)]], crs="EPSG:32616", highway=["primary", "motorway_link"]
    )
    assert motorway_tiles(network)[["motorway", "ramp"]].values.tolist() == [[0.0, 900.0]]


def test_splits_have_their_sizes_and_a_tile_between_them(split):
    assert split["split"].value_counts().drop("").to_dict() == COUNTS
    assert_apart(split)


def test_the_seed_decides(tiles, split):
    again = split_tiles(tiles, COUNTS, rng=np.random.default_rng(3), attempts=50)
    other = split_tiles(tiles, COUNTS, rng=np.random.default_rng(4), attempts=50)
    assert again["split"].equals(split["split"])
    assert not other["split"].equals(split["split"])


def test_areas_of_splits_do_not_meet(split):
    test, train = split_area(split, "test"), split_area(split, "train")
    assert test.area == 5e6
    assert shapely.distance(test, train) >= 1000.0
    assert split_area(split, "test", inset=50.0).area < test.area


def test_impossible_splits_are_refused(tiles, split):
    with pytest.raises(OptionError, match="too few"):
        split_tiles(tiles, {"train": 140, "validation": 2, "test": 2}, rng=np.random.default_rng(1), attempts=20)
    with pytest.raises(OptionError, match="give train, validation, test"):
        split_tiles(tiles, {"train": 4}, rng=np.random.default_rng(1))
    with pytest.raises(InputError, match="no area of split 'tests'"):
        split_area(split, "tests")


@pytest.mark.slow
def test_columbus_has_138_tiles_of_the_paper_and_keeps_them(extracts):
    columbus = find_dataset("columbus")
    network = load_network(columbus, extracts)
    split = split_tiles(motorway_tiles(network), columbus.splits, rng=np.random.default_rng(columbus.split_seed))
    assert split["split"].value_counts().drop("").to_dict() == {"train": 110, "validation": 16, "test": 12}
    assert_apart(split)
    # The published split: a change here makes another benchmark.
    assert split.index[split["split"] == "test"].tolist() == [
        *("334_4428", "335_4429", "336_4429", "337_4430", "338_4420", "338_4431"),
        *("339_4420", "339_4430", "340_4420", "340_4421", "340_4422", "341_4421"),
    ]
