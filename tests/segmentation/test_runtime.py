import sys
from dataclasses import asdict

import numpy as np
import pytest

from probe2road.errors import InputError, OptionError
from probe2road.segmentation.runtime import RUNTIMES, load_network, run_network
from probe2road.segmentation.weights import ModelInfo, network_input, pack_weights, read_weights

VISION = ("traces", "lane_markings", "road_boundaries")


def tiles(n=3, channels=3, rows=64, cols=96, seed=0):
    """Counts of random points and lines, as networks see them."""
    counts = np.random.default_rng(seed).poisson(0.05, (n, channels, rows, cols))
    counts[:, 0, rows // 2] += 9
    return network_input(counts)


@pytest.fixture(params=RUNTIMES)
def network(request, write_weights):
    pytest.importorskip(request.param)
    return load_network(read_weights(write_weights()), threads=1, runtime=request.param, precision="float32")


def test_a_line_of_traces_comes_out(network):
    counts = np.zeros((1, 3, 64, 64), np.uint32)
    counts[0, 0, 30] = 9
    probability = run_network(network, network_input(counts))
    assert probability.shape == (1, 64, 64)
    assert probability.dtype == np.float32
    np.testing.assert_allclose(
        probability[0, [30, 40], 32], 1 / (1 + np.exp([-40 * (1 / 5 - 0.15), 40 * 0.15])), rtol=1e-5
    )


def test_a_batch_gives_what_its_tiles_give(network):
    together = run_network(network, tiles())
    one_by_one = [run_network(network, tile[None])[0] for tile in tiles()]
    backwards = run_network(network, tiles()[::-1])[::-1]
    assert (together == np.stack(one_by_one)).all()
    assert (together == backwards).all()


def test_an_empty_batch_gives_an_empty_answer(network):
    assert run_network(network, tiles()[:0]).shape == (0, 64, 96)


@pytest.mark.parametrize(("rows", "cols"), [(1, 1), (31, 33), (100, 64)])
def test_any_size_is_padded_and_cropped_back(network, rows, cols):
    small = tiles(rows=rows, cols=cols)
    padded = np.pad(small, ((0, 0), (0, 0), (0, -rows % 32), (0, -cols % 32)))
    assert (run_network(network, small) == run_network(network, padded)[:, :rows, :cols]).all()


def test_the_number_of_channels_must_be_right(network):
    with pytest.raises(
        InputError, match=r"blur: the raster has 1 channels, the network wants 3: traces, lane_markings"
    ):
        run_network(network, tiles(channels=1))


def test_an_absent_gpu_is_an_error(write_weights, monkeypatch):
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CPUExecutionProvider"])
    with pytest.raises(OptionError, match="onnxruntime finds no cuda device; use device cpu"):
        load_network(read_weights(write_weights()), device="cuda")


def test_an_unknown_device_is_an_error(write_weights):
    with pytest.raises(OptionError, match="there is no device 'tpu'; use cpu or cuda"):
        load_network(read_weights(write_weights()), device="tpu")


def test_an_unknown_precision_is_an_error(write_weights):
    with pytest.raises(OptionError, match="there is no precision 'int8'; use float32 or bfloat16"):
        load_network(read_weights(write_weights()), precision="int8")


def test_openvino_where_it_cannot_be_is_an_error(write_weights, monkeypatch):
    weights = read_weights(write_weights())
    with pytest.raises(OptionError, match=r"runtime: OpenVINO does not run on cuda here; use onnxruntime"):
        load_network(weights, device="cuda", runtime="openvino")
    monkeypatch.setitem(sys.modules, "openvino", None)
    with pytest.raises(OptionError, match=r"runtime: OpenVINO is not installed; pip install 'probe2road\[openvino\]'"):
        load_network(weights, runtime="openvino")


def test_a_precision_that_is_not_there_is_an_error(write_weights, monkeypatch):
    weights, openvino = read_weights(write_weights()), pytest.importorskip("openvino")
    with pytest.raises(OptionError, match="precision: onnxruntime has no bfloat16"):
        load_network(weights, runtime="onnxruntime", precision="bfloat16")
    monkeypatch.setattr(openvino.Core, "get_property", lambda *names: ["FP32"])
    with pytest.raises(OptionError, match="precision: this processor has no bfloat16; use float32"):
        load_network(weights, runtime="openvino", precision="bfloat16")


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_a_file_without_a_network_is_an_error(tmp_path, runtime):
    pytest.importorskip(runtime)
    path = tmp_path / "empty.onnx"
    path.write_bytes(pack_weights(b"", ModelInfo("empty", ("traces",))))
    with pytest.raises(InputError, match=r"empty\.onnx: (onnxruntime cannot load|the network does not take)"):
        load_network(read_weights(path), runtime=runtime)


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_metadata_of_another_network_are_an_error(tmp_path, blur_model, runtime):
    pytest.importorskip(runtime)
    path = tmp_path / "mixed.onnx"
    path.write_bytes(pack_weights(blur_model(3), ModelInfo("other", ("traces",))))
    with pytest.raises(InputError, match="does not take 1 channels as its metadata say"):
        load_network(read_weights(path), runtime=runtime)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A small D-LinkNet, its export, and the network that the export fills again."""
    torch = pytest.importorskip("torch")
    from probe2road.segmentation.dlinknet import Architecture, DLinkNet
    from probe2road.segmentation.export_onnx import export, load_parameters

    torch.manual_seed(0)
    small = Architecture(blocks=(1, 1, 1, 1), width=8, centre_width=8, head_width=8)
    trained = DLinkNet(small)
    for seed in range(4):  # gives batch normalisation something to remember
        trained(torch.from_numpy(tiles(seed=seed)))
    with torch.no_grad():
        trained.head[-1].weight *= 100  # so that probabilities spread
    path = tmp_path_factory.mktemp("exported") / "small.onnx"
    export(trained, ModelInfo("small", VISION, network=asdict(small)), path)
    again = DLinkNet(small)
    assert load_parameters(again, path).channels == VISION
    return trained, path, again


@pytest.mark.parametrize(("rows", "cols"), [(64, 96), (50, 70)])
def test_torch_and_the_runtime_agree(exported, rows, cols):
    import torch

    _, path, again = exported
    seen = tiles(rows=rows, cols=cols, seed=7)
    padded = np.pad(seen, ((0, 0), (0, 0), (0, -rows % 32), (0, -cols % 32)))
    with torch.no_grad():
        expected = torch.sigmoid(again.eval()(torch.from_numpy(padded)))[:, 0, :rows, :cols].numpy()
    assert expected.std() > 0.1
    np.testing.assert_allclose(run_network(load_network(read_weights(path), threads=1), seen), expected, atol=1e-3)


def test_parameters_come_back_in_half_precision(exported):
    trained, _, again = exported
    assert trained.training  # an export leaves it as it was
    stored = again.state_dict()
    for name, value in trained.state_dict().items():
        if "num_batches_tracked" not in name:
            np.testing.assert_allclose(stored[name].numpy(), value.numpy(), rtol=2**-11, atol=2**-24)


def test_an_export_does_not_say_where_the_code_lay(exported):
    assert b"site-packages" not in exported[1].read_bytes()


def test_parameters_of_another_network_are_refused(exported):
    from probe2road.segmentation.dlinknet import Architecture, DLinkNet
    from probe2road.segmentation.export_onnx import load_parameters

    for blocks, channels in (((2, 1, 1, 1), 3), ((1, 1, 1, 1), 1)):
        other = DLinkNet(Architecture(blocks=blocks, width=8, centre_width=8, head_width=8), channels=channels)
        with pytest.raises(InputError, match=r"small\.onnx: holds the weights of another network"):
            load_parameters(other, exported[1])
