"""The configuration of a training run: one dataclass, one TOML file."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from probe2road.bounds import NotEmpty, NotNegative, OneOf, Positive
from probe2road.errors import OptionError
from probe2road.options import checked, load_options
from probe2road.raster.counts import CHANNELS
from probe2road.segmentation.losses import LossOptions
from probe2road.training.samples import SampleOptions
from probe2road.training.sources import TrainingSource

__all__ = ["SHIPPED", "TrainConfig", "ValidationOptions", "load_config"]

SHIPPED = ("gnss-vision", "gnss", "paper")  # configurations that come with the package


@dataclass(frozen=True)
@checked
class ValidationOptions:
    """How the checkpoint is chosen: by scores on squares that no training sample touches."""

    sources: tuple[TrainingSource, ...] = (TrainingSource(name="milan"),)  # data sets
    squares: Positive[int] = 10  # of each source, spread over it
    size: Positive[int] = 1024  # pixels, side of a square
    every: Positive[int] = 500  # steps


@dataclass(frozen=True)
@checked
class TrainConfig:
    """All options that determine the trained weights."""

    name: str = "model"  # of the model
    seed: NotNegative[int] = 1
    architecture: str = "compact"  # one of `probe2road.segmentation.dlinknet.ARCHITECTURES`
    channels: Annotated[tuple[Annotated[str, OneOf(*CHANNELS)], ...], NotEmpty()] = CHANNELS  # of the input
    sources: tuple[TrainingSource, ...] = (TrainingSource(name="columbus", split="train"),)
    sample: SampleOptions = field(default_factory=SampleOptions)
    loss: LossOptions = field(default_factory=LossOptions)
    validation: ValidationOptions = field(default_factory=ValidationOptions)
    steps: Positive[int] = 10_000
    batch: Positive[int] = 4  # samples in a step, in each process
    learning_rate: Positive[float] = 1e-3  # of Adam
    schedule: Literal["constant", "cosine"] = "cosine"  # of the rate; cosine ends at nothing
    warm_up: NotNegative[int] = 200  # steps over which the learning rate rises to its value
    precision: Literal["bf16", "fp32"] = "bf16"  # "bf16" (mixed) or "fp32"
    compile: bool = False  # torch.compile; pays on a GPU, not on a CPU
    start_from: str = ""  # weights file to begin with; random weights where empty
    tile: Positive[int] = 1024  # pixels, side of the tiles in which the finished network looks at an area
    keep_every: Positive[int] = 500  # steps between checkpoints to resume from

    def __post_init__(self) -> None:
        """Refuse a configuration without anything to learn from."""
        if not any(source.weight > 0 for source in self.sources):
            raise OptionError("there are no sources", where="TrainConfig", fix="name data sets, or fleets of your own")

    @property
    def channel_rows(self) -> tuple[int, ...]:
        """Return the position of each input channel in the rasters."""
        return tuple(CHANNELS.index(name) for name in self.channels)


def load_config(name: str | Path) -> TrainConfig:
    """Read a configuration from a TOML file, or one of `SHIPPED` by its name.

    Raises
    ------
    OptionError
        If there is no such file, or it sets something that does not exist.

    Examples
    --------
    >>> load_config("paper").architecture
    'dlinknet50'
    """
    if str(name) in SHIPPED:
        name = Path(str(resources.files("probe2road.training").joinpath("configs", f"{name}.toml")))
    return load_options(name, TrainConfig)
