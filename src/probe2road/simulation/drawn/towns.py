"""Drawings of towns: street networks at one level, regular and irregular."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import Voronoi

from probe2road.simulation.drawn.curves import resample
from probe2road.simulation.drawn.roads import Road

__all__ = ["draw_town"]

_BLOCK = 110.0  # m


def draw_town(rng: np.random.Generator, regular: bool, blocks: int) -> list[Road]:
    """Draw a town of ``blocks`` by ``blocks``; some streets are missing, but all streets are connected."""
    nodes, streets, rank = _grid(rng, blocks) if regular else _grown(rng, blocks)
    keep = _thinned(rng, nodes, streets, rank)
    roads = []
    for (a, b), main in zip(streets[keep], rank[keep], strict=True):
        line = resample(_bowed(rng, nodes[a], nodes[b], 0.0 if regular else 0.06))
        if main:
            roads.append(Road(line, "secondary", 1, 1, speed=50 / 3.6))
        elif rng.random() < 0.15:
            roads.append(Road(line, "residential", 1, 0, speed=30 / 3.6))
        else:
            roads.append(Road(line, "residential", 1, 1, speed=30 / 3.6))
    return roads


def _grid(rng: np.random.Generator, blocks: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return the nodes, the streets (pairs of node rows), and which are main streets, of a grid with unequal blocks."""
    side = blocks + 1
    xs, ys = (np.cumsum(rng.uniform(0.7, 1.4, side)) * _BLOCK for _ in range(2))
    xs, ys = xs - xs.mean(), ys - ys.mean()
    turn = rng.uniform(0, np.pi / 2)
    grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1).reshape(-1, 2)
    rotation = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    index = np.arange(side * side).reshape(side, side)
    along_x = np.stack([index[:-1], index[1:]], axis=-1)  # (blocks, side, 2), streets along x
    along_y = np.stack([index[:, :-1], index[:, 1:]], axis=-1)  # (side, blocks, 2)
    main_x, main_y = np.zeros(along_x.shape[:2], dtype=bool), np.zeros(along_y.shape[:2], dtype=bool)
    main_x[:, int(rng.integers(0, 3)) :: 4], main_y[int(rng.integers(0, 3)) :: 4] = True, True
    streets = np.concatenate([along_x.reshape(-1, 2), along_y.reshape(-1, 2)])
    return grid @ rotation, streets, np.concatenate([main_x.ravel(), main_y.ravel()])


def _grown(rng: np.random.Generator, blocks: int) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return nodes, streets and main streets from a Voronoi diagram of random centres; short edges are collapsed."""
    side = blocks + 4
    k = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)
    centres = (k - (side - 1) / 2 + rng.uniform(-0.38, 0.38, k.shape)) * _BLOCK
    diagram = Voronoi(centres)
    streets = np.array([pair for pair in diagram.ridge_vertices if -1 not in pair], dtype=np.int64)
    nodes = diagram.vertices
    inside = np.abs(nodes).max(axis=1) < (blocks / 2 + 0.3) * _BLOCK
    streets = streets[inside[streets].all(axis=1)]
    length = np.hypot(*(nodes[streets[:, 0]] - nodes[streets[:, 1]]).T)
    size = len(nodes)
    short = streets[length < 0.25 * _BLOCK]
    joined = sparse.csr_array((np.ones(len(short)), (short[:, 0], short[:, 1])), shape=(size, size))
    _, label = csgraph.connected_components(joined, directed=False)
    centre = np.column_stack([np.bincount(label, nodes[:, i]) for i in (0, 1)]) / np.bincount(label)[:, None]
    streets = np.unique(np.sort(label[streets], axis=1), axis=0).astype(np.int64)
    streets = streets[streets[:, 0] != streets[:, 1]]
    middle = np.abs(centre[streets].mean(axis=1))
    return centre, streets, np.asarray(middle.min(axis=1) < 0.35 * _BLOCK)


def _thinned(
    rng: np.random.Generator,
    nodes: NDArray[np.float64],
    streets: NDArray[np.int64],
    main: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Choose the streets to build: a random spanning tree, the main streets, and five of six others."""
    size = len(nodes)
    weight = sparse.csr_array((rng.uniform(1, 2, len(streets)), (streets[:, 0], streets[:, 1])), shape=(size, size))
    tree = csgraph.minimum_spanning_tree(weight).tocoo()
    in_tree = np.isin(streets[:, 0] * size + streets[:, 1], tree.row.astype(np.int64) * size + tree.col)
    return np.flatnonzero(in_tree | main | (rng.random(len(streets)) < 5 / 6))


def _bowed(rng: np.random.Generator, a: NDArray[np.float64], b: NDArray[np.float64], bow: float) -> NDArray[np.float64]:
    """Return a street from a to b, bent sideways by a random share of its length."""
    t = np.linspace(0.0, 1.0, 21)[:, None]
    normal = np.array([a[1] - b[1], b[0] - a[0]])
    return np.asarray(a + (b - a) * t + normal * rng.normal(0.0, bow) * 4 * t * (1 - t))
