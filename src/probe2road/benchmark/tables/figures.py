"""Figures of ablations: scores over the values of one option, with their intervals."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from probe2road.benchmark.tables.intervals import Interval
from probe2road.draw.picture import BLUE, DPI, FRAME, INK, ORANGE, PURPLE, SOFT, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Point", "draw_points"]

_SIZE = 5.0, 3.2  # inches
_COLORS = {"GEO F1": BLUE, "iTOPO F1": ORANGE}  # all other scores are drawn thin
_LABEL = 14  # characters, from which the label of a value goes on below
_LINES: tuple[Literal["-", "--"], ...] = ("-", "--")  # of the first series and the second
_APART = 0.12  # how far the points of a series stand beside those of the one before it


@dataclass(frozen=True)
class Point:
    """One value of an option, with its scores."""

    label: str
    scores: Mapping[str, Interval]  # by name
    series: str = ""  # line that it belongs to, where there is more than one


def draw_points(
    path: Path, points: Sequence[Point], *, title: str, axis: str = "", default: str = "", joined: bool = True
) -> None:
    """Draw scores over the values of an option, in the given order.

    Parameters
    ----------
    path
        The PNG file.
    points
        At least one, in two series at most. All have the same scores; an interval without width is drawn without a bar.
    title
        Heading.
    axis
        What the values are.
    default
        Label of the value that is marked.
    joined
        Whether lines lead from value to value.

    Examples
    --------
    >>> import tempfile
    >>> points = [Point(label, {"GEO F1": Interval(f1, f1 - 0.1, f1 + 0.1)}) for label, f1 in (("1", 0.8), ("2", 0.7))]
    >>> picture = Path(tempfile.mkdtemp()) / "option.png"
    >>> draw_points(picture, points, title="Option", default="2")
    >>> picture.read_bytes()[1:4]
    b'PNG'
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, dpi=DPI)
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    labels = list(dict.fromkeys(point.label for point in points))
    series = list(dict.fromkeys(point.series for point in points))
    for number, name in enumerate(series):
        of_series = [point for point in points if point.series == name]
        at = [labels.index(point.label) + _APART * number for point in of_series]
        for score in points[0].scores:
            line = _LINES[number] if joined else "none"
            _draw_score(axes, at, [point.scores[score] for point in of_series], score, line, filled=number == 0)
    if default in labels:
        middle = labels.index(default) + _APART * (len(series) - 1) / 2
        axes.axvspan(middle - 0.3, middle + 0.3, color=FRAME, alpha=0.45, linewidth=0, zorder=0)
    ticks = [textwrap.fill(label, _LABEL) + ("\n(default)" if label == default else "") for label in labels]
    axes.set_xticks(range(len(labels)), ticks)
    axes.set_xlim(-0.5, len(labels) - 0.5 + _APART * (len(series) - 1))
    axes.set_xlabel(axis, fontsize=8.5, color=SOFT)
    axes.set_title(title, loc="left", fontsize=11, fontweight="bold", color=INK, pad=22)
    _style(axes, list(points[0].scores), series)
    figure.tight_layout(pad=0.6)
    save_figure(figure, path)


def _draw_score(
    axes: Axes, at: Sequence[float], scores: Sequence[Interval], name: str, line: str, *, filled: bool
) -> None:
    """Draw one score of one series."""
    color, main = _COLORS.get(name, PURPLE), name in _COLORS
    values = [score.value for score in scores]
    ends = [[score.value - score.low for score in scores], [score.high - score.value for score in scores]]
    axes.errorbar(
        at, values, yerr=ends if any(map(any, ends)) else None, color=color, linestyle=line,
        linewidth=1.5 if main else 0.8, elinewidth=0.8, marker="o", markersize=4.5 if main else 3.0,
        markerfacecolor=color if filled else "#ffffff", zorder=3 if main else 2,
    )  # fmt: skip


def _style(axes: Axes, scores: Sequence[str], series: Sequence[str]) -> None:
    """Draw a thin frame, and explain the colours and lines below the title."""
    from matplotlib.lines import Line2D

    axes.grid(axis="y", color=FRAME, linewidth=0.5)
    axes.set_axisbelow(True)
    axes.tick_params(color=FRAME, labelcolor=SOFT, labelsize=8)
    for spine in axes.spines.values():
        spine.set(color=FRAME, linewidth=0.8)
    handles = [Line2D([], [], color=_COLORS.get(name, PURPLE), linewidth=1.5, label=name) for name in scores]
    if len(series) > 1:
        handles += [
            Line2D([], [], color=SOFT, linestyle=line, linewidth=1.2, label=name, marker="o", markersize=3.5,
                   markerfacecolor=SOFT if line == _LINES[0] else "#ffffff")
            for line, name in zip(_LINES, series, strict=False)
        ]  # fmt: skip
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=len(handles), borderaxespad=0.2,
        fontsize=8, frameon=False, labelcolor=INK, handlelength=1.6, columnspacing=1.0,
    )  # fmt: skip
