from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from probe2road.graph.roadgraph import RoadGraph
from sketches import graph_of


@pytest.fixture
def streets() -> Callable[..., RoadGraph]:
    """Return a maker of small street grids: jittered corners, bent edges, some edges missing."""

    def make(seed: int, *, size: int = 4, block: float = 25.0, noise: float = 3.0) -> RoadGraph:
        rng = np.random.default_rng(seed)
        corner = {(i, j): block * np.array([i, j]) + rng.normal(0, noise, 2) for i in range(size) for j in range(size)}
        lines = []
        for (i, j), start in corner.items():
            for end in ((i + 1, j), (i, j + 1)):
                if end in corner and rng.random() < 0.8:
                    bend = (start + corner[end]) / 2 + rng.normal(0, noise, 2)
                    line = [start, bend, corner[end]]
                    lines.append(line if rng.random() < 0.5 else line[::-1])
        return graph_of(*lines)

    return make
