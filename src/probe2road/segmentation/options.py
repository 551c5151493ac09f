"""The options that decide the centreline probability, and nothing behind it."""

from __future__ import annotations

from dataclasses import dataclass, field

from probe2road.errors import OptionError
from probe2road.fleet.contract import TraceGaps
from probe2road.segmentation.density import DensityOptions
from probe2road.segmentation.network import NetworkOptions

__all__ = ["SEGMENTERS", "SegmentationOptions"]

SEGMENTERS = ("network", "density")


@dataclass(frozen=True)
class SegmentationOptions:
    """Everything that the probability of a fleet depends on; a cached one is taken where these are the same."""

    resolution: float = 1.0  # m per pixel
    segmenter: str = "network"  # one of SEGMENTERS
    gaps: TraceGaps = field(default_factory=TraceGaps)  # where traces are broken
    network: NetworkOptions = field(default_factory=NetworkOptions)  # of the learned segmenter
    density: DensityOptions = field(default_factory=DensityOptions)  # of the density segmenter

    def __post_init__(self) -> None:
        """Refuse an unknown segmenter."""
        if self.segmenter not in SEGMENTERS:
            raise OptionError(f"there is no segmenter {self.segmenter!r}", fix=f"use {', '.join(SEGMENTERS)}")
