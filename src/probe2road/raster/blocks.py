"""Rasters whose memory grows with the pixels written, not with their bounding box.

Strategy
--------
A fleet in two cities spans a box of a hundred thousand million pixels and drives on one in a thousand. So the pixels
of a whole area lie in square blocks, and a block is made when something other than zero is first written to it. What
works window by window reads and writes slices and does not see the difference; what asks for everything asks for the
pixels that are set.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

__all__ = ["Blocks"]

_SIDE = 256  # pixels; of a tile of a GeoTIFF, too


class Blocks:
    """A raster of shape ``(rows, cols)`` that is zero wherever nothing was written.

    ``blocks[rows, cols]`` with two slices copies a part out as an ordinary array, and assigning to it writes one;
    with two arrays of indices it reads single pixels, as an array of numpy does. Other kinds of indices are not known.

    Parameters
    ----------
    shape
        Rows and columns.
    dtype
        Of the pixels.
    side
        Rows and columns of a block; no influence on the content.

    Examples
    --------
    >>> country = Blocks((1_000_000, 1_000_000), np.float32)
    >>> country[10:12, 999_998:] = [[1, 2], [3, 0]]
    >>> country[11:14, 999_997:]
    array([[0., 3., 0.],
           [0., 0., 0.],
           [0., 0., 0.]], dtype=float32)
    >>> country.nonzero()
    (array([10, 10, 11]), array([999998, 999999, 999998]))
    >>> len(country.filled)
    1
    """

    ndim = 2

    def __init__(self, shape: tuple[int, int], dtype: DTypeLike, *, side: int = _SIDE) -> None:
        self.shape, self.dtype, self.side = (int(shape[0]), int(shape[1])), np.dtype(dtype), side
        self.filled: dict[tuple[int, int], NDArray[Any]] = {}  # by row and column of blocks

    @classmethod
    def from_array(cls, array: ArrayLike) -> Blocks:
        """Return the blocks of an array of two dimensions."""
        array = np.asarray(array)
        blocks = cls((array.shape[0], array.shape[1]), array.dtype)
        blocks[:, :] = array
        return blocks

    def __repr__(self) -> str:
        return f"Blocks({self.shape}, {self.dtype}, {len(self.filled)} of {self.side} x {self.side} filled)"

    def __getitem__(self, key: tuple[Any, Any]) -> NDArray[Any]:
        rows, cols = key
        if not isinstance(rows, slice):
            return self._pixels(np.asarray(rows, np.int64), np.asarray(cols, np.int64))
        top, bottom, left, right = self._span(rows, cols)
        part = np.zeros((max(bottom - top, 0), max(right - left, 0)), self.dtype)
        for block, inside, outside in self._overlaps(top, bottom, left, right):
            if block in self.filled:
                part[outside] = self.filled[block][inside]
        return part

    def __setitem__(self, key: tuple[slice, slice], value: ArrayLike) -> None:
        top, bottom, left, right = self._span(*key)
        value = np.broadcast_to(np.asarray(value), (max(bottom - top, 0), max(right - left, 0)))
        for block, inside, outside in self._overlaps(top, bottom, left, right):
            if block in self.filled or value[outside].any():
                self._block(block)[inside] = value[outside]

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return self[:, :] if dtype is None else self[:, :].astype(dtype)

    def put(self, row: NDArray[np.int64], col: NDArray[np.int64], value: Any) -> None:
        """Set single pixels to one value."""
        for block, place in self._grouped(row, col):
            self._block(block)[row[place] % self.side, col[place] % self.side] = value

    def nonzero(self, at_least: float | None = None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the rows and columns of all pixels that are set, or at least ``at_least``, in reading order."""
        rows, cols = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for _, row_of_blocks in groupby(self._in_order(), lambda entry: entry[0][0]):
            found = []
            for (i, j), pixels in row_of_blocks:
                row, col = np.nonzero(pixels if at_least is None else pixels >= at_least)
                found.append((row + i * self.side, col + j * self.side))
            row, col = (np.concatenate(axis) for axis in zip(*found, strict=True))
            order = np.argsort(row, kind="stable")  # the blocks came from left to right
            rows.append(row[order])
            cols.append(col[order])
        return np.concatenate(rows), np.concatenate(cols)

    def windows(self) -> Iterator[tuple[int, int, NDArray[Any]]]:
        """Yield the first row, the first column and the pixels of every stored block, in reading order."""
        for (i, j), pixels in self._in_order():
            yield i * self.side, j * self.side, pixels

    def any_in(self, top: int, left: int, rows: int, cols: int) -> bool:
        """Tell whether any pixel of a rectangle is set."""
        spans = self._overlaps(top, min(top + rows, self.shape[0]), left, min(left + cols, self.shape[1]))
        return any(block in self.filled and self.filled[block][inside].any() for block, inside, _ in spans)

    def squares(self, size: int) -> list[tuple[int, int]]:
        """Return the first pixels of the squares of ``size`` pixels that overlap a stored block, in reading order."""
        found = {
            (row, col)
            for top, left, pixels in self.windows()
            for row in range(top // size, (top + pixels.shape[0] - 1) // size + 1)
            for col in range(left // size, (left + pixels.shape[1] - 1) // size + 1)
        }
        return [(row * size, col * size) for row, col in sorted(found)]

    def _block(self, block: tuple[int, int]) -> NDArray[Any]:
        """Return a block, which is created if it is missing; blocks at the far edges are smaller."""
        if block not in self.filled:
            rows, cols = (min(self.side, n - k * self.side) for n, k in zip(self.shape, block, strict=True))
            self.filled[block] = np.zeros((rows, cols), self.dtype)
        return self.filled[block]

    def _in_order(self) -> list[tuple[tuple[int, int], NDArray[Any]]]:
        """Return the blocks in reading order."""
        return [(key, self.filled[key]) for key in sorted(self.filled)]

    def _grouped(
        self, row: NDArray[np.int64], col: NDArray[np.int64]
    ) -> Iterator[tuple[tuple[int, int], NDArray[np.int64]]]:
        """Yield each block that holds some of the given pixels, and which pixels these are."""
        i, j = row // self.side, col // self.side
        number = i * (self.shape[1] // self.side + 1) + j
        order = np.argsort(number, kind="stable")
        cuts = np.flatnonzero(np.diff(number[order], prepend=-1)) if len(order) else order
        for place in np.split(order, cuts[1:]) if len(order) else []:
            yield (int(i[place[0]]), int(j[place[0]])), place

    def _span(self, rows: slice, cols: slice) -> tuple[int, int, int, int]:
        """Return top, bottom, left and right of two slices."""
        (top, bottom, _), (left, right, _) = rows.indices(self.shape[0]), cols.indices(self.shape[1])
        return top, bottom, left, right

    def _overlaps(
        self, top: int, bottom: int, left: int, right: int
    ) -> Iterator[tuple[tuple[int, int], tuple[slice, slice], tuple[slice, slice]]]:
        """Yield the blocks that overlap a rectangle, with the overlap inside the block and inside the rectangle."""
        for i in range(top // self.side, -(-bottom // self.side)):
            low, high = max(top, i * self.side), min(bottom, (i + 1) * self.side)
            for j in range(left // self.side, -(-right // self.side)):
                near, far = max(left, j * self.side), min(right, (j + 1) * self.side)
                yield (
                    (i, j),
                    (
                        slice(low - i * self.side, high - i * self.side),
                        slice(near - j * self.side, far - j * self.side),
                    ),
                    (slice(low - top, high - top), slice(near - left, far - left)),
                )

    def _pixels(self, row: NDArray[np.int64], col: NDArray[np.int64]) -> NDArray[Any]:
        """Read single pixels."""
        values = np.zeros(row.shape, self.dtype)
        for block, place in self._grouped(row, col):
            if block in self.filled:
                values[place] = self.filled[block][row[place] % self.side, col[place] % self.side]
        return values
