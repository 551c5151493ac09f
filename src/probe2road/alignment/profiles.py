"""The map on which drives are registered: profiles across the road for each place along it, one for each kind.

Strategy
--------
A profile is two histograms over the offset from the spine: what was seen at each offset (votes), and what would have
been seen there on average, given from where the drives looked (the exposure). The quotient is the rate at which
something is seen, relative to the average of the fleet. A vote is spread over neighbouring offsets by a narrow kernel,
so that the map stays sharp, and over neighbouring places, because a line goes on. Votes can be taken away again, which
is how a drive is compared with all others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

__all__ = [
    "Profiles",
    "RoadPlaces",
    "ShiftSearch",
    "Sights",
    "add_sights",
    "add_view",
    "average_view",
    "empty_profiles",
]

_VIEW_SMOOTHING = 1.5  # m, 1 sigma, over which the average view of the fleet is smoothed, to hide single lines
_SPREAD_ALONG = 2  # places to which a vote spreads, either way
_SPREAD_DECAY = 0.75  # share of a vote that spreads from place to place


class RoadPlaces(NamedTuple):
    """N places along roads, each with a profile in the map."""

    before: NDArray[np.int64]  # (n,) the place behind, -1 at the end of a road
    after: NDArray[np.int64]  # (n,) the place ahead

    @classmethod
    def from_roads(cls, road: NDArray[np.int64]) -> RoadPlaces:
        """Connect places that are sorted by road and along it."""
        index = np.arange(len(road))
        same = np.concatenate([[False], road[1:] == road[:-1], [False]])
        return cls(np.where(same[:-1], index - 1, -1), np.where(same[1:], index + 1, -1))


class ShiftSearch(NamedTuple):
    """The shifts to try, and the resolution of the map."""

    reach: float  # m, the largest shift
    bin: float  # m
    half_width: float  # m, of a profile
    kernel: float  # m, 1 sigma, by which a vote is spread
    doubt: float  # keyframes that must look at a place before their observations have half the weight
    temper: float  # weight of one observation; below 1, because neighbouring ones share errors


class Sights(NamedTuple):
    """The o observations of k keyframes in coordinates of places, in the order of the keyframes."""

    first: NDArray[np.int64]  # (k + 1,) observation at which each keyframe begins, then their number
    place: NDArray[np.int64]  # (o,)
    value: NDArray[np.float64]  # (o,) m, to the left of the spine, or above it
    kind: NDArray[np.int8]  # (o,)


class Profiles(NamedTuple):
    """The map of n places; registration changes its arrays in place."""

    before: NDArray[np.int64]  # (n,) as in `RoadPlaces`
    after: NDArray[np.int64]  # (n,)
    average: NDArray[np.float64]  # (kinds, bins) what a keyframe sees on average, by distance to its side; odd number
    votes: NDArray[np.float32]  # (n, kinds, bins) what was seen
    looked: NDArray[np.float32]  # (n, kinds, bins) what those who looked there would see on average
    moved: NDArray[np.float64]  # (n,) m, sum of the shifts of the keyframes that passed
    passed: NDArray[np.float64]  # (n,) number of keyframes that passed


def empty_profiles(places: RoadPlaces, view: NDArray[np.float64], search: ShiftSearch) -> Profiles:
    """Return an empty map."""
    n_bins = int(2 * search.half_width / search.bin) + 1
    n, shape = len(places.before), (len(places.before), len(view), n_bins)
    return Profiles(
        places.before, places.after, view,
        np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(n), np.zeros(n),
    )  # fmt: skip


def average_view(
    sights: Sights, keyframe: NDArray[np.int64], own: NDArray[np.float64], search: ShiftSearch
) -> NDArray[np.float64]:
    """Count the average observations of a keyframe by their lateral distance from it.

    Parameters
    ----------
    sights
        The observations.
    keyframe
        Keyframe of each observation, shape ``(o,)``.
    own
        Position of each keyframe, in the coordinates of the values, shape ``(k,)``.
    search
        Width and bins of the profiles.

    Returns
    -------
    ndarray, shape (kinds, bins)
        An odd number of bins, the keyframe in the middle.
    """
    n_bins = 2 * int(search.half_width / search.bin) + 1
    kinds = int(sights.kind.max()) + 1 if len(sights.kind) else 1
    at = np.round((sights.value - own[keyframe]) / search.bin).astype(np.int64) + n_bins // 2
    inside = (at >= 0) & (at < n_bins)
    count = np.zeros((kinds, n_bins))
    np.add.at(count, (sights.kind[inside], at[inside]), 1.0)
    seeing = max(len(np.unique(keyframe)), 1)
    return gaussian_filter1d(count / seeing, _VIEW_SMOOTHING / search.bin, axis=1, mode="constant")


@njit(cache=True)
def add_sights(k: int, sign: float, shift: float, sights: Sights, profiles: Profiles, search: ShiftSearch) -> None:
    """Add the observations of keyframe k to the map, moved by a shift, or subtract them if ``sign`` is negative."""
    radius = int(np.ceil(2.5 * search.kernel / search.bin))
    kernel = np.empty(2 * radius + 1)
    for o in range(sights.first[k], sights.first[k + 1]):
        exact = (sights.value[o] + shift + search.half_width) / search.bin
        centre = int(np.round(exact))
        mass = 0.0
        for b in range(2 * radius + 1):
            kernel[b] = np.exp(-0.5 * ((centre - radius + b - exact) * search.bin / search.kernel) ** 2)
            mass += kernel[b]
        votes = profiles.votes[:, sights.kind[o]]
        _spread(sights.place[o], centre - radius, kernel, sign / mass, profiles.before, profiles.after, votes)


@njit(cache=True)
def add_view(
    k: int, sign: float, at: float, place: int, sights: Sights, profiles: Profiles, search: ShiftSearch
) -> None:
    """Add the view of keyframe k, for each kind that it observed, to the map; subtract it if ``sign`` is negative."""
    view = profiles.average
    first = int(np.round((at + search.half_width) / search.bin)) - view.shape[1] // 2
    for which in range(len(view)):
        for o in range(sights.first[k], sights.first[k + 1]):
            if sights.kind[o] == which:
                looked = profiles.looked[:, which]
                _spread(place, first, view[which], sign, profiles.before, profiles.after, looked)
                break


@njit(cache=True)
def _spread(
    place: int,
    first: int,
    kernel: NDArray[np.float64],
    scale: float,
    before: NDArray[np.int64],
    after: NDArray[np.int64],
    histograms: NDArray[np.float32],
) -> None:
    """Add a kernel, starting at bin ``first``, to the histogram of a place and, with less weight, of its neighbours."""
    low, high = max(-first, 0), min(len(kernel), histograms.shape[1] - first)
    for ahead in (True, False):
        at, weight = place, scale
        for step in range(_SPREAD_ALONG + 1):
            if at < 0:
                break
            if ahead or step > 0:
                for b in range(low, high):
                    histograms[at, first + b] += weight * kernel[b]
            at = after[at] if ahead else before[at]
            weight *= _SPREAD_DECAY
