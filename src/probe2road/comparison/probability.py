"""How probable a difference between two maps is real: logistic models of its evidence.

The coefficients were fitted on differences that were put into maps on purpose, by `experiments/diff_edits.py`; the
page of results says how well they hold on a city that they never saw.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import expit

__all__ = ["FEATURES", "evidence_features", "probabilities"]

FEATURES: Mapping[str, tuple[str, ...]] = {
    "moved": ("distance", "shared", "log_length"),
    "added": ("log_support", "log_length"),
    "suspect_closed": ("log_expected",),
    "direction_changed": ("log_odds",),
    "connection_added": ("log_count", "dead_end"),
    "connection_missing": ("crosses",),
}  # what each model weighs

_COEFFICIENTS: Mapping[str, tuple[float, ...]] = {
    "moved": (-9.29, 0.51, 0.18, 0.88),
    "added": (0.74, 0.33, 0.1),
    "suspect_closed": (-2.61, 0.87),
    "direction_changed": (-1.75, 0.51),
    "connection_added": (-1.28, 0.21, 3.71),
    "connection_missing": (-0.69, 3.46),
}  # the constant, and one for each feature

_NEAR = 60.0  # m within which the dead end of a road may be the reason why two roads are not joined
_MOST_ODDS = 12.0  # log odds that are weighed, at most: counts of drives are not independent beyond


def evidence_features(evidence: pd.DataFrame) -> pd.DataFrame:
    """Return the features of differences from their evidence, as far as its columns are there.

    Parameters
    ----------
    evidence
        Any of ``distance`` (m), ``nearest``, ``support``, ``length`` (m), ``expected``, ``count``, ``crosses``,
        ``odds`` (a probability) and ``dead_end_distance`` (m).

    Examples
    --------
    >>> evidence_features(pd.DataFrame({"support": [0.0], "dead_end_distance": [12.0]})).values.tolist()
    [[0.0, 1.0]]
    """
    made: dict[str, NDArray[np.float64]] = {}
    if "distance" in evidence:
        made["distance"] = evidence["distance"].to_numpy(np.float64)
    if "nearest" in evidence:  # our line stands for a nearer road of the base as well
        made["shared"] = 1.0 - evidence["nearest"].to_numpy(np.float64)
    for name in ("support", "length", "expected", "count"):
        if name in evidence:
            made[f"log_{name}"] = np.log1p(evidence[name].to_numpy(np.float64))
    if "odds" in evidence:
        odds = np.clip(evidence["odds"].to_numpy(np.float64), 1e-12, 1 - 1e-12)
        made["log_odds"] = np.clip(np.log(odds / (1 - odds)), -_MOST_ODDS, _MOST_ODDS)
    if "crosses" in evidence:
        made["crosses"] = evidence["crosses"].to_numpy(np.float64, na_value=0.0)
    if "dead_end_distance" in evidence:
        made["dead_end"] = (evidence["dead_end_distance"].to_numpy(np.float64) <= _NEAR).astype(np.float64)
    return pd.DataFrame(made, index=evidence.index)


def probabilities(change: str, evidence: pd.DataFrame) -> NDArray[np.float64]:
    """Return the probabilities that differences of one kind are real, shape (n,).

    Parameters
    ----------
    change
        A key of `FEATURES`.
    evidence
        As of `evidence_features`, one row for each.

    Examples
    --------
    >>> few, many = probabilities("added", pd.DataFrame({"support": [1, 30], "length": [40.0, 400.0]}))
    >>> bool(few < many)
    True
    """
    constant, *weights = _COEFFICIENTS[change]
    features = evidence_features(evidence)[list(FEATURES[change])].to_numpy(np.float64)
    return np.asarray(expit(constant + features @ np.array(weights)))
