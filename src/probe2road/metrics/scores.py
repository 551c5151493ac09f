"""The score of one metric, and the tidy table of several scores."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

__all__ = ["SCORE_DTYPES", "Score", "f_score", "ratio", "scores_table"]

SCORE_DTYPES = {
    "metric": "str",
    "precision": "float64",
    "recall": "float64",
    "f1": "float64",
    "matched_proposal": "float64",  # samples, pixels, pairs or metres of the proposal that found a partner
    "proposal": "float64",  # all samples, pixels, pairs or metres of the proposal
    "matched_reference": "float64",  # the same for the reference; equal if matching is one-to-one
    "reference": "float64",
    "parameters": "str",  # JSON, every parameter of the metric
    "details": "str",  # JSON, facts to read beside the score: node counts, lengths
}


@dataclass(frozen=True)
class Score:
    """The result of one metric for a proposal.

    Attributes
    ----------
    metric
        Its name, such as ``geo``.
    precision, recall
        In [0, 1]; 0 where there is nothing to score.
    matched_proposal, proposal, matched_reference, reference
        The counts behind them (samples, pixels, pairs, or metres for buffer GEO).
    parameters
        Every parameter, because a score without its parameters cannot be compared.
    details
        Facts to read beside the score.
    """

    metric: str
    precision: float
    recall: float
    matched_proposal: float
    proposal: float
    matched_reference: float
    reference: float
    parameters: Mapping[str, Any]
    details: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def from_counts(
        cls,
        metric: str,
        *,
        matched_proposal: float,
        proposal: float,
        matched_reference: float,
        reference: float,
        parameters: Mapping[str, Any],
        details: Mapping[str, Any] | None = None,
    ) -> Score:
        """Build a score whose precision and recall are ratios of pooled counts."""
        precision, recall = ratio(matched_proposal, proposal), ratio(matched_reference, reference)
        return cls(
            metric,
            precision,
            recall,
            float(matched_proposal),
            float(proposal),
            float(matched_reference),
            float(reference),
            dict(parameters),
            dict(details or {}),
        )

    @property
    def f1(self) -> float:
        """Return the harmonic mean of precision and recall."""
        return f_score(self.precision, self.recall)

    def __str__(self) -> str:
        parameters = ", ".join(f"{name}={value}" for name, value in self.parameters.items())
        return f"{self.metric} P {self.precision:.3f} R {self.recall:.3f} F1 {self.f1:.3f} ({parameters})"


def ratio(part: float, whole: float) -> float:
    """Return a quotient, and 0 for 0 / 0: an empty graph scores 0, never NaN.

    Examples
    --------
    >>> ratio(1, 4), ratio(0, 0)
    (0.25, 0.0)
    """
    return float(part) / float(whole) if whole > 0 else 0.0


def f_score(precision: float, recall: float) -> float:
    """Return the harmonic mean of precision and recall; 0 where both are 0.

    Examples
    --------
    >>> round(f_score(1.0, 2 / 3), 3), f_score(0.0, 0.0)
    (0.8, 0.0)
    """
    return ratio(2.0 * precision * recall, precision + recall)


def scores_table(scores: Iterable[Score]) -> pd.DataFrame:
    """Return scores as a tidy table, one row each, with the columns and types of `SCORE_DTYPES`.

    Examples
    --------
    >>> counts = {"matched_proposal": 2, "proposal": 2, "matched_reference": 2, "reference": 3}
    >>> score = Score.from_counts("geo", **counts, parameters={"spacing": 11.0, "radius": 6.0})
    >>> print(score)
    geo P 1.000 R 0.667 F1 0.800 (spacing=11.0, radius=6.0)
    >>> scores_table([score])[["metric", "reference", "parameters"]].values.tolist()
    [['geo', 3.0, '{"spacing": 11.0, "radius": 6.0}']]
    >>> len(scores_table([]))
    0
    """
    rows = [
        vars(score)
        | {"f1": score.f1, "parameters": json.dumps(dict(score.parameters)), "details": json.dumps(dict(score.details))}
        for score in scores
    ]
    return pd.DataFrame(rows, columns=list(SCORE_DTYPES)).astype(SCORE_DTYPES)
