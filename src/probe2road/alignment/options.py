"""The options of fleet alignment, with their units."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from probe2road.bounds import AtLeast, Positive
from probe2road.errors import OptionError
from probe2road.options import checked

__all__ = ["AlignOptions"]


@dataclass(frozen=True)
@checked
class AlignOptions:
    """How drives are aligned; the defaults are those of METHOD 9.2 unless a comment says otherwise."""

    tile: Positive[float] = 1500.0  # m, side of the area that one factor graph covers
    margin: Positive[float] = 300.0  # m, by which tiles reach into each other; there the results are blended
    keyframe_spacing: Positive[float] = 20.0  # m driven between the poses of the factor graph
    heading_gate: Positive[float] = 25.0  # degrees; roads that differ by more never attract each other
    altitude_gate: Positive[float] = 2.5  # m of height that separates roads: half the distance of decks (METHOD: 3 m)
    reach: Positive[float] = 12.0  # m, lateral; drives nearer than this may be on one carriageway
    search: Positive[float] = 9.0  # m, largest lateral shift that registration tries
    first_gate: Positive[float] = 1.5  # m, from a point to its line, in the first round, after registration
    last_gate: Positive[float] = 0.7  # m, from a point to its line, in the last rounds
    rounds: Positive[int] = 6  # of matching and optimising, at most
    converged: Positive[float] = 0.01  # m; rounds end when the median residual changes by less
    min_drives: Annotated[int, AtLeast(2)] = 2  # drives that must have seen a line before it attracts others
    marking_sigma: Positive[float] = 0.2  # m, of a marking point about its line
    boundary_sigma: Positive[float] = 0.35  # m, of a boundary point
    lane_sigma: Positive[float] = 3.0  # m, of the path of a drive without camera about the middle of all
    gnss_sigma: Positive[float] = 3.0  # m, of a fix where the data has no accuracy
    gnss_length: Positive[float] = 1000.0  # m driven over which errors of GNSS are correlated
    odometry_share: Positive[float] = 0.005  # share of the distance, 1 sigma of the motion between keyframes
    odometry_heading: Positive[float] = 0.1  # degrees, 1 sigma, of the turn between keyframes
    height_share: Positive[float] = 0.01  # share of the distance, 1 sigma of the change of height between keyframes
    keep_rejected: bool = True  # leave rejected drives in the data, where they were; else drop them

    @property
    def gates(self) -> tuple[float, ...]:
        """Return the gate of each round, m: it shrinks over half of the rounds and then stays."""
        shrinking = np.geomspace(self.first_gate, self.last_gate, max(self.rounds // 2 + 1, 2))
        return (*shrinking.tolist(), *[self.last_gate] * self.rounds)[: self.rounds]

    def __post_init__(self) -> None:
        """Refuse tiles without a core, and gates that grow."""
        if self.margin * 2 > self.tile:
            fix = "use a margin of at most half a tile"
            raise OptionError(f"margin is {self.margin}, tile is {self.tile}", where="AlignOptions", fix=fix)
        if self.last_gate > self.first_gate:
            fault = f"last_gate is {self.last_gate}, first_gate is {self.first_gate}"
            raise OptionError(fault, where="AlignOptions", fix="use gates that shrink")
