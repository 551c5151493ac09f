"""Train the network of the baseline DeepMG on the training split of a benchmark data set.

    python experiments/train_deepmg.py CONFIG.toml DATASET_FOLDER OUTPUT_FOLDER

The first call computes the features of all tiles into OUTPUT_FOLDER; every call goes on from the last complete epoch.
"""

from __future__ import annotations

import argparse
import logging
from dataclasses import dataclass, field
from pathlib import Path

import geopandas as gpd

from probe2road.baselines.deepmg.features import FeatureOptions, thin_traces
from probe2road.baselines.deepmg.tiles import TileSet, open_tiles, tile_grids, write_tiles
from probe2road.baselines.deepmg.training import TrainOptions, train
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.errors import InputError
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.graph_files import read_graph
from probe2road.options import load_options

logger = logging.getLogger("train_deepmg")


@dataclass(frozen=True)
class Config:
    """What the TOML file may set."""

    variant: str = "fixed"  # or as_published
    min_drives: int = 4  # drives that an edge of the reference needs to be a label
    features: FeatureOptions = field(default_factory=FeatureOptions)
    training: TrainOptions = field(default_factory=TrainOptions)


def main() -> None:
    """Prepare what is missing, then train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path, help="TOML file")
    parser.add_argument("dataset", type=Path, help="folder made by: probe2road benchmark prepare")
    parser.add_argument("output", type=Path, help="folder for tiles, checkpoint and weights")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s: %(message)s")
    config = load_options(arguments.config, Config)
    arguments.output.mkdir(parents=True, exist_ok=True)
    tiles, validation = prepare(arguments.dataset, arguments.output, config)
    weights = train(tiles, validation, arguments.output, config.training)
    logger.info("the best weights are in %s", weights)


def prepare(dataset: Path, output: Path, config: Config) -> tuple[TileSet, TileSet]:
    """Return the tiles for training and validation, from an earlier call where they are complete."""
    folders = {split: output / f"tiles-{split}" for split in ("train", "validation")}
    if not all(folder.is_dir() for folder in folders.values()):
        steps = thin_traces(read_fleet(dataset / "modelled.parquet"), config.features)
        reference = labelled_reference(read_graph(dataset / "reference.gpkg"), min_drives=config.min_drives)
        squares = gpd.read_file(dataset / "tiles.gpkg")
        for split, folder in folders.items():
            chosen = squares.geometry[squares["split"] == split].to_numpy()
            grids = tile_grids(chosen, resolution=config.features.resolution, crs=squares.crs)
            write_tiles(folder, steps, reference, grids, variant=config.variant, features=config.features)
    tiles, validation = (open_tiles(folder) for folder in folders.values())
    if (tiles.variant, tiles.features) != (config.variant, config.features):
        raise InputError("the tiles are of another configuration", where=output, fix="name another folder")
    return tiles, validation


if __name__ == "__main__":
    main()
