"""Weights files of T2RNet, and the network's predictions for windows of a grid."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from probe2road.baselines.deepmg.features import FeatureOptions, Steps, extract_features
from probe2road.baselines.deepmg.t2rnet import T2RNet
from probe2road.baselines.deepmg.tiles import TILE_CELLS
from probe2road.baselines.deepmg.variants import Variant, find_variant
from probe2road.errors import InputError, needs_extra
from probe2road.io.atomic import atomic_path
from probe2road.raster.grid import Grid, Window

with needs_extra("train", feature="DeepMG"):
    import torch

__all__ = ["TrainedNetwork", "load_network", "predict_windows", "save_network"]

logger = logging.getLogger(__name__)


class TrainedNetwork(NamedTuple):
    """A network and the options of the features it was trained with."""

    network: T2RNet
    variant: Variant
    features: FeatureOptions


def save_network(network: T2RNet, path: str | Path, *, variant: str, features: FeatureOptions) -> None:
    """Write a network's weights in half precision with all that prediction needs; the file is complete or absent."""
    width = network.region_head.in_channels
    halves = {name: part.half() if part.is_floating_point() else part for name, part in network.state_dict().items()}
    state = {"width": width, "variant": variant, "features": asdict(features), "network": halves}
    with atomic_path(path) as temporary:
        torch.save(state, temporary)


def load_network(path: str | Path) -> TrainedNetwork:
    """Read a file of `save_network`; the network is ready to predict.

    Raises
    ------
    InputError
        If there is no such file, or it has no weights of T2RNet.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        network = T2RNet(state["width"])
        network.load_state_dict(state["network"])
    except Exception as error:  # torch raises whatever the file makes it stumble over
        fix = "train some with experiments/train_deepmg.py"
        raise InputError(f"not weights of T2RNet ({type(error).__name__})", where=path, fix=fix) from error
    return TrainedNetwork(network.eval(), find_variant(state["variant"]), FeatureOptions(**state["features"]))


def predict_windows(trained: TrainedNetwork, steps: Steps, grid: Grid) -> Iterator[tuple[Window, NDArray[np.float32]]]:
    """Predict centreline probability window by window; windows without a fix are left out.

    Parameters
    ----------
    trained
        From `load_network`.
    steps
        Traces, thinned with the features of the network.
    grid
        With its resolution.

    Yields
    ------
    Window, ndarray of float32
        The window, and the probability of its own cells ``(rows, cols)``.

    Notes
    -----
    The published code predicts tile by tile without context (METHOD 3.3, item 6).
    """
    halo = trained.variant.halo
    row, col = grid.rowcol(steps.x, steps.y)
    inside = (row >= 0) & (row < grid.rows) & (col >= 0) & (col < grid.cols)
    across = -(-grid.cols // TILE_CELLS)
    driven = np.unique(row[inside] // TILE_CELLS * across + col[inside] // TILE_CELLS)
    windows = grid.windows(TILE_CELLS, halo=halo)
    for number in driven:
        window = windows[number]
        side = TILE_CELLS + 2 * halo
        around = grid.window(window.row - halo, window.col - halo, side, side)
        planes, neighbours = extract_features(steps, around, trained.variant)
        bits = np.unpackbits(neighbours, axis=0).astype(np.float32)
        with torch.no_grad():
            line, _ = trained.network(torch.from_numpy(planes)[None], torch.from_numpy(bits)[None])
        yield window, line[0].numpy()[window.inner]
    logger.info("predicted %d of %d windows of %d cells", len(driven), len(windows), TILE_CELLS**2)
