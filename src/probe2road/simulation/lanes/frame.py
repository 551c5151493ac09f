"""The curvilinear frame of a network: from section, distance along it and lateral offset to a position.

Strategy
--------
The vertices of all sections lie in flat arrays, with the arc length of every vertex counted through all sections in a
row and a gap of one metre between two, so that one sorted search locates any number of places at once. The normal at a
vertex halves the angle between its two steps; at a node where two section ends meet and no other, it halves the angle
between the sections, so that lateral offsets are continuous from one to the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["SectionFrame"]

_MIN_STEP = 1e-6  # m; a shorter step has no direction of its own


@dataclass(frozen=True)
class SectionFrame:
    """Flat geometry of r sections with n vertices.

    Attributes
    ----------
    xyz
        Vertices, shape ``(n, 3)``.
    offsets
        Section row i owns vertices ``offsets[i]`` to ``offsets[i + 1]``, shape ``(r + 1,)``.
    arc
        Arc length of every vertex, increasing through all sections (m), shape ``(n,)``.
    normal
        Unit vector to the right of the drawing direction, shape ``(n, 2)``.
    length
        Length of every section in plan (m), shape ``(r,)``.
    """

    xyz: NDArray[np.float64]
    offsets: NDArray[np.int64]
    arc: NDArray[np.float64]
    normal: NDArray[np.float64]
    length: NDArray[np.float64]

    @classmethod
    def from_network(cls, network: RoadNetwork) -> SectionFrame:
        """Compute the frame of a network."""
        xyz, offsets = network.vertices()
        head = np.zeros(len(xyz), dtype=bool)
        head[offsets[:-1]] = True
        step = np.hypot(*np.diff(xyz[:, :2], axis=0, prepend=xyz[:1, :2]).T)
        arc = np.cumsum(np.where(head, 1.0, step))
        tangent = _vertex_tangents(xyz[:, :2], head)
        _join_tangents(tangent, network, offsets)
        normal = np.column_stack([tangent[:, 1], -tangent[:, 0]])
        return cls(xyz, offsets, arc, normal, arc[offsets[1:] - 1] - arc[offsets[:-1]])

    def positions(
        self, row: NDArray[np.int64], s: NDArray[np.float64], offset: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return positions at distances along section rows and offsets to the right; shape ``(k, 3)``.

        Distances outside the section are taken at its ends.

        Examples
        --------
        >>> from probe2road.simulation.networks.network import network_from_sections
        >>> frame = SectionFrame.from_network(network_from_sections([[(0, 0), (90, 0)]], crs="EPSG:32616"))
        >>> frame.positions(np.array([0, 0]), np.array([45.0, 999.0]), np.array([2.0, 0.0])).tolist()
        [[45.0, -2.0, 0.0], [90.0, 0.0, 0.0]]
        """
        before, weight = self._locate(row, s)
        w = weight[:, None]
        place = self.xyz[before] * (1 - w) + self.xyz[before + 1] * w
        place[:, :2] += (self.normal[before] * (1 - w) + self.normal[before + 1] * w) * offset[:, None]
        return place

    def lateral(self, row: NDArray[np.int64], s: NDArray[np.float64], xy: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far to the right of a section positions lie (m), given their distances s along it."""
        before, weight = self._locate(row, s)
        w = weight[:, None]
        on_line = self.xyz[before, :2] * (1 - w) + self.xyz[before + 1, :2] * w
        normal = self.normal[before] * (1 - w) + self.normal[before + 1] * w
        return np.asarray(((xy - on_line) * normal).sum(axis=1))

    def heights(self, row: NDArray[np.int64], s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return heights at distances along section rows (m)."""
        before, weight = self._locate(row, s)
        return np.asarray(self.xyz[before, 2] * (1 - weight) + self.xyz[before + 1, 2] * weight)

    def _locate(self, row: NDArray[np.int64], s: NDArray[np.float64]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the vertex before each place and the weight of the vertex after it."""
        first, last = self.offsets[row], self.offsets[row + 1] - 1
        arc = np.clip(self.arc[first] + s, self.arc[first], self.arc[last])
        before = np.clip(np.searchsorted(self.arc, arc, side="right") - 1, first, last - 1)
        span = np.maximum(self.arc[before + 1] - self.arc[before], _MIN_STEP)
        return before.astype(np.int64), np.clip((arc - self.arc[before]) / span, 0.0, 1.0)


def _vertex_tangents(xy: NDArray[np.float64], head: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the mean direction of the steps before and after every vertex; ends have only one step."""
    step = np.diff(xy, axis=0)
    unit = step / np.maximum(np.hypot(*step.T), _MIN_STEP)[:, None]
    unit[head[1:]] = 0.0  # from the end of one section to the start of the next
    total = np.zeros_like(xy)
    total[:-1] += unit
    total[1:] += unit
    return _unit(total)


def _join_tangents(tangent: NDArray[np.float64], network: RoadNetwork, offsets: NDArray[np.int64]) -> None:
    """Give two section ends at a node without others the same direction, in place."""
    node = network.sections[["u", "v"]].to_numpy().ravel()
    vertex = np.column_stack([offsets[:-1], offsets[1:] - 1]).ravel()
    sign = np.tile([1.0, -1.0], len(offsets) - 1)  # outward from the node
    order = np.argsort(node, kind="stable")
    ends = pd.Series(node[order])
    first = np.flatnonzero((ends.groupby(ends).transform("size") == 2).to_numpy())[::2]
    a, b = order[first], order[first + 1]
    outward_a, outward_b = (tangent[vertex[end]] * sign[end, None] for end in (a, b))
    smooth = (outward_a * outward_b).sum(axis=1) < 0  # the road goes on rather than turning back
    shared = _unit(outward_a - outward_b)[smooth]
    tangent[vertex[a[smooth]]] = shared * sign[a[smooth], None]
    tangent[vertex[b[smooth]]] = -shared * sign[b[smooth], None]


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.maximum(np.hypot(*vector.T), _MIN_STEP)[:, None]
