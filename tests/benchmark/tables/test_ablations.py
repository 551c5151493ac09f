import csv
import json
from dataclasses import replace

import pandas as pd
import pytest

from probe2road.benchmark.tables import ablations
from probe2road.benchmark.tables.ablate import run_ablations
from probe2road.benchmark.tables.ablations import BASE, find_ablations, vary
from probe2road.benchmark.tables.cells import build_cell, score_cells
from probe2road.benchmark.tables.measured import Measured
from probe2road.benchmark.tables.source import Source
from probe2road.cli.main import main
from probe2road.errors import InputError, OptionError
from probe2road.segmentation.weights import read_weights

NAME = "interchange-diamond-1"
LOSS = {"geo_f1": 0.9, "itopo_f1": 0.7, "soft_f1": 0.8, "steps": 600}


@pytest.fixture(autouse=True)
def here(monkeypatch):
    """Build in this process, which has all modules."""
    monkeypatch.setattr(
        "probe2road.benchmark.tables.cells.measure",
        lambda function, *arguments: Measured(function(*arguments), 0.0, 0.0),
    )


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Where all tests keep what they build."""
    return tmp_path_factory.mktemp("work")


@pytest.fixture
def source(sets, work):
    return Source(sets / NAME, work, "modelled")


def test_the_command_writes_a_page_cells_and_figures(sets, work, tmp_path, monkeypatch):
    monkeypatch.setattr(ablations, "_COUNTS", (1, 4, 16))
    (tmp_path / "exp.json").write_text(json.dumps({"base": LOSS, "cp_2x2": LOSS, "width_1": LOSS}))
    output = tmp_path / "page"
    output.mkdir()
    (output / "notes.toml").write_text('thinning = "Both are alike."')
    words = ["benchmark", "ablate", sets, "--output", output, "--name", NAME, "--work", work, "--poses", "modelled"]
    words += ["--only", "thinning", "--only", "traces", "--trainings", tmp_path / "exp.json", "--quiet"]
    with pytest.raises(SystemExit) as done:
        main([str(word) for word in words])
    assert done.value.code in (None, 0)

    text = (output / "index.md").read_text()
    for part in (
        "## Thinning\n\nBoth are alike.\n\n![Thinning](thinning.png)",
        "| **Guo-Hall** |",
        "CP-loss, buffer 2x2",
    ):
        assert part in text
    assert "CP-loss, buffer 3x3" not in text
    for name in ("thinning", "traces", "loss"):
        assert (output / f"{name}.png").read_bytes()[1:4] == b"PNG"
    with (output / "cells.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["value"] for row in rows] == ["Guo-Hall", "Zhang-Suen", *2 * ["1", "4", "16"]]
    assert json.loads(rows[1]["config"])["options"]["thinning"] == "zhang_suen"
    of_gap, of_reference = rows[2:5], rows[5:]
    assert [json.loads(row["config"])["min_drives"] for row in of_reference] == [1, 4, 16]
    assert of_gap[1]["geo_f1"] == of_reference[1]["geo_f1"] == rows[0]["geo_f1"]
    # Roads that few passed are found as well as busy ones; against busy ones alone they are too much.
    assert min(float(row["geo_recall"]) for row in of_reference) > 0.9
    assert float(of_reference[-1]["geo_precision"]) < float(of_reference[0]["geo_precision"])


def test_a_variant_takes_the_probability_and_scores_like_the_base_with_its_options(source, monkeypatch):
    base = score_cells(source, BASE)[-1]
    monkeypatch.setattr("probe2road.segmentation.probability.predict_window", None)
    own = read_weights(BASE.weights).info.threshold
    same = replace(vary("threshold-0.2", {"mask": {"threshold": own, "seed_threshold": own}}), name="ablations/same")
    build_cell(source, same, like=BASE)
    (cell,) = score_cells(source, same)
    assert cell.key["options"] != base.key["options"]
    for metric in ("geo", "itopo"):
        pd.testing.assert_frame_equal(cell.tiles[metric], base.tiles[metric])
    assert cell.figures["resumed"]
    assert {name: value for name, value in cell.figures.items() if name in ("topo_f1", "km")} == {
        name: base.figures[name] for name in ("topo_f1", "km")
    }


def test_no_disambiguation_splits_nothing(source):
    tables = {variant.label: variant.method for variant in find_ablations(["junctions"], source)[0].variants}
    assert tables["guarded"] is BASE
    for label in ("none", "guarded"):
        build_cell(source, tables[label], like=None if label == "guarded" else BASE)
    log = {}
    for label in ("none", "guarded"):
        log[label] = score_cells(source, tables[label])[-1].figures
    assert log["none"]["junctions_f1"] <= log["guarded"]["junctions_f1"]


def test_every_variant_has_a_folder_of_its_own_and_differs_from_the_base_in_one_thing(source):
    for ablation in find_ablations([], source):
        places = {
            (variant.source.place, variant.method.name, variant.source.min_drives) for variant in ablation.variants
        }
        shared = 1 if ablation.name == "traces" else 0  # the default stands in both series
        assert len(places) == len(ablation.variants) - shared
        for variant in ablation.variants:
            if variant.like is not None:
                assert variant.method.options.segmentation == variant.like.options.segmentation
                assert variant.source == source
        assert ablation.default in [variant.label for variant in ablation.variants]


def test_poses_that_cannot_be_had_are_left_out(source, monkeypatch):
    monkeypatch.setattr(ablations, "find_spec", lambda name: None)
    (found,) = find_ablations(["poses"], source)
    assert [variant.label for variant in found.variants] == ["raw", "modelled"]
    monkeypatch.setattr(ablations, "find_spec", lambda name: name)
    (found,) = find_ablations(["poses"], source)
    assert [variant.label for variant in found.variants] == ["raw", "modelled", "aligned"]
    assert found.default == "modelled"


def test_what_cannot_be_varied_is_said_at_once(sets, tmp_path):
    with pytest.raises(OptionError, match="no ablation 'colour'"):
        run_ablations(sets, tmp_path / "out", name=NAME, only=["thinning", "colour"])
    for text, fault in (("{}", "none of the runs"), ('{"base": {"geo_f1": 0.9}}', "itopo_f1"), ("{", "trainings")):
        (tmp_path / "exp.json").write_text(text)
        with pytest.raises(InputError, match=rf"exp\.json: .*{fault}"):
            run_ablations(sets, tmp_path / "out", name=NAME, trainings=tmp_path / "exp.json")
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.toml").write_text("thinning: bad")
    with pytest.raises(InputError, match=r"notes\.toml: is not TOML"):
        run_ablations(sets, tmp_path / "out", name=NAME)
