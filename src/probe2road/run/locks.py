"""One process at a time works in a folder."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from probe2road.errors import OutputError

__all__ = ["holder", "lock_folder", "locked"]


def holder() -> dict[str, Any]:
    """Return who this process is, for the mark that it leaves in a folder it holds."""
    return {"process": os.getpid(), "host": socket.gethostname()}


def lock_folder(folder: Path, lock: str, *, mark: str) -> FileLock:
    """Hold a folder for this process until the lock is released; the lock of a process that died is free.

    Parameters
    ----------
    folder
        Which exists.
    lock
        Name of the file that is locked.
    mark
        Name of a JSON file that says who holds the folder, see `holder`.

    Raises
    ------
    OutputError
        If another process holds it, naming that, or if the folder takes no lock.
    """
    held = FileLock(folder / lock)
    try:
        held.acquire(timeout=0)
    except Timeout as error:
        fault = f"{_named(folder / mark)} is working in this folder"
        raise OutputError(fault, where=folder, fix="wait until it is done, or name another folder") from error
    except OSError as error:
        raise OutputError(f"cannot be locked ({error.strerror})", where=folder) from error
    return held


@contextmanager
def locked(folder: Path, lock: str, *, mark: str) -> Iterator[None]:
    """Hold a folder, as `lock_folder` does, while the block runs; no file of the lock stays.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with locked(folder, ".lock", mark="mark.json"), locked(folder, ".lock", mark="mark.json"):
    ...     pass
    Traceback (most recent call last):
        ...
    probe2road.errors.OutputError: ...: another process is working in this folder; wait until it is done, ...
    >>> list(folder.iterdir())
    []
    """
    held = lock_folder(folder, lock, mark=mark)
    try:
        yield
    finally:
        (folder / lock).unlink(missing_ok=True)  # whoever comes now finds the work done
        held.release()


def _named(mark: Path) -> str:
    """Name the process that a mark is of, as well as it can be told."""
    try:
        said = json.loads(mark.read_text(encoding="utf-8"))
        return f"process {said['process']} on {said['host']}"
    except (OSError, ValueError, LookupError, TypeError):
        return "another process"
