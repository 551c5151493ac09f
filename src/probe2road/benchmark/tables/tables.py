"""The tables of the paper in Markdown: our cells, their intervals, and the paper's numbers beside them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from probe2road.benchmark.tables.cells import FULL, Cell
from probe2road.benchmark.tables.intervals import Interval, difference_interval, f1_interval
from probe2road.benchmark.tables.methods import METHODS
from probe2road.benchmark.tables.published import METHODS_TABLE, SOFT_F1_TABLE, STAGES_TABLE, VISION_TABLE, Triple
from probe2road.metrics.scores import ratio

__all__ = [
    "ablation_table",
    "cost_table",
    "difference_table",
    "markdown_table",
    "methods_table",
    "soft_table",
    "stages_table",
    "vision_table",
]

_GRAPH_METRICS = ("geo", "itopo")
_OURS = "probe2road"
_PAIR_HEADER = ["GEO P", "R", "F1", "iTOPO P", "R", "F1", "paper: GEO F1", "iTOPO F1"]


def methods_table(cells: Sequence[Cell], areas: Iterable[str]) -> str:
    """Return Tables I and II: GEO and iTOPO of every method in some areas."""
    rows = []
    for area in areas:
        for cell in _full(cells, area):
            paper = METHODS_TABLE.get((area, cell.method))
            rows.append([area, METHODS[cell.method].label, *_pair(cell), *_paper_pair(paper)])
    return markdown_table(["area", "method", *_PAIR_HEADER], rows)


def soft_table(cells: Sequence[Cell]) -> str:
    """Return Table III: soft F1 of the masks of our own methods."""
    rows = []
    for cell in cells:
        if cell.stage != FULL or "soft_f1" not in cell.tiles:
            continue
        paper = SOFT_F1_TABLE.get(cell.area) if cell.method == _OURS else None
        triples = [*_triple(cell, "soft_f1"), *_triple(cell, "soft_f1_thinned")]
        rows.append([cell.area, METHODS[cell.method].label, *triples, "" if paper is None else f"{paper.f1:.3f}"])
    header = ["area", "method", "mask P", "R", "soft F1", "skeleton P", "R", "soft F1", "paper"]
    return markdown_table(header, rows)


def vision_table(cells: Sequence[Cell], area: str) -> str:
    """Return Table IV: the same network with and without the points of the camera."""
    chosen = {cell.method: cell for cell in _full(cells, area)}
    rows = [
        [area, METHODS[name].label, *_pair(chosen[name]), *_paper_pair(paper if area == "boston" else None)]
        for name, paper in VISION_TABLE.items()
        if name in chosen
    ]
    return markdown_table(["area", "method", *_PAIR_HEADER], rows)


def stages_table(cells: Sequence[Cell], areas: Iterable[str]) -> str:
    """Return Table V: the scores after each step of the post-processing."""
    rows = []
    for area in areas:
        for cell in (cell for cell in cells if cell.area == area and cell.method == _OURS):
            paper = STAGES_TABLE.get(cell.stage) if area == "boston" else None
            rows.append([area, cell.stage, *_pair(cell, digits=4), *_paper_pair(paper, digits=4)])
    return markdown_table(["area", "stage", *_PAIR_HEADER], rows)


def difference_table(cells: Sequence[Cell], areas: Iterable[str]) -> str:
    """Return the advantage of Probe2Road over each other method, with the same drawn tiles for both."""
    rows = []
    for area in areas:
        chosen = {cell.method: cell for cell in _full(cells, area)}
        if _OURS not in chosen:
            continue
        for name in (name for name in chosen if name != _OURS):
            pairs = [(chosen[_OURS].tiles[metric], chosen[name].tiles[metric]) for metric in _GRAPH_METRICS]
            ahead = [_with_interval(difference_interval(*pair), sign="+") for pair in pairs]
            rows.append([area, METHODS[name].label, *ahead])
    return markdown_table(["area", "Probe2Road ahead of", "GEO F1", "iTOPO F1"], rows)


def cost_table(cells: Sequence[Cell]) -> str:
    """Return the table of other metrics, size, and the costs of a build."""
    names = ("topo_f1", "apls_f1", "junctions_f1")
    rows = []
    for cell in (cell for cell in cells if cell.stage == FULL):
        figures = cell.figures
        rows.append(
            [
                cell.area, METHODS[cell.method].label, *(f"{figures[name]:.3f}" for name in names),
                *("" if figures[name] is None else f"{figures[name]:.2f}" for name in ("median_m", "p95_m")),
                f"{figures['nodes']:.0f}",
                f"{figures['km']:.1f}", f"{figures['seconds']:.0f}{'+' if figures['resumed'] else ''}",
                f"{figures['megabytes']:.0f}",
            ]
        )  # fmt: skip
    header = ["area", "method", "TOPO F1", "APLS", "junctions F1", "lateral, m", "95 %, m", "nodes", "km", "s", "MB"]
    return markdown_table(header, rows)


def ablation_table(axis: str, rows: Sequence[tuple[str, Cell, Cell]]) -> str:
    """Return the table of the scores for the values of an option.

    Parameters
    ----------
    axis
        What the values are.
    rows
        Value, its cell, and the cell of the default, which it is compared with on the same tiles.
    """
    lines = []
    for value, cell, default in rows:
        pairs = [(cell.tiles[metric], default.tiles[metric]) for metric in _GRAPH_METRICS]
        scores = [_with_interval(f1_interval(tiles)) for tiles, _ in pairs]
        ahead = ["" if cell is default else _with_interval(difference_interval(*pair), sign="+") for pair in pairs]
        figures = f"{cell.figures['junctions_f1']:.3f}", f"{cell.figures['nodes']:.0f}", f"{cell.figures['km']:.1f}"
        lines.append([value, scores[0], ahead[0], scores[1], ahead[1], *figures])
    header = [axis, "GEO F1", "above default", "iTOPO F1", "above default", "junctions F1", "nodes", "km"]
    return markdown_table(header, lines)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _full(cells: Sequence[Cell], area: str) -> list[Cell]:
    """Return the cells of finished graphs in an area."""
    return [cell for cell in cells if cell.area == area and cell.stage == FULL]


def _pair(cell: Cell, *, digits: int = 3) -> list[str]:
    """Return GEO and iTOPO of a cell as text."""
    return [text for metric in _GRAPH_METRICS for text in _triple(cell, metric, digits=digits)]


def _triple(cell: Cell, metric: str, *, digits: int = 3) -> list[str]:
    """Return precision, recall, and F1 with its interval, as text."""
    sums = cell.tiles[metric].sum()
    precision = ratio(sums["matched_proposal"], sums["proposal"])
    recall = ratio(sums["matched_reference"], sums["reference"])
    interval = f1_interval(cell.tiles[metric])
    return [f"{precision:.{digits}f}", f"{recall:.{digits}f}", _with_interval(interval, digits=digits)]


def _with_interval(interval: Interval, *, sign: str = "", digits: int = 3) -> str:
    return f"{interval.value:{sign}.{digits}f} ({interval.low:{sign}.3f} to {interval.high:{sign}.3f})"


def _paper_pair(paper: tuple[Triple, Triple] | None, *, digits: int = 3) -> list[str]:
    """Return F1 of GEO and iTOPO from the paper as text."""
    return ["", ""] if paper is None else [f"{triple.f1:.{digits}f}" for triple in paper]
