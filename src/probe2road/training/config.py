"""The configuration of a training run: one dataclass, one TOML file."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path

from probe2road.errors import OptionError
from probe2road.options import load_options
from probe2road.raster.counts import CHANNELS
from probe2road.segmentation.losses import LossOptions
from probe2road.training.samples import SampleOptions
from probe2road.training.sources import Source

__all__ = ["SHIPPED", "TrainConfig", "ValidationOptions", "load_config"]

SHIPPED = ("gnss-vision", "gnss", "paper")  # configurations that come with the package


@dataclass(frozen=True)
class ValidationOptions:
    """What chooses the checkpoint: scores on squares that no training sample touches."""

    sources: tuple[Source, ...] = (Source(name="milan"),)  # data sets
    squares: int = 10  # of each source, spread over it
    size: int = 1024  # pixels, side of a square
    every: int = 500  # steps


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides which weights come out."""

    name: str = "model"  # of the model
    seed: int = 1
    architecture: str = "compact"  # one of `probe2road.segmentation.dlinknet.ARCHITECTURES`
    channels: tuple[str, ...] = CHANNELS  # of the input, out of `probe2road.raster.counts.CHANNELS`
    sources: tuple[Source, ...] = (Source(name="columbus", split="train"),)
    sample: SampleOptions = field(default_factory=SampleOptions)
    loss: LossOptions = field(default_factory=LossOptions)
    validation: ValidationOptions = field(default_factory=ValidationOptions)
    steps: int = 10_000
    batch: int = 4  # samples in a step, in each process
    learning_rate: float = 1e-3  # of Adam
    schedule: str = "cosine"  # "constant", or "cosine": from the learning rate down to nothing at the last step
    warm_up: int = 200  # steps over which the learning rate rises to its value
    precision: str = "bf16"  # "bf16" (mixed) or "fp32"
    compile: bool = False  # torch.compile; pays on a GPU, not on a CPU
    start_from: str = ""  # weights file to begin with; random weights where empty
    tile: int = 1024  # pixels, side of the tiles in which the finished network looks at an area
    keep_every: int = 500  # steps between checkpoints to resume from

    def __post_init__(self) -> None:
        """Refuse what cannot be run."""
        unknown = [name for name in self.channels if name not in CHANNELS]
        if unknown or not self.channels:
            fix = f"use one or more of {', '.join(CHANNELS)}"
            raise OptionError(f"channels are {', '.join(self.channels) or 'none'}", where="channels", fix=fix)
        if self.schedule not in ("constant", "cosine") or self.precision not in ("bf16", "fp32"):
            fix = "use schedule constant or cosine, and precision bf16 or fp32"
            raise OptionError(f"schedule {self.schedule!r}, precision {self.precision!r}", where="TrainConfig", fix=fix)
        if min(self.steps, self.batch, self.keep_every, self.validation.every) < 1 or not self.learning_rate > 0:
            fix = "use positive numbers of steps and samples, and a positive learning rate"
            raise OptionError("there is nothing to run", where="TrainConfig", fix=fix)
        if not self.sources or not any(source.weight > 0 for source in self.sources):
            raise OptionError("there are no sources", where="sources", fix="name data sets, or fleets of your own")

    @property
    def channel_rows(self) -> tuple[int, ...]:
        """Position of each input channel in the rasters."""
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
