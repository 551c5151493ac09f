from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from probe2road.benchmark.sets import datasets
from probe2road.benchmark.sets import prepare as module
from probe2road.benchmark.sets.datasets import DATASETS, GROUPS, find_dataset, find_datasets, load_network
from probe2road.benchmark.sets.prepare import check_dataset, prepare, prepare_dataset, read_tiles
from probe2road.benchmark.sets.recording import Recording
from probe2road.benchmark.sets.reference import MAIN_ROADS, labelled_reference
from probe2road.benchmark.sets.tiles import split_tiles
from probe2road.errors import InputError, OptionError
from probe2road.graph.check import check_graph
from probe2road.io.graph_files import read_graph
from probe2road.simulation.networks.network import check_network

ROADS = """<osm version="0.6">
<node id="1" lat="52.0" lon="9.0"/><node id="2" lat="52.0" lon="9.3"/>
<way id="9"><nd ref="1"/><nd ref="2"/><tag k="highway" v="motorway"/></way></osm>"""
SPLITS = {"train": 6, "validation": 4, "test": 4}


@pytest.fixture(scope="module", autouse=True)
def few_attempts():
    """Draw blocks of tiles less often than the real sets do."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "split_tiles", partial(split_tiles, attempts=50))
        yield


@pytest.fixture(scope="module")
def tiny():
    """A data set of a road of 20 km, and of few drives."""
    return replace(find_dataset("columbus"), name="tiny", network="roads.osm", drive_km=25.0, splits=SPLITS)


@pytest.fixture(scope="module")
def made(tiny, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    (folder / "roads.osm").write_text(ROADS)
    return prepare_dataset(tiny, folder / "tiny", data=folder)


def test_a_data_set_is_complete_and_says_what_it_is(made, tiny):
    check_dataset(made.folder)
    manifest = json.loads((made.folder / "manifest.json").read_text())
    assert manifest["definition"]["seed"] == tiny.seed
    assert manifest["licence"] == "ODbL-1.0"
    assert set(manifest["files"]) == {path.name for path in made.folder.iterdir()} - {"manifest.json"}
    readme = (made.folder / "README.md").read_text()
    assert "OpenStreetMap contributors" in readme
    assert "tiles.gpkg" in readme


def test_tiles_of_a_data_set_are_those_of_its_definition(made):
    tiles = read_tiles(made.folder)
    assert tiles["split"].value_counts().drop("").to_dict() == SPLITS


def test_making_it_again_changes_nothing(made, tiny):
    before = {path.name: path.read_bytes() for path in made.folder.iterdir()}
    assert prepare_dataset(tiny, made.folder, data=made.folder.parent) == made
    after = {path.name: path.read_bytes() for path in made.folder.iterdir()}
    assert set(after) == set(before)
    assert [name for name in after if after[name] != before[name] and name not in ("tiles.gpkg", "manifest.json")] == []
    check_dataset(made.folder)


def test_labels_come_from_the_true_numbers_of_drives(made):
    reference = read_graph(made.reference)
    assert labelled_reference(reference, min_drives=0).length == reference.length
    enough = int(reference.edges["support"].max())
    assert labelled_reference(reference, min_drives=enough).length > 0
    none = labelled_reference(reference, min_drives=enough + 1)
    assert (len(none.edges), len(none.nodes), len(none.turns)) == (0, 0, 0)
    with pytest.raises(OptionError, match="min_drives"):
        labelled_reference(reference, min_drives=-1)


def test_labels_need_numbers_of_drives(fork):
    with pytest.raises(InputError, match="has no number of drives"):
        labelled_reference(fork.reference_graph())


def test_damage_is_found(made, tmp_path):
    copy = Recording(Path(shutil.copytree(made.folder, tmp_path / "copy")))
    check_dataset(copy.folder)
    copy.poses.unlink()
    copy.routes.write_bytes(b"")
    with pytest.raises(InputError, match=r"2 faults(?s:.*)poses.parquet is missing(?s:.*)routes.parquet is not as"):
        check_dataset(copy.folder)


def test_generated_sets_need_no_extract_and_carry_no_notice(tmp_path, monkeypatch):
    tiny = {name: replace(DATASETS[name], drive_km=4.0) for name in ("corridor-1", "town-2")}
    monkeypatch.setattr(datasets, "DATASETS", tiny)
    stages = []
    folders = prepare(["corridor-1", "town-2"], tmp_path, data="absent", progress=lambda *state: stages.append(state))
    assert [folder.name for folder in folders] == ["corridor-1", "town-2"]
    for folder in folders:
        check_dataset(folder)
        assert "OpenStreetMap" not in (folder / "README.md").read_text()
        check_graph(read_graph(folder / "reference.gpkg"))
        with pytest.raises(InputError, match="has no splits"):
            read_tiles(folder)
    assert stages[-1] == ("town-2: km", 4, 4)


def test_a_variant_without_camera_has_no_modelled_data(tmp_path):
    phone = replace(find_dataset("corridor-1-phone"), drive_km=4.0)
    made = prepare_dataset(phone, tmp_path / "phone", data="")
    assert not made.modelled.exists()
    assert "modelled" not in (made.folder / "README.md").read_text()


def test_definitions_are_distinct_and_groups_name_them():
    assert all(member in DATASETS for members in GROUPS.values() for member in members)
    assert len({(data.network, data.seed) for data in DATASETS.values()}) == len(DATASETS)
    assert len(find_datasets([])) == 7
    assert {"boston", "hannover", "tokyo_shibuya"} == set(GROUPS["test"])


def test_unknown_names_are_refused_before_anything_is_made(tmp_path):
    with pytest.raises(OptionError, match="no data set 'boston-sunny'"):
        prepare(["corridor-1", "boston-sunny"], tmp_path / "sets", data="")
    assert not (tmp_path / "sets").exists()


@pytest.mark.parametrize("name", [*GROUPS["interchanges"], *GROUPS["corridors"], *GROUPS["towns"]])
def test_generated_networks_are_sound(name):
    network = load_network(find_dataset(name), "")
    check_network(network)
    assert network.driving_side == ("right" if int(name[-1]) % 2 else "left")


@pytest.mark.slow
@pytest.mark.parametrize("name", GROUPS["cities"])
def test_real_networks_are_main_roads_with_primary_roads_where_they_meet(extracts, name):
    network = load_network(find_dataset(name), extracts)
    check_network(network)
    main = network.sections[network.sections["highway"].isin(MAIN_ROADS)]
    assert main.length.sum() > 0.7 * network.length
    assert network.driving_side == ("left" if name == "tokyo_shibuya" else "right")
