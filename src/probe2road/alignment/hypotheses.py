"""Scores of every shift of every keyframe, and the best sequence of shifts.

Strategy
--------
The score of a hypothesis is the log-likelihood of a Poisson process: the rate at which something is seen at each offset
is that at which other drives saw it, given how far to the side they could see. Where nobody could see yet it is the
rate at which the drive itself saw it a little before and after, so a drive in a lane of its own extends the map; it is
not pulled to where all its lines would match lines. That asks for cameras that see other lanes: one that sees its own
alone finds beside the road, where nobody looked, always what it expects. The less is seen of other lanes, the less is
new. And what should be seen and is not counts against a hypothesis, so a drive is not put beside a guard rail that it
did not see. GNSS adds its own term, which is small at one keyframe because its error is the same at the next.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.alignment.profiles import Profiles, ShiftSearch, Sights, add_sights, add_view

__all__ = ["Track", "best_path", "gnss_scores", "own_rates", "sight_scores"]

_OUTLIERS = 0.05  # least rate of anything anywhere, as a share of the average
_OWN_WINDOW = 8  # keyframes before and after that say what a drive sees all along
_NOVELTY = 0.95  # weight of what the drive itself saw, against the average, where nobody could see yet
_OWN_DOUBT = 0.3  # keyframes whose average view they are mixed with
_OWN_LANE = 5.5  # m to either side; what is seen further away, smoothed as views are, belongs to other lanes
_WIDE = 0.03  # share of a view in other lanes, from which a camera tells a lane of its own from those of others


class Track(NamedTuple):
    """The positions of k keyframes and their uncertainty, in the coordinates of the values of `Sights`."""

    home: NDArray[np.int64]  # (k,) the place of each keyframe, -1 for none
    own: NDArray[np.float64]  # (k,) m, position of each keyframe
    recorded: NDArray[np.float64]  # (k,) m, recorded minus present position: zero unless the keyframe was moved before
    move_sigma: NDArray[np.float64]  # (k,) m, by how much the shift may change since the keyframe before, 1 sigma
    prior_sigma: NDArray[np.float64]  # (k,) m, how far the recorded position may be off, inflated for shared errors


@njit(cache=True)
def gnss_scores(begin: int, end: int, track: Track, profiles: Profiles, search: ShiftSearch) -> NDArray[np.float64]:
    """Return the log-likelihood of the recorded positions under every shift: shape ``(end - begin, shifts)``.

    The most likely shift of a drive is the mean shift of the drives that were placed there before.
    """
    reach = int(np.round(search.reach / search.bin))
    score = np.zeros((end - begin, 2 * reach + 1))
    centre = 0.0
    for k in range(begin, end):
        place = track.home[k]
        if place >= 0 and profiles.passed[place] > 0.5:
            centre = profiles.moved[place] / profiles.passed[place]
        for m in range(2 * reach + 1):
            off = ((m - reach) * search.bin - centre - track.recorded[k]) / track.prior_sigma[k]
            score[k - begin, m] = -0.5 * off * off
    return score


@njit(cache=True)
def sight_scores(
    k: int,
    sights: Sights,
    track: Track,
    profiles: Profiles,
    search: ShiftSearch,
    alone: NDArray[np.float32],
    score: NDArray[np.float64],
) -> None:
    """Add the log-likelihood of what keyframe k saw, and of what it did not see, to the score of every shift.

    ``alone`` is its part of `own_rates`, ``score`` has the shape ``(shifts,)``.
    """
    n_bins = profiles.votes.shape[2]
    reach = len(score) // 2
    for which in range(len(profiles.average)):
        seen = 0
        doubt = search.doubt * profiles.average[which].max()
        for o in range(sights.first[k], sights.first[k + 1]):
            if sights.kind[o] != which:
                continue
            seen += 1
            place = sights.place[o]
            line, could = profiles.votes[place, which], profiles.looked[place, which]
            start = int(np.round((sights.value[o] + search.half_width) / search.bin)) - reach
            unknown = doubt * alone[which, min(max(start + reach, 0), n_bins - 1)]
            for m in range(len(score)):
                b = min(max(start + m, 0), n_bins - 1)
                rate = (max(line[b], 0.0) + unknown) / (could[b] + doubt)
                score[m] += search.temper * np.log(_OUTLIERS + (1.0 - _OUTLIERS) * rate)
        if seen > 0:
            _score_missing(k, which, seen, track, profiles, search, alone, score)


@njit(cache=True)
def _score_missing(
    k: int,
    which: int,
    seen: int,
    track: Track,
    profiles: Profiles,
    search: ShiftSearch,
    alone: NDArray[np.float32],
    score: NDArray[np.float64],
) -> None:
    """Subtract from the score of every shift what others saw of a kind there and this keyframe did not see."""
    view, n_bins, reach = profiles.average[which], profiles.votes.shape[2], len(score) // 2
    doubt = search.doubt * view.max()
    # The weight is limited by what the camera reported of this kind at all.
    weight = search.temper * min(seen / max(view.sum(), 1e-9), 1.0)
    line, could = profiles.votes[track.home[k], which], profiles.looked[track.home[k], which]
    start = int(np.round((track.own[k] + search.half_width) / search.bin)) - len(view) // 2
    for shift in range(len(score)):
        m = shift - reach
        expected = 0.0
        for b in range(max(-start, -start - m, 0), min(len(view), n_bins - start, n_bins - start - m)):
            at = start + m + b
            rate = (max(line[at], 0.0) + doubt * alone[which, start + b]) / (could[at] + doubt)
            expected += view[b] * (rate - 1.0)
        score[shift] -= weight * expected


@njit(cache=True)
def own_rates(
    begin: int, end: int, sights: Sights, track: Track, profiles: Profiles, search: ShiftSearch
) -> NDArray[np.float32]:
    """Return how often a chain sees something at each offset around each keyframe (left out), relative to the average.

    Shape ``(end - begin, kinds, bins)``; the less of other lanes is seen, the nearer to 1.
    """
    view = profiles.average
    kinds, n_bins = view.shape
    seen = np.zeros((end - begin, kinds, n_bins), np.float32)
    could = np.zeros((end - begin, kinds, n_bins), np.float32)
    nowhere, nothing = np.full(1, -1, np.int64), np.zeros(1)
    # A map with one place for each keyframe, which holds only that keyframe.
    here = Sights(sights.first, np.zeros(len(sights.value), np.int64), sights.value, sights.kind)
    for k in range(begin, end):
        i = k - begin
        alone = Profiles(nowhere, nowhere, view, seen[i : i + 1], could[i : i + 1], nothing, nothing)
        add_sights(k, 1.0, 0.0, here, alone, search)
        add_view(k, 1.0, track.own[k], 0, here, alone, search)
    rates = np.empty((end - begin, kinds, n_bins), np.float32)
    for which in range(kinds):
        doubt = _OWN_DOUBT * view[which].max()
        novelty = _NOVELTY * min(_share_of_other_lanes(view[which], search) / _WIDE, 1.0)
        for b in range(n_bins):
            others_seen, others_could = _around(seen[:, which, b]), _around(could[:, which, b])
            for i in range(end - begin):
                own_rate = (max(others_seen[i], 0.0) + doubt) / (max(others_could[i], 0.0) + doubt)
                rates[i, which, b] = novelty * own_rate + 1.0 - novelty
    return rates


@njit(cache=True)
def _share_of_other_lanes(view: NDArray[np.float64], search: ShiftSearch) -> float:
    """Return the share of a view, shape ``(bins,)``, that lies further to the side than the lane of the vehicle."""
    reach = int(_OWN_LANE / search.bin)
    middle = len(view) // 2
    near = view[max(middle - reach, 0) : middle + reach + 1].sum()
    return 1.0 - near / max(view.sum(), 1e-9)


@njit(cache=True)
def _around(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return, for every value, the sum of the other values within its window."""
    n = len(values)
    sums = np.empty(n)
    total = 0.0
    for i in range(min(_OWN_WINDOW, n)):
        total += values[i]
    for i in range(n):
        if i + _OWN_WINDOW < n:
            total += values[i + _OWN_WINDOW]
        if i - _OWN_WINDOW - 1 >= 0:
            total -= values[i - _OWN_WINDOW - 1]
        sums[i] = total - values[i]
    return sums


@njit(cache=True)
def best_path(score: NDArray[np.float64], move_sigma: NDArray[np.float64], search: ShiftSearch) -> NDArray[np.float64]:
    """Return the best sequence of shifts (m), shape ``(k,)``, for scores ``(k, shifts)``: the Viterbi algorithm."""
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
