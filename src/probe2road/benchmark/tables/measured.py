"""A function call in a separate process: its result, its seconds, and its peak memory."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from probe2road.run.workers import in_processes

__all__ = ["Measured", "measure"]

T = TypeVar("T")


@dataclass(frozen=True)
class Measured(Generic[T]):
    """The result of a call, and its time and memory."""

    result: T
    seconds: float  # wall time
    megabytes: float  # peak memory of the process, with the interpreter and all it imported


def measure(function: Callable[..., T], *arguments: Any) -> Measured[T]:
    """Call a function in a new process, and measure it.

    Parameters
    ----------
    function
        Of a module, so that another process can import it.
    arguments
        Of the call; they and the result travel between the processes.

    Examples
    --------
    >>> measure(max, 1, 2).result
    2
    """
    return next(in_processes(_run, [(function, *arguments)], 1))


def _run(function: Callable[..., T], *arguments: Any) -> Measured[T]:
    """Call a function in this process, and measure it."""
    started = time.perf_counter()
    result = function(*arguments)
    return Measured(result, time.perf_counter() - started, _peak_megabytes())


def _peak_megabytes() -> float:
    """Return the peak memory of this process; that of getrusage would include the parent's."""
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1024
