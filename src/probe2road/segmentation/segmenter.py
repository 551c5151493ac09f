"""The interface of every segmenter: counts in, centreline probability out, window by window."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe2road.raster.grid import Grid

__all__ = ["Segmenter"]


@dataclass(frozen=True)
class Segmenter:
    """A method to turn count rasters into the probability that a pixel lies on a road centreline.

    Attributes
    ----------
    name
        What it is called on the command line and in reports.
    predict
        Maps counts ``(3, rows, cols)`` and their grid to probabilities ``(rows, cols)``, float32 in [0, 1].
        Called with a window and its halo.
    window
        Side of the windows that it works on, in pixels.
    halo
        Context on every side of a window, in pixels.
    blend
        Whether what it predicts in the halo counts too, so that windows overlap and fade into each other. If
        not, the probability of a pixel must depend on nothing farther away than the halo.
    threshold
        Probability from which a pixel belongs to a road that is already certain somewhere.
    seed_threshold
        Probability that makes a road certain: a connected part of the mask without such a pixel is dropped.
    parameters
        What it was configured with, for reports.
    """

    name: str
    predict: Callable[[NDArray[np.uint32], Grid], NDArray[np.float32]]
    window: int
    halo: int
    blend: bool
    threshold: float
    seed_threshold: float
    parameters: dict[str, Any]
