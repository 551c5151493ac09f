"""What every segmenter is: counts in, centreline probability out, window by window."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe2road.grid import Grid

__all__ = ["Segmenter"]


@dataclass(frozen=True)
class Segmenter:
    """A way to turn count rasters into the probability that a pixel lies on a road centreline.

    Attributes
    ----------
    name
        What it is called on the command line and in reports.
    predict
        Maps counts ``(3, rows, cols)`` and their grid to probabilities ``(rows, cols)``, float32 in [0, 1].
        The probability of a pixel depends on nothing farther away than the halo.
    halo
        Context that a pixel needs, in pixels.
    threshold
        Probability from which a pixel belongs to a road that is already certain somewhere.
    seed_threshold
        Probability that makes a road certain: a connected part of the mask without such a pixel is dropped.
    parameters
        What it was configured with, for reports.
    """

    name: str
    predict: Callable[[NDArray[np.uint32], Grid], NDArray[np.float32]]
    halo: int
    threshold: float
    seed_threshold: float
    parameters: dict[str, Any]
