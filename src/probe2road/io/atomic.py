"""Atomic output: a file or folder that probe2road writes is complete or absent, never half there."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

from probe2road.errors import OutputError

__all__ = ["atomic_path", "make_folder"]


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
        If the parent folder does not exist or cannot be written, if the block wrote nothing, or if a file
        would replace a folder or a folder a file.

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
    try:
        workshop = Path(tempfile.mkdtemp(dir=target.parent, prefix=f".{target.name}."))
    except OSError as error:
        raise OutputError(f"folder {target.parent} cannot be written ({error.strerror})", where=target) from error
    try:
        yield workshop / target.name
        _move(workshop, target)
    finally:
        shutil.rmtree(workshop, ignore_errors=True)


def _move(workshop: Path, target: Path) -> None:
    """Move what was written in the workshop to its target."""
    written = workshop / target.name
    if not written.exists():
        raise OutputError("nothing was written", where=target)
    if target.exists() and target.is_dir() != written.is_dir():
        kinds = ("a folder", "a file") if target.is_dir() else ("a file", "a folder")
        raise OutputError(f"is {kinds[0]}, and {kinds[1]} would replace it", where=target, fix="choose another name")
    if not target.is_dir():
        written.replace(target)
        return
    # A folder that is not empty cannot be replaced in one step: set it aside, and back if the move fails.
    aside = workshop / f"{target.name}.old"
    target.replace(aside)
    try:
        written.replace(target)
    except OSError:
        aside.replace(target)
        raise


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
