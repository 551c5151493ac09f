"""The training loop: every sample has its own seed, so that an interrupted run continues as if uninterrupted."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from probe2road.errors import OptionError, needs_extra
from probe2road.run.progress import Progress
from probe2road.segmentation.losses import loss_function
from probe2road.segmentation.weights import network_input
from probe2road.training.config import TrainConfig
from probe2road.training.curves import draw_curves, write_curve
from probe2road.training.samples import Sample, draw_sample
from probe2road.training.scene import Scene
from probe2road.training.sources import members, open_scene
from probe2road.training.state import CURVE, TrainingState, keep_best, keep_state, open_state
from probe2road.training.validation import Square, validate, validation_squares

with needs_extra("train", feature="training the segmentation network"):
    import torch
    from torch import Tensor, nn
    from torch.distributed import init_process_group, is_initialized
    from torch.nn.parallel import DistributedDataParallel
    from torch.utils.tensorboard import SummaryWriter

__all__ = ["is_first", "learning_rate", "predict_squares", "train", "use_threads"]

logger = logging.getLogger(__name__)

_PICTURE = "curve.png"
_LOG = "tensorboard"


def train(
    config: TrainConfig,
    output: str | Path,
    *,
    sets: str | Path,
    device: str = "auto",
    stop_after: float | None = None,
    progress: Progress | None = None,
) -> TrainingState:
    """Train a network, or continue the run in the same output folder.

    Started by ``torchrun`` in several processes, each draws its own samples and they share their gradients.

    Parameters
    ----------
    config
        What to train.
    output
        Folder for ``checkpoint.pt`` (to go on from), ``best.pt`` (weights with the best validation score so far),
        ``curve.json``, ``curve.png`` and ``tensorboard``.
    sets
        Folder of prepared data sets.
    device
        "cpu", "cuda", or "auto": cuda where there is one.
    stop_after
        Seconds after which the run stops at the next validation, resumable; never where None.
    progress
        Called after every step.

    Returns
    -------
    TrainingState
        At the last step, or where it was stopped.

    Raises
    ------
    InputError
        If a data set is missing, or the output folder keeps a run of another configuration.
    OptionError
        If cuda is asked for and absent.

    Notes
    -----
    Paper, section III-B; METHOD 1.3, 1.4.
    """
    output = Path(output)
    output.mkdir(parents=True, exist_ok=True)
    where, rank, ranks = _join(device)
    state = open_state(config, output, where)
    network: nn.Module = DistributedDataParallel(state.network) if ranks > 1 else state.network
    if config.compile:
        network.compile()
    scenes = [(open_scene(source, sets), source.weight) for source in members(config.sources)]
    squares = validation_squares(config.validation, config.sample, sets) if rank == 0 else []
    loss_of = loss_function(config.loss)
    started = since = time.monotonic()
    losses: list[float] = []
    for step, x, y in _batches(config, scenes, state.step, rank):
        for group in state.optimiser.param_groups:
            group["lr"] = learning_rate(config, step)
        network.train()
        with _mixed(config, where):
            logits = network(x.to(where, memory_format=torch.channels_last))
        loss = loss_of(logits, y.to(where), step)
        state.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        state.optimiser.step()
        state.step = step + 1
        losses.append(float(loss.detach()))
        if progress is not None:
            progress("training", state.step, config.steps)
        validated = state.step % config.validation.every == 0 or state.step == config.steps
        if validated and rank == 0:
            pace = (time.monotonic() - since) / len(losses)
            _validate(state, config, squares, output, loss=float(np.mean(losses)), pace=pace)
        if validated:
            since, losses = time.monotonic(), []
        if rank == 0 and (validated or state.step % config.keep_every == 0):
            keep_state(state, config, output)
        if validated and stop_after is not None and time.monotonic() - started > stop_after:
            break
    return state


def _batches(
    config: TrainConfig, scenes: Sequence[tuple[Scene, float]], first: int, rank: int
) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Yield step, input ``(n, c, h, w)`` and label ``(n, 1, h, w)``; the next batch is drawn in the background."""
    weights = np.array([weight for _, weight in scenes])
    rows = list(config.channel_rows)

    def batch(step: int) -> list[Sample]:
        samples = []
        for number in range(rank * config.batch, (rank + 1) * config.batch):
            rng = np.random.default_rng([config.seed, step, number])
            scene = scenes[int(rng.choice(len(scenes), p=weights / weights.sum()))][0]
            samples.append(draw_sample(scene, rng, config.sample))
        return samples

    with ThreadPoolExecutor(1, thread_name_prefix="samples") as pool:
        ahead = pool.submit(batch, first)
        for step in range(first, config.steps):
            samples = ahead.result()
            ahead = pool.submit(batch, step + 1)
            x = network_input(np.stack([sample.counts[rows] for sample in samples]))
            y = np.stack([sample.label[None] for sample in samples]).astype(np.float32)
            yield step, torch.from_numpy(x), torch.from_numpy(y)


def learning_rate(config: TrainConfig, step: int) -> float:
    """Return the learning rate of a step."""
    rise = min(1.0, (step + 1) / max(config.warm_up, 1))
    fall = 1.0 if config.schedule == "constant" else 0.5 * (1.0 + np.cos(np.pi * step / config.steps))
    return float(config.learning_rate * rise * fall)


def _mixed(config: TrainConfig, where: torch.device) -> AbstractContextManager[None]:
    """Compute in bfloat16, if the options ask for it."""
    return torch.autocast(where.type, torch.bfloat16, enabled=config.precision == "bf16")


def _validate(
    state: TrainingState, config: TrainConfig, squares: Sequence[Square], output: Path, *, loss: float, pace: float
) -> None:
    """Score the network, add a row to the curve, and keep the weights if they are the best so far."""
    probabilities = predict_squares(state.network, config, squares)
    row = {"step": float(state.step), "loss": loss, "seconds_per_step": pace, **validate(squares, probabilities)}
    state.curve.append(row)
    write_curve(state.curve, output / CURVE)
    draw_curves(state.curve, output / _PICTURE, title=config.name)
    with SummaryWriter(str(output / _LOG)) as log:
        for name, value in row.items():
            log.add_scalar(name, value, state.step)
    logger.info(
        "step %d: loss %.3f, soft F1 %.3f, GEO F1 %.3f, %.2f s a step",
        state.step, loss, row["soft_f1"], row["geo_f1"], pace,
    )  # fmt: skip
    if row["score"] > state.best:
        state.best = row["score"]
        keep_best(state, output)


def predict_squares(network: nn.Module, config: TrainConfig, squares: Sequence[Square]) -> list[NDArray[np.float32]]:
    """Return the probability of each square ``(size, size)``, in the precision of training but in evaluation mode."""
    network.eval()
    where = next(network.parameters()).device
    probabilities = []
    for part in squares:
        x = torch.from_numpy(network_input(part.counts[None, list(config.channel_rows)]))
        with torch.no_grad(), _mixed(config, where):
            logits = network(x.to(where, memory_format=torch.channels_last))
        probabilities.append(torch.sigmoid(logits.float())[0, 0].cpu().numpy())
    return probabilities


def use_threads(threads: int) -> None:
    """Compute with at most the given number of threads inside the block.

    Raises
    ------
    OptionError
        If it is not a positive number.
    """
    if threads < 1:
        raise OptionError(f"threads is {threads}", fix="use 1 or more")
    torch.set_num_threads(threads)


def is_first() -> bool:
    """Tell whether this is the process that writes files, among those that a launcher started."""
    return os.environ.get("RANK", "0") == "0"


def _join(device: str) -> tuple[torch.device, int, int]:
    """Return the device, the number of this process and of all; connect the processes if a launcher started several."""
    if device not in ("auto", "cpu", "cuda"):
        raise OptionError(f"there is no device {device!r}", fix="use auto, cpu or cuda")
    there = torch.cuda.is_available()
    if device == "cuda" and not there:
        raise OptionError("there is no GPU that torch can use", where="device", fix="use cpu, or a torch with CUDA")
    kind = "cuda" if there and device != "cpu" else "cpu"
    ranks = int(os.environ.get("WORLD_SIZE", "1"))
    if ranks > 1 and not is_initialized():
        init_process_group("nccl" if kind == "cuda" else "gloo")
    local = int(os.environ.get("LOCAL_RANK", "0"))
    return torch.device(kind, local) if kind == "cuda" else torch.device(kind), int(os.environ.get("RANK", "0")), ranks
