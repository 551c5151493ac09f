"""What all tests share."""

from __future__ import annotations

import logging
import os

import pytest
from hypothesis import settings

# A check must not fail by chance on a change that is not at fault: continuous integration draws the same examples
# every time. At a desk they are drawn anew, which is how they find what nobody thought of.
settings.register_profile("repeatable", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def untouched_log() -> None:
    """Undo what the command line did to the log in an earlier test or fixture."""
    logger = logging.getLogger("probe2road")
    logger.handlers.clear()
    logger.setLevel(logging.NOTSET)
    logger.propagate = True


@pytest.fixture(autouse=True)
def repeatable_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run the network alike on every processor, with or without OpenVINO and bfloat16."""
    monkeypatch.setattr("probe2road.segmentation.runtime._fastest", lambda device: "onnxruntime")
