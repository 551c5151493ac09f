"""Atomic output: a file or folder that probe2road writes is complete or absent, never half there.

What is being written lies in a hidden folder beside its target, ``.NAME.HOST-PROCESS-RANDOM.p2r-part``. A process
that is killed leaves that folder behind; the name says whose it was, so that the next write of the same target can
tell a leftover from the work of a process that is still alive.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import socket
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from probe2road.errors import OutputError, Probe2RoadError

__all__ = ["atomic_path", "is_workshop", "make_folder", "sweep_leftovers"]

_PART = ".p2r-part"
_OWNER = re.compile(r"\.(?P<host>[0-9a-f]{8})-(?P<process>\d+)-[^.]*\.p2r-part$")
_HOST = f"{zlib.crc32(socket.gethostname().encode()):08x}"
_NO_ROOM = {
    errno.ENOSPC: "no space left on the device",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file is larger than is allowed",
    errno.EIO: "the device reports an input/output error",
    errno.EROFS: "the file system is read-only",
}  # what the disk can refuse, in words

_open_workshops: set[Path] = set()  # of this process


@contextmanager
def atomic_path(path: str | PathLike[str]) -> Iterator[Path]:
    """Give a place to write to that becomes ``path`` when the block ends without an error.

    The place has the same name, and so the same suffix, in a hidden folder beside ``path``: on the same file
    system, which makes the final move atomic. Whatever a library leaves next to its file (journals, locks)
    goes away with that folder. If the block raises, an existing ``path`` stays as it was. A folder replaces a
    folder as a whole; its old content is gone only when the new one is in place.

    Parameters
    ----------
    path
        File or folder to write; its parent must exist.

    Yields
    ------
    Path
        Where to write. The block creates a file or a folder there.

    Raises
    ------
    OutputError
        If the parent folder does not exist or cannot be written, if the disk is full or fails, if the block wrote
        nothing, or if a file would replace a folder or a folder a file.

    Examples
    --------
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_path(folder / "notes.txt") as temporary:
    ...     _ = temporary.write_text("complete")
    >>> (folder / "notes.txt").read_text()
    'complete'
    >>> with atomic_path(folder / "nothing.txt") as temporary:
    ...     pass
    Traceback (most recent call last):
        ...
    probe2road.errors.OutputError: ...nothing.txt: nothing was written
    >>> sorted(file.name for file in folder.iterdir())
    ['notes.txt']
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise OutputError(f"folder {target.parent} does not exist", where=target, fix="create it first")
    sweep_leftovers(target.parent, target.name)
    try:
        workshop = Path(
            tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}.{_HOST}-{os.getpid()}-", suffix=_PART)
        )
    except OSError as error:
        raise OutputError(f"folder {target.parent} cannot be written ({error.strerror})", where=target) from error
    _open_workshops.add(workshop)
    try:
        yield workshop / target.name
        _move(workshop, target)
    except Probe2RoadError:
        raise
    except Exception as error:
        refusal = _NO_ROOM.get(getattr(error, "errno", None) or 0) or _refusal_of_disk(workshop)
        if refusal is None:
            raise
        fix = "make room, or write somewhere else; what was there before is untouched"
        raise OutputError(f"cannot be written: {refusal}", where=target, fix=fix) from error
    finally:
        _open_workshops.discard(workshop)
        shutil.rmtree(workshop, ignore_errors=True)


def _refusal_of_disk(folder: Path) -> str | None:
    """Say why the disk takes nothing more, or None where it does: libraries hide the reason behind one of their own."""
    probe = folder / "probe"
    try:
        with probe.open("wb") as file:
            file.write(bytes(1 << 16))
            os.fsync(file.fileno())
        probe.unlink()
    except OSError as error:
        return _NO_ROOM.get(error.errno or 0)
    return None


def is_workshop(path: Path) -> bool:
    """Whether `atomic_path` made this folder, in whatever process."""
    return _OWNER.search(path.name) is not None


def sweep_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove what killed processes left behind when they wrote into a folder.

    Only folders that `atomic_path` made on this machine, and whose process is gone, are removed.

    Parameters
    ----------
    folder
        Where the files are, or would have been.
    name
        Of the one file whose leftovers go; all of them where it is None.

    Examples
    --------
    >>> folder = Path(tempfile.mkdtemp())
    >>> for process in (os.getpid() + 10**7, 1):  # one that cannot be alive, one that always is
    ...     (folder / f".roads.gpkg.{_HOST}-{process}-abc.p2r-part").mkdir()
    >>> sweep_leftovers(folder, "roads.gpkg")
    >>> len(list(folder.iterdir()))
    1
    """
    for path in folder.glob(f".*{_PART}"):
        owner = _OWNER.search(path.name)
        if owner is None or owner["host"] != _HOST or name not in (None, path.name[1 : owner.start()]):
            continue
        if path not in _open_workshops and not _is_alive(int(owner["process"])):
            shutil.rmtree(path, ignore_errors=True)


def _is_alive(process: int) -> bool:
    """Whether another process of this number runs; this process knows its own workshops."""
    if process == os.getpid():
        return False
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass
    return True


def _move(workshop: Path, target: Path) -> None:
    """Move what was written in the workshop to its target."""
    written = workshop / target.name
    if not written.exists():
        raise OutputError("nothing was written", where=target)
    if target.exists() and target.is_dir() != written.is_dir():
        kinds = ("a folder", "a file") if target.is_dir() else ("a file", "a folder")
        raise OutputError(f"is {kinds[0]}, and {kinds[1]} would replace it", where=target, fix="choose another name")
    _make_durable(written)
    if not target.is_dir():
        written.replace(target)
        _sync(target.parent)
        return
    # A folder that is not empty cannot be replaced in one step: set it aside, and back if the move fails.
    aside = workshop / f"{target.name}.old"
    target.replace(aside)
    try:
        written.replace(target)
    except OSError:
        aside.replace(target)
        raise
    _sync(target.parent)


def _make_durable(written: Path) -> None:
    """Have a file, or all of a folder, on the disk before its name is: a crash of the machine leaves old or new."""
    for path in [*written.rglob("*"), written] if written.is_dir() else [written]:
        _sync(path)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(path: Path) -> None:
    """Create a folder that output goes to, and those above it; one that is there stays as it is.

    Raises
    ------
    OutputError
        If it cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot be created ({error.strerror})", where=path) from error
