"""Work in several processes, with results in order."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any, TypeVar

__all__ = ["in_processes"]

T = TypeVar("T")

_AHEAD = 2  # results that wait, beyond one for each process


def in_processes(
    function: Callable[..., T],
    jobs: Iterable[tuple[Any, ...]],
    workers: int,
    *,
    initializer: Callable[..., None] | None = None,
    initargs: tuple[Any, ...] = (),
) -> Generator[T, None, None]:
    """Call a function in worker processes and yield its results in the order of the jobs.

    Jobs are taken only a few ahead of the result that is waited for, so that memory does not follow their number. A
    caller that stops early cancels what has not begun.

    Parameters
    ----------
    function
        Of a module, so that another process can import it.
    jobs
        Arguments of each call.
    workers
        Processes.
    initializer, initargs
        Called once in each process.

    Examples
    --------
    >>> list(in_processes(max, [(1, 2), (4, 3)], 1))
    [2, 4]
    """
    # Spawned, not forked: the parent may hold threads of numba or pyarrow.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=initializer, initargs=initargs) as pool:
        waiting: list[Future[T]] = []
        try:
            for job in jobs:
                waiting.append(pool.submit(function, *job))
                if len(waiting) >= workers + _AHEAD:
                    yield waiting.pop(0).result()
            while waiting:
                yield waiting.pop(0).result()
        finally:
            for future in waiting:
                future.cancel()
