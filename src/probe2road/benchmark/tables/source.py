"""The fleet data of a comparison: a prepared data set, with given poses and number of drives."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import shapely
from numpy.typing import NDArray

from probe2road.benchmark.sets.aligning import align_dataset
from probe2road.benchmark.sets.datasets import find_dataset
from probe2road.benchmark.sets.prepare import check_dataset, read_tiles
from probe2road.benchmark.sets.recording import POSES, Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.benchmark.sets.tiles import SPLITS, split_area
from probe2road.bounds import NotNegative, OneOf, Positive
from probe2road.errors import InputError
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.fleet_reader import read_fleet_files
from probe2road.io.fleet_writer import write_fleet
from probe2road.io.graph_files import read_graph
from probe2road.options import checked

__all__ = ["Source", "choose_drives", "make_fleet"]

logger = logging.getLogger(__name__)

_SEED = 64


@dataclass(frozen=True)
@checked
class Source:
    """A prepared data set, which of its fleets and roads to use, and the folder for results."""

    folder: Path
    work: Path
    poses: Annotated[str, OneOf(*POSES)] = "aligned"  # one of POSES
    drives: Positive[int] | None = None  # of each road at most, roughly; all where None
    min_drives: NotNegative[int] = 4  # of the whole fleet, that a road of the reference has

    @property
    def name(self) -> str:
        """Return the name of the data set."""
        return self.folder.name

    @property
    def place(self) -> Path:
        """Return the folder for all results from this fleet."""
        return self.work / (f"{self.name}-{self.poses}" + ("" if self.drives is None else f"-{self.drives}"))

    @cached_property
    def digest(self) -> str:
        """Return a digest of the whole data set, from its manifest with the checksums of all files."""
        check_dataset(self.folder)
        return hashlib.sha256((self.folder / "manifest.json").read_bytes()).hexdigest()[:16]

    @property
    def aligned_digest(self) -> str | None:
        """Return a digest of the aligned fleet, which is not in the manifest; None for other poses."""
        if self.poses != "aligned":
            return None
        with Recording(self.folder).aligned.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:16]

    @cached_property
    def driven(self) -> RoadGraph:
        """Return the true road graph with the true numbers of drives."""
        return read_graph(Recording(self.folder).reference)

    @cached_property
    def reference(self) -> RoadGraph:
        """Return the roads that enough drives of the whole fleet passed."""
        return labelled_reference(self.driven, min_drives=self.min_drives)

    @cached_property
    def areas(self) -> dict[str, shapely.Geometry | None]:
        """Return the name and extent of each area to score: the splits, or the whole."""
        if not find_dataset(self.name).splits:
            return {self.name: None}
        tiles = read_tiles(self.folder)
        return {f"{self.name}, {split}": split_area(tiles, split) for split in SPLITS}

    @property
    def fleet_file(self) -> Path:
        """Return the file with the traces of the fleet; `make_fleet` makes it if the data set lacks it."""
        if self.drives is None:
            return Recording(self.folder).traces(self.poses)
        return self.place / "fleet.parquet"


def make_fleet(source: Source) -> None:
    """Align the raw fleet, or choose drives from a fleet, if the files are missing.

    Raises
    ------
    InputError
        If the data set has no such fleet.
    MissingExtraError
        If an alignment is needed and GTSAM is not installed.
    """
    path = source.fleet_file
    if path.exists():
        return
    if source.drives is not None:
        whole = replace(source, drives=None)
        make_fleet(whole)
        routes = pq.read_table(Recording(source.folder).routes).to_pandas()
        chosen = choose_drives(routes, source.drives, rng=np.random.default_rng(_SEED))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_fleet(_of_drives(read_fleet_files(whole.fleet_file), chosen), path)
    elif source.poses == "aligned":
        align_dataset(source.folder)
    else:
        raise InputError("the data set has no such fleet", where=path, fix="prepare it again, or choose other poses")


def choose_drives(routes: pd.DataFrame, most: int, *, rng: np.random.Generator) -> NDArray[np.int64]:
    """Choose drives so that each road has about the given number of them, if the fleet has enough.

    Drives are taken in random order, each one that passes a road which has not got enough yet. A road on the way of
    many others ends up with more.

    Parameters
    ----------
    routes
        Columns ``trace_id`` and ``section``.
    most
        Drives of a road.
    rng
        Draws the order.

    Returns
    -------
    ndarray of int64
        Their ids, sorted.

    Examples
    --------
    >>> routes = pd.DataFrame({"trace_id": [0, 0, 1, 2, 2], "section": [5, 6, 5, 5, 6]})
    >>> len(choose_drives(routes, 1, rng=np.random.default_rng(0))) < 3
    True
    """
    sections, place = np.unique(routes["section"].to_numpy(), return_inverse=True)
    passed = {drive: np.unique(place[rows]) for drive, rows in routes.groupby("trace_id").indices.items()}
    drives = np.array(sorted(passed), np.int64)
    count = np.zeros(len(sections), np.int64)
    chosen = []
    for drive in rng.permutation(drives):
        if (count[passed[drive]] < most).any():
            count[passed[drive]] += 1
            chosen.append(drive)
    return np.sort(np.array(chosen, np.int64))


def _of_drives(fleet: Fleet, drives: NDArray[np.int64]) -> Fleet:
    """Return a fleet with only the given drives."""
    kept = [table[table["trace_id"].isin(drives)].reset_index(drop=True) for table in (fleet.traces, fleet.points)]
    return Fleet(kept[0], kept[1], fleet.crs)
