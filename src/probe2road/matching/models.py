"""The parameters of the two hidden Markov models of map matching."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from probe2road.errors import OptionError

__all__ = ["FLEET", "SPARSE", "PublishedModel", "RouteModel"]


@dataclass(frozen=True)
class RouteModel:
    """Matching by candidate points and the routes between them; costs are negative log probabilities.

    The defaults are those of the profile `FLEET`; `SPARSE` differs in the fields that depend on the interval.
    """

    sigma: float = 5.0  # m, spread of fixes about the centreline; the column accuracy can only widen it
    tail: float = 4.0  # degrees of freedom of Student's t, the law of the distances; small is tolerant of outliers
    radius: float = 60.0  # m, of the search for candidates
    null_distance: float = 35.0  # m, to a road in the right direction, beyond which no road is the better explanation
    spacing: float = 25.0  # m; fixes nearer than this to the one before only follow the route, they do not shape it
    beta: float = 10.0  # m, mean excess of the route over the straight line between two fixes
    beta_rate: float = 0.0  # m/s, by which that mean grows with the time between them
    break_cost: float = 20.0  # of a jump that no route explains; leaving the network and returning cost half each
    uturn_cost: float = 10.0  # of turning back at a node; half of it at a dead end
    turn_cost: float = 1.5  # of a turn by 180 degrees, growing with 1 - cos of the angle
    heading_weight: float = 4.0  # kappa of von Mises' law for the column heading
    course_weight: float = 2.0  # the same for the direction from the fix before to the fix after
    course_interval: float = 5.0  # s between fixes, beyond which that direction says little
    altitude_sigma: float = 2.0  # m, spread of altitudes about their slowly varying bias
    altitude_cap: float = 4.0  # largest cost of an altitude
    max_step: float = 5000.0  # m between two fixes, beyond which no route is looked for

    def __post_init__(self) -> None:
        """Refuse numbers that are no scale or no cost."""
        positive = {"sigma", "tail", "radius", "null_distance", "beta", "break_cost", "altitude_sigma", "max_step"}
        for field in fields(self):
            _require(self, field.name, above=field.name in positive)


@dataclass(frozen=True)
class PublishedModel:
    """The matcher of Biagioni and Eriksson (METHOD 4.4): directed edges and a state for no road; probabilities."""

    step: float = 10.0  # m, largest distance of interpolated fixes
    sigma: float = 50.0  # m, of the complementary normal distribution
    cutoff: float = 150.0  # m, at and beyond which an edge has emission 0
    unknown: float = 0.01  # emission of the state for no road
    stay: float = 0.5  # edge to itself
    leave: float = 1e-5  # edge to no road
    turn_back: float = 1e-5  # edge to its reverse, at nodes that do not have exactly two edges
    stay_unknown: float = 0.9  # no road to no road
    enter: float = 0.1  # no road to any edge, shared by them
    reentry: str = "global"  # shared by all edges ("global") or by those within the cutoff ("local")
    floor: float = 1e-11  # states below this share are dropped
    memory: int = 300  # steps after which a state is decided

    def __post_init__(self) -> None:
        """Refuse numbers that are no probability or no scale."""
        for name in ("step", "sigma", "cutoff", "memory"):
            _require(self, name, above=True)
        for name in ("unknown", "stay", "leave", "turn_back", "stay_unknown", "enter", "floor"):
            _require(self, name)
            if getattr(self, name) > 1:
                raise OptionError(f"{name} is {getattr(self, name)}", where="PublishedModel", fix="use at most 1")
        if self.reentry not in ("global", "local"):
            raise OptionError(f"reentry is {self.reentry!r}", where="PublishedModel", fix="use global or local")


def _require(model: Any, name: str, *, above: bool = False) -> None:
    """Refuse a value that is negative, or zero where it must be above."""
    value = getattr(model, name)
    if not (value > 0 if above else value >= 0):
        fix = "use a positive number" if above else "use a number that is not negative"
        raise OptionError(f"{name} is {value}", where=type(model).__name__, fix=fix)


FLEET = RouteModel()
SPARSE = RouteModel(
    sigma=7.0,
    tail=8.0,
    radius=80.0,
    null_distance=60.0,
    spacing=10.0,
    beta=10.0,
    beta_rate=1.5,
    break_cost=15.0,
    uturn_cost=6.0,
    turn_cost=2.0,
    course_weight=0.0,
)
