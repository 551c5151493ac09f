"""Seconds and memory per tile of 1000 x 1000 pixels, for each runtime and precision, on one thread and on two.

Run with ``python benchmarks/bench_segmentation.py WEIGHTS.onnx``. Every row is a process of its own, so that memory
is that of one runtime. What is not installed is left out. On a busy machine only the CPU time means something.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from probe2road.segmentation.runtime import load_network, run_network
from probe2road.segmentation.weights import network_input, read_weights

SIDE = 1000  # px
RUNTIMES = (("onnxruntime", "fp32"), ("openvino", "fp32"), ("openvino", "bf16"), ("torch", "fp32"), ("torch", "bf16"))

Predict = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def tile(channels: int, stride: int) -> NDArray[np.float32]:
    """Return a tile with streets every 100 m, padded to the stride."""
    rng = np.random.default_rng(0)
    counts = rng.poisson(0.01, (1, channels, SIDE, SIDE))
    counts[:, :, ::100] += rng.poisson(20, (1, channels, SIDE // 100, SIDE))
    counts[:, :, :, ::100] += rng.poisson(20, (1, channels, SIDE, SIDE // 100))
    return network_input(np.pad(counts, ((0, 0), (0, 0), (0, -SIDE % stride), (0, -SIDE % stride))))


def predictor(runtime: str, precision: str, path: Path, threads: int) -> Predict:
    """Return what runs a weights file in one of `RUNTIMES`."""
    weights = read_weights(path)
    if runtime == "onnxruntime":
        network = load_network(weights, threads=threads)
        return lambda tiles: run_network(network, tiles)
    if runtime == "openvino":
        import openvino

        hints = {"INFERENCE_PRECISION_HINT": precision.replace("fp32", "f32"), "INFERENCE_NUM_THREADS": threads}
        model = openvino.Core().compile_model(path, "CPU", hints)
        return lambda tiles: np.array(model(tiles)[0][:, 0])
    return torch_predictor(path, precision, threads)


def torch_predictor(path: Path, precision: str, threads: int) -> Predict:
    """Return the network itself, in the memory format that is fastest on a processor."""
    import torch

    from probe2road.segmentation.dlinknet import DLinkNet, find_architecture
    from probe2road.segmentation.export_onnx import load_parameters

    torch.set_num_threads(threads)
    info = read_weights(path).info
    network = DLinkNet(find_architecture(info.network["architecture"]), channels=len(info.channels))
    load_parameters(network, path)
    network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def predict(tiles: NDArray[np.float32]) -> NDArray[np.float32]:
        seen = torch.from_numpy(tiles).to(memory_format=torch.channels_last)
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            return np.asarray(torch.sigmoid(network(seen).float())[:, 0].numpy())

    return predict


def measure(runtime: str, precision: str, path: Path, threads: int, repeats: int) -> None:
    """Print one row: wall and CPU time of the best run, peak memory, largest difference from onnxruntime."""
    info = read_weights(path).info
    tiles = tile(len(info.channels), info.stride)
    start = time.perf_counter()
    predict = predictor(runtime, precision, path, threads)
    loading = time.perf_counter() - start
    spent = []
    for _ in range(repeats + 1):  # the first run is longer
        before = time.perf_counter(), time.process_time()
        probability = predict(tiles)
        spent.append((time.perf_counter() - before[0], time.process_time() - before[1]))
    wall, processor = (min(column) for column in zip(*spent[1:], strict=True))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    reference = run_network(load_network(read_weights(path), threads=threads), tiles)
    difference = np.abs(probability - reference).max()
    figures = f"{loading:.2f} | {wall:.2f} | {processor:.2f} | {peak:.2f} | {difference:.1g}"
    print(f"| {runtime} | {precision} | {threads} | {figures} |", flush=True)


def table(path: Path, repeats: int) -> None:
    """Print all rows, each from a process of its own."""
    info = read_weights(path).info
    print(f"{info.name}: {len(info.channels)} channels, {path.stat().st_size / 1e6:.1f} MB\n")
    print("| runtime | precision | threads | load, s | tile, s | CPU, s | memory, GiB | difference |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for runtime, precision in RUNTIMES:
        if find_spec(runtime) is None:
            continue
        for threads in (1, 2):
            only = [runtime, precision, str(threads)]
            environment = os.environ | {"OMP_NUM_THREADS": str(threads)}
            subprocess.run(
                [sys.executable, __file__, str(path), "--repeats", str(repeats), "--only", *only],
                env=environment,
                check=True,
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights", type=Path, help="weights file")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--only", nargs=3, metavar=("RUNTIME", "PRECISION", "THREADS"), help="print one row only")
    arguments = parser.parse_args()
    if arguments.only:
        runtime, precision, threads = arguments.only
        measure(runtime, precision, arguments.weights, int(threads), arguments.repeats)
    else:
        table(arguments.weights, arguments.repeats)
