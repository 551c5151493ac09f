"""What all tests share."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

# A check must not fail by chance on a change that is not at fault: continuous integration draws the same examples
# every time. At a desk they are drawn anew, which is how they find what nobody thought of.
settings.register_profile("repeatable", derandomize=True)
if os.environ.get("CI"):
    settings.load_profile("repeatable")


@pytest.fixture(autouse=True)
def same_log() -> Iterator[None]:
    """Undo what the command line does to the log, so that the next test can look into it."""
    logger = logging.getLogger("probe2road")
    before = logger.handlers[:], logger.level, logger.propagate
    yield
    logger.handlers[:], logger.propagate = before[0], before[2]
    logger.setLevel(before[1])
