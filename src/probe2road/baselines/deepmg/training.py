"""Training of T2RNet with the settings of its source code (METHOD 3.2); a run can be interrupted and continued."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe2road.baselines.deepmg.prediction import save_network
from probe2road.baselines.deepmg.t2rnet import T2RNet, t2rnet_loss
from probe2road.baselines.deepmg.tiles import Batch, TileSet, read_batch
from probe2road.baselines.deepmg.variants import find_variant
from probe2road.bounds import NotNegative, Positive
from probe2road.errors import InputError, OptionError, needs_extra
from probe2road.io.atomic import atomic_path
from probe2road.options import checked

with needs_extra("train", feature="training DeepMG"):
    import torch
    from torch import Tensor

__all__ = ["TrainOptions", "train"]

logger = logging.getLogger(__name__)

_BETAS = (0.5, 0.999)  # of Adam
_THRESHOLD = 0.5  # probability from which a cell is a centreline
_VALIDATION_BATCH = 8  # tiles at a time


@dataclass(frozen=True)
@checked
class TrainOptions:
    """How T2RNet is trained; the defaults are the published settings."""

    width: Positive[int] = 64  # channels of the first stage
    epochs: Positive[int] = 200
    learning_rate: Positive[float] = 2e-4
    halve_every: Positive[int] = 10  # epochs after which the learning rate is halved
    validate_every: Positive[int] = 20  # training steps
    seed: NotNegative[int] = 2017  # of the weights at the start and of the order of the tiles
    device: str = "cpu"
    bfloat16: bool = False  # whether convolutions run in half precision; faster where the processor has it


@dataclass
class _Run:
    """The state of a training run, as stored in a checkpoint."""

    network: T2RNet
    optimiser: torch.optim.Adam
    epoch: int = 0  # the next one
    best: float = -1.0  # F1 of the weights that were kept
    history: list[dict[str, float]] = field(default_factory=list)


def train(tiles: TileSet, validation: TileSet, folder: str | Path, options: TrainOptions | None = None) -> Path:
    """Train T2RNet, and keep the weights with the best F1 of centreline cells on validation tiles.

    After every epoch a checkpoint is written to the folder; a call with the same folder goes on from there. The number
    of epochs may be raised between calls, everything else has to stay.

    Parameters
    ----------
    tiles, validation
        From `probe2road.baselines.deepmg.tiles.write_tiles`, of one variant with one set of features.
    folder
        Created where it does not exist. ``weights.pt`` has the best weights so far, ``history.csv`` a line for each
        epoch, ``checkpoint.pt`` what is needed to go on.
    options
        None takes the defaults.

    Returns
    -------
    Path
        The file of the best weights.

    Raises
    ------
    InputError
        If tiles differ in variant or features, or there are none.
    OptionError
        If the folder has a checkpoint of other options.
    """
    options, folder = options or TrainOptions(), Path(folder)
    same = (tiles.variant, tiles.features) == (validation.variant, validation.features)
    if not same or not tiles.count or not validation.count:
        fault = "training and validation tiles are of different kinds, or there are none"
        raise InputError(fault, where=tiles.folder, fix="prepare both with the same configuration")
    folder.mkdir(parents=True, exist_ok=True)
    run = _start(tiles, folder, options)
    while run.epoch < options.epochs:
        row = _epoch(run, tiles, validation, folder, options)
        run.history.append(row)
        run.epoch += 1
        logger.info("epoch %d of %d: loss %.4f, F1 %.4f", run.epoch, options.epochs, row["loss"], row["f1"])
        _write_checkpoint(run, tiles, folder, options)
    return folder / "weights.pt"


def _epoch(run: _Run, tiles: TileSet, validation: TileSet, folder: Path, options: TrainOptions) -> dict[str, float]:
    """Train on every tile once; return a row of the history, with the F1 that was measured last."""
    rate = options.learning_rate * 0.5 ** (run.epoch // options.halve_every)
    for group in run.optimiser.param_groups:
        group["lr"] = rate
    total, f1 = 0.0, float("nan")
    size = find_variant(tiles.variant).batch_size
    order = np.random.default_rng([options.seed, run.epoch]).permutation(tiles.count)
    batches = [order[start : start + size] for start in range(0, len(order), size)]
    for number, chosen in enumerate(batches, start=run.epoch * len(batches) + 1):
        total += _step(run, read_batch(tiles, chosen.tolist()), options)
        if number % options.validate_every == 0:
            f1 = _validated(run, validation, folder, options)
    return {"epoch": run.epoch + 1, "loss": total / len(batches), "f1": f1, "learning_rate": rate}


def _start(tiles: TileSet, folder: Path, options: TrainOptions) -> _Run:
    """Begin a run, or continue the run whose checkpoint is in the folder."""
    torch.manual_seed(options.seed)
    network = T2RNet(options.width).to(options.device)
    run = _Run(network, torch.optim.Adam(network.parameters(), lr=options.learning_rate, betas=_BETAS))
    path = folder / "checkpoint.pt"
    if not path.exists():
        return run
    kept = torch.load(path, map_location=options.device, weights_only=True)
    if kept["settings"] != _settings(tiles, options):
        fix = "name another folder, or use the options of before"
        raise OptionError("the checkpoint belongs to a training with other options", where=path, fix=fix)
    network.load_state_dict(kept["network"])
    run.optimiser.load_state_dict(kept["optimiser"])
    run.epoch, run.best, run.history = kept["epoch"], kept["best"], kept["history"]
    logger.info("going on from epoch %d of %s", run.epoch, path)
    return run


def _settings(tiles: TileSet, options: TrainOptions) -> dict[str, Any]:
    """Return the settings that must not change within a run."""
    settings = asdict(options) | {"variant": tiles.variant, "features": asdict(tiles.features), "tiles": tiles.count}
    return {name: value for name, value in settings.items() if name not in ("epochs", "device")}


def _step(run: _Run, batch: Batch, options: TrainOptions) -> float:
    """Do one training step, and return its loss."""
    run.network.train()
    planes, neighbours, line, region = _tensors(batch, options.device)
    with torch.autocast(options.device, torch.bfloat16, enabled=options.bfloat16):
        lines, regions = run.network(planes, neighbours)
    loss = t2rnet_loss((lines.float(), regions.float()), line, region)
    run.optimiser.zero_grad()
    loss.backward()  # type: ignore[no-untyped-call]
    run.optimiser.step()
    return float(loss.detach())


def _validated(run: _Run, tiles: TileSet, folder: Path, options: TrainOptions) -> float:
    """Return the F1 of centreline cells, pooled over all tiles; keep the weights if it is the best so far."""
    run.network.eval()
    counts = np.zeros(3)  # hits, found, true
    with torch.no_grad():
        for batch in _in_order(tiles):
            planes, neighbours, _, _ = _tensors(batch, options.device)
            found = run.network(planes, neighbours)[0].cpu().numpy() >= _THRESHOLD
            counts += (found & (batch.line > 0)).sum(), found.sum(), batch.line.sum()
    f1 = float(2.0 * counts[0] / max(counts[1] + counts[2], 1.0))
    if f1 > run.best:
        run.best = f1
        save_network(run.network, folder / "weights.pt", variant=tiles.variant, features=tiles.features)
    return f1


def _in_order(tiles: TileSet) -> Iterator[Batch]:
    """Yield all tiles in batches, in order."""
    for start in range(0, tiles.count, _VALIDATION_BATCH):
        yield read_batch(tiles, range(start, min(start + _VALIDATION_BATCH, tiles.count)))


def _tensors(batch: Batch, device: str) -> tuple[Tensor, ...]:
    """Convert a batch to the tensors that the network takes."""

    def tensor(array: NDArray[Any]) -> Tensor:
        return torch.from_numpy(array).to(device, torch.float32)

    bits = torch.from_numpy(np.unpackbits(batch.neighbours, axis=1))
    inputs = (tensor(batch.planes), bits.to(device).to(torch.float32))
    planes, neighbours = (part.contiguous(memory_format=torch.channels_last) for part in inputs)
    return planes, neighbours, tensor(batch.line), tensor(batch.region)


def _write_checkpoint(run: _Run, tiles: TileSet, folder: Path, options: TrainOptions) -> None:
    """Write all that is needed to continue, and the history as a table."""
    state = {
        "network": run.network.state_dict(),
        "optimiser": run.optimiser.state_dict(),
        "epoch": run.epoch,
        "best": run.best,
        "history": run.history,
        "settings": _settings(tiles, options),
    }
    with atomic_path(folder / "checkpoint.pt") as temporary:
        torch.save(state, temporary)
    lines = [",".join(run.history[0]), *(",".join(f"{value:g}" for value in row.values()) for row in run.history)]
    with atomic_path(folder / "history.csv") as temporary:
        temporary.write_text("\n".join([*lines, ""]))
