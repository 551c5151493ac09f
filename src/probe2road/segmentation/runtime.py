"""Networks without torch: a weights file run by onnxruntime, or by OpenVINO where it is installed."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from probe2road.errors import InputError, OptionError
from probe2road.segmentation.weights import ModelInfo, Weights

__all__ = ["DEVICES", "PRECISIONS", "RUNTIMES", "LoadedNetwork", "load_network", "run_network"]

DEVICES = ("cpu", "cuda")
RUNTIMES = ("onnxruntime", "openvino")
PRECISIONS = ("float32", "bfloat16")

logger = logging.getLogger(__name__)

_ERRORS_ONLY = 3  # severity from which onnxruntime writes to standard error
# One algorithm for all runs and full single precision, so that a GPU repeats itself and agrees with the CPU.
_CUDA = ("CUDAExecutionProvider", {"cudnn_conv_algo_search": "HEURISTIC", "use_tf32": "0"})
_Infer = Callable[[NDArray[np.float32]], NDArray[np.float32]]  # (1, channels, rows, cols) to (1, 1, rows, cols)


@dataclass(frozen=True)
class LoadedNetwork:
    """A network ready to run on one tile, shape ``(1, channels, rows, cols)``, after the other."""

    info: ModelInfo
    infer: _Infer


def load_network(
    weights: Weights,
    *,
    device: str = "cpu",
    threads: int | None = None,
    runtime: str | None = None,
    precision: str | None = None,
) -> LoadedNetwork:
    """Make a network ready to run.

    Parameters
    ----------
    weights
        From `probe2road.segmentation.weights.read_weights`.
    device
        One of `DEVICES`.
    threads
        At most; as many as there are cores where it is None. No influence on the result.
    runtime
        One of `RUNTIMES`. None takes OpenVINO on a processor where it is installed, and onnxruntime elsewhere.
    precision
        One of `PRECISIONS`. None takes bfloat16 where both the processor and the runtime have it: half the time, and
        probabilities that are off by about .01 at single pixels.

    Raises
    ------
    OptionError
        If there is no such device, runtime or precision, or none that can be used here.
    InputError
        If the runtime cannot run the network, or it is not the one that the metadata describe.
    """
    given = (("device", device, DEVICES), ("runtime", runtime, RUNTIMES), ("precision", precision, PRECISIONS))
    for name, value, choices in given:
        if value is not None and value not in choices:
            raise OptionError(f"there is no {name} {value!r}", fix=f"use {' or '.join(choices)}")
    if (runtime or _fastest(device)) == "openvino":
        infer = _with_openvino(weights, device, threads, precision)
    else:
        infer = _with_onnxruntime(weights, device, threads, precision)
    return LoadedNetwork(weights.info, infer)


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
    probability = np.empty((len(tiles), rows, cols), np.float32)
    for number, tile in enumerate(padded):
        probability[number] = network.infer(tile[None])[0, 0, :rows, :cols]
    return probability


def _fastest(device: str) -> str:
    """Name the runtime for those who name none."""
    return "openvino" if device == "cpu" and find_spec("openvino") is not None else "onnxruntime"


def _with_onnxruntime(weights: Weights, device: str, threads: int | None, precision: str | None) -> _Infer:
    """Load a network into onnxruntime, which computes in single precision only."""
    if precision == "bfloat16":
        raise OptionError("onnxruntime has no bfloat16", where="precision", fix="use float32, or runtime openvino")
    if device == "cuda" and _CUDA[0] not in onnxruntime.get_available_providers():
        raise _absent(device)
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = threads or 0
    settings.log_severity_level = _ERRORS_ONLY
    providers = [_CUDA] if device == "cuda" else ["CPUExecutionProvider"]
    try:
        session = onnxruntime.InferenceSession(weights.model, settings, providers=providers)
        inputs, outputs = session.get_inputs(), session.get_outputs()
    except Exception as error:  # what onnxruntime raises has no base class of its own
        raise InputError(f"onnxruntime cannot load the weights ({error})", where=weights.path) from error
    if device == "cuda" and session.get_providers()[0] != _CUDA[0]:
        raise _absent(device)
    _require_channels(weights, [value.shape for value in inputs], len(outputs))
    return lambda tile: session.run(None, {inputs[0].name: tile})[0]


def _with_openvino(weights: Weights, device: str, threads: int | None, precision: str | None) -> _Infer:
    """Load a network into OpenVINO."""
    try:
        import openvino
    except ImportError as error:
        fix = "pip install 'probe2road[openvino]', or use onnxruntime"
        raise OptionError("OpenVINO is not installed", where="runtime", fix=fix) from error
    if device != "cpu":
        raise OptionError(f"OpenVINO does not run on {device} here", where="runtime", fix="use onnxruntime")
    core = openvino.Core()
    fast = "BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    if precision == "bfloat16" and not fast:
        raise OptionError("this processor has no bfloat16", where="precision", fix="use float32")
    chosen = precision or ("bfloat16" if fast else "float32")
    settings: dict[str, Any] = {
        "INFERENCE_PRECISION_HINT": {"bfloat16": "bf16", "float32": "f32"}[chosen],
        "NUM_STREAMS": 1,
        **({"INFERENCE_NUM_THREADS": threads} if threads else {}),
    }
    try:
        model = core.read_model(model=weights.model)
        shapes = [
            [-1 if size.is_dynamic else size.get_length() for size in value.partial_shape] for value in model.inputs
        ]
        compiled = core.compile_model(model, "CPU", settings)
    except Exception as error:  # a RuntimeError for whatever is wrong
        raise InputError(f"OpenVINO cannot load the weights ({error})", where=weights.path) from error
    _require_channels(weights, shapes, len(model.outputs))
    request = compiled.create_infer_request()
    logger.info("running the network with OpenVINO in %s", chosen)
    return lambda tile: request.infer({0: tile})[compiled.output(0)]


def _require_channels(weights: Weights, shapes: list[list[Any]], outputs: int) -> None:
    """Refuse a network that is not what its metadata say."""
    channels = len(weights.info.channels)
    if len(shapes) != 1 or outputs != 1 or list(shapes[0][1:2]) != [channels]:
        raise InputError(f"the network does not take {channels} channels as its metadata say", where=weights.path)


def _absent(device: str) -> OptionError:
    return OptionError(
        f"onnxruntime finds no {device} device",
        where="device",
        fix="use device cpu, or install a GPU driver and onnxruntime-gpu in place of onnxruntime",
    )
