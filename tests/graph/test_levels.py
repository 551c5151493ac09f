"""Which road passes over which, from heights at the places where they cross."""

from __future__ import annotations

from probe2road.graph.levels import crossing_layers
from sketches import graph_of


def test_each_storey_is_one_layer_above_what_it_passes_over():
    street = [(0, 0, 0), (100, 0, 0)]
    bridge = [(50, -50, 6), (50, 50, 6)]
    viaduct = [(0, 20, 12), (100, 20, 12)]  # over the bridge only
    beside = [(0, 90, 30), (100, 90, 30)]  # high, but over nothing
    assert crossing_layers(graph_of(street, bridge, viaduct, beside)).tolist() == [0, 1, 2, 0]


def test_heights_that_hardly_differ_and_unknown_heights_decide_nothing():
    street, other = [(0, 0, 0), (100, 0, 0)], [(50, -50, 2), (50, 50, 2)]
    plain = [(70, -50), (70, 50)]
    assert crossing_layers(graph_of(street, other, plain)).tolist() == [0, 0, 0]


def test_roads_that_meet_do_not_cross():
    assert crossing_layers(graph_of([(0, 0, 0), (50, 0, 0)], [(50, 0, 0), (50, 40, 9)])).tolist() == [0, 0]


def test_the_height_counts_where_they_cross():
    rising = [(0, 0, 0), (100, 0, 10)]
    crossed_low, crossed_high = [(10, -50, 6), (10, 50, 6)], [(90, -50, 6), (90, 50, 6)]
    assert crossing_layers(graph_of(rising, crossed_low, crossed_high)).tolist() == [1, 2, 0]


def test_roads_that_pass_over_each_other_in_turns_have_an_end():
    first = [(0, 0, 0), (100, 0, 10)]
    second = [(0, 1, 5), (20, -1, 5), (80, -1, 5), (100, 1, 5)]
    assert crossing_layers(graph_of(first, second)).max() <= 11
