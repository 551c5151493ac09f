"""Damaged files of every graph format are read or refused; `tools/fuzz.py` tries more, and the fleet's, on request."""

from __future__ import annotations

import importlib
import random
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

INPUTS = 100

fuzz: Any = importlib.import_module("fuzz")


@pytest.fixture(scope="module")
def seeds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return dict(fuzz.write_seeds(tmp_path_factory.mktemp("seeds")))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("reader", fuzz.GRAPH)
def test_a_damaged_graph_is_read_or_refused(reader: str, seeds: dict[str, Path], tmp_path: Path) -> None:
    """In this process, which is quicker; the program does it in one that may hang or crash."""
    fuzz.read(reader, seeds[reader])
    for number, files in enumerate(fuzz.inputs_of(seeds[reader], INPUTS, random.Random(f"test {reader}"))):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name, content in files.items():
            (folder / name).write_bytes(content)
        assert fuzz.outcome_of(reader, folder / seeds[reader].name) in ("read", "refused"), folder


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    worker = fuzz.Worker(1000 << 20)
    yield worker
    worker.stop()


def test_a_hang_is_counted_and_the_worker_replaced(worker: Any, seeds: dict[str, Path]) -> None:
    assert worker.ask("graphml", seeds["graphml"], 60.0) == "read"
    assert worker.ask("graphml", seeds["graphml"], 0.0) == "hang"
    assert worker.ask("graphml", seeds["graphml"], 60.0) == "read"
