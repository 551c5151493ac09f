"""Registration: each drive shifted until its sightings lie on those of the other drives.

Strategy
--------
Markings of raw drives, laid over each other, are a blur: the errors are of the width of a lane, and the nearest line is
often that of the neighbouring lane (METHOD 9.2, adjacent-lane aliasing). So drives are not attracted to the mean of
all, but placed one after the other on a map that stays sharp (`probe2road.alignment.profiles`). A drive is a sequence
of keyframes, and its shift may change between them only as odometry can drift. Every shift within the search range is a
hypothesis at every keyframe (`probe2road.alignment.hypotheses`); the best sequence of shifts comes from dynamic
programming. When all are placed, each is taken out and placed again, so that the first do not decide for all.

Drives that agree already are settled: all are on the map from the start, and each is only taken out and placed once.
Placing them anew, one after the other, would let two of them lock beside the road that all others agree on: what one
saw there alone fits what the other saw as well as anything.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from probe2road.alignment.hypotheses import Track, best_path, gnss_scores, own_rates, sight_scores
from probe2road.alignment.profiles import (
    Profiles,
    RoadPlaces,
    ShiftSearch,
    Sights,
    add_sights,
    add_view,
    average_view,
    empty_profiles,
)

__all__ = ["Chains", "DriveEvidence", "register"]

_PASSES = 2  # how often each chain is placed on a map that starts empty


@dataclass(frozen=True)
class DriveEvidence:
    """The o observations of keyframes, in coordinates of places and in the order of the keyframes."""

    keyframe: NDArray[np.int64]  # (o,)
    place: NDArray[np.int64]  # (o,)
    value: NDArray[np.float64]  # (o,) m, to the left of the spine, or above it
    kind: NDArray[np.int8]  # (o,)


@dataclass(frozen=True)
class Chains:
    """C chains of keyframes, and the order in which they are placed."""

    starts: NDArray[np.int64]  # (c + 1,) keyframe at which each starts, then their number
    order: NDArray[np.int64]  # (c,) the chains in the order in which they are placed
    held: NDArray[np.bool_]  # (c,) chains that do not move; they are placed before all others

    @property
    def placing(self) -> NDArray[np.int64]:
        """Return the order in which chains are placed; those that do not move come first."""
        held = self.held[self.order]
        return np.concatenate([self.order[held], self.order[~held]])


def register(
    evidence: DriveEvidence,
    places: RoadPlaces,
    chains: Chains,
    track: Track,
    search: ShiftSearch,
    *,
    settled: bool = False,
) -> NDArray[np.float64]:
    """Find the shift of every keyframe.

    Parameters
    ----------
    evidence
        What was seen.
    places
        Neighbours of each place.
    chains
        Which keyframes belong together, and in which order they are placed.
    track
        Where the keyframes are.
    search
        The hypotheses.
    settled
        Whether the chains agree already, and each is compared with all others from the start.

    Returns
    -------
    ndarray, shape (k,)
        Metres, to be added to the values.

    Examples
    --------
    Two drives that see two lines; the second one lies 3 m off and is brought onto the first:

    >>> lines = np.tile([-1.5, 2.0], 40)
    >>> keyframe = np.repeat(np.arange(20), 4)
    >>> value = np.concatenate([lines[:40], lines[40:] - 3.0])
    >>> seen = DriveEvidence(keyframe, keyframe % 10, value, np.zeros(80, np.int8))
    >>> chains = Chains(np.array([0, 10, 20]), np.array([0, 1]), np.zeros(2, bool))
    >>> track = Track(
    ...     np.arange(20) % 10, np.repeat([0.25, -2.75], 10), np.zeros(20), np.full(20, 0.1), np.full(20, 10.0)
    ... )
    >>> search = ShiftSearch(8.0, 0.25, 20.0, 0.3, 2.0, 1.0)
    >>> shift = register(seen, RoadPlaces.from_roads(np.zeros(10, np.int64)), chains, track, search)
    >>> shift[10:].round(2).tolist() == [3.0] * 10
    True
    """
    first = np.searchsorted(evidence.keyframe, np.arange(len(track.home) + 1))
    sights = Sights(first, evidence.place, evidence.value, evidence.kind)
    view = average_view(sights, evidence.keyframe, track.own, search)
    profiles = empty_profiles(places, view, search)
    return _place_chains(chains.starts, chains.placing, chains.held, sights, track, profiles, search, settled)


@njit(cache=True)
def _place_chains(
    starts: NDArray[np.int64],
    order: NDArray[np.int64],
    held: NDArray[np.bool_],
    sights: Sights,
    track: Track,
    profiles: Profiles,
    search: ShiftSearch,
    settled: bool,
) -> NDArray[np.float64]:
    """Place the chains on the map and leave them there: return the shift of each keyframe (m), shape ``(k,)``."""
    shift = np.zeros(len(track.home))
    placed = np.full(len(starts) - 1, settled)
    if settled:
        for chain in range(len(starts) - 1):
            _add_chain(starts[chain], starts[chain + 1], 1.0, shift, sights, track, profiles, search)
    for _ in range(1 if settled else _PASSES):
        for chain in order:
            begin, end = starts[chain], starts[chain + 1]
            if held[chain] and placed[chain]:
                continue
            if placed[chain]:
                _add_chain(begin, end, -1.0, shift, sights, track, profiles, search)
            if not held[chain]:
                score = gnss_scores(begin, end, track, profiles, search)
                alone = own_rates(begin, end, sights, track, profiles, search)
                for k in range(begin, end):
                    if track.home[k] >= 0:
                        sight_scores(k, sights, track, profiles, search, alone[k - begin], score[k - begin])
                shift[begin:end] = best_path(score, track.move_sigma[begin:end], search)
            _add_chain(begin, end, 1.0, shift, sights, track, profiles, search)
            placed[chain] = True
    return shift


@njit(cache=True)
def _add_chain(
    begin: int,
    end: int,
    sign: float,
    shift: NDArray[np.float64],
    sights: Sights,
    track: Track,
    profiles: Profiles,
    search: ShiftSearch,
) -> None:
    """Add a chain to the map at its shift, or remove it if ``sign`` is negative."""
    for k in range(begin, end):
        place = track.home[k]
        if place >= 0:
            add_sights(k, sign, shift[k], sights, profiles, search)
            add_view(k, sign, track.own[k] + shift[k], place, sights, profiles, search)
            profiles.moved[place] += sign * (shift[k] - track.recorded[k])
            profiles.passed[place] += sign
