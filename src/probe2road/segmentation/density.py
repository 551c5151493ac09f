"""Centreline probability from trace density alone, without network weights and without a camera.

Strategy
--------
Traces blur into a kernel density. A threshold on it alone either loses lightly driven roads or lets busy ones
bloom until they swallow their neighbours. Three things make it safe, and the probability is the least of them:

* evidence: enough traces. Counts enter as log2(1 + count), so that a busy road outweighs the quiet one that
  meets it by a few times, not by hundreds, and a single trace still counts as one.
* a ridge: the density has to curve downwards across the road, measured by the most negative eigenvalue of its
  Hessian relative to the density itself. That ratio does not depend on how many vehicles drove, only on where
  the pixel lies in the bundle of their traces: at the middle of a bundle of spread s seen with bandwidth b it
  is b^2 / (b^2 + s^2), and it falls to zero at the distance sqrt(b^2 + s^2) from it.
* presence: traces close by, at a third of the bandwidth. Outside the corner of a busy road the tail of the
  density is a ridge too, but nobody drove there.

The bandwidth decides which traces are one road. It follows from how far the traces of one road lie apart, which
the data tell (`probe2road.segmentation.bandwidth`): metre-level fleet data gets a fine kernel, consumer GNSS in a
city a broad one, and neither needs a parameter.
"""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage

from probe2road.bounds import Positive
from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet, TraceGaps
from probe2road.options import checked
from probe2road.raster.grid import Grid
from probe2road.segmentation.bandwidth import estimate_bandwidth
from probe2road.segmentation.segmenter import Segmenter

__all__ = ["DensityOptions", "density_probability", "density_segmenter"]

logger = logging.getLogger(__name__)

_TRUNCATE = 4.5  # kernel half-width in bandwidths; a shorter kernel ends in a step that looks like a ridge
_CLOSE_BY = 1 / 3  # bandwidths
_THRESHOLD = 0.5  # probability that continues a road
_SEED_THRESHOLD = 0.67  # probability that starts a road: three traces on a ridge
_WINDOW = 1024  # pixels; no influence on the result


@dataclass(frozen=True)
@checked
class DensityOptions:
    """How trace density is converted to probability."""

    bandwidth: Positive[float] | None = None  # m, Gaussian sigma; None: estimated from the data
    half_evidence: Positive[float] = 1.0  # traces on a ridge at which the probability is one half
    half_presence: Positive[float] = 0.3  # traces close by at which the probability is one half
    half_ridge: Positive[float] = 0.3  # relative curvature at which the probability is one half


def density_segmenter(
    fleet: Fleet, grid: Grid, *, options: DensityOptions | None = None, gaps: TraceGaps | None = None
) -> Segmenter:
    """Return the density segmenter for a fleet, with its bandwidth estimated if it is not given.

    Parameters
    ----------
    fleet
        The fleet; only its traces are used.
    grid
        Grid of the rasters to come.
    options
        How density becomes probability.
    gaps
        Where traces are broken.

    Returns
    -------
    Segmenter
        Named ``density``.
    """
    options = options or DensityOptions()
    if options.bandwidth is None:
        options = replace(options, bandwidth=estimate_bandwidth(fleet, grid, gaps=gaps))
    settled = options
    assert settled.bandwidth is not None

    def predict(counts: NDArray[np.uint32], window: Grid) -> NDArray[np.float32]:
        return density_probability(counts[0], window, options=settled)

    return Segmenter(
        name="density",
        predict=predict,
        window=_WINDOW,
        halo=_halo(settled.bandwidth, grid),
        blend=False,
        threshold=_THRESHOLD,
        seed_threshold=_SEED_THRESHOLD,
        parameters=asdict(settled),
    )


def density_probability(
    trace_counts: NDArray[np.uint32], grid: Grid, *, options: DensityOptions
) -> NDArray[np.float32]:
    """Return the probability that pixels lie on a centreline, computed from the trace channel.

    Parameters
    ----------
    trace_counts
        Shape ``(rows, cols)``; outside counts as empty.
    grid
        Its grid.
    options
        With a bandwidth.

    Returns
    -------
    ndarray of float32, shape (rows, cols)
        In [0, 1); 0 where there is no trace nearby.

    Raises
    ------
    OptionError
        If the bandwidth is not set.

    Examples
    --------
    Five vehicles on one line: certain on it, nothing beside it.

    >>> counts = np.zeros((41, 41), np.uint32)
    >>> counts[20] = 5
    >>> grid = Grid.from_bounds((1000, 0, 1040.5, 40.5), crs="EPSG:32616")
    >>> probability = density_probability(counts, grid, options=DensityOptions(bandwidth=3.0))
    >>> probability[[20, 10], 20].tolist()
    [0.72..., 0.0]
    """
    if options.bandwidth is None:
        raise OptionError("no bandwidth", where="DensityOptions", fix="set one, or use density_segmenter")
    sigma = options.bandwidth / grid.resolution
    weight = np.log2(1.0 + trace_counts).astype(np.float32)
    evidence, presence = (
        # The scale is that of traces: a single straight trace has 1 on its line.
        ndimage.gaussian_filter(weight * np.float32(s * np.sqrt(2 * np.pi)), s, mode="constant", truncate=_TRUNCATE)
        for s in (sigma, sigma * _CLOSE_BY)
    )
    return _least(evidence, presence, sigma, options.half_evidence, options.half_presence, options.half_ridge)


def _halo(bandwidth: float, grid: Grid) -> int:
    """Return the context that a pixel needs: half the kernel, as scipy rounds it, and one pixel for the Hessian."""
    return int(_TRUNCATE * bandwidth / grid.resolution + 0.5) + 1


@njit(cache=True)
def _least(
    evidence: NDArray[np.float32],
    presence: NDArray[np.float32],
    sigma: float,
    half_evidence: float,
    half_presence: float,
    half_ridge: float,
) -> NDArray[np.float32]:
    """Return the probability ``(rows, cols)``: the least of evidence, presence and ridge; 0 at the outer pixels."""
    rows, cols = evidence.shape
    probability = np.zeros((rows, cols), np.float32)
    for r in range(1, rows - 1):
        for c in range(1, cols - 1):
            here, close = evidence[r, c], presence[r, c]
            if here <= 0.0 or close <= 0.0:
                continue
            d_rr = evidence[r + 1, c] - 2.0 * here + evidence[r - 1, c]
            d_cc = evidence[r, c + 1] - 2.0 * here + evidence[r, c - 1]
            d_rc = 0.25 * (
                evidence[r + 1, c + 1] - evidence[r + 1, c - 1] - evidence[r - 1, c + 1] + evidence[r - 1, c - 1]
            )
            across = 0.5 * (d_rr + d_cc) - np.sqrt(0.25 * (d_rr - d_cc) ** 2 + d_rc**2)
            ridge = max(0.0, -across * sigma * sigma / here)
            probability[r, c] = min(
                here / (here + half_evidence), close / (close + half_presence), 0.5 * ridge / half_ridge
            )
    return probability
