"""Short training runs that differ from the shipped configuration in one thing each, scored on validation squares.

Usage: probe2road benchmark prepare columbus rhein_neckar porto milan interchanges corridors --output SETS
       python experiments/training_experiments.py SETS RESULTS.json [--steps 800] [--names base,width_1,...]

Prints a Markdown table of docs/results/segmentation.md. Results are kept in RESULTS.json run by run; a run that is
there already is not repeated. Every run has the same samples, steps and learning rates, and the seed of the
configuration unless another one is given. What is not in the shipped configuration lives here only, until it proves
worth it.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor, nn
from torch.nn import functional

from probe2road.raster.counts import CHANNELS
from probe2road.segmentation.dlinknet import ARCHITECTURES, STRIDE, Architecture, DLinkNet
from probe2road.segmentation.export_onnx import export
from probe2road.segmentation.losses import LossOptions, bce_dice, loss_function
from probe2road.segmentation.weights import ModelInfo, network_input
from probe2road.training.config import TrainConfig, load_config
from probe2road.training.loop import learning_rate
from probe2road.training.samples import SampleOptions, Vectors, sample_vectors, square_vectors
from probe2road.training.scene import Scene
from probe2road.training.sources import members, open_scene
from probe2road.training.validation import validate, validation_squares

Channels = Callable[[Vectors], NDArray[np.float32]]

LAYERS = (3.0, 8.0)  # m above the lowest trace nearby where the second and the third altitude layer begin
NEARBY = 32  # pixels, cells in which the lowest trace is looked for
BINS = 8  # of the heading
KEYPOINT = 4  # pixels, radius of the mark at a junction


@dataclass(frozen=True)
class Variation:
    """One run."""

    what: str
    architecture: Architecture = ARCHITECTURES["compact"]
    rows: tuple[int, ...] = (0, 1, 2)  # channels of the count rasters
    extra: Channels | None = None  # further input channels, drawn from the vectors
    loss: LossOptions = field(default_factory=partial(LossOptions, kind="bce_dice"))
    label_width: int = 3
    fine: bool = False  # whether the decoder also gets what was seen at half and at full resolution
    keypoints: bool = False  # whether a second output learns to mark junctions
    data: str = "modelled"  # poses of the cities and corridors learned from, where they are not raw
    validated: str = "modelled"  # poses of the fleet validated on
    turns: int = 1  # right angles by which squares are turned in validation, the results averaged
    weights: str = ""  # name of the run whose weights are used; trained anew where empty


class FineDLinkNet(DLinkNet):
    """A D-LinkNet of basic blocks whose decoder also adds what was seen at half and at full resolution."""

    def __init__(self, architecture: Architecture, *, channels: int, classes: int) -> None:
        super().__init__(architecture, channels=channels, classes=classes)
        self.fine = nn.Conv2d(channels, architecture.head_width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:  # (n, c, h, w), h and w multiples of 32
        """Return logits ``(n, classes, h, w)``."""
        stem = functional.relu(self.bn1(self.conv1(x)))
        e1 = self.layer1(functional.max_pool2d(stem, 3, stride=2, padding=1))
        e2 = self.layer2(e1)
        e3 = self.layer3(e2)
        d4 = self.decoder4(self.centre(self.layer4(e3))) + e3
        d2 = self.decoder2(self.decoder3(d4) + e2) + e1
        y: Tensor = self.head[1:](self.head[0](self.decoder1(d2) + stem) + self.fine(x))
        return y


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", type=Path, help="folder of the prepared data sets")
    parser.add_argument("results", type=Path, help="JSON file to add to")
    parser.add_argument("--steps", type=int, default=800)
    parser.add_argument("--names", default=",".join(VARIATIONS), help="comma-separated")
    parser.add_argument("--seed", type=int, help="in place of that of the configuration; use another RESULTS.json")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--export", action="store_true", help="write weights files beside the results, for build")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    results = json.loads(options.results.read_text()) if options.results.exists() else {}
    for name in options.names.split(","):
        if name not in results:
            variation = VARIATIONS[name]
            weights = options.results.with_name(f"{options.results.stem}-{variation.weights or name}.pt")
            results[name] = run(variation, options.sets, options.steps, weights, seed=options.seed)
            options.results.write_text(json.dumps(results, indent=1))
            print(name, results[name], flush=True)
        if options.export:
            write_weights(name, options.results.with_name(f"{options.results.stem}-{name}.pt"))
    print("\n| run | soft F1 | GEO F1/P/R | iTOPO F1 | million parameters | s a step | s a tile |")
    print("|---|---|---|---|---|---|---|")
    for name, row in results.items():
        print(
            f"| {VARIATIONS[name].what} | {row['soft_f1']:.3f} | {row['geo_f1']:.3f}/{row['geo_precision']:.3f}/"
            f"{row['geo_recall']:.3f} | {row['itopo_f1']:.3f} | {row['parameters'] / 1e6:.1f} | {row['seconds']:.2f} | "
            f"{tile_seconds(VARIATIONS[name]):.2f} |"
        )


def tile_seconds(variation: Variation) -> float:
    """Seconds of processor time that a prediction of 1024 x 1024 pixels takes, in single precision."""
    channels = len(variation.rows) + (0 if variation.extra is None else 2)  # more input channels cost next to nothing
    kind = FineDLinkNet if variation.fine else DLinkNet
    network = kind(variation.architecture, channels=channels, classes=1 + variation.keypoints)
    network.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    x = torch.rand(1, channels, 1024, 1024).to(memory_format=torch.channels_last)
    spent = []
    for _ in range(3):
        started = time.process_time()
        with torch.inference_mode():
            network(x)
        spent.append(time.process_time() - started)
    return variation.turns * min(spent)


def run(variation: Variation, sets: Path, steps: int, weights: Path, *, seed: int | None) -> dict[str, float]:
    """Train, unless there are weights already, and validate."""
    config = replace(load_config("gnss-vision"), steps=steps)
    config = config if seed is None else replace(config, seed=seed)
    (validated,) = config.validation.sources
    validation = replace(config.validation, sources=(replace(validated, data=variation.validated),))
    config = replace(config, validation=validation)
    # Interchanges are always modelled: there are twenty, and to align them takes as long as a city.
    sources = [
        one if one.data == "raw" else replace(one, data="modelled" if one.name == "interchanges" else variation.data)
        for one in config.sources
    ]
    scenes = [(open_scene(source, sets), source.weight) for source in members(sources)]
    torch.manual_seed(config.seed)
    channels = len(network_channels(variation, square_vectors(scenes[0][0], (0.0, 0.0), SampleOptions(size=32))))
    kind = FineDLinkNet if variation.fine else DLinkNet
    network = kind(variation.architecture, channels=channels, classes=1 + variation.keypoints)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    seconds = 0.0
    if variation.weights:
        network.load_state_dict(torch.load(weights, weights_only=True))
    else:
        seconds = learn(network, variation, config, scenes)
        torch.save(network.state_dict(), weights)
    parameters = sum(parameter.numel() for parameter in network.parameters())
    return {**scores(network, variation, config, sets), "parameters": parameters, "seconds": seconds, "steps": steps}


def write_weights(name: str, weights: Path) -> None:
    """Write the network of a run as a weights file that `probe2road build` takes."""
    variation = VARIATIONS[name]
    channels = tuple(CHANNELS[row] for row in variation.rows)
    network = DLinkNet(variation.architecture, channels=len(channels))
    network.load_state_dict(torch.load(weights, weights_only=True))
    info = ModelInfo(name, channels, tile=512, stride=STRIDE, training={"experiment": variation.what})
    export(network, info, weights.with_suffix(".onnx"))


def learn(network: nn.Module, variation: Variation, config: TrainConfig, scenes: list[tuple[Scene, float]]) -> float:
    """Train, and return the seconds of processor time that a step took."""
    sample = replace(config.sample, label_width=variation.label_width)
    optimiser = torch.optim.Adam(network.parameters())
    loss_of = loss_function(variation.loss)
    started = time.process_time()
    for step, (x, y, marks) in enumerate(batches(variation, config, sample, scenes)):
        optimiser.param_groups[0]["lr"] = learning_rate(config, step)
        network.train()
        with torch.autocast("cpu", torch.bfloat16):
            logits = network(x.to(memory_format=torch.channels_last))
        loss = loss_of(logits[:, :1], y, step)
        if variation.keypoints:
            loss = loss + 0.5 * bce_dice(logits[:, 1:], marks)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
    return (time.process_time() - started) / config.steps


def batches(
    variation: Variation, config: TrainConfig, sample: SampleOptions, scenes: list[tuple[Scene, float]]
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield input, label and junction marks; the same places and drives for every variation."""
    weights = np.array([weight for _, weight in scenes])
    for step in range(config.steps):
        batch = []
        for number in range(config.batch):
            rng = np.random.default_rng([config.seed, step, number])
            scene = scenes[int(rng.choice(len(scenes), p=weights / weights.sum()))][0]
            vectors = sample_vectors(scene, rng, sample)
            label = vectors.drawn(sample.label_width).label
            marks = junction_marks(vectors) if variation.keypoints else label
            batch.append((network_channels(variation, vectors), label[None], marks[None]))
        x, y, marked = (np.stack(part).astype(np.float32) for part in zip(*batch, strict=True))
        yield torch.from_numpy(x), torch.from_numpy(y), torch.from_numpy(marked)


def scores(network: nn.Module, variation: Variation, config: TrainConfig, sets: Path) -> dict[str, float]:
    """Validate as training does; labels are those of the shipped width whatever was learned."""
    network.eval()
    squares = validation_squares(config.validation, config.sample, sets)
    (source,) = config.validation.sources
    scene = open_scene(source, sets)
    options = replace(config.sample, size=config.validation.size)
    probabilities = []
    for part in squares:
        x, y = part.grid.left + options.size / 2 - scene.origin[0], part.grid.top - options.size / 2 - scene.origin[1]
        total = np.zeros(part.label.shape, np.float32)
        for turn in range(variation.turns):
            vectors = turned(square_vectors(scene, (x, y), options), turn)
            with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
                logits = network(torch.from_numpy(network_channels(variation, vectors))[None])[0, 0]
            total += np.rot90(torch.sigmoid(logits.float()).numpy(), -turn)
        probabilities.append(thickened(total / np.float32(variation.turns), variation, config))
    return validate(squares, probabilities)


def thickened(probability: NDArray[np.float32], variation: Variation, config: TrainConfig) -> NDArray[np.float32]:
    """Bring a prediction of thinner or thicker lines to the width of the validation labels, for soft F1."""
    more = config.sample.label_width - variation.label_width
    if more > 0:
        return ndimage.grey_dilation(probability, size=(more + 1, more + 1))
    return ndimage.grey_erosion(probability, size=(1 - more, 1 - more)) if more < 0 else probability


def network_channels(variation: Variation, vectors: Vectors) -> NDArray[np.float32]:
    """Input of the network: shape ``(channels, size, size)``."""
    counts = network_input(vectors.drawn(1).counts[list(variation.rows)])
    return counts if variation.extra is None else np.concatenate([counts, variation.extra(vectors)])


def turned(vectors: Vectors, turn: int) -> Vectors:
    """Turn a square by right angles, as numpy.rot90 turns its rasters."""
    for _ in range(turn):
        last = vectors.size - 1
        vectors = replace(
            vectors,
            row=last - vectors.col, col=vectors.row,
            point_row=last - vectors.point_col, point_col=vectors.point_row,
            label_row=last - vectors.label_col, label_col=vectors.label_row,
        )  # fmt: skip
    return vectors


def along_segments(vectors: Vectors) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Places every pixel along the segments: rows and columns within the sample, and the fix each segment ends at."""
    ends = np.flatnonzero(~vectors.breaks)
    d_row, d_col = (np.diff(axis, prepend=axis[:1])[ends] for axis in (vectors.row, vectors.col))
    count = np.maximum(np.maximum(np.abs(d_row), np.abs(d_col)), 1)
    fix = np.repeat(np.arange(len(ends)), count)
    part = (np.arange(len(fix)) - np.repeat(np.cumsum(count) - count, count)) / count[fix]
    row = np.rint(vectors.row[ends][fix] - part * d_row[fix]).astype(np.int64)
    col = np.rint(vectors.col[ends][fix] - part * d_col[fix]).astype(np.int64)
    inside = (row >= 0) & (row < vectors.size) & (col >= 0) & (col < vectors.size)
    return row[inside], col[inside], ends[fix[inside]]


def heading(vectors: Vectors, fix: NDArray[np.int64]) -> NDArray[np.float64]:
    """Direction of the segment that ends at each fix, radians in the sample."""
    return np.arctan2(vectors.row[fix] - vectors.row[fix - 1], vectors.col[fix] - vectors.col[fix - 1])


def heading_mean(vectors: Vectors) -> NDArray[np.float32]:
    """Mean cosine and sine of the headings of the traces of each pixel."""
    row, col, fix = along_segments(vectors)
    angle, pixel, n = heading(vectors, fix), row * vectors.size + col, vectors.size**2
    count = np.maximum(np.bincount(pixel, minlength=n), 1)
    parts = [np.bincount(pixel, wave(angle), n) / count for wave in (np.cos, np.sin)]
    return np.stack(parts).reshape(2, vectors.size, vectors.size).astype(np.float32)


def heading_bins(vectors: Vectors) -> NDArray[np.float32]:
    """Traces of each pixel, counted by heading."""
    row, col, fix = along_segments(vectors)
    bins = np.floor(heading(vectors, fix) / (2 * np.pi) * BINS).astype(np.int64) % BINS
    return layered(vectors, bins, row, col, BINS)


def altitude_layers(vectors: Vectors) -> NDArray[np.float32]:
    """Traces of each pixel, counted by their height above the lowest trace nearby."""
    row, col, fix = along_segments(vectors)
    cells = -(-vectors.size // NEARBY)
    cell = (row // NEARBY) * cells + col // NEARBY
    lowest = np.full(cells * cells, np.inf)
    np.minimum.at(lowest, cell, vectors.z[fix])
    lowest = ndimage.minimum_filter(lowest.reshape(cells, cells), 3).ravel()
    layer = np.searchsorted(LAYERS, vectors.z[fix] - lowest[cell])
    return layered(vectors, layer, row, col, len(LAYERS) + 1)


def layered(
    vectors: Vectors, layer: NDArray[np.int64], row: NDArray[np.int64], col: NDArray[np.int64], layers: int
) -> NDArray[np.float32]:
    """Count places by layer and pixel, and take logarithms."""
    n = vectors.size
    counts = np.bincount((layer * n + row) * n + col, minlength=layers * n * n)
    return network_input(counts.reshape(layers, n, n))


def junction_marks(vectors: Vectors) -> NDArray[np.uint8]:
    """Discs where three or more ends of labelled edges meet."""
    edge = vectors.label_edge
    first = np.r_[True, edge[1:] != edge[:-1]] if len(edge) else np.zeros(0, bool)
    ends = first | np.r_[first[1:], True][: len(edge)]
    places, count = np.unique(np.column_stack([vectors.label_row, vectors.label_col])[ends], axis=0, return_counts=True)
    places = places[count >= 3]
    places = places[((places >= 0) & (places < vectors.size)).all(axis=1)]
    away = np.ones((vectors.size, vectors.size), bool)
    away[tuple(places.T)] = False
    return (
        (ndimage.distance_transform_edt(away) <= KEYPOINT).astype(np.uint8)
        if len(places)
        else np.zeros_like(away, np.uint8)
    )


_compact = partial(replace, ARCHITECTURES["compact"])
_cp = partial(LossOptions, kind="cp", warm_up=300)

VARIATIONS = {
    "base": Variation("as shipped: compact, three channels, BCE + Dice, labels of 3 pixels"),
    "gnss": Variation("traces only", rows=(0,)),
    "width_1": Variation("labels of 1 pixel", label_width=1),
    "width_5": Variation("labels of 5 pixels", label_width=5),
    "cp_2x2": Variation("CP-loss after 300 steps, buffer 2x2", loss=_cp(buffer="2x2")),
    "cp_3x3": Variation("CP-loss after 300 steps, buffer 3x3", loss=_cp(buffer="3x3")),
    "cp_scratch": Variation("CP-loss from the first step, buffer 2x2", loss=_cp(buffer="2x2", warm_up=0)),
    "heading_mean": Variation("and mean cosine and sine of the heading", extra=heading_mean),
    "heading_bins": Variation("and eight channels of heading", extra=heading_bins),
    "altitude": Variation("and three channels of altitude layers", extra=altitude_layers),
    "aligned": Variation("cities and corridors aligned by `align`", data="aligned"),
    "base_on_aligned": Variation("as shipped, validated on aligned data", validated="aligned", weights="base"),
    "aligned_on_aligned": Variation("aligned, validated on aligned data", validated="aligned", weights="aligned"),
    "keypoints": Variation("and a second output for junctions", keypoints=True),
    "turned": Variation("predictions averaged over four right angles", turns=4, weights="base"),
    "fine_1": Variation("skip connections at full and half resolution, labels of 1 pixel", fine=True, label_width=1),
    "shallow": Variation("blocks 2, 2, 2, 2", architecture=_compact(blocks=(2, 2, 2, 2))),
    "narrow": Variation("width 16", architecture=_compact(width=16, centre_width=64)),
    "wide": Variation("width 48", architecture=_compact(width=48, centre_width=192)),
    "head": Variation("32 channels at full resolution", architecture=_compact(head_width=32)),
    "plain_centre": Variation("centre without bottleneck", architecture=_compact(centre_width=None)),
    "attention": Variation("bottleneck transformer", architecture=ARCHITECTURES["compact_attention"]),
    "transformer": Variation("transformer in the centre", architecture=ARCHITECTURES["compact_transformer"]),
}


if __name__ == "__main__":
    main()
