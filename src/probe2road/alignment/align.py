"""Fleet alignment: drives moved so that they agree with each other and, on average, with GNSS.

See docs/concepts/alignment.md for the method (METHOD 9.2).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.alignment.options import AlignOptions
from probe2road.alignment.parts import cut_at_jumps, without_false_starts
from probe2road.alignment.reckoning import steadying
from probe2road.alignment.report import AlignmentReport, make_report
from probe2road.alignment.screening import screen_drives
from probe2road.alignment.tiling import align_tiles, find_tiles, moved_fleet
from probe2road.errors import InputError, OptionError
from probe2road.fleet.contract import POINT_KINDS, Fleet
from probe2road.run.progress import Progress
from probe2road.run.workspace import open_workspace

__all__ = ["AlignOptions", "Alignment", "add_drives", "align"]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Alignment:
    """An aligned fleet, and a report of what alignment changed."""

    fleet: Fleet
    report: AlignmentReport

    def __repr__(self) -> str:
        return f"Alignment({self.fleet!r}, {self.report!r})"

    def _repr_html_(self) -> str:
        """Show figures in a notebook, without any ids."""
        return f"<b>Alignment</b><br>{self.fleet._repr_html_()}{self.report._repr_html_()}"


@dataclass(frozen=True)
class _Run:
    """The inputs, besides the fleet, that determine the result of a tile."""

    options: AlignOptions
    held: int  # drives that do not move


def align(
    fleet: Fleet,
    *,
    options: AlignOptions | None = None,
    workspace: str | Path | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Alignment:
    """Align the drives of a fleet with each other.

    Drives are connected by the lane markings and road boundaries that they saw, or, without points, weakly by their
    paths; on average, they stay where GNSS has them. No drive is fixed: a single drive keeps its place, and is only
    smoothed.

    Parameters
    ----------
    fleet
        Raw fleet data; ``heading``, ``speed`` and ``accuracy`` are used if present. Not changed.
    options
        None takes the defaults.
    workspace
        Folder that keeps the result of each tile, so that an interrupted run can continue.
    workers
        Number of processes; it changes the result by no more than the tolerance of the solver, millimetres.
    progress
        Called during the work.

    Returns
    -------
    Alignment
        The same rows with moved poses, and points moved rigidly with the pose that they were seen from. Fixes at the
        start of a drive, from before the receiver had a position, are left out. A drive that jumps is cut, and the
        parts of drive 7 are called 7/0, 7/1 and so on. Drives that cannot be aligned are where they were, or left out
        with ``keep_rejected=False``; the report names them.

    Raises
    ------
    InputError
        If the fleet is empty.
    OptionError
        If ``workers`` is not positive.
    MissingExtraError
        If GTSAM is not installed.

    Examples
    --------
    >>> from probe2road.demo import demo_fleet
    >>> fleet = demo_fleet(n_drives=4)
    >>> aligned = align(fleet)
    >>> len(aligned.fleet.traces) == len(fleet.traces), aligned.report.summary["rejected"]
    (True, 0)
    """
    held = np.zeros(fleet.n_traces, bool)
    return _align(fleet, held, options or AlignOptions(), workspace, workers, progress)


def add_drives(
    aligned: Fleet,
    new: Fleet,
    *,
    options: AlignOptions | None = None,
    workspace: str | Path | None = None,
    workers: int = 1,
    progress: Progress | None = None,
) -> Alignment:
    """Align new drives to an aligned fleet that does not move.

    Only tiles that new drives touch are worked on. There, old drives are the map: they hold the lines where they
    are, and the new ones are registered on them and optimised between them. Where no old drive was, new drives are
    aligned with each other, as `align` would.

    Parameters
    ----------
    aligned
        From `align` or an earlier call.
    new
        Raw fleet data, brought to the CRS of the aligned fleet; no trace id may be in both.
    options, workspace, workers, progress
        As in `align`.

    Returns
    -------
    Alignment
        Old and new drives together.

    Raises
    ------
    InputError
        If a trace id is in both fleets.
    """
    new = new if new.crs == aligned.crs else new.to_crs(aligned.crs)
    double = np.intersect1d(aligned.ids.to_numpy(), new.ids.to_numpy())
    if len(double):
        fault = f"{len(double)} trace ids are in both fleets ({', '.join(map(str, double[:3]))})"
        raise InputError(fault, where="add_drives", fix="give new drives ids of their own")
    joined = _joined(aligned, new)
    held = joined.ids.isin(aligned.ids)
    return _align(joined, held, options or AlignOptions(), workspace, workers, progress)


def _align(
    fleet: Fleet,
    held: NDArray[np.bool_],
    options: AlignOptions,
    folder: str | Path | None,
    workers: int,
    progress: Progress | None,
) -> Alignment:
    if fleet.traces.empty:
        raise InputError("the fleet has no traces", where="align", fix="pass at least one drive")
    if workers < 1:
        raise OptionError(f"workers is {workers}", where="align", fix="use 1 or more")
    fleet = without_false_starts(fleet, ~held)
    reasons = np.where(held, "", screen_drives(fleet))
    touched = ((reasons == "") & ~held)[fleet.owner]
    steady = np.zeros((len(touched), 4))
    steady[touched, :2] = steadying(fleet)[touched]
    fleet, drive = cut_at_jumps(moved_fleet(fleet, steady), (reasons == "") & ~held)
    reasons, held = reasons[drive], held[drive]
    usable = reasons == ""
    tiles = find_tiles(fleet, options, touched=touched if held.any() else None)
    with open_workspace(folder, fleet, _Run(options, int(held.sum()))) as work:
        moves = align_tiles(
            fleet, usable, tiles, options, held=held, workspace=work, workers=workers, progress=progress
        )
    report = make_report(fleet, reasons, held, replace(moves, shift=moves.shift + steady))
    # Held drives do not move, not even by what rounding leaves.
    shift = np.where(touched[:, None], moves.shift, 0.0)
    result = moved_fleet(fleet, shift)
    if not options.keep_rejected:
        result = _without(result, report.drives.loc[~usable, "trace_id"])
    figures = report.summary
    logger.info(
        "aligned %d drives by points and %d by path, rejected %d; spread %s m before, %s m after",
        figures["aligned"], figures["by path"], figures["rejected"], figures["spread_before"], figures["spread_after"],
    )  # fmt: skip
    return Alignment(result, report)


def _joined(one: Fleet, other: Fleet) -> Fleet:
    """Join two fleets of one CRS, in the order that the contract requires."""
    traces = pd.concat([one.traces, other.traces], ignore_index=True)
    points = pd.concat([one.points, other.points], ignore_index=True)
    points["kind"] = pd.Categorical(points["kind"], categories=POINT_KINDS)
    traces = traces.sort_values(["trace_id", "t"], kind="stable", ignore_index=True)
    return Fleet(traces, points, one.crs)


def _without(fleet: Fleet, ids: pd.Series) -> Fleet:
    """Return a fleet without some of its drives."""
    return replace(
        fleet,
        traces=fleet.traces[~fleet.traces["trace_id"].isin(ids)].reset_index(drop=True),
        points=fleet.points[~fleet.points["trace_id"].isin(ids)].reset_index(drop=True),
    )
