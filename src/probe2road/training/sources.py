"""The sources of scenes: data sets of the benchmark, or the user's fleet data and reference."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import shapely

from probe2road.benchmark.sets.datasets import find_datasets
from probe2road.benchmark.sets.prepare import read_tiles
from probe2road.benchmark.sets.recording import POSES, Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.benchmark.sets.tiles import split_area
from probe2road.bounds import NotNegative, OneOf
from probe2road.errors import InputError, MissingFileError, OptionError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.fleet_reader import read_fleet, read_fleet_files
from probe2road.io.graph_files import read_graph
from probe2road.matching.labels import LabelOptions, label_pieces
from probe2road.options import checked
from probe2road.training.scene import Scene, load_scene, make_scene, save_scene

__all__ = ["TrainingSource", "driven_reference", "members", "open_scene"]

logger = logging.getLogger(__name__)

_SCENES = "scenes"  # folder of the laid-out scenes, beside the data sets


@dataclass(frozen=True)
@checked
class TrainingSource:
    """Fleet data and the roads on which it was recorded: either a data set of the benchmark, or files."""

    name: str = "columbus"  # of a data set or a group of the benchmark, or what to call your own
    split: str = ""  # of the data set; all of it where empty
    data: Annotated[str, OneOf(*POSES)] = "modelled"  # of a data set: one of POSES
    fleet: str = ""  # fleet data of your own, read by `probe2road.read_fleet`
    points: str = ""  # its semantic points, where they are another file
    reference: str = ""  # centrelines of your own, a graph file
    weight: NotNegative[float] = 1.0  # how often it is drawn, against the other sources

    def __post_init__(self) -> None:
        """Refuse a source that names neither a data set nor files, or both."""
        if self.name == "" or bool(self.fleet) != bool(self.reference):
            fix = "give the name of a data set, or a name, a fleet and a reference"
            raise OptionError("names nothing to learn from", where="source", fix=fix)


def members(sources: Sequence[TrainingSource]) -> list[TrainingSource]:
    """Replace groups of data sets by their members, which share the weight of the group.

    Raises
    ------
    OptionError
        If there is no data set of a name.

    Examples
    --------
    >>> sources = [TrainingSource("town-1"), TrainingSource("corridors", data="raw")]
    >>> [(source.name, source.weight) for source in members(sources)][:2]
    [('town-1', 1.0), ('corridor-1', 0.25)]
    """
    single = []
    for source in sources:
        names = [source.name] if source.fleet else [data.name for data in find_datasets([source.name])]
        single += [replace(source, name=name, weight=source.weight / len(names)) for name in names]
    return single


def open_scene(source: TrainingSource, sets: str | Path) -> Scene:
    """Return the scene of a source, which is made beside the data sets at the first call.

    Parameters
    ----------
    source
        Where from.
    sets
        Folder of the prepared data sets; scenes are kept in ``scenes`` in it.

    Returns
    -------
    Scene
        Mapped into memory.

    Raises
    ------
    InputError
        If the data set is not there, or a file cannot be read.
    """
    label = "-".join(part for part in (source.name, source.split, source.data) if part)
    folder = Path(sets) / _SCENES / label
    about = {**asdict(replace(source, weight=1.0)), "changed": [_changed(path) for path in _files(source, sets)]}
    if (scene := load_scene(folder, about=about)) is None:
        logger.info("laying out scene %s", label)
        save_scene(_make(source, Path(sets)), folder, about=about)
        scene = load_scene(folder, about=about)
        assert scene is not None
    return scene


def driven_reference(
    source: TrainingSource, sets: str | Path, *, min_drives: int
) -> tuple[RoadGraph, shapely.Geometry | None]:
    """Return the edges of a data set that enough drives drove on, and the area of its split (None for all of it).

    Raises
    ------
    OptionError
        If the source is no data set.
    """
    if source.fleet:
        fix = "validate on a data set of the benchmark"
        raise OptionError(f"source {source.name} is no data set", where="validation", fix=fix)
    recording = _recording(source, sets)
    area = split_area(read_tiles(recording.folder), source.split) if source.split else None
    return labelled_reference(read_graph(recording.reference), min_drives=min_drives), area


def _make(source: TrainingSource, sets: Path) -> Scene:
    """Make the scene of a source."""
    if source.fleet:
        fleet = read_fleet(source.fleet, source.points or None)
        pieces, driven = label_pieces(read_graph(source.reference).to_crs(fleet.crs), fleet, LabelOptions())
        return make_scene(fleet, pieces, driven)
    recording = _recording(source, sets)
    fleet = read_fleet_files(recording.traces(source.data))
    driven = pd.read_parquet(recording.routes).rename(columns={"section": "edge"})
    area = split_area(read_tiles(recording.folder), source.split) if source.split else None
    return make_scene(fleet, read_graph(recording.reference), driven, area=area)


def _recording(source: TrainingSource, sets: str | Path) -> Recording:
    """Return the recording of an existing data set."""
    recording = Recording(Path(sets) / source.name)
    if not recording.reference.exists():
        fix = f"run probe2road benchmark prepare {source.name} --output {sets}"
        raise MissingFileError("there is no such data set", where=recording.folder, fix=fix)
    return recording


def _files(source: TrainingSource, sets: str | Path) -> list[Path]:
    """List the files that determine whether a scene is up to date."""
    if source.fleet:
        return [Path(path) for path in (source.fleet, source.points, source.reference) if path]
    recording = _recording(source, sets)
    if source.data == "aligned" and not recording.aligned.exists():
        fix = f"run probe2road benchmark align {sets} --name {source.name}"
        raise InputError("the data set is not aligned", where=recording.folder, fix=fix)
    return [recording.aligned if source.data == "aligned" else recording.folder / "manifest.json"]


def _changed(path: Path) -> int:
    """Return the time at which a file was changed, ns."""
    if not path.exists():
        raise MissingFileError("is missing", where=path)
    return int(np.int64(path.stat().st_mtime_ns))
