"""From probability to mask, with memory in proportion to the road pixels rather than to the area."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from probe2road.bounds import Probability
from probe2road.errors import OptionError
from probe2road.options import checked
from probe2road.raster.blocks import Blocks
from probe2road.segmentation.segmenter import Segmenter

__all__ = ["MaskOptions", "threshold_mask"]


@dataclass(frozen=True)
@checked
class MaskOptions:
    """Which probability counts as road; a threshold of None takes that of the segmenter."""

    threshold: Probability | None = None  # probability that continues a road
    seed_threshold: Probability | None = None  # probability that starts a road

    def __post_init__(self) -> None:
        """Refuse a seed threshold below the threshold."""
        if self.threshold is not None and self.seed_threshold is not None and self.threshold > self.seed_threshold:
            fault = f"threshold is {self.threshold}, seed_threshold is {self.seed_threshold}"
            raise OptionError(fault, where="MaskOptions", fix="use threshold <= seed_threshold")

    def of(self, segmenter: Segmenter) -> tuple[float, float]:
        """Return the threshold and the seed threshold for the output of a segmenter.

        If only the threshold is given, the segmenter's seed threshold is raised to it where it is lower.
        """
        threshold = segmenter.threshold if self.threshold is None else self.threshold
        seed_threshold = self.seed_threshold
        return threshold, max(segmenter.seed_threshold, threshold) if seed_threshold is None else seed_threshold


@overload
def threshold_mask(
    probability: NDArray[Any], *, threshold: float, seed_threshold: Probability | None = None
) -> NDArray[np.bool_]: ...


@overload
def threshold_mask(probability: Blocks, *, threshold: float, seed_threshold: Probability | None = None) -> Blocks: ...


def threshold_mask(
    probability: NDArray[Any] | Blocks, *, threshold: float, seed_threshold: Probability | None = None
) -> NDArray[np.bool_] | Blocks:
    """Return the parts where the probability reaches a threshold and, somewhere in the part, a higher one.

    Parameters
    ----------
    probability
        Shape ``(rows, cols)``; an array, or blocks.
    threshold
        Probability above 0 from which a pixel can belong to a road (METHOD 0.1 row 12).
    seed_threshold
        Probability that an 8-connected part must reach somewhere to be kept; every part is kept where None.

    Returns
    -------
    ndarray of bool, shape (rows, cols)
        Blocks of them where the probability is in blocks.

    Raises
    ------
    OptionError
        If the seed threshold is below the threshold.

    Examples
    --------
    >>> threshold_mask(np.array([[0.6, 0.9, 0.1, 0.6]]), threshold=0.5, seed_threshold=0.8).astype(int)
    array([[1, 1, 0, 0]])
    """
    seed_threshold = threshold if seed_threshold is None else seed_threshold
    if seed_threshold < threshold:
        raise OptionError(f"seed threshold {seed_threshold} is below threshold {threshold}", where="threshold_mask")
    blocks = probability if isinstance(probability, Blocks) else Blocks.from_array(probability)
    row, col = blocks.nonzero(at_least=threshold)
    part = _parts(row * blocks.shape[1] + col, blocks.shape[1])
    certain = np.zeros(part.max(initial=-1) + 1, bool)
    certain[part[blocks[row, col] >= seed_threshold]] = True
    mask = Blocks(blocks.shape, bool)
    mask.put(row[certain[part]], col[certain[part]], True)
    return mask if isinstance(probability, Blocks) else mask[:, :]


def _parts(pixels: NDArray[np.int64], cols: int) -> NDArray[np.int64]:
    """Label the 8-connected parts of a set of pixels, given by ascending flat indices."""
    pairs = []
    col = pixels % cols
    for step, inside in ((1, col < cols - 1), (cols - 1, col > 0), (cols, col >= 0), (cols + 1, col < cols - 1)):
        own = np.flatnonzero(inside)
        other = np.searchsorted(pixels, pixels[own] + step)
        met = pixels[np.minimum(other, len(pixels) - 1)] == pixels[own] + step
        pairs.append((own[met], other[met]))
    first, second = (np.concatenate(side) for side in zip(*pairs, strict=True))
    links = coo_array((np.ones(len(first), bool), (first, second)), shape=(len(pixels), len(pixels)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)
