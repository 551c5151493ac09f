from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from probe2road.errors import InputError, OptionError
from probe2road.segmentation import weights as module
from probe2road.segmentation.weights import ModelInfo, network_input, pack_weights, read_weights, replace_info

INFO = ModelInfo(
    name="tiny",
    channels=("traces", "lane_markings"),
    network={"width": 8, "blocks": [1, 1]},
    threshold=0.4,
    seed_threshold=0.6,
    tile=512,
    training={"seed": 3, "scores": {"geo": 0.9}, "städte": ["Köln"]},
)


def test_metadata_come_back_as_they_went(tmp_path):
    path = tmp_path / "tiny.onnx"
    path.write_bytes(pack_weights(b"", INFO))
    weights = read_weights(path)
    assert weights.info == INFO
    assert weights.path == path


def test_other_metadata_are_as_if_written_at_once(write_weights):
    path = write_weights(name="plain")
    before = path.read_bytes()
    model = before[: before.index(b"probe2road") - 4]
    replace_info(path, replace(read_weights(path).info, threshold=0.3))
    assert read_weights(path).info.threshold == 0.3
    assert path.read_bytes().startswith(model)
    replace_info(path, replace(read_weights(path).info, threshold=0.5))
    assert path.read_bytes() == before


def test_the_file_is_an_ordinary_onnx_model(write_weights):
    path = write_weights(name="plain")
    onnx.checker.check_model(onnx.load(path))
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    assert '"name": "plain"' in session.get_modelmeta().custom_metadata_map["probe2road"]


def test_the_digest_sees_the_network_and_the_metadata(tmp_path):
    digests = set()
    for number, (model, info) in enumerate([(b"", INFO), (b"\x08\x0a", INFO), (b"", replace(INFO, threshold=0.3))]):
        path = tmp_path / f"{number}.onnx"
        path.write_bytes(pack_weights(model, info))
        digests.add(read_weights(path).digest)
    assert len(digests) == 3


def test_a_file_cut_off_anywhere_is_refused(write_weights, tmp_path):
    data = write_weights().read_bytes()
    cut = tmp_path / "cut.onnx"
    for length in {*range(0, len(data), 29), len(data) - 1}:
        cut.write_bytes(data[:length])
        with pytest.raises(InputError, match=r"cut\.onnx: (the weights are|not a weights file)"):
            read_weights(cut)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_a_changed_byte_anywhere_is_noticed(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("weights") / "changed.onnx"
    content = bytearray(pack_weights(b"\x08\x0a" * 20, INFO))
    place = data.draw(st.integers(0, len(content) - 1))
    content[place] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"changed\.onnx: "):
        read_weights(path)


@pytest.mark.parametrize("tail", [b"\x08\x0a", b"\0", b"and more"])
def test_bytes_behind_the_end_are_noticed(write_weights, tail):
    path = write_weights()
    path.write_bytes(path.read_bytes() + tail)
    with pytest.raises(InputError, match=r"weights\.onnx: "):
        read_weights(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a weights file of probe2road"),
        (b"<html>not found</html>", "not a weights file|cut off"),
        (b"\x08\x0a", "not a weights file of probe2road; use a file that probe2road train has exported"),
    ],
)
def test_other_files_are_told_apart(tmp_path, content, message):
    path = tmp_path / "other.onnx"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_weights(path)


def test_a_missing_file_is_an_error(tmp_path):
    with pytest.raises(InputError, match=r"absent\.onnx: weights cannot be read \(No such file or directory\)"):
        read_weights(tmp_path / "absent.onnx")


def test_a_newer_format_is_an_error(write_weights, monkeypatch):
    with monkeypatch.context() as newer:
        newer.setattr(module, "FORMAT", 2)
        path = write_weights()
    with pytest.raises(InputError, match="weights of format 2; this version reads up to 1; update probe2road"):
        read_weights(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"channels": ()}, "ModelInfo: channels is "),
        ({"channels": ("traces", "traces")}, "model tiny: channels are "),
        ({"resolution": 0.0}, "ModelInfo: resolution is 0.0"),
        ({"tile": 1000}, "model tiny: a tile of 1000 px"),
        ({"tile": 16}, "model tiny: a tile of 16 px"),
        ({"threshold": 0.8, "seed_threshold": 0.7}, "model tiny: threshold is 0.8"),
        ({"seed_threshold": 1.0}, "ModelInfo: seed_threshold is 1.0"),
    ],
)
def test_metadata_that_mean_nothing_are_refused(changes, message):
    with pytest.raises(OptionError, match=message):
        replace(INFO, **changes)


def test_networks_see_the_logarithm_of_one_more_than_the_count():
    counts = np.array([[0, 1], [9, 2**31]], np.uint32)
    seen = network_input(counts)
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen, np.log10(1.0 + counts), rtol=1e-6)
