"""The methods in the paper's tables: their names, their input, and how they build."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from probe2road.baselines.biagioni.recipe import FLEET, build_biagioni
from probe2road.baselines.deepmg.recipe import DeepMGOptions, build_deepmg
from probe2road.baselines.kde import KdeOptions, build_kde
from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.recipe import BuildOptions, build
from probe2road.run.stages import CLEANED, GAPS_FILLED, Stage
from probe2road.segmentation.network import shipped_weights
from probe2road.segmentation.options import SegmentationOptions

__all__ = ["METHODS", "Method", "find_methods"]


@dataclass(frozen=True)
class Method:
    """A method from fleet data to a road graph, as in a row of a table."""

    name: str
    label: str
    builder: Callable[..., RoadGraph]  # called as `probe2road.recipe.build` is
    options: Any  # of the builder, a frozen dataclass
    points: bool = False  # whether it gets to see the semantic points, or traces alone
    mask: bool = False  # whether its workspace holds a mask that soft F1 can score
    stages: Mapping[str, Stage] = field(default_factory=dict)  # graphs of its workspace that are scored, too

    @property
    def weights(self) -> Path | None:
        """Return the weights file of the method's network, if it has one."""
        if isinstance(self.options, DeepMGOptions):
            return Path(self.options.weights)
        if isinstance(self.options, BuildOptions) and self.options.segmentation.segmenter == "network":
            return Path(self.options.segmentation.network.weights or shipped_weights(points=self.points))
        return None


_NETWORK = BuildOptions(segmentation=SegmentationOptions(segmenter="network"))
_DENSITY = BuildOptions(segmentation=SegmentationOptions(segmenter="density"))
_STAGES = {"no post-processing": CLEANED, "gap filling": GAPS_FILLED}

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        Method(
            "probe2road", "Probe2Road, GNSS and vision", build, _NETWORK,
            points=True, mask=True, stages=_STAGES,
        ),
        Method("probe2road-gnss", "Probe2Road, GNSS only", build, _NETWORK, mask=True),
        Method("density", "Probe2Road, density segmenter", build, _DENSITY, mask=True),
        Method("kde", "KDE in three dimensions", build_kde, KdeOptions()),
        Method("biagioni", "Biagioni and Eriksson", build_biagioni, FLEET),
        Method("deepmg", "DeepMG", build_deepmg, DeepMGOptions()),
    )
}  # fmt: skip


def find_methods(names: Sequence[str], *, deepmg: str | Path | None = None) -> list[Method]:
    """Return methods by name, in the order of the names; all if no name is given.

    Parameters
    ----------
    names
        Out of `METHODS`.
    deepmg
        File of DeepMG's weights. Without it the method cannot be asked for, and is left out of all of them.

    Raises
    ------
    OptionError
        If there is no method of a name, or DeepMG is named and has no weights.

    Examples
    --------
    >>> [method.label for method in find_methods(["kde", "density"])]
    ['KDE in three dimensions', 'Probe2Road, density segmenter']
    """
    names = list(names) or [name for name in METHODS if deepmg is not None or name != "deepmg"]
    if unknown := [name for name in names if name not in METHODS]:
        raise OptionError(f"there is no method {unknown[0]!r}", where="benchmark", fix=f"use {', '.join(METHODS)}")
    if "deepmg" in names and deepmg is None:
        fix = "train a network with experiments/train_deepmg.py and name its file"
        raise OptionError("DeepMG has no weights", where="benchmark", fix=fix)
    found = [METHODS[name] for name in names]
    return [
        replace(method, options=replace(method.options, weights=str(deepmg))) if method.name == "deepmg" else method
        for method in found
    ]
