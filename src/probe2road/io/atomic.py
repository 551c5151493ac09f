"""Atomic output: a file or folder written by probe2road is complete or absent, never partial.

What is being written lies in a hidden folder beside its target, ``.NAME.HOST-PROCESS-RANDOM.p2r-part``. A process
that is killed leaves that folder behind; the name says whose it was, so that the next write of the same target can
tell a leftover from the work of a process that is still alive.

Files that belong together change together. Their folder is renamed to ``.NAME.p2r-commit`` when all of them are
complete, and from that moment on they are the files that count: they are moved into place, and whoever reads or writes
there next does what a killed process could not. `settled` says where a file is to be read.
"""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import socket
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from os import PathLike
from pathlib import Path

from probe2road.errors import OutputError, Probe2RoadError

__all__ = [
    "atomic_path",
    "atomic_paths",
    "discard",
    "is_workshop",
    "make_folder",
    "require_place",
    "settled",
    "sweep_leftovers",
]

_PART, _COMMIT = ".p2r-part", ".p2r-commit"
_CONTENT = "content.json"  # in a commit: the files that belong together, and which of them are no more
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
    """Yield a temporary path that becomes ``path`` when the block ends without an error.

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
    with _workshop(target) as workshop:
        yield workshop / target.name
        _move(workshop, target)


@contextmanager
def atomic_paths(paths: Sequence[str | PathLike[str]]) -> Iterator[list[Path]]:
    """Yield temporary paths for files that belong together: at the end of the block, all become ``paths``, or none.

    Only the first has to be written; where another is not, what was there before is removed. If the block raises, or
    the process is killed before the last file is complete, all stay as they were. A process that is killed later
    leaves the rest of the moves to the next one that asks for the files with `settled`, or writes beside them.

    Parameters
    ----------
    paths
        Files in one folder, which must exist.

    Yields
    ------
    list of Path
        Where to write each of them.

    Raises
    ------
    OutputError
        As for `atomic_path`.

    Examples
    --------
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_paths([folder / "roads.csv", folder / "turns.csv"]) as (roads, turns):
    ...     _ = roads.write_text("edge"), turns.write_text("from_edge")
    >>> with atomic_paths([folder / "roads.csv", folder / "turns.csv"]) as (roads, _):
    ...     _ = roads.write_text("edge,length")
    >>> [file.name for file in folder.iterdir()]
    ['roads.csv']
    """
    targets = [Path(path) for path in paths]
    first = targets[0]
    with _workshop(first) as workshop:
        places = [workshop / target.name for target in targets]
        yield places
        if not places[0].exists():
            raise OutputError("nothing was written", where=first)
        for target in targets:
            if target.is_dir():
                raise OutputError("is a folder, and a file would replace it", where=target, fix="choose another name")
        content = {"files": [target.name for target in targets]}
        content["removed"] = [place.name for place in places if not place.exists()]
        (workshop / _CONTENT).write_text(json.dumps(content), encoding="utf-8")
        _make_durable(workshop)
        commit = first.with_name(f".{first.name}{_COMMIT}")
        _finish(commit)  # of another process, since ours began
        workshop.replace(commit)
        try:
            _sync(first.parent)
            _finish(commit)
        except OSError as error:
            fault = f"is complete, but cannot be moved into place ({error.strerror})"
            fix = f"it lies in {commit.name}, and is moved when it is next read or written"
            raise OutputError(fault, where=first, fix=fix) from error


def settled(path: str | PathLike[str]) -> Path:
    """Return where a file of `atomic_paths` can be read, after completing the work of a killed process.

    That is the path itself, but for a folder that takes no changes, in which a process was killed as it moved files
    into place.

    Examples
    --------
    >>> settled("roads.parquet").name
    'roads.parquet'
    """
    path = Path(path)
    for commit in path.parent.glob(f".*{_COMMIT}"):
        try:
            _finish(commit)
        except OSError:
            content = _content_of(commit)
            if path.name in content["removed"] or (commit / path.name).exists():
                return commit / path.name
    return path


def _content_of(commit: Path) -> dict[str, list[str]]:
    """Return the description of a commit; nothing if the folder is not ours, or is gone."""
    try:
        content = json.loads((commit / _CONTENT).read_text(encoding="utf-8"))
        return {"files": list(content["files"]), "removed": list(content["removed"])}
    except (OSError, ValueError, LookupError, TypeError):
        return {"files": [], "removed": []}


def _finish(commit: Path) -> None:
    """Move the files of a commit into place, repeatedly, because another process may do the same now."""
    content = _content_of(commit)
    if not content["files"]:
        return
    for name in content["removed"]:
        commit.with_name(name).unlink(missing_ok=True)
    for name in content["files"]:
        if (commit / name).exists():
            with suppress(FileNotFoundError):
                (commit / name).replace(commit.with_name(name))
    _sync(commit.parent)
    shutil.rmtree(commit, ignore_errors=True)


@contextmanager
def _workshop(target: Path) -> Iterator[Path]:
    """Yield a hidden folder beside a target that is removed when the block ends, and report a full disk as such."""
    if not target.parent.is_dir():
        raise OutputError(f"folder {target.parent} does not exist", where=target, fix="create it first")
    try:
        sweep_leftovers(target.parent, target.name)
        for commit in target.parent.glob(f".*{_COMMIT}"):
            _finish(commit)
        workshop = Path(
            tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}.{_HOST}-{os.getpid()}-", suffix=_PART)
        )
    except OSError as error:
        reason = _NO_ROOM.get(error.errno or 0, error.strerror)
        raise OutputError(f"folder {target.parent} cannot be written ({reason})", where=target) from error
    _open_workshops.add(workshop)
    try:
        yield workshop
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


def require_place(path: str | PathLike[str], *, folder: bool = False) -> None:
    """Refuse an output path that cannot be written, before the work for it is done.

    Parameters
    ----------
    path
        File or folder that will be written.
    folder
        Whether it will be a folder.

    Raises
    ------
    OutputError
        If the folder that it goes into does not exist, or if it is a folder where a file is written, or the reverse.

    Examples
    --------
    >>> require_place(tempfile.mkdtemp())
    Traceback (most recent call last):
        ...
    probe2road.errors.OutputError: ...: is a folder, and a file would replace it; choose another name
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise OutputError(f"folder {path.parent} does not exist", where=path, fix="create it first")
    if path.exists() and path.is_dir() != folder:
        kinds = ("a file", "a folder") if folder else ("a folder", "a file")
        raise OutputError(f"is {kinds[0]}, and {kinds[1]} would replace it", where=path, fix="choose another name")


def _refusal_of_disk(folder: Path) -> str | None:
    """Return why the disk accepts no more data, or None; libraries hide the reason behind errors of their own."""
    probe = folder / "probe"
    try:
        with probe.open("wb") as file:
            file.write(bytes(1 << 16))
            os.fsync(file.fileno())
        probe.unlink()
    except OSError as error:
        return _NO_ROOM.get(error.errno or 0)
    return None


def discard(folder: Path, name: str) -> None:
    """Remove a folder beside a file in one step; after a kill, the next write of the file removes the rest.

    Parameters
    ----------
    folder
        What goes; nothing happens where it does not exist.
    name
        Of the file.
    """
    doomed = folder.with_name(f".{name}.{_HOST}-{os.getpid()}-discarded{_PART}")
    with suppress(OSError):
        folder.replace(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def is_workshop(path: Path) -> bool:
    """Tell whether `atomic_path` made this folder, in any process."""
    return _OWNER.search(path.name) is not None


def sweep_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove the files that killed processes left when they wrote into a folder.

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
    """Tell whether another process with this number is running; this process knows its own workshops."""
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
    """Move the written output from the workshop to its target."""
    written = workshop / target.name
    if not written.exists():
        raise OutputError("nothing was written", where=target)
    if target.exists() and target.is_dir() != written.is_dir():
        kinds = ("a folder", "a file") if target.is_dir() else ("a file", "a folder")
        raise OutputError(f"is {kinds[0]}, and {kinds[1]} would replace it", where=target, fix="choose another name")
    _make_durable(written)
    if not target.is_dir():
        written.replace(target)
        _confirm(target)
        return
    # A folder that is not empty cannot be replaced in one step: set it aside, and back if the move fails.
    aside = workshop / f"{target.name}.old"
    target.replace(aside)
    try:
        written.replace(target)
    except OSError:
        aside.replace(target)
        raise
    _confirm(target)


def _confirm(target: Path) -> None:
    """Have the new name on the disk; the file is in place whether that succeeds or not."""
    try:
        _sync(target.parent)
    except OSError as error:
        reason = _NO_ROOM.get(error.errno or 0, error.strerror)
        fault = f"is complete and in place, but the disk does not confirm it ({reason})"
        raise OutputError(fault, where=target, fix="check the disk, and write it again") from error


def _make_durable(written: Path) -> None:
    """Write a file, or all of a folder, to the disk before it is renamed: after a crash, it is old or new."""
    for path in [*written.rglob("*"), written] if written.is_dir() else [written]:
        _sync(path)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_folder(path: Path) -> None:
    """Create an output folder and its parents; an existing folder stays as it is.

    Raises
    ------
    OutputError
        If it cannot be created.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot be created ({error.strerror})", where=path) from error
