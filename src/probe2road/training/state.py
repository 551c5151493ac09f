"""The state of a training run, and the files that keep it."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from probe2road.errors import InputError, needs_extra
from probe2road.io.atomic import atomic_path
from probe2road.segmentation.dlinknet import DLinkNet, find_architecture
from probe2road.segmentation.export_onnx import load_parameters
from probe2road.training.config import TrainConfig

with needs_extra("train", feature="training the segmentation network"):
    import torch

__all__ = ["BEST", "CURVE", "TrainingState", "build_network", "keep_best", "keep_state", "open_state"]

logger = logging.getLogger(__name__)

BEST = "best.pt"
CURVE = "curve.json"

_CHECKPOINT = "checkpoint.pt"
_FREE = ("keep_every",)  # what may change between a run and its resumption


@dataclass
class TrainingState:
    """All state on which the next training step depends."""

    network: DLinkNet
    optimiser: torch.optim.Optimizer
    step: int = 0  # steps done
    best: float = -1.0  # validation score of the best weights so far
    curve: list[dict[str, float]] = field(default_factory=list)  # one row for each validation


def build_network(config: TrainConfig) -> DLinkNet:
    """Return the network of a configuration, with seeded random weights or with those of the given weights file."""
    torch.manual_seed(config.seed)
    network = DLinkNet(find_architecture(config.architecture), channels=len(config.channels))
    if config.start_from:
        load_parameters(network, config.start_from)
    return network


def open_state(config: TrainConfig, folder: Path, device: torch.device) -> TrainingState:
    """Return the training state stored in a folder, or that of a new run.

    Raises
    ------
    InputError
        If the folder keeps a run of another configuration, or a checkpoint that cannot be read.
    """
    network = build_network(config).to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimiser = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    state = TrainingState(network, optimiser)
    path = folder / _CHECKPOINT
    if not path.exists():
        return state
    try:
        kept = torch.load(path, map_location=device, weights_only=True)
    except Exception as error:  # torch raises many kinds for a damaged file
        raise InputError("is no checkpoint of ours", where=path, fix="remove it to begin anew") from error
    if kept["config"] != _identity(config):
        different = [name for name, value in _identity(config).items() if kept["config"].get(name) != value]
        fault = f"is of a run with another {', '.join(different)}"
        raise InputError(fault, where=path, fix="use another output folder, or remove it to begin anew")
    network.load_state_dict(kept["network"])
    optimiser.load_state_dict(kept["optimiser"])
    state.step, state.best, state.curve = kept["step"], kept["best"], kept["curve"]
    logger.info("going on after step %d of %d", state.step, config.steps)
    return state


def keep_state(state: TrainingState, config: TrainConfig, folder: Path) -> None:
    """Write the checkpoint from which a run continues."""
    kept = {
        "config": _identity(config), "network": state.network.state_dict(), "optimiser": state.optimiser.state_dict(),
        "step": state.step, "best": state.best, "curve": state.curve,
    }  # fmt: skip
    with atomic_path(folder / _CHECKPOINT) as temporary:
        torch.save(kept, temporary)


def keep_best(state: TrainingState, folder: Path) -> None:
    """Write the weights of the network as the best weights so far."""
    with atomic_path(folder / BEST) as temporary:
        torch.save(state.network.state_dict(), temporary)


def _identity(config: TrainConfig) -> dict[str, Any]:
    """Return a configuration in a form that can be compared with one that was read back."""
    return {name: value for name, value in json.loads(json.dumps(asdict(config))).items() if name not in _FREE}
