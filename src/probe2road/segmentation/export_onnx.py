"""Export and import: from a torch network to a weights file, and back.

Strategy
--------
The graph is exported as it is, with nothing folded or fused, so that the initialisers keep the names that the
parameters have in torch and training can start from any weights file. The runtimes fold and fuse when they load.
Large parameters are rounded to half precision and stored so, with a cast behind them: half the size, computed in single
precision all the same. The rounded network is the one that is shipped, and what scores have to be measured with; torch
and the file agree on it, which is checked before the file takes the place of an older one.
"""

from __future__ import annotations

import copy
import logging
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from probe2road.errors import InputError, OutputError, needs_extra
from probe2road.io.atomic import atomic_path
from probe2road.segmentation.runtime import load_network, run_network
from probe2road.segmentation.weights import ModelInfo, network_input, pack_weights, read_weights

with needs_extra("train", feature="exporting and loading networks"):
    import onnx
    import torch
    from torch import nn

if TYPE_CHECKING:
    from onnx import ModelProto

__all__ = ["export", "load_parameters"]

logger = logging.getLogger(__name__)

_INPUT, _OUTPUT = "counts", "probability"

_TOLERANCE = 1e-3  # largest difference in probability between torch and the file
_LARGE = 1024  # values of a kernel that is stored in half precision; vectors, as of batch normalisation, never are
_PREFIX = "network."  # what the wrapper puts before the names of parameters
_SINGLE = ".single"  # what a stored initialiser is called behind its cast
_UNUSED = "num_batches_tracked"  # of batch normalisation: counted in training, needed nowhere


class _Probability(nn.Module):
    """A network that returns probabilities instead of logits."""

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, counts: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(self.network(counts))


def export(network: nn.Module, info: ModelInfo, path: str | Path, *, half: bool = True) -> None:
    """Write a network and its metadata as a weights file.

    Parameters
    ----------
    network
        Maps log10(1 + count), float32 ``(n, channels, rows, cols)``, to logits ``(n, 1, rows, cols)``. It is
        exported in evaluation mode and left as it was.
    info
        What the network expects and promises.
    path
        File to write; complete or absent.
    half
        Whether large parameters are rounded to half precision.

    Raises
    ------
    OutputError
        If what the file computes differs by more than 1e-3 from what torch computes with the same parameters, or the
        file cannot be written.
    """
    model = _Probability(copy.deepcopy(network)).cpu().float().eval()
    tiles = _sample(info)
    exact = _run_torch(model, tiles)
    if half:
        _round_large(model)
    onnx_model = _graph(model, info)
    if half:
        _halve(onnx_model)
    data = pack_weights(onnx_model.SerializeToString(deterministic=True), info)
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)
        stored = run_network(load_network(read_weights(temporary), runtime="onnxruntime"), tiles)
        difference = float(np.abs(stored - _run_torch(model, tiles)).max())
        if not difference <= _TOLERANCE:
            raise OutputError(f"onnxruntime and torch differ by {difference:.2g} in probability", where=path)
    rounding = np.abs(stored - exact)
    logger.info(
        "wrote %s: %.1f MB; on noise %.1g from torch at most; rounding moves it by %.1g on average and %.1g at most",
        *(path, len(data) / 1e6, difference, rounding.mean(), rounding.max()),
    )


def load_parameters(network: nn.Module, path: str | Path) -> ModelInfo:
    """Fill a network with the parameters of a weights file.

    Parameters
    ----------
    network
        Built as the network that was exported; its parameters and buffers are overwritten.
    path
        Written by `export`.

    Returns
    -------
    ModelInfo
        The metadata of the file.

    Raises
    ------
    InputError
        If the file is no weights file, or holds the parameters of another network.
    """
    weights = read_weights(path)
    stored = {
        tensor.name.removeprefix(_PREFIX): torch.from_numpy(onnx.numpy_helper.to_array(tensor).astype(np.float32))
        for tensor in onnx.load_from_string(weights.model).graph.initializer
        if tensor.name.startswith(_PREFIX)
    }
    try:
        missing, unexpected = network.load_state_dict(stored, strict=False)
    except RuntimeError as error:  # shapes differ
        raise InputError("holds the weights of another network", where=path) from error
    missing = [name for name in missing if not name.endswith(_UNUSED)]
    if missing or unexpected:
        raise InputError(
            f"holds the weights of another network: {len(missing)} parameters are missing, {len(unexpected)} unknown",
            where=path,
            fix=f"build it as its metadata say: {weights.info.network}",
        )
    return weights.info


def _graph(model: nn.Module, info: ModelInfo) -> ModelProto:
    """Return the ONNX graph of a model, for any number of tiles whose size is a multiple of the stride."""
    side = torch.export.Dim("rows"), torch.export.Dim("cols")
    sizes = {0: torch.export.Dim.DYNAMIC, 2: info.stride * side[0], 3: info.stride * side[1]}
    sample = torch.zeros(2, len(info.channels), 2 * info.stride, 3 * info.stride)
    registration = logging.getLogger("torch.onnx._internal.exporter._registration")
    registration.addFilter(_no_torchvision)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*LeafSpec", FutureWarning)  # torch 2.13 calls what it deprecates
        program = torch.onnx.export(
            model,
            (sample,),
            dynamo=True,
            optimize=False,
            verbose=False,
            input_names=[_INPUT],
            output_names=[_OUTPUT],
            dynamic_shapes=(sizes,),
        )
    registration.removeFilter(_no_torchvision)
    assert program is not None
    onnx_model = program.model_proto
    _strip(onnx_model)
    return onnx_model


def _no_torchvision(record: logging.LogRecord) -> bool:
    """Suppress torch's message that torchvision, which is not needed here, is not installed."""
    return "torchvision" not in record.getMessage()


def _strip(onnx_model: ModelProto) -> None:
    """Remove the notes of the exporter about the source code, which include paths on this machine."""
    graph = onnx_model.graph
    del onnx_model.metadata_props[:]
    del graph.metadata_props[:]
    del graph.value_info[:]
    for item in (*graph.node, *graph.initializer, *graph.input, *graph.output):
        del item.metadata_props[:]
        item.doc_string = ""


def _halve(onnx_model: ModelProto) -> None:
    """Store large initialisers in half precision, each followed by a cast to single precision."""
    graph = onnx_model.graph
    cast: dict[str, str] = {}
    for tensor in graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype == np.float32 and values.ndim > 1 and values.size >= _LARGE:
            cast[tensor.name] = tensor.name + _SINGLE
            tensor.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), tensor.name))
    for node in graph.node:
        node.input[:] = [cast.get(name, name) for name in node.input]
    nodes = [
        *(onnx.helper.make_node("Cast", [name], [single], to=onnx.TensorProto.FLOAT) for name, single in cast.items()),
        *graph.node,
    ]
    del graph.node[:]
    graph.node.extend(nodes)


def _sample(info: ModelInfo) -> NDArray[np.float32]:
    """Return tiles of random points and lines, similar to the input of a network."""
    side, channels = 8 * info.stride, len(info.channels)
    rng = np.random.default_rng(0)
    counts = rng.poisson(0.02, (2, channels, side, side))
    counts[..., rng.integers(0, side, 3)] += rng.integers(0, 50, (2, channels, side, 1))
    return network_input(counts)


def _run_torch(model: nn.Module, tiles: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a model's probabilities ``(n, rows, cols)``."""
    with torch.no_grad():
        return model(torch.from_numpy(tiles))[:, 0].numpy()


def _round_large(model: nn.Module) -> None:
    """Round the large parameters of a model to half precision, in place."""
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.dim() > 1 and parameter.numel() >= _LARGE:
                parameter.copy_(parameter.half().float())
