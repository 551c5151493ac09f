"""Registration: each drive shifted until what it saw lies on what the drives before it saw.

Strategy
--------
Markings of raw drives, laid over each other, are a blur: the errors are of the width of a lane, and the nearest line is
often that of the neighbouring lane (METHOD 9.2, adjacent-lane aliasing). So drives are not attracted to the mean of
all, but placed one after the other on a map that stays sharp. The map is a profile across the road for each place along
it, one for each kind of thing; a drive is a sequence of keyframes, and its shift may change between them only as
odometry can drift. Every shift within the search range is a hypothesis at every keyframe; the best sequence of shifts
comes from dynamic programming. When all are placed, each is taken out and placed again, so that the first do not
decide for all.

The score of a hypothesis is the log-likelihood of a Poisson process: the rate at which something is seen at each offset
is that at which earlier drives saw it, given how far to the side they could see. Where nobody could see yet it is the
rate at which the drive itself saw it a little before and after, so a drive in a lane of its own extends the map; it is
not pulled to where all its lines would match lines.
And what should be seen and is not counts against a hypothesis, so a drive is not put beside a guard rail that it did
not see. GNSS adds its own term, which is small at one keyframe because its error is the same at the next.

The same procedure registers heights, where the profile is one of heights and the thing seen is the road itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

__all__ = ["Evidence", "Places", "ShiftSearch", "register"]

_OUTLIERS = 0.05  # least rate of anything anywhere, as a share of the average
_VIEW_SMOOTHING = 1.5  # m, 1 sigma: of the fleet's view to the side, so that single lines do not show in it
_SPREAD_ALONG = 2  # places to which a vote spreads, either way
_OWN_WINDOW = 8  # keyframes before and after that say what a drive sees all along
_OWN_DOUBT = 0.3  # keyframes whose average view they are mixed with
_SPREAD_DECAY = 0.75  # of a vote, from place to place


class Places(NamedTuple):
    """N places along roads: where the profiles of the map are."""

    before: NDArray[np.int64]  # (n,) the place behind, -1 at the end of a road
    after: NDArray[np.int64]  # (n,) the place ahead

    @classmethod
    def from_roads(cls, road: NDArray[np.int64]) -> Places:
        """Line up places that are sorted by road and along it."""
        index = np.arange(len(road))
        same = np.concatenate([[False], road[1:] == road[:-1], [False]])
        return cls(np.where(same[:-1], index - 1, -1), np.where(same[1:], index + 1, -1))


class ShiftSearch(NamedTuple):
    """What shifts are tried, and how sharp the map is."""

    reach: float  # m, the largest shift
    bin: float  # m
    half_width: float  # m, of a profile
    kernel: float  # m, 1 sigma, by which a vote is spread
    doubt: float  # keyframes that must have looked at a place before what they saw counts half
    temper: float  # weight of one observation; below 1, because neighbouring ones share errors
    novelty: float = 0.95  # weight of what the drive itself saw, against the average, where nobody could see yet


@dataclass(frozen=True)
class Evidence:
    """What keyframes saw, in coordinates of places: o observations, in the order of the keyframes."""

    keyframe: NDArray[np.int64]  # (o,)
    place: NDArray[np.int64]  # (o,)
    value: NDArray[np.float64]  # (o,) m, to the left of the spine, or above it
    kind: NDArray[np.int8]  # (o,)


def register(
    evidence: Evidence,
    places: Places,
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    home: NDArray[np.int64],
    own: NDArray[np.float64],
    recorded: NDArray[np.float64],
    move_sigma: NDArray[np.float64],
    prior_sigma: NDArray[np.float64],
    search: ShiftSearch,
    *,
    held: NDArray[np.bool_] | None = None,
    passes: int = 2,
) -> NDArray[np.float64]:
    """Find the shift of every keyframe.

    Parameters
    ----------
    evidence
        What was seen.
    places
        Neighbours of each place.
    starts
        Keyframe at which each chain starts, and their number: shape ``(chains + 1,)``.
    order
        The chains in the order in which they are placed.
    home
        Place of each keyframe, -1 where it has none: shape ``(k,)``.
    own
        Where each keyframe itself is, in the terms of the values: shape ``(k,)``.
    recorded
        Where it was recorded, less where it is: zero unless it has been moved before. Shape ``(k,)``.
    move_sigma
        By how much the shift may change since the keyframe before, m, 1 sigma: shape ``(k,)``.
    prior_sigma
        How far the recorded position may be off, m, 1 sigma; shape ``(k,)``. Inflate it for the errors that
        neighbouring keyframes share.
    search
        The hypotheses.
    held
        Chains that must stay where they are and come before all others: shape ``(chains,)``.
    passes
        How often each chain is placed.

    Returns
    -------
    ndarray, shape (k,)
        Metres, to be added to the values.

    Examples
    --------
    Two drives that see two lines; the second one lies 3 m off and is brought onto the first:

    >>> lines = np.tile([-1.5, 2.0], 40)
    >>> keyframe = np.repeat(np.arange(20), 4)
    >>> seen = Evidence(keyframe, keyframe % 10, np.concatenate([lines[:40], lines[40:] - 3.0]), np.zeros(80, np.int8))
    >>> shift = register(
    ...     seen, Places.from_roads(np.zeros(10, np.int64)), np.array([0, 10, 20]), np.array([0, 1]),
    ...     np.arange(20) % 10, np.repeat([0.25, -2.75], 10),
    ...     np.zeros(20), np.full(20, 0.1), np.full(20, 10.0), ShiftSearch(8.0, 0.25, 20.0, 0.3, 2.0, 1.0),
    ... )
    >>> shift[10:].round(2).tolist() == [3.0] * 10
    True
    """
    held = np.zeros(len(starts) - 1, bool) if held is None else held
    offsets = np.searchsorted(evidence.keyframe, np.arange(len(home) + 1))
    kinds = int(evidence.kind.max()) + 1 if len(evidence.kind) else 1
    n_bins = int(2 * search.half_width / search.bin) + 1
    shape = (len(places.before), kinds, n_bins)
    votes, looked = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    return _register(
        offsets, evidence.place, evidence.value, evidence.kind, own, _view(evidence, own, kinds, search),
        places.before, places.after, starts, np.concatenate([order[held[order]], order[~held[order]]]), home,
        recorded, move_sigma, prior_sigma, search, held, passes, votes, looked,
    )  # fmt: skip


def _view(evidence: Evidence, own: NDArray[np.float64], kinds: int, search: ShiftSearch) -> NDArray[np.float64]:
    """Count what a keyframe sees on average by distance to its side: shape ``(kinds, bins)``, an odd number of bins."""
    n_bins = 2 * int(search.half_width / search.bin) + 1
    at = np.round((evidence.value - own[evidence.keyframe]) / search.bin).astype(np.int64) + n_bins // 2
    inside = (at >= 0) & (at < n_bins)
    count = np.zeros((kinds, n_bins))
    np.add.at(count, (evidence.kind[inside], at[inside]), 1.0)
    seeing = max(len(np.unique(evidence.keyframe)), 1)
    return gaussian_filter1d(count / seeing, _VIEW_SMOOTHING / search.bin, axis=1, mode="constant")


@njit(cache=True)
def _register(
    offsets: NDArray[np.int64],
    place: NDArray[np.int64],
    value: NDArray[np.float64],
    kind: NDArray[np.int8],
    own: NDArray[np.float64],
    view: NDArray[np.float64],
    before: NDArray[np.int64],
    after: NDArray[np.int64],
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    home: NDArray[np.int64],
    recorded: NDArray[np.float64],
    move_sigma: NDArray[np.float64],
    prior_sigma: NDArray[np.float64],
    search: ShiftSearch,
    held: NDArray[np.bool_],
    passes: int,
    votes: NDArray[np.float32],
    looked: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Place every chain ``passes`` times; see `register`.

    ``votes`` is what was seen at each place, kind and offset, ``looked`` what would be seen there on average.
    """
    shift = np.zeros(len(home))
    placed = np.zeros(len(starts) - 1, np.bool_)
    # By how much those who passed a place left their recorded positions: GNSS wants the next one to do the same.
    total, passed = np.zeros(len(before)), np.zeros(len(before))
    for turn in range(passes):
        for chain in order:
            begin, end = starts[chain], starts[chain + 1]
            if held[chain] and turn > 0:
                continue
            for k in range(begin, end):
                if placed[chain] and home[k] >= 0:
                    _add_sights(k, -1.0, shift[k], offsets, place, value, kind, before, after, search, votes)
                    _add_view(k, -1.0, own[k] + shift[k], offsets, home[k], kind, view, before, after, search, looked)
                    total[home[k]] -= shift[k] - recorded[k]
                    passed[home[k]] -= 1.0
            if not held[chain]:
                score = _gnss_scores(begin, end, home, recorded, prior_sigma, search, total, passed)
                alone = _own_rates(begin, end, offsets, value, kind, own, view, search)
                for k in range(begin, end):
                    if home[k] >= 0:
                        _sight_scores(
                            k, offsets, place, value, kind, own, view, home, search, votes, looked, alone[k - begin],
                            score[k - begin],
                        )  # fmt: skip
                shift[begin:end] = _best_path(score, move_sigma[begin:end], search)
            for k in range(begin, end):
                if home[k] >= 0:
                    _add_sights(k, 1.0, shift[k], offsets, place, value, kind, before, after, search, votes)
                    _add_view(k, 1.0, own[k] + shift[k], offsets, home[k], kind, view, before, after, search, looked)
                    total[home[k]] += shift[k] - recorded[k]
                    passed[home[k]] += 1.0
            placed[chain] = True
    return shift


@njit(cache=True)
def _add_sights(
    k: int,
    sign: float,
    shift: float,
    offsets: NDArray[np.int64],
    place: NDArray[np.int64],
    value: NDArray[np.float64],
    kind: NDArray[np.int8],
    before: NDArray[np.int64],
    after: NDArray[np.int64],
    search: ShiftSearch,
    votes: NDArray[np.float32],
) -> None:
    """Add what a keyframe saw to the map, or take it away."""
    radius = int(np.ceil(2.5 * search.kernel / search.bin))
    kernel = np.empty(2 * radius + 1)
    for o in range(offsets[k], offsets[k + 1]):
        exact = (value[o] + shift + search.half_width) / search.bin
        centre = int(np.round(exact))
        mass = 0.0
        for b in range(2 * radius + 1):
            kernel[b] = np.exp(-0.5 * ((centre - radius + b - exact) * search.bin / search.kernel) ** 2)
            mass += kernel[b]
        _spread(place[o], centre - radius, kernel, sign / mass, before, after, votes[:, kind[o]])


@njit(cache=True)
def _add_view(
    k: int,
    sign: float,
    at: float,
    offsets: NDArray[np.int64],
    place: int,
    kind: NDArray[np.int8],
    view: NDArray[np.float64],
    before: NDArray[np.int64],
    after: NDArray[np.int64],
    search: ShiftSearch,
    looked: NDArray[np.float32],
) -> None:
    """Add how far a keyframe could see from where it is, of each kind of which it saw anything, or take it away."""
    centre = int(np.round((at + search.half_width) / search.bin))
    for which in range(len(view)):
        for o in range(offsets[k], offsets[k + 1]):
            if kind[o] == which:
                _spread(place, centre - view.shape[1] // 2, view[which], sign, before, after, looked[:, which])
                break


@njit(cache=True)
def _spread(
    place: int,
    first: int,
    kernel: NDArray[np.float64],
    scale: float,
    before: NDArray[np.int64],
    after: NDArray[np.int64],
    profiles: NDArray[np.float32],
) -> None:
    """Add a kernel, from bin ``first`` on, to the profile of a place and, less, to those around it."""
    low, high = max(-first, 0), min(len(kernel), profiles.shape[1] - first)
    for ahead in (True, False):
        at, weight = place, scale
        for step in range(_SPREAD_ALONG + 1):
            if at < 0:
                break
            if ahead or step > 0:
                for b in range(low, high):
                    profiles[at, first + b] += weight * kernel[b]
            at = after[at] if ahead else before[at]
            weight *= _SPREAD_DECAY


@njit(cache=True)
def _gnss_scores(
    begin: int,
    end: int,
    home: NDArray[np.int64],
    recorded: NDArray[np.float64],
    prior_sigma: NDArray[np.float64],
    search: ShiftSearch,
    total: NDArray[np.float64],
    passed: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Log-likelihood of the recorded positions under every shift: shape ``(end - begin, shifts)``."""
    reach = int(np.round(search.reach / search.bin))
    score = np.zeros((end - begin, 2 * reach + 1))
    centre = 0.0
    for k in range(begin, end):
        if home[k] >= 0 and passed[home[k]] > 0.5:
            centre = total[home[k]] / passed[home[k]]
        for m in range(2 * reach + 1):
            off = ((m - reach) * search.bin - centre - recorded[k]) / prior_sigma[k]
            score[k - begin, m] = -0.5 * off * off
    return score


@njit(cache=True)
def _sight_scores(
    k: int,
    offsets: NDArray[np.int64],
    place: NDArray[np.int64],
    value: NDArray[np.float64],
    kind: NDArray[np.int8],
    own: NDArray[np.float64],
    view: NDArray[np.float64],
    home: NDArray[np.int64],
    search: ShiftSearch,
    votes: NDArray[np.float32],
    looked: NDArray[np.float32],
    alone: NDArray[np.float32],
    score: NDArray[np.float64],
) -> None:
    """Add the log-likelihood of what a keyframe saw to the score of every shift, shape ``(shifts,)``."""
    n_bins = votes.shape[2]
    reach = len(score) // 2
    for which in range(len(view)):
        seen = 0
        doubt = search.doubt * view[which].max()
        for o in range(offsets[k], offsets[k + 1]):
            if kind[o] != which:
                continue
            seen += 1
            line, could = votes[place[o], which], looked[place[o], which]
            start = int(np.round((value[o] + search.half_width) / search.bin)) - reach
            unknown = doubt * alone[which, min(max(start + reach, 0), n_bins - 1)]
            for m in range(len(score)):
                b = min(max(start + m, 0), n_bins - 1)
                rate = (max(line[b], 0.0) + unknown) / (could[b] + doubt)
                score[m] += search.temper * np.log(_OUTLIERS + (1.0 - _OUTLIERS) * rate)
        # What should have been seen: no more of it than the camera reported at all.
        weight = search.temper * min(seen / max(view[which].sum(), 1e-9), 1.0)
        if weight == 0.0:
            continue
        line, could = votes[home[k], which], looked[home[k], which]
        start = int(np.round((own[k] + search.half_width) / search.bin)) - view.shape[1] // 2
        for shift in range(len(score)):
            m = shift - reach
            expected = 0.0
            for b in range(max(-start, -start - m, 0), min(view.shape[1], n_bins - start, n_bins - start - m)):
                at = start + m + b
                rate = (max(line[at], 0.0) + doubt * alone[which, start + b]) / (could[at] + doubt)
                expected += view[which, b] * (rate - 1.0)
            score[shift] -= weight * expected


@njit(cache=True)
def _own_rates(
    begin: int,
    end: int,
    offsets: NDArray[np.int64],
    value: NDArray[np.float64],
    kind: NDArray[np.int8],
    own: NDArray[np.float64],
    view: NDArray[np.float64],
    search: ShiftSearch,
) -> NDArray[np.float32]:
    """Rate of what a chain sees, relative to the average, at each offset around each keyframe, that one left out.

    Shape ``(end - begin, kinds, bins)``.
    """
    kinds, n_bins = view.shape
    seen = np.zeros((end - begin, kinds, n_bins), np.float32)
    could = np.zeros((end - begin, kinds, n_bins), np.float32)
    nowhere = np.full(1, -1, np.int64)
    origin = np.zeros(len(value), np.int64)
    for k in range(begin, end):
        i = k - begin
        _add_sights(k, 1.0, 0.0, offsets, origin, value, kind, nowhere, nowhere, search, seen[i : i + 1])
        _add_view(k, 1.0, own[k], offsets, 0, kind, view, nowhere, nowhere, search, could[i : i + 1])
    rates = np.zeros((end - begin, kinds, n_bins), np.float32)
    for which in range(kinds):
        doubt = _OWN_DOUBT * view[which].max()
        for b in range(n_bins):
            total_seen, total_could = 0.0, 0.0
            for i in range(min(_OWN_WINDOW, end - begin)):
                total_seen += seen[i, which, b]
                total_could += could[i, which, b]
            for i in range(end - begin):
                if i + _OWN_WINDOW < end - begin:
                    total_seen += seen[i + _OWN_WINDOW, which, b]
                    total_could += could[i + _OWN_WINDOW, which, b]
                if i - _OWN_WINDOW - 1 >= 0:
                    total_seen -= seen[i - _OWN_WINDOW - 1, which, b]
                    total_could -= could[i - _OWN_WINDOW - 1, which, b]
                others_seen = max(total_seen - seen[i, which, b], 0.0)
                others_could = max(total_could - could[i, which, b], 0.0)
                own_rate = (others_seen + doubt) / (others_could + doubt)
                rates[i, which, b] = search.novelty * own_rate + 1.0 - search.novelty
    return rates


@njit(cache=True)
def _best_path(score: NDArray[np.float64], move_sigma: NDArray[np.float64], search: ShiftSearch) -> NDArray[np.float64]:
    """Best sequence of shifts (m), shape ``(k,)``, for scores ``(k, shifts)``: the Viterbi algorithm."""
    k, shifts = score.shape
    reach = (shifts - 1) // 2
    best = score.copy()
    came = np.zeros((k, shifts), np.int64)
    for i in range(1, k):
        sigma = max(move_sigma[i] / search.bin, 0.2)
        window = min(int(np.ceil(4.0 * sigma)), 2 * reach)
        for m in range(shifts):
            top, source = -np.inf, m
            for j in range(max(m - window, 0), min(m + window + 1, shifts)):
                reached = best[i - 1, j] - 0.5 * ((m - j) / sigma) ** 2
                if reached > top:
                    top, source = reached, j
            best[i, m] += top
            came[i, m] = source
    path = np.zeros(k)
    at = int(np.argmax(best[k - 1]))
    for i in range(k - 1, -1, -1):
        path[i] = (at - reach) * search.bin
        at = came[i, at]
    return path
