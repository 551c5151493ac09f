"""The ablations beyond the paper: each one changes one thing in the default method or in its data."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any

from probe2road.benchmark.sets.recording import POSES
from probe2road.benchmark.tables.methods import METHODS, Method
from probe2road.benchmark.tables.source import Source
from probe2road.errors import OptionError
from probe2road.options import options_from_table
from probe2road.recipe import BuildOptions
from probe2road.segmentation.network import shipped_weights
from probe2road.segmentation.weights import read_weights

__all__ = ["ABLATIONS", "BASE", "Ablation", "AblationValue", "find_ablations", "vary"]

BASE = METHODS["probe2road"]  # what is varied

_THRESHOLDS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)
_LENGTHS = (0, 5, 10, 15, 20, 30)  # m
_COUNTS = (1, 2, 4, 8, 16)
_WEIGHTS = (0.01, 0.03, 0.1, 0.3, 1.0)
_DRIVES = (1, 2, 4, 8, 16, 32, 64)

# No proof is enough: heights count only if they differ by more than anything does.
_NO_HEIGHTS = {"min_height": 0.0, "confidence": 1e9}
_NO_SPLIT = {"min_count": 10**9, "max_inner": 0.0, **_NO_HEIGHTS}

_FOLDER = str.maketrans({" ": "-", ",": None})  # from labels to names of folders

Table = Mapping[str, Any]  # options, as TOML has them


@dataclass(frozen=True)
class AblationValue:
    """One value of an ablation."""

    label: str  # on the axis
    source: Source
    method: Method
    series: str = ""  # line that it belongs to, where an ablation has more than one

    @property
    def like(self) -> Method | None:
        """Return the method with the same segmentation, if there is another one."""
        return None if self.method.name in METHODS else BASE


@dataclass(frozen=True)
class Ablation:
    """One property of the method or the data, with the values to try."""

    name: str
    title: str
    axis: str  # what the values are, with unit
    variants: Sequence[AblationValue]
    default: str  # label
    joined: bool = True  # whether the values are numbers, between which lines mean something


def find_ablations(names: Sequence[str], source: Source) -> list[Ablation]:
    """Return ablations by name, in the order of the names; all if no name is given.

    Parameters
    ----------
    names
        Out of `ABLATIONS`.
    source
        Fleet that they work on. Where drives or poses are varied, it is the default.

    Raises
    ------
    OptionError
        If there is no ablation of a name.

    Examples
    --------
    >>> from pathlib import Path
    >>> (found,) = find_ablations(["collapse"], Source(Path("sets/milan"), Path("work")))
    >>> [variant.label for variant in found.variants], found.default
    (['0', '5', '10', '15', '20', '30'], '15')
    >>> find_ablations(["colour"], Source(Path("sets/milan"), Path("work")))
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: benchmark: there is no ablation 'colour'; use threshold, collapse, ...
    """
    if unknown := [name for name in names if name not in ABLATIONS]:
        fix = f"use {', '.join(ABLATIONS)}"
        raise OptionError(f"there is no ablation {unknown[0]!r}", where="benchmark", fix=fix)
    return [ABLATIONS[name](source) for name in names or ABLATIONS]


def vary(name: str, table: Table) -> Method:
    """Return the default method with other options; without any, the default method itself.

    Parameters
    ----------
    name
        Of the method, and of its folder below that of all ablations.
    table
        What is set, as `probe2road.options.options_from_table` takes it.

    Examples
    --------
    >>> vary("collapse-5", {"clean": {"short_edge": 5}}).options.clean.short_edge
    5.0
    >>> vary("collapse-15", {"clean": {"short_edge": 15}}) is BASE
    True
    """
    options = options_from_table(dict(table), BuildOptions, where=name)
    if options == BASE.options:
        return BASE
    return _graph_only(replace(BASE, name=f"ablations/{name}", label=f"{BASE.label}, {name}", options=options))


def _graph_only(method: Method) -> Method:
    """Return a method of which only the graph is scored."""
    return replace(method, mask=False, stages={})


def _threshold(source: Source) -> Ablation:
    """Vary the probability threshold of the mask; the default is that of the network."""
    own = read_weights(shipped_weights(points=BASE.points)).info.threshold
    tables = {
        f"{value:g}": {} if value == own else {"mask": {"threshold": value, "seed_threshold": value}}
        for value in sorted({*_THRESHOLDS, own})
    }
    return _of_options("threshold", "Mask threshold", "probability", tables, source)


def _collapse(source: Source) -> Ablation:
    """Vary the length up to which edges between junctions are collapsed."""
    tables = {f"{value}": {"clean": {"short_edge": value}} for value in _LENGTHS}
    return _of_options("collapse", "Collapse length", "length, m", tables, source)


def _traces(source: Source) -> Ablation:
    """Vary the N of the gaps, which changes the build, and the N of the reference, which changes the score."""
    tables = {f"{value}": {"refinement": {"min_traces": value}} for value in _COUNTS}
    gaps = _of_options("traces", "Drives that a road needs, N", "N", tables, source)
    roads = [
        AblationValue(
            f"{value}",
            replace(source, min_drives=value),
            BASE if value == source.min_drives else _graph_only(BASE),
            "of the reference",
        )
        for value in _COUNTS
    ]
    return replace(gaps, variants=[*(replace(variant, series="of a filled gap") for variant in gaps.variants), *roads])


def _alpha(source: Source) -> Ablation:
    """Vary the weight of turning into a gap edge."""
    tables = {f"{value:g}": {"refinement": {"gap_weight": value}} for value in _WEIGHTS}
    return _of_options("alpha", "Weight of gap edges in map matching", "alpha_g", tables, source)


def _thinning(source: Source) -> Ablation:
    """Vary the method that turns the mask into lines."""
    tables: dict[str, Table] = {"Guo-Hall": {}, "Zhang-Suen": {"thinning": "zhang_suen"}}
    return _of_options("thinning", "Thinning", "algorithm", tables, source, joined=False)


def _junctions(source: Source) -> Ablation:
    """Vary the method that splits false junctions."""
    rules: dict[str, Table] = {
        "none": _NO_SPLIT, "literal": {"variant": "literal"}, "guarded, no heights": _NO_HEIGHTS, "guarded": {}
    }  # fmt: skip
    tables = {label: {"refinement": {"junctions": rule}} for label, rule in rules.items()}
    return _of_options("junctions", "Disambiguation of junctions", "variant", tables, source, joined=False)


def _poses(source: Source) -> Ablation:
    """Vary how well the drives agree; poses that are missing and cannot be made are left out."""
    sources = [replace(source, poses=poses) for poses in reversed(POSES)]
    variants = [AblationValue(one.poses, one, BASE) for one in sources if one.poses == source.poses or _can_be_had(one)]
    return Ablation("poses", "Poses", "poses", variants, source.poses, joined=False)


def _can_be_had(source: Source) -> bool:
    """Tell whether a fleet exists, or the package that makes it is installed."""
    return source.fleet_file.exists() or (source.poses == "aligned" and find_spec("gtsam") is not None)


def _drives(source: Source) -> Ablation:
    """Vary the number of drives of each road; the reference stays the same."""
    sources = {f"{count}": replace(source, drives=count) for count in _DRIVES} | {"all": source}
    variants = [
        AblationValue(label, one, METHODS[name] if one is source else _graph_only(METHODS[name]), series)
        for name, series in (("probe2road", "network"), ("density", "density segmenter"))
        for label, one in sources.items()
    ]
    return Ablation("drives", "Drives per road", "drives", variants, "all")


def _of_options(
    name: str, title: str, axis: str, tables: Mapping[str, Table], source: Source, *, joined: bool = True
) -> Ablation:
    """Return the ablation of an option from labels and the values to set; the default sets no value."""
    methods = {label: vary(f"{name}-{label}".translate(_FOLDER), table) for label, table in tables.items()}
    default = next(label for label, method in methods.items() if method is BASE)
    variants = [AblationValue(label, source, method) for label, method in methods.items()]
    return Ablation(name, title, axis, variants, default, joined)


ABLATIONS: Mapping[str, Callable[[Source], Ablation]] = {
    "threshold": _threshold,
    "collapse": _collapse,
    "traces": _traces,
    "alpha": _alpha,
    "thinning": _thinning,
    "junctions": _junctions,
    "poses": _poses,
    "drives": _drives,
}
