"""Whether the roads of a map are driven the way that the map says."""

from __future__ import annotations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.comparison.overlap import OverlapOptions, Roads
from probe2road.graph.direction import ONEWAY_TAGS, WAYS, DirectionOptions, oneway_probabilities
from probe2road.metrics.network import locate
from probe2road.metrics.projection import direction_over, project_along

__all__ = ["direction_changes"]

_BASE_IS_RIGHT = 0.95  # share of the edges of a map whose direction is as the map says
_WRONG_WAY = 0.04  # share of traversals that are matched to the wrong side of a road
_BESIDE = 30.0  # m to a carriageway that is driven the other way
_ELSEWHERE = 1e6  # m; farther than any road: a road that is closed in a direction is not looked for


def direction_changes(theirs: Roads, flows: pd.DataFrame, options: OverlapOptions) -> pd.DataFrame:
    """Return how probable it is that each edge of a base map is driven another way than it says.

    The three ways of `probe2road.graph.direction.oneway_probabilities` are weighed by the traversals, and by the trust
    in the base. Some drives against a one-way road say nothing where a road beside it is open that way: they were on
    that one.

    Parameters
    ----------
    theirs
        The base map.
    flows
        From `probe2road.comparison.flows.base_flows`.
    options
        What is beside a road.

    Returns
    -------
    DataFrame, indexed by the rows of the base's edges
        ``oneway`` (``yes``, ``-1``, ``no``: the most probable way among those the base does not say) and
        ``probability`` (that the base is wrong, before calibration).
    """
    along, against = flows["along"].to_numpy(), flows["against"].to_numpy()
    explained = (theirs.sense == 1) & (against < along) & _open_beside(theirs, options)
    against = np.where(explained, 0.0, against)
    even = DirectionOptions(oneway_share=2 / 3, wrong_way=_WRONG_WAY)
    likelihood = oneway_probabilities(along, against, options=even)
    said = np.stack([theirs.sense == way for way in WAYS], axis=1)
    posterior = likelihood * np.where(said, _BASE_IS_RIGHT, (1 - _BASE_IS_RIGHT) / 2)
    posterior /= posterior.sum(axis=1, keepdims=True)
    other = np.where(said, -1.0, posterior).argmax(axis=1)
    words = np.array([ONEWAY_TAGS[way] for way in WAYS])
    probability = 1.0 - (posterior * said).sum(axis=1)
    return pd.DataFrame({"oneway": words[other], "probability": np.where(along + against > 0, probability, 0.0)})


def _open_beside(theirs: Roads, options: OverlapOptions) -> NDArray[np.bool_]:
    """Tell of every edge whether a road beside its middle is open against its direction."""
    network = theirs.network
    edge = np.arange(len(theirs.sense))
    middle = network.length / 2
    xy, _ = locate(network, edge, middle)
    driven = -direction_over(network, edge, middle, options.span)
    found, _ = project_along(
        xy,
        driven,
        network,
        radius=_BESIDE,
        max_angle=options.max_angle,
        span=options.span,
        sense=theirs.sense,
        against=_ELSEWHERE,
    )
    # An edge that is closed that way is found only where there is no other: it is then the edge itself.
    return (found >= 0) & (found != edge)
