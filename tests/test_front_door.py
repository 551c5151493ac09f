"""What `import probe2road` offers: verbs, everything needed to call them, and every room; and how results show."""

from __future__ import annotations

import ast
import pickle
import re
import subprocess
import sys
import typing
from dataclasses import fields, is_dataclass
from importlib import import_module
from inspect import signature
from pathlib import Path
from pkgutil import iter_modules
from types import FunctionType, ModuleType
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import probe2road as p2r
from probe2road.draw import view as draw_view
from probe2road.draw.view import Page
from sketches import UTM

VERBS = ("read_fleet", "simulate", "align", "build", "refine", "match", "label", "evaluate", "view", "write_graph")
VERBS += ("read_graph", "write_fleet", "describe_fleet", "describe_graph", "rasterize", "clean_graph", "add_drives")
VERBS += ("read_network", "find_preset", "fleet_from_tables", "graph_from_lines", "check_graph", "from_networkx")
ROOMS = [module.name for module in iter_modules(p2r.__path__) if module.name != "__main__"]


@pytest.fixture
def graph() -> p2r.RoadGraph:
    """A street and a side street; nobody has driven the second."""
    support = pd.DataFrame({"support": pd.array([7, None], "Int64")})
    return p2r.graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 50)]], crs=UTM, attributes=support)


@pytest.fixture
def fleet() -> p2r.Fleet:
    """Two drives along the street, and a lane marking."""
    x = np.tile(np.arange(0.0, 100.0, 10.0), 2)
    traces = pd.DataFrame({"trace_id": np.repeat(["secret-A", "secret-B"], 10), "t": np.arange(20), "x": x, "y": 1.0})
    points = pd.DataFrame({"trace_id": ["secret-A"], "x": [50.0], "y": [3.0], "kind": ["lane_marking"]})
    return p2r.fleet_from_tables(traces, points, crs=UTM, keep_crs=True)


def test_every_name_of_the_stub_is_there_and_the_stub_names_all() -> None:
    tree = ast.parse(Path(p2r.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    listed = [alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names]
    assert len(listed) == len(set(listed))
    assert sorted(listed) == sorted(dir(p2r))
    assert [name for name in listed if not hasattr(p2r, name)] == []
    assert set(VERBS) <= {name for name in listed if callable(getattr(p2r, name))}


@pytest.mark.parametrize("verb", VERBS)
def test_whatever_a_verb_takes_or_gives_can_be_had_at_the_front_door(verb: str) -> None:
    hints = typing.get_type_hints(getattr(p2r, verb))
    named = {kind for hint in hints.values() for kind in ours(hint)}
    assert [kind.__name__ for kind in named if getattr(p2r, kind.__name__, None) is not kind] == []


def ours(hint: Any) -> set[type]:
    """Return the classes of ours that an annotation names, and those of the options nested in them."""
    found = {part for item in typing.get_args(hint) for part in ours(item)}
    if isinstance(hint, type) and hint.__module__.startswith("probe2road."):
        found.add(hint)
        if is_dataclass(hint) and re.search("Options$|Preset$|TraceGaps", hint.__name__):
            hints = typing.get_type_hints(hint)
            found |= {part for entry in fields(hint) for part in ours(hints[entry.name])}
    return found


@pytest.mark.parametrize("room", ROOMS)
def test_every_room_and_what_is_in_it_can_be_had_by_attribute(room: str) -> None:
    found = getattr(p2r, room)
    assert isinstance(found, ModuleType)
    if room == "metrics":
        return  # its functions are named like its modules
    for module in iter_modules(getattr(found, "__path__", [])):
        assert module.name in dir(found)


def test_rooms_open_without_an_import() -> None:
    code = (
        "import probe2road as p2r; print(p2r.refinement.gaps.fill.__name__, p2r.errors.InputError.__name__, "
        "p2r.simulation.networks.osm.__name__, callable(p2r.metrics.geo), callable(p2r.evaluate), "
        "callable(p2r.metrics.geo), callable(p2r.align), p2r.alignment.align.__name__)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout.split() == [
        "probe2road.refinement.gaps.fill",
        "InputError",
        "probe2road.simulation.networks.osm",
        *["True"] * 4,
        "probe2road.alignment.align",
    ]


def test_no_verb_is_named_like_a_room() -> None:
    """Else the import of the room would take the place of the verb."""
    functions = {name for name in dir(p2r) if isinstance(getattr(p2r, name), FunctionType)}
    assert functions.isdisjoint(ROOMS)


@pytest.mark.parametrize("verb", ["build", "align", "add_drives", "refine", "match", "label", "view", "evaluate"])
def test_options_workspace_and_progress_are_keywords(verb: str) -> None:
    kinds = {name: entry.kind for name, entry in signature(getattr(p2r, verb)).parameters.items()}
    keywords = {name for name in kinds if kinds[name] is kinds[name].KEYWORD_ONLY}
    assert {"options", "workspace", "progress", "work", "report"} & set(kinds) <= keywords
    assert {"work", "report"}.isdisjoint(kinds)


def test_the_program_runs_as_a_module() -> None:
    run = subprocess.run([sys.executable, "-m", "probe2road", "--help"], capture_output=True, text=True, check=True)
    assert "python -m probe2road" in run.stdout


def test_results_are_short_and_name_no_drive(graph: p2r.RoadGraph, fleet: p2r.Fleet) -> None:
    matches = p2r.match(graph, fleet)
    expected = {
        fleet: "Fleet(2 traces, 20 fixes, 1 points, WGS 84 / UTM zone 16N)",
        graph: "RoadGraph(3 nodes, 2 edges, 0.150 km, WGS 84 / UTM zone 16N)",
        matches: "Matches(2 traces, 20 fixes, 20 fixes matched, 2 steps, 1 edges driven)",
        p2r.SimulatedFleet(fleet, fleet.traces, fleet.traces, graph): f"SimulatedFleet({fleet!r} on {graph!r})",
    }
    for result, text in expected.items():
        assert repr(result) == text
        table = result._repr_html_()
        assert "secret" not in repr(result) + table
        assert table.count("<tr>") == table.count("</tr>") > 3


def test_an_alignment_is_shown_by_its_figures(fleet: p2r.Fleet) -> None:
    drives = pd.DataFrame({"trace_id": ["secret-A"], "status": "aligned", "reason": "", "points": 9, "shift": 0.4})
    report = p2r.AlignmentReport(drives, 0.61, 0.12, pd.DataFrame(), 1)
    alignment = p2r.Alignment(fleet, report)
    assert repr(report) == "AlignmentReport(1 drives: 1 aligned; lines 0.61 to 0.12 m)"
    assert repr(alignment) == f"Alignment({fleet!r}, {report!r})"
    assert "secret" not in alignment._repr_html_()


def test_results_are_equal_to_themselves_only_and_go_into_sets(graph: p2r.RoadGraph, fleet: p2r.Fleet) -> None:
    for result in (graph, fleet, p2r.match(graph, fleet)):
        twin = pickle.loads(pickle.dumps(result))
        assert result == result
        assert result != twin
        assert result in [twin, result]
        assert len({result, twin, result}) == 2


def test_plot_draws_into_axes_like_geopandas(graph: p2r.RoadGraph) -> None:
    axes = Figure().subplots()
    assert graph.plot(ax=axes, color="crimson", linewidth=3) is axes
    assert axes.collections[0].get_linewidth() == 3
    assert len(axes.collections[0].get_paths()) == 2
    own = graph.plot("length", legend=True)
    assert isinstance(own, Axes)
    assert (
        len(graph.plot(column="support").collections[0].get_paths()) == 1
    )  # as geopandas: what is missing is not drawn
    plt.close("all")


def test_explore_opens_a_page_of_ours(
    graph: p2r.RoadGraph, fleet: p2r.Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[str] = []
    monkeypatch.setattr(draw_view.webbrowser, "open", lambda address: not opened.append(address))
    monkeypatch.setattr(draw_view.tempfile, "tempdir", str(tmp_path))
    page = graph.explore(fleet=fleet, title="A & B", color_by="length")
    (file,) = tmp_path.glob("probe2road-*/roads.html")
    assert opened == [file.as_uri()]
    text = file.read_text()
    assert "<h1>A &amp; B</h1>" in text
    assert "secret" not in text
    assert repr(page).startswith("Page('A & B', ")
    page.save(tmp_path / "kept.html")
    assert (tmp_path / "kept.html").read_text() == text


def test_explore_shows_the_page_in_a_notebook(graph: p2r.RoadGraph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(draw_view, "in_notebook", lambda: True)
    monkeypatch.setattr(draw_view.webbrowser, "open", lambda _: pytest.fail("a notebook shows the page itself"))
    page = graph.explore()
    assert isinstance(page, Page)
    frame = page._repr_html_()
    assert frame.startswith('<iframe srcdoc="&lt;!DOCTYPE html&gt;')
    assert frame.count('"') == 4  # of srcdoc and style: nothing of the page ends them


@pytest.mark.parametrize(("shell", "expected"), [(object(), False), (type("Shell", (), {"kernel": 1})(), True)])
def test_only_a_kernel_is_a_notebook(shell: object, expected: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    python = ModuleType("IPython")
    python.get_ipython = lambda: shell  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", python)
    assert import_module("probe2road.notebook").in_notebook() is expected


def test_one_metric_needs_no_list(graph: p2r.RoadGraph) -> None:
    for metric in ("geo", p2r.GeoOptions(radius=5.0)):
        scores = p2r.evaluate(graph, graph, metrics=metric)
        assert scores["metric"].tolist() == ["geo"]
        assert scores["f1"].tolist() == [1.0]
    with pytest.raises(p2r.errors.OptionError, match="there is no metric 'g'"):
        p2r.evaluate(graph, graph, metrics="g")


def test_a_fleet_stays_in_its_crs_on_request() -> None:
    street = pd.DataFrame({"trace_id": 1, "x": [0.0, 100.0], "y": 0.0})
    assert p2r.fleet_from_tables(street, crs=UTM).bounds != (0.0, 0.0, 100.0, 0.0)
    assert p2r.fleet_from_tables(street, crs=UTM, keep_crs=True).bounds == (0.0, 0.0, 100.0, 0.0)
    with pytest.raises(p2r.errors.CRSError, match="degrees"):
        p2r.fleet_from_tables(street, crs="EPSG:4326", keep_crs=True)
    with pytest.raises(p2r.errors.OptionError, match="keep_crs contradicts target_crs"):
        p2r.fleet_from_tables(street, crs=UTM, target_crs=UTM, keep_crs=True)
