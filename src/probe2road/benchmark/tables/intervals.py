"""Confidence intervals: how much a score would change on other tiles of the same roads, by bootstrap over tiles.

Strategy: a score pools counts over tiles, so drawing tiles with replacement is drawing how often each tile counts. All
draws are one matrix product. Two methods on the same tiles are compared draw by draw: what makes a tile hard is
hard for both, and their difference is known better than either score.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

__all__ = ["COUNTS", "DRAWS", "Interval", "difference_interval", "f1_interval"]

COUNTS = ["matched_proposal", "proposal", "matched_reference", "reference"]

DRAWS = 2000
_LEVEL = 0.95
_SEED = 20120101


@dataclass(frozen=True)
class Interval:
    """A figure and its interval."""

    value: float
    low: float
    high: float


def f1_interval(tiles: pd.DataFrame, *, draws: int = DRAWS, level: float = _LEVEL) -> Interval:
    """Return F1 over all tiles, and its interval from tiles drawn with replacement.

    Parameters
    ----------
    tiles
        One row per tile, with the columns `COUNTS`. Without rows everything is 0.
    draws
        How often tiles are drawn, from a fixed seed.
    level
        Probability of the interval.

    Examples
    --------
    >>> tiles = pd.DataFrame([[9, 10, 9, 10], [5, 10, 5, 10]], columns=COUNTS)
    >>> interval = f1_interval(tiles)
    >>> interval.value, interval.low, interval.high
    (0.7, 0.5, 0.9)
    """
    counts = tiles[COUNTS].to_numpy(np.float64)
    if len(counts) == 0:
        return Interval(0.0, 0.0, 0.0)
    return _interval(_f1(counts.sum(axis=0)[None]), _f1(_weights(len(counts), draws) @ counts), level)


def difference_interval(
    ours: pd.DataFrame, theirs: pd.DataFrame, *, draws: int = DRAWS, level: float = _LEVEL
) -> Interval:
    """Return the difference of two F1, and its interval from the same drawn tiles for both.

    Parameters
    ----------
    ours, theirs
        As in `f1_interval`, with the tiles as index; a tile that only one has counts nothing for the other.
    draws, level
        As in `f1_interval`.

    Examples
    --------
    >>> ours = pd.DataFrame([[9, 10, 9, 10], [6, 10, 6, 10]], columns=COUNTS)
    >>> difference = difference_interval(ours, ours - [1, 0, 1, 0])
    >>> round(difference.value, 3), round(difference.low, 3), round(difference.high, 3)
    (0.1, 0.1, 0.1)
    """
    tiles = ours.index.union(theirs.index)
    if len(tiles) == 0:
        return Interval(0.0, 0.0, 0.0)
    both = [table[COUNTS].reindex(tiles, fill_value=0).to_numpy(np.float64) for table in (ours, theirs)]
    weights = _weights(len(tiles), draws)
    value = _f1(both[0].sum(axis=0)[None]) - _f1(both[1].sum(axis=0)[None])
    return _interval(value, _f1(weights @ both[0]) - _f1(weights @ both[1]), level)


def _weights(n: int, draws: int) -> NDArray[np.float64]:
    """Return how often each tile is drawn, shape (draws, n)."""
    rng = np.random.default_rng(_SEED)
    return rng.multinomial(n, np.full(n, 1.0 / n), size=draws).astype(np.float64)


def _f1(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return F1 of pooled counts: shape (draws, 4) to (draws,)."""
    precision, recall = (
        np.divide(sums[:, part], sums[:, part + 1], out=np.zeros(len(sums)), where=sums[:, part + 1] > 0)
        for part in (0, 2)
    )
    total = precision + recall
    return np.divide(2.0 * precision * recall, total, out=np.zeros(len(sums)), where=total > 0)


def _interval(value: NDArray[np.float64], drawn: NDArray[np.float64], level: float) -> Interval:
    low, high = np.quantile(drawn, [(1.0 - level) / 2.0, (1.0 + level) / 2.0])
    return Interval(float(value[0]), float(low), float(high))
