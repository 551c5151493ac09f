"""The report of an alignment: which drives were aligned, how far they moved, and how well they agree."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.alignment.tiling import Moves
from probe2road.errors import InputError
from probe2road.fleet.contract import Fleet
from probe2road.io.atomic import atomic_path
from probe2road.notebook import figures_table

__all__ = ["STATUSES", "AlignmentReport", "draw_alignment", "make_report", "write_report"]

logger = logging.getLogger(__name__)

STATUSES = ("aligned", "by path", "held", "rejected")

_EDGES = np.round(np.arange(-5.0, 5.01, 0.1), 2)  # m, of the histograms of residuals
_MAD_TO_SIGMA = 1.4826
_WINDOW = 250.0  # m, side of the area that is drawn where none is given
_MOST_DRAWN = 60_000  # points in a panel


@dataclass(frozen=True, eq=False)
class AlignmentReport:
    """The outcome of an alignment, in figures.

    Attributes
    ----------
    drives
        One row a drive: ``trace_id``; ``status``, one of `STATUSES` (``by path``: no point of it lies on a line that
        others saw, so only its path and GNSS placed it; ``held``: aligned before); ``reason`` of a rejection, else
        empty; ``points``, those on common lines; ``shift``, median distance by which it was moved, m.
    spread_before, spread_after
        Robust standard deviation (1.4826 times the median absolute value) of marking and boundary points about the
        common lines across the road, m, both for the points that lie on these lines after alignment; NaN without any.
    histogram
        ``offset`` (m, lower edge), ``before``, ``after``: points by distance to their line.
    tiles
        Number of tiles.
    """

    drives: pd.DataFrame
    spread_before: float
    spread_after: float
    histogram: pd.DataFrame
    tiles: int

    @property
    def summary(self) -> dict[str, Any]:
        """Return the figures that fit on one line, for logs and JSON."""
        status = self.drives["status"].value_counts()
        rejected = self.drives.loc[self.drives["status"] == "rejected", "reason"].value_counts()
        return {
            "drives": len(self.drives),
            **{name: int(status.get(name, 0)) for name in STATUSES},
            "reasons": {str(reason): int(count) for reason, count in rejected.items()},
            "points_on_lines": int(self.drives["points"].sum()),
            "spread_before": _rounded(self.spread_before),
            "spread_after": _rounded(self.spread_after),
            "tiles": self.tiles,
        }

    def __repr__(self) -> str:
        figures = self.summary
        drives = ", ".join(f"{figures[name]} {name}" for name in STATUSES if figures[name])
        apart = f"{figures['spread_before']} to {figures['spread_after']} m"
        return f"AlignmentReport({figures['drives']} drives: {drives}; lines {apart})"

    def _repr_html_(self) -> str:
        """Show figures in a notebook, without any ids."""
        return figures_table("AlignmentReport", self.summary)


def make_report(fleet: Fleet, reasons: NDArray[np.str_], held: NDArray[np.bool_], moves: Moves) -> AlignmentReport:
    """Compute the report of an alignment.

    Parameters
    ----------
    fleet
        The fleet before.
    reasons
        Why each drive was rejected, empty where it was not, shape ``(n_traces,)``.
    held
        Drives that were aligned before, shape ``(n_traces,)``.
    moves
        What alignment did.
    """
    points = np.bincount(fleet.owner, weights=moves.sights, minlength=fleet.n_traces).astype(np.int64)
    moved = pd.Series(np.hypot(moves.shift[:, 0], moves.shift[:, 1])).groupby(fleet.owner).median()
    status = np.select([reasons != "", held, points > 0], ["rejected", "held", "aligned"], "by path")
    drives = pd.DataFrame(
        {
            "trace_id": fleet.ids,
            "status": status,
            "reason": reasons,
            "points": points,
            "shift": moved.to_numpy(),
        }
    )
    before, after = moves.residuals[:, 1], moves.residuals[:, 2]
    counts = {name: np.histogram(part, _EDGES)[0] for name, part in (("before", before), ("after", after))}
    histogram = pd.DataFrame({"offset": _EDGES[:-1], **counts})
    return AlignmentReport(drives, _spread(before), _spread(after), histogram, moves.tiles)


def write_report(report: AlignmentReport, folder: str | PathLike[str]) -> None:
    """Write ``report.json``, ``drives.csv`` and ``residuals.csv`` into a folder, which is created if it is missing."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with atomic_path(folder / "drives.csv") as temporary:
        report.drives.to_csv(temporary, index=False, float_format="%.3f")
    with atomic_path(folder / "residuals.csv") as temporary:
        report.histogram.to_csv(temporary, index=False)
    with atomic_path(folder / "report.json") as temporary:
        temporary.write_text(json.dumps(report.summary, indent=1), encoding="utf-8")
    logger.info("wrote the report to %s", folder)


def draw_alignment(
    before: Fleet,
    after: Fleet,
    path: str | PathLike[str],
    *,
    bounds: tuple[float, float, float, float] | None = None,
) -> None:
    """Draw the points of a place before and after alignment, side by side, as PNG.

    Parameters
    ----------
    before, after
        The same fleet; where it has no points its traces are drawn.
    path
        The file.
    bounds
        ``(left, bottom, right, top)`` in metres; the busiest square of 250 m if it is None.

    Raises
    ------
    InputError
        If the fleet is empty.
    """
    from matplotlib.figure import Figure

    if before.traces.empty:
        raise InputError("there is nothing to draw", where=path, fix="pass a fleet with traces")
    left, bottom, right, top = bounds or _busiest(after)
    figure = Figure(figsize=(11.0, 5.8), dpi=150, layout="constrained")
    for axis, fleet, title in zip(figure.subplots(1, 2), (before, after), ("before", "after"), strict=True):
        table = fleet.points if len(fleet.points) else fleet.traces
        inside = table["x"].between(left, right) & table["y"].between(bottom, top)
        shown = table[inside]
        shown = shown.iloc[:: max(len(shown) // _MOST_DRAWN, 1)]
        boundary = (shown["kind"] == "road_boundary").to_numpy() if "kind" in shown else np.zeros(len(shown), bool)
        for part, color in ((~boundary, "#12304f"), (boundary, "#d9480f")):
            axis.scatter(shown["x"][part], shown["y"][part], s=0.5, c=color, linewidths=0)
        axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[], title=title)
    with atomic_path(path) as temporary:
        figure.savefig(temporary, format="png", metadata={"Software": None})
    logger.info("wrote %s", path)


def _busiest(fleet: Fleet) -> tuple[float, float, float, float]:
    """Return the square of the plane with the most different headings: an interchange, if there is one."""
    traces = fleet.traces
    column, row = ((traces[axis].to_numpy() // _WINDOW).astype(np.int64) for axis in "xy")
    heading = traces["heading"].to_numpy() if "heading" in traces else np.zeros(len(traces))
    cells = pd.DataFrame({"column": column, "row": row, "heading": np.nan_to_num(heading) // 30.0})
    best = cells.groupby(["column", "row"])["heading"].agg(["nunique", "size"]).sort_values(["nunique", "size"])
    left, bottom = (index * _WINDOW for index in best.index[-1])
    return left, bottom, left + _WINDOW, bottom + _WINDOW


def _spread(residuals: NDArray[np.float64]) -> float:
    return _MAD_TO_SIGMA * float(np.median(np.abs(residuals))) if len(residuals) else float("nan")


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
