"""The learned segmenter: a network from a weights file, applied to the area tile by tile."""

from __future__ import annotations

import logging
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from probe2road.bounds import AtLeast, AtMost, OneOf, Positive
from probe2road.errors import InputError, MissingFileError, OptionError
from probe2road.fleet.contract import Fleet
from probe2road.options import checked
from probe2road.raster.counts import CHANNELS
from probe2road.raster.grid import Grid
from probe2road.segmentation.runtime import DEVICES, PRECISIONS, RUNTIMES, load_network, run_network
from probe2road.segmentation.segmenter import Segmenter
from probe2road.segmentation.weights import Weights, network_input, read_weights

__all__ = ["NetworkOptions", "find_weights", "network_segmenter", "shipped_weights"]

logger = logging.getLogger(__name__)

_STEPS = np.float32(2**16)  # of the probability between 0 and 1: fewer digits compress better
_NO_NETWORK = 'use segmenter="density"'


@dataclass(frozen=True)
@checked
class NetworkOptions:
    """Which network runs, and how."""

    weights: str | None = None  # file; None: the shipped one that suits the fleet
    device: Annotated[str, OneOf(*DEVICES)] = "cpu"  # or "cuda"
    threads: Positive[int] | None = None  # largest number of threads; None: one for each core
    runtime: Annotated[str, OneOf(*RUNTIMES)] | None = None  # None: OpenVINO where it is installed, else onnxruntime
    precision: Annotated[str, OneOf(*PRECISIONS)] | None = None  # None: bfloat16 where processor and runtime have it
    tile: Positive[int] | None = None  # px, side of the tiles that the network sees; None: that of the model
    overlap: Annotated[float, AtLeast(0), AtMost(0.9)] = 0.25  # of neighbouring tiles, share of their side; paper: 0.5
    turns: Annotated[int, AtLeast(1), AtMost(4)] = 1  # rotations of every tile by right angles, whose mean is taken


def shipped_weights(*, points: bool) -> Path:
    """Return the weights file that comes with probe2road, for fleets with semantic points or for traces alone.

    Raises
    ------
    InputError
        If this installation has none.
    """
    name = "gnss-vision.onnx" if points else "gnss.onnx"
    path = Path(str(resources.files("probe2road").joinpath("weights", name)))
    if not path.is_file():
        raise MissingFileError("this installation has no weights", where=path, fix=f"name a file, or {_NO_NETWORK}")
    return path


def find_weights(fleet: Fleet, options: NetworkOptions) -> Weights:
    """Read the weights for a fleet: those in the options, or the shipped ones that use all of the fleet's channels.

    Raises
    ------
    InputError
        If the file is bad, or its network looks at what the fleet does not have.
    """
    points = len(fleet.points) > 0
    weights = read_weights(options.weights or shipped_weights(points=points))
    wanted = weights.info.channels
    unknown = [name for name in wanted if name not in CHANNELS]
    if unknown:
        raise InputError(f"no raster has the channels {', '.join(unknown)}", where=weights.path, fix=_NO_NETWORK)
    if not points and wanted != CHANNELS[:1]:
        raise InputError(
            f"the network looks at {', '.join(wanted)}, and the fleet has no semantic points",
            where=weights.path,
            fix="give the points, or weights for traces alone",
        )
    return weights


def network_segmenter(weights: Weights, grid: Grid, options: NetworkOptions | None = None) -> Segmenter:
    """Return the learned segmenter for a fleet.

    Parameters
    ----------
    weights
        From `find_weights` or `probe2road.segmentation.weights.read_weights`.
    grid
        Grid of the rasters to come.
    options
        How to run the network.

    Returns
    -------
    Segmenter
        Named ``network``.

    Raises
    ------
    OptionError
        If the grid has another resolution than the network was trained at, the tile does not suit the network, or
        the device is absent.
    InputError
        If the network cannot be run.

    Notes
    -----
    Paper, section III-B. Tiles overlap as METHOD 0.1 row 13 says; see `probe2road.segmentation.tiling`.
    """
    options = options or NetworkOptions()
    info = replace(weights.info, tile=options.tile or weights.info.tile)
    if not np.isclose(grid.resolution, info.resolution):
        raise OptionError(
            f"the network sees pixels of {info.resolution} m, the raster has {grid.resolution} m",
            where=weights.path,
            fix=f'use resolution={info.resolution} or segmenter="density"',
        )
    network = load_network(
        weights,
        device=options.device,
        threads=options.threads,
        runtime=options.runtime,
        precision=options.precision,
    )
    channels = [CHANNELS.index(name) for name in info.channels]
    halo = int(info.tile * options.overlap / 2)

    def predict(counts: NDArray[np.uint32], _grid: Grid) -> NDArray[np.float32]:
        present, rows, cols = counts.shape
        if present <= max(channels):
            what = f"the raster has {present} channels, the network wants {', '.join(info.channels)}"
            raise InputError(what, where=weights.path, fix=f"give the channels {', '.join(CHANNELS)}")
        seen = np.zeros((1, len(channels), info.tile, info.tile), np.float32)  # at the far edges too
        seen[0, :, :rows, :cols] = network_input(counts[channels])
        turned = (run_network(network, np.rot90(seen, k, (2, 3)))[0] for k in range(options.turns))
        probability = sum(np.rot90(part, -k) for k, part in enumerate(turned))[:rows, :cols] / options.turns
        return np.asarray(np.round(probability * _STEPS) / _STEPS, np.float32)

    return Segmenter(
        name="network",
        predict=predict,
        window=info.tile - 2 * halo,
        halo=halo,
        blend=True,
        threshold=info.threshold,
        seed_threshold=info.seed_threshold,
        parameters={"model": info.name, "digest": weights.digest, **asdict(options)},
    )
