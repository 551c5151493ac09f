"""The ends of edges: their nodes, their positions, and the directions from there along the edges.

An edge has two ends. End ``2 e`` is where edge row ``e`` starts, end ``2 e + 1`` where it stops, so that ``end // 2``
is the edge and ``end ^ 1`` its other end. Functions here take tables and lines: `RoadGraph.ends` and
`RoadGraph.end_rows` keep their results for a graph, and the simulator calls them for its sections.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

__all__ = ["EdgeEnds", "end_rows", "line_ends"]

_NOWHERE = 1e-9  # m; an edge that leads no farther than this has no direction


@dataclass(frozen=True, eq=False)
class EdgeEnds:
    """The two ends of each of E edges, in plan; one row for each end."""

    node: NDArray[np.int64]  # (2 E,) row of the node
    position: NDArray[np.float64]  # (2 E, 2) m
    ahead: NDArray[np.float64]  # (2 E, 2) unit vector away from the node into the edge; 0 if the edge returns there

    @classmethod
    def from_lines(
        cls, lines: NDArray[Any], rows: NDArray[np.int64], *, reach: float, skip: float = 0.0, share: float = 1.0
    ) -> EdgeEnds:
        """Measure the ends of lines, given the rows of their nodes, shape ``(E, 2)``, as `line_ends` does.

        Examples
        --------
        >>> lines = np.array([shapely.LineString([(0, 0), (30, 0), (30, 40)])])
        >>> ends = EdgeEnds.from_lines(lines, np.array([[0, 1]]), reach=20.0)
        >>> ends.node.tolist(), ends.ahead.tolist()
        ([0, 1], [[1.0, 0.0], [0.0, -1.0]])
        """
        position, vector = line_ends(lines, reach=reach, skip=skip, share=share)
        size = np.hypot(*vector.T)[:, None]
        ahead = np.divide(vector, size, out=np.zeros_like(vector), where=size > _NOWHERE)
        ends = cls(rows.ravel(), position, ahead)
        for array in (ends.node, ends.position, ends.ahead):
            array.setflags(write=False)
        return ends


def end_rows(nodes: pd.DataFrame, edges: pd.DataFrame) -> NDArray[np.int64]:
    """Return the rows of the nodes at which edges start and stop, shape ``(E, 2)``; -1 for a missing node.

    Raveled, the rows are those of the ends by number.

    Examples
    --------
    >>> nodes = pd.DataFrame(index=[10, 20, 30])
    >>> end_rows(nodes, pd.DataFrame({"u": [10, 20], "v": [30, 20]})).tolist()
    [[0, 2], [1, 1]]
    """
    return np.stack([nodes.index.get_indexer(edges[end]) for end in ("u", "v")], axis=1).astype(np.int64)


def line_ends(
    lines: NDArray[Any], *, reach: float, skip: float = 0.0, share: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the positions of both ends of lines in plan, and vectors from there along the lines.

    Parameters
    ----------
    lines
        LineStrings, shape ``(E,)``.
    reach
        Metres along the line, from its end, to which a vector leads.
    skip
        Metres along the line, from its end, at which it starts: what a mask bends there is left out. At most half of
        what the reach is on that line.
    share
        Of the length of a line, what the reach is at most.

    Returns
    -------
    position, vector
        Metres, shape ``(2 E, 2)`` each, by number of the end. A vector is zero where its line comes back to its end.

    Examples
    --------
    >>> line = np.array([shapely.LineString([(0, 0), (50, 0)])])
    >>> line_ends(line, reach=40.0, skip=10.0)[1].tolist(), line_ends(line, reach=40.0, share=0.5)[1].tolist()
    ([[30.0, 0.0], [-30.0, 0.0]], [[25.0, 0.0], [-25.0, 0.0]])
    """
    lines = shapely.force_2d(lines)
    length = shapely.length(lines)
    farthest = np.minimum(reach, share * length)
    position, near, far = (
        shapely.get_coordinates(
            shapely.line_interpolate_point(lines[:, None], np.stack([away, length - away], axis=1)).ravel()
        )
        for away in (np.zeros(len(lines)), np.minimum(skip, 0.5 * farthest), farthest)
    )
    return position, far - near
