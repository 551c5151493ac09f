"""Soft F1: the paper's score of a segmentation mask."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from probe2road.errors import InputError
from probe2road.metrics.matching import require_positive
from probe2road.metrics.scores import Score

__all__ = ["soft_f1"]


def soft_f1(
    proposal: NDArray[Any] | Sequence[NDArray[Any]],
    reference: NDArray[Any] | Sequence[NDArray[Any]],
    *,
    size: int = 2,
) -> Score:
    """Compare masks pixel by pixel after dilating both with a small square; the pixels of all tiles are pooled.

    An empty mask scores 0. The proposal is not thinned; a prediction wider than the reference loses precision,
    so thin it before for the other reading, and report both.

    Parameters
    ----------
    proposal, reference
        One mask of shape (rows, cols), or as many tiles on both sides; nonzero is road.
    size
        Width of the square, pixels: 2 is the paper's, which grows towards low rows and columns only (the
        convention of scipy); 3 is symmetric; 1 does not dilate.

    Returns
    -------
    Score
        Counts are pixels after dilation.

    Raises
    ------
    InputError
        If the shapes differ.

    Notes
    -----
    METHOD 6.6. It is not a buffered F1: a line shifted by one pixel scores 0.5, by two pixels 0.

    Examples
    --------
    >>> reference = np.zeros((6, 6), bool)
    >>> reference[3] = True
    >>> [soft_f1(np.roll(reference, shift, axis=0), reference).f1 for shift in (0, 1, 2)]
    [1.0, 0.5, 0.0]
    """
    require_positive("soft_f1", size=size)
    proposals, references = _tiles(proposal), _tiles(reference)
    if [tile.shape for tile in proposals] != [tile.shape for tile in references]:
        raise InputError("the masks differ in number or shape", where="soft_f1", fix="use one grid for both")
    square = np.ones((size, size), bool)
    both = proposed = wanted = 0
    for a, b in zip(proposals, references, strict=True):
        a, b = (binary_dilation(np.asarray(tile) != 0, square) for tile in (a, b))
        both += int(np.count_nonzero(a & b))
        proposed += int(np.count_nonzero(a))
        wanted += int(np.count_nonzero(b))
    return Score.from_counts(
        "soft_f1",
        matched_proposal=both,
        proposal=proposed,
        matched_reference=both,
        reference=wanted,
        parameters={"size": size},
        details={"tiles": len(proposals)},
    )


def _tiles(masks: NDArray[Any] | Sequence[NDArray[Any]]) -> list[NDArray[Any]]:
    if isinstance(masks, np.ndarray) and masks.ndim == 2:
        return [masks]
    return [np.asarray(mask) for mask in masks]
