"""The options that determine the centreline probability, and no later stage."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from probe2road.bounds import OneOf, Positive
from probe2road.fleet.contract import TraceGaps
from probe2road.options import checked
from probe2road.segmentation.density import DensityOptions
from probe2road.segmentation.network import NetworkOptions

__all__ = ["SEGMENTERS", "SegmentationOptions"]

SEGMENTERS = ("network", "density")


@dataclass(frozen=True)
@checked
class SegmentationOptions:
    """All options that the probability depends on; a cached probability is used if they are equal."""

    resolution: Positive[float] = 1.0  # m per pixel
    segmenter: Annotated[str, OneOf(*SEGMENTERS)] = "network"  # one of SEGMENTERS
    gaps: TraceGaps = field(default_factory=TraceGaps)  # where traces are broken
    network: NetworkOptions = field(default_factory=NetworkOptions)  # options of the learned segmenter
    density: DensityOptions = field(default_factory=DensityOptions)  # options of the density segmenter
