"""The parameters of the two hidden Markov models of map matching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from probe2road.bounds import NotNegative, Positive, Share
from probe2road.options import checked

__all__ = ["FLEET", "SPARSE", "PublishedModel", "RouteModel"]


@dataclass(frozen=True)
@checked
class RouteModel:
    """Matching by candidate points and the routes between them; costs are negative logarithms of probabilities.

    The defaults are those of the profile `FLEET`; `SPARSE` differs in the fields that depend on the interval.
    """

    sigma: Positive[float] = 5.0  # m, spread of fixes about the centreline; the column accuracy can only widen it
    tail: Positive[float] = 4.0  # degrees of freedom of Student's t for the distances; small values tolerate outliers
    radius: Positive[float] = 60.0  # m, of the search for candidates
    null_distance: Positive[float] = 35.0  # m, to a road in the right direction, beyond which "no road" is more likely
    spacing: NotNegative[float] = 25.0  # m; fixes nearer than this to the one before do not shape the route
    beta: Positive[float] = 10.0  # m, mean excess of the route over the straight line between two fixes
    beta_rate: NotNegative[float] = 0.0  # m/s, by which this mean grows with the time between them
    break_cost: Positive[float] = 20.0  # cost of a jump without a route; leaving the network or returning costs half
    uturn_cost: NotNegative[float] = 10.0  # cost of turning back at a node; half of it at a dead end
    turn_cost: NotNegative[float] = 1.5  # cost of a turn by 180 degrees; it grows with 1 - cos of the angle
    heading_weight: NotNegative[float] = 4.0  # kappa of the von Mises distribution for the column heading
    course_weight: NotNegative[float] = 2.0  # the same for the direction from the fix before to the fix after
    course_interval: NotNegative[float] = 5.0  # s between fixes, beyond which this direction has less weight
    altitude_sigma: Positive[float] = 2.0  # m, spread of altitudes about their slowly varying bias
    altitude_cap: NotNegative[float] = 4.0  # largest cost of an altitude
    max_step: Positive[float] = 5000.0  # m between two fixes, beyond which no route is searched


@dataclass(frozen=True)
@checked
class PublishedModel:
    """The matcher of Biagioni and Eriksson (METHOD 4.4): probabilities of directed edges, and a state for no road."""

    step: Positive[float] = 10.0  # m, largest distance of interpolated fixes
    sigma: Positive[float] = 50.0  # m, of the complementary normal distribution
    cutoff: Positive[float] = 150.0  # m, at and beyond which an edge has emission 0
    unknown: Share = 0.01  # emission of the state for no road
    stay: Share = 0.5  # edge to itself
    leave: Share = 1e-5  # edge to no road
    turn_back: Share = 1e-5  # edge to its reverse, at nodes that do not have exactly two edges
    stay_unknown: Share = 0.9  # no road to no road
    enter: Share = 0.1  # no road to any edge, shared by them
    reentry: Literal["global", "local"] = "global"  # shared by all edges, or by those within the cutoff
    floor: Share = 1e-11  # states below this share are dropped
    memory: Positive[int] = 300  # steps after which a state is decided


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
