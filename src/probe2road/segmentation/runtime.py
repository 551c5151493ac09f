"""Networks without torch: weights files run by onnxruntime."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from probe2road.errors import InputError, OptionError
from probe2road.segmentation.weights import ModelInfo, Weights

__all__ = ["DEVICES", "LoadedNetwork", "load_network", "run_network"]

DEVICES = ("cpu", "cuda")

_ERRORS_ONLY = 3  # severity from which onnxruntime writes to standard error
# One algorithm for all runs, in full single precision, so that results of a GPU are repeatable and agree with the CPU.
_CUDA = ("CUDAExecutionProvider", {"cudnn_conv_algo_search": "HEURISTIC", "use_tf32": "0"})


@dataclass(frozen=True)
class LoadedNetwork:
    """A network that is ready to run."""

    info: ModelInfo
    session: onnxruntime.InferenceSession


def load_network(weights: Weights, *, device: str = "cpu", threads: int | None = None) -> LoadedNetwork:
    """Load a network so that it is ready to run.

    Parameters
    ----------
    weights
        From `probe2road.segmentation.weights.read_weights`.
    device
        One of `DEVICES`.
    threads
        At most; as many as there are cores if it is None. No influence on the result.

    Raises
    ------
    OptionError
        If there is no such device, or none that onnxruntime can use.
    InputError
        If onnxruntime cannot run the network, or it is not the one that the metadata describe.
    """
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = threads or 0
    settings.log_severity_level = _ERRORS_ONLY
    providers = _providers(device)
    try:
        session = onnxruntime.InferenceSession(weights.model, settings, providers=providers)
        inputs, outputs = session.get_inputs(), session.get_outputs()
    except Exception as error:  # what onnxruntime raises has no base class of its own
        raise InputError(f"onnxruntime cannot load the weights ({error})", where=weights.path) from error
    if device == "cuda" and session.get_providers()[0] != _CUDA[0]:
        raise _absent(device)
    channels = len(weights.info.channels)
    if len(inputs) != 1 or len(outputs) != 1 or inputs[0].shape[1:2] != [channels]:
        raise InputError(f"the network does not take {channels} channels as its metadata say", where=weights.path)
    return LoadedNetwork(weights.info, session)


def run_network(network: LoadedNetwork, tiles: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the probability that pixels lie on a centreline.

    Tiles are run one by one: a batch brings no speed on a processor, and so nothing can depend on it.

    Parameters
    ----------
    network
        From `load_network`.
    tiles
        log10(1 + count), shape ``(n, channels, rows, cols)``; padded at the bottom and on the right with zeros where
        rows and columns are no multiples of the network's stride.

    Returns
    -------
    ndarray of float32, shape (n, rows, cols)

    Raises
    ------
    InputError
        If there are not as many channels as the network wants.
    """
    _, channels, rows, cols = tiles.shape
    info = network.info
    if channels != len(info.channels):
        raise InputError(
            f"the raster has {channels} channels, the network wants {len(info.channels)}: {', '.join(info.channels)}",
            where=info.name,
            fix="use weights for these channels",
        )
    padding = ((0, 0), (0, 0), (0, -rows % info.stride), (0, -cols % info.stride))
    padded = np.pad(tiles, padding) if any(after for _, after in padding) else tiles
    name = network.session.get_inputs()[0].name
    probability = np.empty((len(tiles), rows, cols), np.float32)
    for number, tile in enumerate(padded):
        probability[number] = network.session.run(None, {name: tile[None]})[0][0, 0, :rows, :cols]
    return probability


def _providers(device: str) -> list[Any]:
    """Return the names by which onnxruntime calls a device."""
    if device not in DEVICES:
        raise OptionError(f"there is no device {device!r}", fix=f"use {' or '.join(DEVICES)}")
    if device == "cpu":
        return ["CPUExecutionProvider"]
    if _CUDA[0] not in onnxruntime.get_available_providers():
        raise _absent(device)
    return [_CUDA]


def _absent(device: str) -> OptionError:
    return OptionError(
        f"onnxruntime finds no {device} device",
        where="device",
        fix="use device cpu, or install a GPU driver and onnxruntime-gpu in place of onnxruntime",
    )
