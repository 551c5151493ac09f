"""Roads that run close beside each other, and graphs that run them together."""

import pytest

from probe2road.errors import OptionError
from probe2road.metrics.apart import ApartOptions, apart
from sketches import graph_of

TWO = graph_of([(0, 0), (220, 0)], [(0, 7), (220, 7)])


def test_one_line_between_two_roads_keeps_none_apart() -> None:
    score = apart(graph_of([(0, 3.5), (220, 3.5)]), TWO)
    assert (score.matched_reference, score.reference, score.proposal) == (0, 38, 0)


def test_a_bridge_between_two_roads_takes_none_of_their_places() -> None:
    assert (
        apart(graph_of([(0, 0), (100, 0), (220, 0)], [(0, 7), (100, 7), (220, 7)], [(100, 0), (100, 7)]), TWO).recall
        == 1
    )


def test_half_of_the_way_apart() -> None:
    half = graph_of(
        [(0, 0), (110, 0)], [(0, 7), (110, 7)], [(110, 0), (120, 3.5)], [(110, 7), (120, 3.5)], [(120, 3.5), (220, 3.5)]
    )
    assert apart(half, TWO).recall == pytest.approx(0.5, abs=0.1)
    assert apart(TWO, half).precision == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize(("gap", "counts"), [(5.9, False), (6.1, True), (8.9, True), (9.1, False)])
def test_only_roads_in_the_range_count(gap: float, counts: bool) -> None:
    roads = graph_of([(0, 0), (220, 0)], [(0, gap), (220, gap)])
    assert (apart(roads, roads).reference > 0) == counts


def test_a_third_road_between_two_hides_the_far_one() -> None:
    three = graph_of([(0, 0), (220, 0)], [(0, 4), (220, 4)], [(0, 8), (220, 8)])
    assert apart(three, three).reference == 0


def test_roads_that_cross_are_not_beside_each_other() -> None:
    crossing = graph_of([(0, 0), (220, 0)], [(110, 7), (110, 100)])
    assert apart(crossing, crossing).reference == 0


def test_sideways_by_more_than_half_the_least_distance_is_another_place() -> None:
    for shift, recall in ((2.9, 1.0), (3.1, 0.0)):
        moved = graph_of([(0, shift), (220, shift)], [(0, 7 + shift), (220, 7 + shift)])
        assert apart(moved, TWO).recall == recall


def test_a_range_with_nothing_in_it_is_refused() -> None:
    with pytest.raises(OptionError, match="least is 9 and most is 9; use least < most"):
        ApartOptions(least=9.0, most=9.0)
