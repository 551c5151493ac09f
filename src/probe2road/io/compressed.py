"""Compressed files: opened by their suffix, and bounded before anything reads them, because some hold too much."""

from __future__ import annotations

import bz2
import gzip
import zlib
from contextlib import suppress
from os import PathLike
from pathlib import Path
from typing import Any, BinaryIO

from probe2road.errors import InputError

__all__ = ["require_bounded", "unpacked"]

_OPENERS: dict[str, Any] = {".gz": gzip.open, ".bz2": bz2.open}
_MOST_OF_GZIP = 1032  # bytes that deflate can make of one
_BLOCK = 1 << 20


def unpacked(path: str | PathLike[str]) -> BinaryIO:
    """Open a file to read its bytes, unpacked if its final suffix is ``.gz`` or ``.bz2``."""
    opened: BinaryIO = _OPENERS.get(Path(path).suffix.lower(), open)(path, "rb")
    return opened


def require_bounded(path: str | PathLike[str], gigabytes: float) -> None:
    """Refuse a compressed file that holds more than so many gigabytes; any other file passes.

    It is read once for that, in blocks, but for a gzip file that is too small to hold so much. What is damaged passes:
    its reader says where.

    Parameters
    ----------
    path
        The file; a final ``.gz`` or ``.bz2`` says that it is compressed.
    gigabytes
        The most it may hold, in 10^9 bytes.

    Raises
    ------
    InputError
        If it holds more.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp(), "zeros.csv.gz")
    >>> with gzip.open(path, "wb") as file:
    ...     _ = file.write(bytes(10**6))
    >>> require_bounded(path, 0.001)
    >>> require_bounded(path, 0.0005)
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: ...zeros.csv.gz: holds more than 0.0005 GB ...
    """
    path = Path(path)
    suffix, limit = path.suffix.lower(), int(gigabytes * 1e9)
    if suffix not in _OPENERS or (suffix == ".gz" and path.stat().st_size * _MOST_OF_GZIP <= limit):
        return
    size = 0
    with suppress(OSError, EOFError, ValueError, zlib.error), unpacked(path) as file:
        while size <= limit and (block := file.read(_BLOCK)):
            size += len(block)
    if size > limit:
        fix = f"check what it is, or allow more, for example max_uncompressed={10 * gigabytes:g}"
        raise InputError(f"holds more than {gigabytes:g} GB when it is decompressed", where=path, fix=fix)
