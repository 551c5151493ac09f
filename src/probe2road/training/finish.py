"""From the best weights of a run to a weights file, with a threshold from the validation squares and a description."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from probe2road.errors import InputError, needs_extra
from probe2road.segmentation.dlinknet import STRIDE
from probe2road.segmentation.export_onnx import export, load_parameters
from probe2road.segmentation.weights import ModelInfo, read_weights, replace_info
from probe2road.training.config import TrainConfig
from probe2road.training.loop import predict_squares
from probe2road.training.state import BEST, TrainingState, build_network
from probe2road.training.validation import validate, validation_squares

with needs_extra("train", feature="training the segmentation network"):
    import torch

__all__ = ["THRESHOLDS", "export_best"]

logger = logging.getLogger(__name__)

THRESHOLDS = (0.2, 0.3, 0.4, 0.5, 0.6, 0.7)


def export_best(config: TrainConfig, state: TrainingState, output: str | Path, *, sets: str | Path) -> Path:
    """Write the best weights of a run as a weights file for ``probe2road build``.

    Of `THRESHOLDS` the one with the best validation score becomes the model's own (METHOD 0.1 row 12).

    Parameters
    ----------
    config
        Of the run.
    state
        Where it ended.
    output
        Folder of the run; gets ``NAME.onnx``.
    sets
        Folder of prepared data sets.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    InputError
        If the run was never validated, so that no weights are the best.
    """
    path = Path(output) / BEST
    if not path.exists():
        raise InputError("there are no weights yet", where=path, fix="train at least to the first validation")
    network = build_network(config)
    network.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    kept = max(state.curve, key=lambda row: row["score"])
    info = ModelInfo(
        name=config.name,
        channels=config.channels,
        network={"architecture": config.architecture},
        tile=config.tile,
        stride=STRIDE,
        training={"config": _described(config), "step": kept["step"], "curve": state.curve, **_before(config)},
    )
    file = Path(output) / f"{config.name}.onnx"
    export(network, info, file)
    load_parameters(network, file)  # rounded, as users will run them
    squares = validation_squares(config.validation, config.sample, sets)
    probabilities = predict_squares(network, replace(config, precision="fp32"), squares)
    sweep = [{"threshold": at, **validate(squares, probabilities, threshold=at)} for at in THRESHOLDS]
    chosen = max(sweep, key=lambda row: row["score"])
    scores = [chosen[name] for name in ("threshold", "soft_f1", "geo_f1")]
    logger.info("threshold %.1f: soft F1 %.3f, GEO F1 %.3f", *scores)
    at = chosen["threshold"]
    training = {**info.training, "thresholds": sweep}
    replace_info(file, replace(info, threshold=at, seed_threshold=at, training=training))
    return file


def _described(config: TrainConfig) -> dict[str, Any]:
    """Return the configuration without the folders of this machine."""
    return asdict(replace(config, start_from=Path(config.start_from).name))


def _before(config: TrainConfig) -> dict[str, Any]:
    """Return how the weights were trained that the run began with, where it did not begin with random ones."""
    return {"before": dict(read_weights(config.start_from).info.training)} if config.start_from else {}
