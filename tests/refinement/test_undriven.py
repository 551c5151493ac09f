import pandas as pd
import pytest

from probe2road.errors import OptionError
from probe2road.refinement.undriven import RungOptions, drop_undriven
from sketches import graph_of

# Two roads side by side with a rung between them, edge 4.
LADDER = [[(0, 0), (90, 0)], [(90, 0), (180, 0)], [(0, 8), (90, 8)], [(90, 8), (180, 8)], [(90, 0), (90, 8)]]


def ladder(over: int, *, along: int = 10, rung: float = 8.0) -> list[int]:
    """Edges that are left when so many traces were matched over the rung, and so many along either road."""
    lines = [*LADDER[:2], *([(x, y + rung - 8.0) for x, y in line] for line in LADDER[2:4]), [(90, 0), (90, rung)]]
    graph = graph_of(*lines)
    driven = [(trace, 2 * (trace % 2) + part) for trace in range(2 * along) for part in (0, 1)]
    steps = pd.DataFrame(driven + [(trace, 4) for trace in range(over)], columns=["trace_id", "edge"])
    return drop_undriven(graph, steps, rungs=RungOptions()).edges.index.tolist()


def test_what_nobody_drives_is_dropped_with_its_turns():
    graph = graph_of([(0, 0), (90, 0)], [(90, 0), (180, 0)], [(90, 0), (90, 8)])
    steps = pd.DataFrame({"trace_id": [1, 1, 1, 2], "edge": [0, 1, 1, 0]})
    assert drop_undriven(graph, steps).edges.index.tolist() == [0, 1]
    assert drop_undriven(graph, steps, min_traces=2).edges.index.tolist() == [0]
    assert drop_undriven(graph, steps, min_traces=0) is graph
    with pytest.raises(OptionError, match="min_traces is -1"):
        drop_undriven(graph, steps, min_traces=-1)


def test_a_rung_needs_more_traces_than_a_road():
    assert ladder(over=0) == ladder(over=2) == [0, 1, 2, 3]
    assert ladder(over=4) == [0, 1, 2, 3, 4]


def test_a_quiet_street_between_quiet_streets_is_no_rung():
    assert ladder(over=1, along=3) == [0, 1, 2, 3, 4]


def test_a_long_edge_is_no_rung():
    assert ladder(over=1, rung=70.0) == [0, 1, 2, 3, 4]


def test_negative_options_are_refused():
    with pytest.raises(OptionError, match="min_share is -1"):
        RungOptions(min_share=-1.0)
