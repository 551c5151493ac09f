"""The junction suite as golden results: which edges are found to connect, for junctions of every kind.

``tests/golden/junctions.json`` is written by running this file: ``python tests/golden/test_junctions.py``. Look at
what has changed before committing it.
"""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

HERE = Path(__file__).parent
GOLDEN = HERE / "junctions.json"
DRIVES = (1, 4)
QUICK = ("diamond", "overpass 20 deg", "merge beside bridge", "roundabout")
SLOW = ("cloverleaf", "trumpet", "tunnel under junction", "weaving", "town")
KINDS = (*QUICK, *SLOW)
TOLERANCE = 0.03  # of F1: libraries round differently, and a drive more or less can decide


def suite() -> ModuleType:
    """Load the benchmark, which is no part of the package."""
    path = HERE.parents[1] / "experiments" / "junction_suite.py"
    spec = importlib.util.spec_from_file_location("junction_suite", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["junction_suite"] = module
    spec.loader.exec_module(module)
    return module


def scores(module: ModuleType, kind: str) -> dict[str, dict[str, float]]:
    """F1 of every variant by drives per movement."""
    counted = module.score_plan(kind, "open_sky", DRIVES, seed=1)
    f1 = module.with_scores(counted, ["drives", "variant"])["f1"]
    return {str(k): {variant: round(float(f1[k, variant]), 4) for variant in module.VARIANTS} for k in DRIVES}


@pytest.fixture(scope="module")
def module() -> ModuleType:
    return suite()


@pytest.mark.parametrize("kind", [*QUICK, *(pytest.param(kind, marks=pytest.mark.slow) for kind in SLOW)])
def test_suite_scores_as_recorded(module: ModuleType, kind: str) -> None:
    golden: dict[str, dict[str, float]] = json.loads(GOLDEN.read_text(encoding="utf-8"))[kind]
    found = scores(module, kind)
    for drives, variants in golden.items():
        for variant, f1 in variants.items():
            assert found[drives][variant] == pytest.approx(f1, abs=TOLERANCE), (drives, variant)


@pytest.mark.parametrize("kind", KINDS)
def test_four_drives_for_each_movement_are_enough(kind: str) -> None:
    golden: dict[str, Any] = json.loads(GOLDEN.read_text(encoding="utf-8"))[kind]["4"]
    assert golden["guarded"] >= 0.93
    assert golden["with altitude"] >= 0.97
    assert golden["with altitude"] >= golden["none"]


def test_perfect_graph_scores_perfectly(module: ModuleType) -> None:
    network = module.network_of("diamond", 1)
    plan = module.plan_graph(network)
    true, false = (plan.truth["connected"] == value for value in (True, False))
    assert true.any()
    assert false.any()
    assert module.confusion(plan.graph, plan) == (true.sum(), false.sum(), 0)


if __name__ == "__main__":
    recorded = {kind: scores(suite(), kind) for kind in KINDS}
    GOLDEN.write_text(json.dumps(recorded, indent=1) + "\n", encoding="utf-8")
