from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from probe2road.graph.roadgraph import RoadGraph
from probe2road.matching.match import Matches, MatchOptions, match
from sketches import fleet_of, graph_of

seeds = st.integers(0, 2**32 - 1)
profiles = st.sampled_from(["fleet", "sparse"])


def random_streets(rng: np.random.Generator) -> RoadGraph:
    """Streets between jittered corners 120 m apart, some missing, bent, drawn either way."""
    size = 4
    corners = 120.0 * np.stack(np.meshgrid(np.arange(size), np.arange(size), indexing="ij"), axis=-1)
    corners = corners + rng.uniform(-25.0, 25.0, corners.shape)
    lines = []
    for i in range(size):
        for j in range(size):
            for k, m in ((i + 1, j), (i, j + 1)):
                if k < size and m < size and rng.random() < 0.85:
                    middle = (corners[i, j] + corners[k, m]) / 2 + rng.uniform(-8.0, 8.0, 2)
                    line = np.array([corners[i, j], middle, corners[k, m]])
                    lines.append(line if rng.random() < 0.5 else line[::-1])
    return graph_of(*lines)


def random_drive(graph: RoadGraph, rng: np.random.Generator, n_edges: int) -> list[tuple[int, bool]]:
    """Edges and directions of a drive that never turns back, from a random edge."""
    edge, forward = int(rng.choice(graph.edges.index)), bool(rng.random() < 0.5)
    drive = [(edge, forward)]
    while len(drive) < n_edges:
        node = graph.edges.loc[edge, "v" if forward else "u"]
        onward = [(int(e), True) for e in graph.edges.index[graph.edges["u"] == node] if e != edge]
        onward += [(int(e), False) for e in graph.edges.index[graph.edges["v"] == node] if e != edge]
        if not onward:
            break
        edge, forward = onward[rng.integers(len(onward))]
        drive.append((edge, forward))
    return drive


def positions(graph: RoadGraph, drive: list[tuple[int, bool]], spacing: float) -> NDArray[np.float64]:
    """Places along a drive, from 20 m behind its start to 20 m before its end."""
    parts = []
    for edge, forward in drive:
        line = np.asarray(graph.edges.geometry[edge].coords)[:, :2]
        parts.append(line if forward else line[::-1])
    line = np.concatenate(parts)
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    at = np.arange(20.0, along[-1] - 20.0, spacing)
    return np.stack([np.interp(at, along, line[:, axis]) for axis in range(2)], axis=1)


def driven(found: Matches, trace: str = "a") -> list[tuple[int, bool]]:
    steps = found.steps[found.steps["trace_id"] == trace]
    return [(int(edge), bool(forward)) for edge, forward in zip(steps["edge"], steps["forward"], strict=True)]


@given(seed=seeds, profile=profiles)
@settings(max_examples=25, deadline=None)
def test_a_dense_trace_along_a_path_gives_the_path(seed: int, profile: str) -> None:
    rng = np.random.default_rng(seed)
    graph = random_streets(rng)
    drive = random_drive(graph, rng, 7)
    found = match(graph, fleet_of({"a": positions(graph, drive, 8.0)}), options=MatchOptions(profile=profile))
    assert driven(found) == drive
    assert found.steps["part"].eq(0).all()
    assert found.steps["entered"].tolist() == [False] + [True] * (len(drive) - 1)
    assert found.fixes["distance"].max() < 1e-6


@given(seed=seeds, profile=profiles)
@settings(max_examples=15, deadline=None)
def test_reversing_a_trace_reverses_the_steps(seed: int, profile: str) -> None:
    rng = np.random.default_rng(seed)
    graph = random_streets(rng)
    xy = positions(graph, random_drive(graph, rng, 7), 8.0)
    forth, back = (match(graph, fleet_of({"a": way}), options=MatchOptions(profile=profile)) for way in (xy, xy[::-1]))
    assert driven(back) == [(edge, not forward) for edge, forward in reversed(driven(forth))]


@given(seed=seeds, profile=st.sampled_from(["auto", "fleet", "sparse", "published"]))
@settings(max_examples=15, deadline=None)
def test_traces_do_not_influence_each_other(seed: int, profile: str) -> None:
    rng = np.random.default_rng(seed)
    graph = random_streets(rng)
    places = {}
    for name in "abc":
        xy = positions(graph, random_drive(graph, rng, 6), rng.choice([8.0, 90.0]))
        places[name] = xy + rng.normal(0, 6.0, xy.shape)
    options = MatchOptions(profile=profile)
    together = match(graph, fleet_of(places), options=options)
    turned = match(graph, fleet_of(dict(zip("cba", [places[name] for name in "abc"], strict=True))), options=options)
    for name, other in zip("abc", "cba", strict=True):
        assert driven(together, name) == driven(turned, other)
        alone = match(graph, fleet_of({name: places[name]}), options=options)
        assert driven(together, name) == driven(alone, name)


@given(seed=seeds, noise=st.sampled_from([0.0, 8.0, 40.0]), profile=st.sampled_from(["fleet", "sparse", "published"]))
@settings(max_examples=25, deadline=None)
def test_steps_and_fixes_agree_whatever_the_noise(seed: int, noise: float, profile: str) -> None:
    rng = np.random.default_rng(seed)
    graph = random_streets(rng)
    xy = positions(graph, random_drive(graph, rng, 9), 12.0)
    found = match(graph, fleet_of({"a": xy + rng.normal(0, noise, xy.shape)}), options=MatchOptions(profile=profile))
    fixes, steps = found.fixes, found.steps
    assert len(fixes) == len(xy)
    assert fixes["edge"].notna().tolist() == fixes["reason"].isna().tolist()
    assert set(fixes["edge"].dropna()) <= set(steps["edge"])
    length = graph.edges["length"].reindex(fixes["edge"].dropna().astype(int)).to_numpy()
    assert (fixes["offset"].dropna().to_numpy() <= length + 1e-6).all()
    ends = graph.edges.loc[steps["edge"], ["u", "v"]].to_numpy()
    ends = np.where(steps["forward"].to_numpy()[:, None], ends, ends[:, ::-1])
    onto = np.flatnonzero(steps["entered"])
    assert (ends[onto, 0] == ends[onto - 1, 1]).all()
    assert (ends[onto, 0] == steps["via_node"].to_numpy()[onto]).all()
    assert steps["left"].tolist() == [*steps["entered"].tolist(), False][1:]
    assert (steps["part"].diff().iloc[1:].to_numpy() == ~steps["entered"].to_numpy()[1:]).all()
