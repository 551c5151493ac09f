"""The stages of long work, and the names of their files.

A stage is a step whose result is kept, in a file of the workspace. Its number says where in the pipeline it stands; the
baselines share the numbers, so that equal things have equal names.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = [
    "ALIGNED_TILE",
    "CLEANED",
    "COLLAPSED",
    "DENSITY",
    "GAPS_FILLED",
    "LINKED",
    "MASK",
    "PROBABILITY",
    "PRUNED",
    "ROADS",
    "SKELETON",
    "STAGES",
    "VECTORIZED",
    "WINDOW",
    "Stage",
    "stage_of",
]

RASTER, GRAPH, RECORD, ARRAYS = ".tif", ".gpkg", ".json", ".npz"


@dataclass(frozen=True)
class Stage:
    """A stage of long work, and the kind of file that stores its result.

    Attributes
    ----------
    name
        Of the file, without suffix.
    suffix
        Of the file: a raster, a graph, a record or arrays.
    segmentation
        Whether it depends on nothing but the fleet, the weights and the options that decide the probability. Such a
        stage stays where only later options changed.
    in_parts
        Whether there is a file for each part of the area.
    """

    name: str
    suffix: str
    segmentation: bool = False
    in_parts: bool = False

    def file(self, part: str = "") -> str:
        """Return the name of the file of the stage, or of one part of it if it has parts.

        Examples
        --------
        >>> CLEANED.file(), WINDOW.file("0-512")
        ('5-cleaned.gpkg', '1-window-0-512.npz')
        """
        return f"{self.name}-{part}{self.suffix}" if self.in_parts else f"{self.name}{self.suffix}"


DENSITY = Stage("1-density", RECORD, segmentation=True)  # what the density segmenter estimated
WINDOW = Stage("1-window", ARRAYS, segmentation=True, in_parts=True)  # probability of one window
PROBABILITY = Stage("1-probability", RASTER, segmentation=True)
MASK = Stage("2-mask", RASTER)
SKELETON = Stage("3-skeleton", RASTER)
VECTORIZED = Stage("4-vectorized", GRAPH)
CLEANED = Stage("5-cleaned", GRAPH)
PRUNED = Stage("5-pruned", GRAPH)  # Biagioni's map, without what no trip drove
GAPS_FILLED = Stage("6-gaps-filled", GRAPH)
LINKED = Stage("6-linked", GRAPH)  # DeepMG's map, with the links that it proposes
COLLAPSED = Stage("6-collapsed", GRAPH)  # Biagioni's map, with parallel segments joined
ROADS = Stage("7-roads", GRAPH)
ALIGNED_TILE = Stage("tile", ARRAYS, in_parts=True)  # moves and residuals of one tile of an alignment

STAGES = (
    *(DENSITY, WINDOW, PROBABILITY, MASK, SKELETON, VECTORIZED, CLEANED, PRUNED),
    *(GAPS_FILLED, LINKED, COLLAPSED, ROADS, ALIGNED_TILE),
)


def stage_of(file: str) -> Stage | None:
    """Return the stage that writes files of a name, or None for no stage.

    Examples
    --------
    >>> stage_of("1-window-0-512.npz") is WINDOW, stage_of("reference.gpkg")
    (True, None)
    """
    for stage in STAGES:
        start, end = (f"{stage.name}-", stage.suffix) if stage.in_parts else (stage.file(), "")
        if file == stage.file() or (stage.in_parts and file.startswith(start) and file.endswith(end)):
            return stage
    return None
