"""Preparation of the data sets of the benchmark: one folder each, with checksums and licence, resumable."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import geopandas as gpd
import numpy as np
import pyogrio

from probe2road.benchmark.sets.datasets import OSM_NOTICE, Dataset, find_datasets, load_network
from probe2road.benchmark.sets.recording import Recording, record_fleet
from probe2road.benchmark.sets.residual import ResidualModel
from probe2road.benchmark.sets.tiles import motorway_tiles, split_tiles
from probe2road.errors import InputError
from probe2road.io.atomic import atomic_path, make_folder
from probe2road.run.progress import Progress
from probe2road.simulation.networks.network import RoadNetwork

__all__ = ["check_dataset", "prepare", "prepare_dataset", "read_tiles"]

logger = logging.getLogger(__name__)

_MANIFEST = "manifest.json"
_README = "README.md"
_TILES = "tiles.gpkg"
_BLOCK = 1 << 20  # bytes read at a time


def prepare(
    names: Sequence[str],
    output: str | Path,
    *,
    data: str | Path,
    workers: int = 1,
    progress: Progress | None = None,
) -> list[Path]:
    """Make data sets of the benchmark.

    Parameters
    ----------
    names
        Of data sets or groups; all cities where it is empty.
    output
        Folder that gets a folder for each data set; created where it does not exist.
    data
        Folder of the OpenStreetMap extracts.
    workers
        Processes that simulate; no influence on the result.
    progress
        Called during the work with the progress of each stage.

    Returns
    -------
    list of Path
        The folders, in the order of the names. What is complete is taken as it is; what was interrupted is
        completed.

    Raises
    ------
    OptionError
        If there is no data set of a name; nothing is made then.
    InputError
        If an extract is missing.
    OutputError
        If a folder holds something else or cannot be written.
    """
    chosen = find_datasets(list(names))
    output = Path(output)
    make_folder(output)
    folders = []
    for number, definition in enumerate(chosen, start=1):
        logger.info("data set %s (%d of %d): %s", definition.name, number, len(chosen), definition.role)
        folder = output / definition.name
        prepare_dataset(definition, folder, data=data, workers=workers, progress=_named(progress, definition.name))
        folders.append(folder)
    return folders


def prepare_dataset(
    definition: Dataset,
    folder: str | Path,
    *,
    data: str | Path,
    workers: int = 1,
    residual: ResidualModel | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Make one data set; see `prepare`.

    Parameters
    ----------
    definition
        What to make.
    folder
        Where; its parent must exist.
    data, workers, progress
        As in `prepare`.
    residual
        Errors of the modelled fleet data; the defaults where not given. A fleet without camera has none.

    Returns
    -------
    Recording
        Beside its files there are ``tiles.gpkg`` (where the set has splits), ``README.md`` and, written last,
        ``manifest.json``.

    Examples
    --------
    >>> import tempfile
    >>> from dataclasses import replace
    >>> from probe2road.benchmark.sets.datasets import find_dataset
    >>> tiny = replace(find_dataset("interchange-diamond-1"), drive_km=5.0)
    >>> with tempfile.TemporaryDirectory() as parent:
    ...     made = prepare_dataset(tiny, Path(parent, "tiny"), data="")
    ...     check_dataset(made.folder)
    ...     sorted(path.name for path in made.folder.iterdir())[:4]
    ['README.md', 'drives.parquet', 'drives.points.parquet', 'manifest.json']
    """
    folder = Path(folder)
    network = load_network(definition, data)
    fleet = definition.fleet
    recording = record_fleet(
        network, folder,
        preset=fleet, drive_km=definition.drive_km, seed=definition.seed, workers=workers,
        residual=(residual or ResidualModel()) if fleet.camera else None, progress=progress,
    )  # fmt: skip
    if definition.splits:
        _write_tiles(network, definition, folder / _TILES)
    extract = None if definition.generated else Path(data) / definition.network
    with atomic_path(folder / _README) as temporary:
        temporary.write_text(_readme(definition, recording), encoding="utf-8")
    with atomic_path(folder / _MANIFEST) as temporary:
        temporary.write_text(json.dumps(_manifest(definition, recording, extract), indent=1), encoding="utf-8")
    return recording


def check_dataset(folder: str | Path) -> None:
    """Check that a data set is complete and unchanged.

    Raises
    ------
    InputError
        Naming every file that is missing or differs from its checksum.

    Examples
    --------
    >>> check_dataset("nowhere")
    Traceback (most recent call last):
        ...
    probe2road.errors.InputError: nowhere: there is no manifest.json; prepare the data set
    """
    folder = Path(folder)
    manifest = folder / _MANIFEST
    if not manifest.is_file():
        raise InputError(f"there is no {_MANIFEST}", where=folder, fix="prepare the data set")
    faults = []
    for name, about in json.loads(manifest.read_text(encoding="utf-8"))["files"].items():
        if not (folder / name).is_file():
            faults.append(f"{name} is missing")
        elif _checksum(folder / name) != about["sha256"]:
            faults.append(f"{name} is not as it was made")
    if faults:
        raise InputError.from_faults(faults, where=folder)


def read_tiles(folder: str | Path) -> gpd.GeoDataFrame:
    """Return the tiles of a data set with their splits; see `probe2road.benchmark.sets.tiles.split_tiles`.

    Raises
    ------
    InputError
        If the data set has none.
    """
    path = Path(folder) / _TILES
    if not path.is_file():
        raise InputError("this data set has no splits", where=folder, fix="use it as a whole")
    tiles = gpd.read_file(path).set_index("tile")
    return tiles.assign(split=tiles["split"].fillna(""))


def _write_tiles(network: RoadNetwork, definition: Dataset, path: Path) -> None:
    """Write the tiles with their splits."""
    rng = np.random.default_rng(definition.split_seed)
    tiles = split_tiles(motorway_tiles(network), definition.splits, rng=rng)
    with atomic_path(path) as temporary:
        pyogrio.write_dataframe(tiles.reset_index(), temporary, layer="tiles", driver="GPKG")


def _manifest(definition: Dataset, recording: Recording, extract: Path | None) -> dict[str, Any]:
    """Return all that identifies a data set: definition, run, licence, and a checksum of every file."""
    files = sorted({*recording.files, *recording.folder.glob(_TILES), recording.folder / _README})
    return {
        "definition": asdict(definition),
        "extract_sha256": None if extract is None else _checksum(extract),
        "licence": "ODbL-1.0" if extract is not None else "Apache-2.0",
        "attribution": OSM_NOTICE if extract is not None else "none: the roads are generated",
        "run": recording.run,
        "files": {path.name: {"bytes": path.stat().st_size, "sha256": _checksum(path)} for path in files},
    }


def _readme(definition: Dataset, recording: Recording) -> str:
    """Return a text that explains the folder."""
    counts = recording.run["counts"]
    licence = (
        "The roads are generated: no external data is in it. The licence is that of probe2road, Apache-2.0."
        if definition.generated
        else f"{OSM_NOTICE}\n\nThe roads, and with them this data set, are a derivative database under that licence."
    )
    modelled = "" if not recording.modelled.exists() else (
        "* `modelled.parquet`, `modelled.points.parquet`: the same with the errors that an alignment leaves\n"
    )  # fmt: skip
    tiles = "* `tiles.gpkg`: tiles of 1 km by 1 km and their splits\n" if definition.splits else ""
    return (
        f"# {definition.name}\n\nSimulated fleet data of the probe2road benchmark: {definition.role}.\n"
        f"{counts['drives']:,} drives, {counts['km']:,.0f} km, preset {definition.preset}, seed {definition.seed}.\n\n"
        "* `drives.parquet`, `drives.points.parquet`: raw fleet data (the points only where there is a camera)\n"
        f"{modelled}* `poses.parquet`: the true pose of every fix, in the same order\n"
        "* `routes.parquet`: the road sections that every drive drove\n"
        "* `reference.gpkg`: the true road graph; `support` is the true number of drives\n"
        f"{tiles}* `run.json`, `manifest.json`: how it was made, and checksums\n\n## Licence\n\n{licence}\n"
    )


def _checksum(path: Path) -> str:
    """Return the SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def _named(progress: Progress | None, name: str) -> Progress | None:
    """Return a progress callback that puts the name of the data set before each stage."""
    if progress is None:
        return None
    return lambda stage, done, total: progress(f"{name}: {stage}", done, total)
