"""What belongs to the tree as a whole: layering, what an import loads, and documents that agree with the code."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import probe2road

DOCUMENTED = ast.Module | ast.ClassDef | ast.FunctionDef
ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "probe2road"
MODULES = {
    ".".join(path.relative_to(SOURCE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(SOURCE.rglob("*.py"))
    if path != SOURCE / "__init__.py"
}


def block(name: str) -> list[str]:
    """Return the lines of a block of decision 0001."""
    page = (ROOT / "docs" / "decisions" / "0001-layout-and-layering.md").read_text(encoding="utf-8")
    found = re.search(rf"```{name}\n(.*?)```", page, re.DOTALL)
    assert found is not None
    return found[1].splitlines()


def layers() -> list[str]:
    """Return the rooms in the order that decision 0001 declares."""
    return [line.split()[0] for line in block("layers")]


def parts() -> dict[str, list[str]]:
    """Return the parts of each room, with their full names, in the order that decision 0001 declares."""
    rooms = [line.split(": ") for line in block("rooms")]
    return {room: [f"{room}.{part}" for part in names.split()] for room, names in rooms}


def rank(module: str, order: list[str]) -> int:
    """Return the place of the longest declared name that is the module or a package it is in; -1 if there is none."""
    names = [name for name in order if module == name or module.startswith(f"{name}.")]
    return order.index(max(names, key=len)) if names else -1


def imports(module: str) -> Iterator[str]:
    """Yield the modules of ours that a module imports, anywhere in its code."""
    for node in ast.walk(ast.parse(MODULES[module].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            found = [f"{node.module}.{alias.name}" for alias in node.names] + [node.module]
        else:
            continue
        for name in found:
            if name.removeprefix("probe2road.") in MODULES and name.startswith("probe2road."):
                yield name.removeprefix("probe2road.")


def test_every_module_has_a_layer_and_every_layer_a_module() -> None:
    order = layers()
    assert len(order) == len(set(order))
    outside = [module for module in MODULES if rank(module, order) < 0]
    assert [module for module in outside if not any(name.startswith(f"{module}.") for name in order)] == []
    assert [name for name in order if name not in MODULES] == []


@pytest.mark.parametrize("module", MODULES)
def test_module_imports_only_what_stands_above_it(module: str) -> None:
    order = layers()
    assert [name for name in imports(module) if rank(name, order) > rank(module, order)] == []


def test_only_explore_takes_the_front_door() -> None:
    """What is imported as an attribute of the package escapes the layers."""
    through = [
        module
        for module, path in MODULES.items()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Import) and "probe2road" in [alias.name for alias in node.names]
    ]
    assert through == ["graph.roadgraph"]


def test_every_room_lists_its_parts() -> None:
    for room, listed in parts().items():
        inside = {
            ".".join(module.split(".")[: room.count(".") + 2]) for module in MODULES if module.startswith(f"{room}.")
        }
        assert sorted(listed) == sorted(inside), room


@pytest.mark.parametrize("room", parts())
def test_part_of_a_room_imports_only_what_stands_above_it(room: str) -> None:
    order = parts()[room]
    for module in MODULES:
        if module.startswith(f"{room}."):
            inside = [name for name in imports(module) if name.startswith(f"{room}.")]
            assert [name for name in inside if rank(name, order) > rank(module, order)] == [], module


def test_no_modules_import_each_other_in_a_circle() -> None:
    graph = {module: {name for name in imports(module) if name != module} for module in MODULES}
    assert len(list(TopologicalSorter(graph).static_order())) == len(MODULES)


@pytest.mark.parametrize("module", MODULES)
def test_module_has_a_docstring_and_says_what_is_public(module: str) -> None:
    tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
    assert ast.get_docstring(tree), "no docstring"
    if MODULES[module].name == "__init__.py" and not list(imports(module)):
        return  # a package that exports nothing
    public = next(
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]
    )
    assert public, "__all__ is empty"
    assert len(public) == len(set(public))


def test_no_two_public_classes_have_one_name() -> None:
    homes: dict[str, list[str]] = {}
    for module, path in MODULES.items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(module)
    assert {name: modules for name, modules in homes.items() if len(modules) > 1} == {}


def test_import_loads_nothing_heavy() -> None:
    code = "import json, sys, probe2road; print(json.dumps([*sys.modules]))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(json.loads(run.stdout))
    assert {"torch", "geopandas", "numba", "numpy", "pandas", "scipy", "matplotlib"}.isdisjoint(loaded)


def test_the_library_names_no_flag_of_the_command_line() -> None:
    programs = {"matching.osrm", "training.sources"}  # the flags of other programs, and whole commands to run first
    flag = re.compile(r"(?<![\w-])--[a-z]")
    for module in sorted(MODULES.keys() - programs):
        if not module.startswith("cli."):
            tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
            documented = [
                ast.get_docstring(node, clean=False) for node in ast.walk(tree) if isinstance(node, DOCUMENTED)
            ]
            texts = [
                node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
            ]
            assert [text for text in texts if flag.search(text) and text not in documented] == [], module


def test_version_is_that_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert probe2road.__version__ == project["version"]


def test_readme_shows_two_commands() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(\w*)\n(.*?)```", readme, re.DOTALL)
    commands = [line for language, text in blocks if language != "python" for line in text.splitlines()]
    assert commands == ["make demo", "make test"]


def test_every_module_is_in_the_reference() -> None:
    folder = ROOT / "docs" / "reference" / "internals"
    pages = "\n".join(path.read_text(encoding="utf-8") for path in sorted(folder.glob("*.md")))
    listed = re.findall(r"^::: probe2road\.(\S+)$", pages, re.MULTILINE)
    documented_by_hand = {"__main__", "cli.main", "cli.benchmark", "cli.reading"}
    packages = {name for name, path in MODULES.items() if path.name == "__init__.py"}
    modules = sorted(set(MODULES) - packages - documented_by_hand)
    assert [name for name in modules if not any(f"{name}.".startswith(f"{entry}.") for entry in listed)] == []
    assert [name for name in listed if name not in MODULES] == []


def test_everything_at_the_front_door_is_on_the_first_level_of_the_reference() -> None:
    pages = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs" / "reference").glob("*.md"))
    listed = re.findall(r"^::: probe2road\.(\S+)$", pages, re.MULTILINE)
    assert len(listed) == len(set(listed))
    in_errors = {"Probe2RoadError", "errors"}
    assert set(listed) | in_errors == {name for name in dir(probe2road) if name not in MODULES} | in_errors


def test_relative_links_of_the_root_documents_lead_somewhere() -> None:
    for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "RELEASING.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        links = [link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
        assert [link for link in links if not (ROOT / link).exists()] == [], name


def test_version_is_that_of_the_citation() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {probe2road.__version__}\n" in citation


def test_minimum_constraints_are_the_lower_bounds() -> None:
    command = [sys.executable, ROOT / "tools" / "minimum_versions.py", "--check"]
    assert subprocess.run(command, capture_output=True, text=True, check=False).stderr == ""


def test_hooks_run_the_tools_of_continuous_integration() -> None:
    hooks = re.findall(r"entry: \.venv/(bin/\S+)", (ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    recipes = (ROOT / "Makefile").read_text(encoding="utf-8").replace("$(BIN)", "bin")
    assert [hook for hook in hooks if hook != "bin/python" and hook not in recipes] == []
    assert {"bin/ruff", "bin/mypy"} <= set(hooks)


def test_make_bench_runs_every_benchmark() -> None:
    program = (ROOT / "benchmarks" / "run_all.py").read_text(encoding="utf-8")
    names = [path.stem.removeprefix("bench_") for path in (ROOT / "benchmarks").glob("bench_*.py")]
    assert [name for name in names if f'    "{name}": [' not in program] == []
