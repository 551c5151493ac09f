import os
import subprocess
import sys
from pathlib import Path

import pytest

from probe2road.cli.main import main
from probe2road.segmentation.weights import read_weights

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

CONFIG = """
name = "tiny"
steps = 4
batch = 1
[sample]
size = 64
[loss]
kind = "bce_dice"
[validation]
sources = [{ name = "interchange-diamond-1" }]
squares = 1
size = 256
every = 2
[[sources]]
name = "interchange-diamond-1"
"""


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "tiny.toml"
    path.write_text(CONFIG)
    return path


def test_train_stops_goes_on_and_writes_weights(config, sets, tmp_path, capsys):
    command = ["-q", "train", str(config), "--sets", str(sets), "--output", str(tmp_path / "run"), "--device", "cpu"]
    with pytest.raises(SystemExit):
        main([*command, "--minutes", "0", "--threads", "1"])
    assert "stopped after step 2 of 4" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(command)
    path = Path(capsys.readouterr().out.strip())
    info = read_weights(path).info
    assert (info.name, info.channels) == ("tiny", ("traces", "lane_markings", "road_boundaries"))
    assert info.training["config"]["steps"] == 4
    assert info.threshold in [row["threshold"] for row in info.training["thresholds"]]


@pytest.mark.slow
def test_two_processes_train_one_network(config, sets, tmp_path):
    programs = Path(sys.executable).parent
    launcher = [programs / "torchrun", "--nproc-per-node", "2", "--no-python", programs / "probe2road"]
    command = ["train", config, "--sets", sets, "--output", tmp_path / "run", "--device", "cpu", "--threads", "1"]
    environment = {**os.environ, "GLOO_SOCKET_IFNAME": "lo", "OMP_NUM_THREADS": "1"}
    subprocess.run([*launcher, *command], check=True, env=environment, capture_output=True)
    assert (tmp_path / "run" / "tiny.onnx").exists()
