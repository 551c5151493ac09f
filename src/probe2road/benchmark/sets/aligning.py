"""The aligned fleet of a data set: the result of ``probe2road align`` for its raw fleet, stored beside it."""

from __future__ import annotations

import json
import logging
import shutil
from pathlib import Path

from probe2road.alignment.align import align
from probe2road.benchmark.sets.recording import Recording
from probe2road.errors import InputError
from probe2road.io.atomic import atomic_path
from probe2road.io.fleet_reader import read_fleet_files
from probe2road.io.fleet_writer import points_path, write_fleet
from probe2road.run.progress import Progress

__all__ = ["align_dataset"]

logger = logging.getLogger(__name__)

_SUMMARY = "aligned.json"
_WORKSPACE = ".aligned"


def align_dataset(folder: str | Path, *, workers: int = 1, progress: Progress | None = None) -> Path:
    """Align the raw fleet of a data set with the default options, unless the result exists.

    Parameters
    ----------
    folder
        The data set, from `probe2road.benchmark.sets.prepare.prepare`.
    workers
        Processes; no influence on the result beyond millimetres.
    progress
        Called during the work with the progress of each stage.

    Returns
    -------
    Path
        ``aligned.parquet``, beside it ``aligned.points.parquet`` and, written last, ``aligned.json`` with the figures
        of the report. They are not in the manifest of the data set; delete them to have them made anew. What was
        interrupted goes on.

    Raises
    ------
    InputError
        If the folder is no data set, or its fleet has no points to align by.
    MissingExtraError
        If GTSAM is not installed.
    """
    recording = Recording(Path(folder))
    if (recording.folder / _SUMMARY).exists():
        return recording.aligned
    if not points_path(recording.drives).exists():
        fix = "prepare the data set first; without a camera there is nothing to align by"
        raise InputError("there are no raw traces with points", where=recording.folder, fix=fix)
    logger.info("aligning the raw fleet of %s", recording.folder.name)
    workspace = recording.folder / _WORKSPACE
    fleet = read_fleet_files(recording.drives)
    result = align(fleet, workspace=workspace, workers=workers, progress=progress)
    write_fleet(result.fleet, recording.aligned)
    with atomic_path(recording.folder / _SUMMARY) as temporary:
        temporary.write_text(json.dumps(result.report.summary, indent=1), encoding="utf-8")
    shutil.rmtree(workspace, ignore_errors=True)
    return recording.aligned
