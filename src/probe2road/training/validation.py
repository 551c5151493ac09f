"""The choice of the checkpoint: soft F1 of masks and GEO F1 of the graphs made from them, on fixed squares."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import shapely
from numpy.typing import NDArray

from probe2road.errors import InputError
from probe2road.graph.clean import clean_graph
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.apart import apart
from probe2road.metrics.geo import geo
from probe2road.metrics.itopo import itopo
from probe2road.metrics.normalise import clip_graph
from probe2road.metrics.scores import Score
from probe2road.metrics.soft_f1 import soft_f1
from probe2road.raster.grid import Grid
from probe2road.segmentation.mask import threshold_mask
from probe2road.training.config import ValidationOptions
from probe2road.training.samples import SampleOptions, square
from probe2road.training.scene import Scene
from probe2road.training.sources import driven_reference, open_scene
from probe2road.vectorize.lines import vectorize
from probe2road.vectorize.skeleton import skeletonize

__all__ = ["Square", "validate", "validation_squares"]


@dataclass(frozen=True)
class Square:
    """A square for validation."""

    counts: NDArray[np.uint32]  # (3, size, size)
    label: NDArray[np.uint8]  # (size, size)
    reference: RoadGraph  # driven edges, clipped to the square
    grid: Grid


def validation_squares(options: ValidationOptions, sample: SampleOptions, sets: str | Path) -> list[Square]:
    """Choose squares of each source for validation, evenly from those with the most road to those with the least.

    Parameters
    ----------
    options
        Which, and how many.
    sample
        What a label is.
    sets
        Folder of the data sets.

    Raises
    ------
    InputError
        If a data set is missing.
    OptionError
        If a source is no data set.
    """
    squares = []
    drawn = replace(sample, size=options.size)
    for source in options.sources:
        scene = open_scene(source, sets)
        reference, _ = driven_reference(source, sets, min_drives=sample.min_drives)
        for centre in _places(scene, options):
            x, y = (np.floor(scene.origin + centre)).tolist()
            half = options.size / 2
            grid = Grid(x - half, y + half, 1.0, options.size, options.size, reference.crs)
            found = square(scene, (x - scene.origin[0], y - scene.origin[1]), drawn)
            squares.append(Square(found.counts, found.label, clip_graph(reference, shapely.box(*grid.bounds)), grid))
    return squares


def validate(
    squares: Sequence[Square], probabilities: Sequence[NDArray[np.float32]], *, threshold: float = 0.5
) -> dict[str, float]:
    """Score predictions on the squares, with the counts of all squares pooled.

    Parameters
    ----------
    squares
        From `validation_squares`.
    probabilities
        Of each square, shape ``(size, size)``.
    threshold
        From which a pixel is road.

    Returns
    -------
    dict
        ``soft_f1``, ``geo_f1``, ``geo_precision``, ``geo_recall``, ``itopo_f1``, ``apart`` (the recall of
        `probe2road.metrics.apart.apart`), and ``score``, the mean of soft F1 and
        GEO F1, which chooses the checkpoint: a loss cannot (METHOD 2.4).

    Raises
    ------
    InputError
        If there are no squares.
    """
    if not squares:
        raise InputError("there are no squares to validate on", where="validation", fix="name a source with roads")
    masks = [threshold_mask(probability, threshold=threshold) for probability in probabilities]
    soft = soft_f1(masks, [part.label for part in squares])
    with _quiet():
        graphs = [
            clean_graph(vectorize(skeletonize(mask), part.grid)) for mask, part in zip(masks, squares, strict=True)
        ]
    place, ways, close = (
        _pooled([metric(graph, part.reference) for graph, part in zip(graphs, squares, strict=True)])
        for metric in (geo, itopo, apart)
    )
    return {
        "score": (soft.f1 + place.f1) / 2, "soft_f1": soft.f1,
        "geo_f1": place.f1, "geo_precision": place.precision, "geo_recall": place.recall, "itopo_f1": ways.f1,
        "apart": close.recall,
    }  # fmt: skip


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the log messages of building the validation graphs out of the log of a training."""
    logger = logging.getLogger("probe2road")
    level = logger.level
    logger.setLevel(max(level, logging.WARNING))
    try:
        yield
    finally:
        logger.setLevel(level)


def _places(scene: Scene, options: ValidationOptions) -> NDArray[np.float64]:
    """Centres of squares of a regular table that hold road: shape ``(n, 2)``, m from the scene's origin."""
    table = pd.DataFrame(np.floor(scene.spots / options.size).astype(np.int64), columns=["col", "row"])
    road = table.value_counts(sort=True)
    road = road[road >= min(30, road.max())]  # 300 m
    chosen = np.unique(np.linspace(0, len(road) - 1, options.squares).round().astype(np.int64))
    places = np.array(sorted(road.index.to_list(), key=lambda place: (-road[place], place)))[chosen]
    return (places + 0.5) * options.size


def _pooled(scores: Sequence[Score]) -> Score:
    """Add up the counts of several scores of one metric."""
    names = ("matched_proposal", "proposal", "matched_reference", "reference")
    counts = {name: sum(getattr(score, name) for score in scores) for name in names}
    return Score.from_counts(scores[0].metric, **counts, parameters=scores[0].parameters)
