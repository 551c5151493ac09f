"""A network small enough to understand: a blurred trace channel, cut at a level."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from probe2road.segmentation.weights import ModelInfo, pack_weights

VISION = ("traces", "lane_markings", "road_boundaries")


WIDTH, LEVEL, STEEPNESS = 5, 0.15, 40.0


def _blur_model(channels):
    """A serialised model: sigmoid(STEEPNESS * (mean of log10(1 + traces) over WIDTH x WIDTH pixels - LEVEL))."""
    kernel = np.zeros((1, channels, WIDTH, WIDTH), np.float32)
    kernel[0, 0] = STEEPNESS / WIDTH**2
    values = {"kernel": kernel, "bias": np.array([-STEEPNESS * LEVEL], np.float32)}
    nodes = [
        helper.make_node("Conv", ["counts", "kernel", "bias"], ["logits"], pads=[WIDTH // 2] * 4),
        helper.make_node("Sigmoid", ["logits"], ["probability"]),
    ]
    graph = helper.make_graph(
        nodes,
        "blur",
        [helper.make_tensor_value_info("counts", TensorProto.FLOAT, ["n", channels, "rows", "cols"])],
        [helper.make_tensor_value_info("probability", TensorProto.FLOAT, ["n", 1, "rows", "cols"])],
        [numpy_helper.from_array(array, name) for name, array in values.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    onnx.checker.check_model(model)
    return model.SerializeToString()


@pytest.fixture
def blur_model():
    """Makes the serialised network, given its number of channels."""
    return _blur_model


@pytest.fixture
def write_weights(tmp_path):
    """Write a weights file of the blurring network; keywords are those of ModelInfo, and what the file is called."""

    def write(channels=VISION, *, file="weights.onnx", **info):
        info = {"name": "blur", "tile": 256, "threshold": 0.5, "seed_threshold": 0.5} | info
        path = tmp_path / file
        path.write_bytes(pack_weights(_blur_model(len(channels)), ModelInfo(channels=channels, **info)))
        return path

    return write
