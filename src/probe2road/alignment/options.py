"""The options of fleet alignment, with their units."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from probe2road.errors import OptionError

__all__ = ["AlignOptions"]


@dataclass(frozen=True)
class AlignOptions:
    """How drives are brought together; the defaults are those of METHOD 9.2 unless a comment says otherwise."""

    tile: float = 1500.0  # m, side of the area that one factor graph covers
    margin: float = 300.0  # m, by which tiles reach into each other; there the results are blended
    keyframe_spacing: float = 20.0  # m driven between the poses of the factor graph
    heading_gate: float = 25.0  # degrees; roads that differ by more never attract each other
    altitude_gate: float = 2.5  # m; nor do roads further apart in height: half of what decks are (METHOD has 3 m)
    reach: float = 12.0  # m, lateral; drives nearer than this may be on one carriageway
    search: float = 9.0  # m, lateral shift within which a drive is looked for on the others
    first_gate: float = 1.5  # m, from a point to its line, in the first round; registration has been before
    last_gate: float = 0.7  # m, to which it shrinks
    rounds: int = 6  # of matching and optimising, at most
    converged: float = 0.01  # m; rounds end when the median residual changes by less
    min_drives: int = 2  # that must have seen a line before it attracts
    marking_sigma: float = 0.2  # m, of a marking point about its line
    boundary_sigma: float = 0.35  # m, of a boundary point
    lane_sigma: float = 3.0  # m, of the path of a drive without camera about the middle of all
    gnss_sigma: float = 3.0  # m, of a fix where the data has no accuracy
    gnss_length: float = 1000.0  # m driven over which errors of GNSS stay alike
    odometry_share: float = 0.005  # of the distance, 1 sigma, of the motion between keyframes
    odometry_heading: float = 0.1  # degrees, 1 sigma, of the turn between keyframes
    height_share: float = 0.01  # of the distance, 1 sigma, of the change of height between keyframes
    keep_rejected: bool = True  # leave rejected drives in the data, where they were; else drop them

    @property
    def gates(self) -> tuple[float, ...]:
        """The gate of each round, m: shrinking over half of them, then the last one."""
        shrinking = np.geomspace(self.first_gate, self.last_gate, max(self.rounds // 2 + 1, 2))
        return (*shrinking.tolist(), *[self.last_gate] * self.rounds)[: self.rounds]

    def __post_init__(self) -> None:
        """Refuse lengths that are not positive and tiles without a core."""
        for name, value in vars(self).items():
            if isinstance(value, float) and not value > 0:
                raise OptionError(f"{name} is {value}", where="AlignOptions", fix="use a positive number")
        if self.margin * 2 > self.tile:
            fix = "use a margin of at most half a tile"
            raise OptionError(f"margin {self.margin} m, tile {self.tile} m", where="AlignOptions", fix=fix)
        if self.last_gate > self.first_gate or self.rounds < 1:
            fault = f"{self.rounds} rounds with gates from {self.first_gate} m to {self.last_gate} m"
            raise OptionError(fault, where="AlignOptions", fix="use 1 round or more and gates that shrink")
        if self.min_drives < 2:
            raise OptionError(f"min_drives is {self.min_drives}", where="AlignOptions", fix="use 2 or more")
