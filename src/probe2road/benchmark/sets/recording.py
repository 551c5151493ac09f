"""A simulated fleet on disk, written while it is driven: memory is limited, and an interrupted run continues.

Strategy: the drives come in portions, and each portion becomes one folder of small Parquet files, which is complete
or absent. When all portions are there they are joined, file by file, into the tables of the recording. A drive
depends on the seed and its number alone, so the result is the same whether a run was interrupted or not.
"""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from probe2road.benchmark.sets.residual import ResidualModel, align_drives
from probe2road.errors import OptionError, OutputError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path, make_folder, sweep_leftovers
from probe2road.io.fleet_writer import ROW_GROUP, bounding_box, point_table, with_geo
from probe2road.io.graph_files import write_graph
from probe2road.run.locks import holder, locked
from probe2road.run.progress import Progress
from probe2road.simulation.fleet_simulation import FleetChunk, simulate_chunks
from probe2road.simulation.networks.network import RoadNetwork
from probe2road.simulation.presets import Preset, find_preset
from probe2road.simulation.records import count_drives

__all__ = ["POSES", "RUN_FILE", "Recording", "record_fleet"]

logger = logging.getLogger(__name__)

RUN_FILE = "run.json"

# Poses that a fleet may have: from `probe2road align`, from the model of what an alignment leaves, or as recorded.
POSES = ("aligned", "modelled", "raw")

_FORMAT = 2  # raised when what a recording holds changes
_PORTIONS, _LOCK = ".portions", ".lock"
_DRIVES = 20  # drives in a portion: some 300 km, 600,000 points
# Table of a portion to the file that the tables of all portions become.
_FILES = {
    "traces": "drives.parquet",
    "points": "drives.points.parquet",
    "modelled_traces": "modelled.parquet",
    "modelled_points": "modelled.points.parquet",
    "poses": "poses.parquet",
    "routes": "routes.parquet",
}
_REFERENCE = "reference.gpkg"


@dataclass(frozen=True)
class Recording:
    """The files that `record_fleet` writes for a simulated fleet, in one folder."""

    folder: Path

    @property
    def drives(self) -> Path:
        """Return the file of raw traces; the points, if there is a camera, are beside it."""
        return self.folder / _FILES["traces"]

    @property
    def modelled(self) -> Path:
        """Return the file of traces with the modelled errors of an alignment; it may be missing."""
        return self.folder / _FILES["modelled_traces"]

    @property
    def aligned(self) -> Path:
        """Return the file of traces from `probe2road.benchmark.sets.aligning.align_dataset`; it may be missing."""
        return self.folder / "aligned.parquet"

    def traces(self, poses: str) -> Path:
        """Return the file of traces with the given poses, one of `POSES`."""
        return {"aligned": self.aligned, "modelled": self.modelled, "raw": self.drives}[poses]

    @property
    def poses(self) -> Path:
        """Return the file of true poses, row by row those of the traces."""
        return self.folder / _FILES["poses"]

    @property
    def routes(self) -> Path:
        """Return the file of the driven sections."""
        return self.folder / _FILES["routes"]

    @property
    def reference(self) -> Path:
        """Return the file of the true road graph with the true numbers of drives."""
        return self.folder / _REFERENCE

    @property
    def run(self) -> dict[str, Any]:
        """Return how the recording was made: preset, seed, amount, versions, counts."""
        return dict(json.loads((self.folder / RUN_FILE).read_text(encoding="utf-8")))

    @property
    def files(self) -> list[Path]:
        """Return all existing files of the recording, sorted by name."""
        names = [*_FILES.values(), _REFERENCE, RUN_FILE]
        return sorted(self.folder / name for name in names if (self.folder / name).exists())


def record_fleet(
    network: RoadNetwork,
    folder: str | Path,
    *,
    preset: str | Path | Preset = "mixed",
    n_drives: int | None = None,
    drive_km: float | None = None,
    seed: int = 0,
    workers: int = 1,
    residual: ResidualModel | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Simulate a fleet, and write its recorded data and the truth to a folder.

    Parameters
    ----------
    network
        The roads.
    folder
        Created where it does not exist. A recording of another run in it is replaced; one of the same run is taken
        as it is, or completed.
    preset, n_drives, drive_km, seed, workers
        As in `probe2road.simulation.fleet_simulation.simulate`. The workers have no influence on the result.
    residual
        Also write the fleet data that an alignment with these residual errors would leave. A fleet without camera
        cannot be aligned.
    progress
        Called with the drives or kilometres done and wanted.

    Returns
    -------
    Recording
        ``drives.parquet`` and ``drives.points.parquet`` (raw fleet data, which `probe2road.read_fleet` reads),
        ``modelled.parquet`` and ``modelled.points.parquet``, ``poses.parquet``, ``routes.parquet``,
        ``reference.gpkg``, ``run.json``. The last is written last.

    Raises
    ------
    OptionError
        If the amount is missing, given twice or not positive, the preset is unknown, or a fleet without camera is
        to be aligned.
    OutputError
        If the folder has files in it that are not those of a recording, if another process works in it, or if it cannot
        be created.

    Examples
    --------
    >>> import tempfile
    >>> from probe2road.simulation.networks.network import network_from_sections
    >>> network = network_from_sections([[(0, 0), (2000, 0)]], crs="EPSG:32616")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     recording = record_fleet(network, folder, n_drives=3, seed=7)
    ...     [path.name for path in recording.files], recording.run["counts"]["drives"]
    (['drives.parquet', 'drives.points.parquet', 'poses.parquet', 'reference.gpkg', 'routes.parquet', 'run.json'], 3)
    """
    chosen = find_preset(preset)
    if (n_drives is None) == (drive_km is None) or not (n_drives or drive_km or 0) > 0:
        raise OptionError(
            f"n_drives is {n_drives}, drive_km is {drive_km}", where="record_fleet", fix="give one, above 0"
        )
    if residual is not None and chosen.camera is None:
        raise OptionError(f"preset {chosen.name!r} has no camera to align by", where="record_fleet", fix="use another")
    run = {
        "format": _FORMAT,
        "network": _fingerprint(network),
        "preset": asdict(chosen),
        "n_drives": n_drives,
        "drive_km": drive_km,
        "seed": seed,
        "residual": None if residual is None else asdict(residual),
        "versions": {name: version(name) for name in ("probe2road", "numpy")},
    }
    recording = Recording(Path(folder))
    make_folder(recording.folder)
    with locked(recording.folder, _LOCK, mark=f"{_PORTIONS}/{RUN_FILE}"):
        portions = _open(recording.folder, json.loads(json.dumps(run)))
        if portions is None:
            logger.info("taking %s from an earlier run", recording.folder)
            return recording
        amount = {"n_drives": n_drives, "drive_km": drive_km}
        _simulate_portions(network, chosen, portions, amount, seed, workers, residual, progress)
        counts = _join(network, portions, recording, run)
    logger.info(
        "recorded %d drives, %.0f km: %d poses, %d points in %s",
        counts["drives"], counts["km"], counts["traces"], counts["points"], recording.folder,
    )  # fmt: skip
    return recording


def _open(folder: Path, run: Mapping[str, Any]) -> Path | None:
    """Prepare the folder: where the portions go, or None if this very recording is there already."""
    done, portions = folder / RUN_FILE, folder / _PORTIONS
    mark = portions / RUN_FILE
    sweep_leftovers(folder)
    if portions.is_dir():
        sweep_leftovers(portions)
        if not any(portions.iterdir()):
            portions.rmdir()  # of a run that was killed before its mark
    if done.exists():
        if _same_run(done, run):
            shutil.rmtree(portions, ignore_errors=True)
            return None
        done.unlink()  # what lies beside it is no longer complete
    elif not mark.exists() and any(path.name != _LOCK for path in folder.iterdir()):
        raise OutputError("the folder is not empty and not a recording", where=folder, fix="name an empty folder")
    if not (mark.exists() and _same_run(mark, run)):
        shutil.rmtree(portions, ignore_errors=True)
        portions.mkdir()
    with atomic_path(mark) as temporary:
        temporary.write_text(json.dumps({**run, **holder()}, indent=1), encoding="utf-8")
    return portions


def _same_run(path: Path, run: Mapping[str, Any]) -> bool:
    kept = json.loads(path.read_text(encoding="utf-8"))
    return all(kept.get(name) == value for name, value in run.items())


def _simulate_portions(
    network: RoadNetwork,
    preset: Preset,
    portions: Path,
    amount: Mapping[str, float | None],
    seed: int,
    workers: int,
    residual: ResidualModel | None,
    progress: Progress | None,
) -> None:
    """Simulate the missing drives, and write them portion by portion."""
    number, driven_km = 0, 0.0
    for path in _complete(portions):
        number, driven_km = number + _about(path)["drives"], driven_km + _about(path)["km"]
    wanted, done = (amount["n_drives"], number) if amount["n_drives"] is not None else (amount["drive_km"], driven_km)
    if number:
        logger.info("going on behind drive %d (%.0f km)", number - 1, driven_km)
    if wanted is not None and number and done >= wanted:
        return
    left = {name: None if value is None else value - done for name, value in amount.items()}
    chunks = simulate_chunks(
        network, preset=preset, seed=seed, workers=workers, first_drive=number, chunk_drives=_DRIVES,
        n_drives=None if left["n_drives"] is None else int(left["n_drives"]), drive_km=left["drive_km"],
    )  # fmt: skip
    for part, chunk in enumerate(chunks, start=len(_complete(portions))):
        _write_portion(chunk, portions / f"{part:06d}", residual, seed)
        number, driven_km = number + len(chunk.length), driven_km + float(chunk.length.sum()) / 1000.0
        if progress is not None and wanted is not None:
            progress(
                "drives" if amount["n_drives"] is not None else "km", _done(amount, number, driven_km), int(wanted)
            )


def _done(amount: Mapping[str, float | None], number: int, km: float) -> int:
    """Return how much of the required amount is done."""
    return number if amount["n_drives"] is not None else min(int(km), int(amount["drive_km"] or 0))


def _complete(portions: Path) -> list[Path]:
    """Return the folders of the portions that exist; they are written in order, so none is missing between them."""
    return sorted(path for path in portions.iterdir() if path.is_dir() and not path.name.startswith("."))


def _about(portion: Path) -> dict[str, Any]:
    return dict(json.loads((portion / "about.json").read_text(encoding="utf-8")))


def _write_portion(chunk: FleetChunk, path: Path, residual: ResidualModel | None, seed: int) -> None:
    """Write one portion as a folder that is complete or absent."""
    tables = {name: getattr(chunk, name) for name in ("traces", "points", "poses", "routes")}
    if residual is not None:
        traces, points = align_drives(chunk.traces, chunk.points, chunk.poses, residual, seed=seed)
        tables |= {"modelled_traces": traces, "modelled_points": points}
    boxes = {}
    with atomic_path(path) as temporary:
        temporary.mkdir()
        for name, table in tables.items():
            placed = "x" in table
            columns = point_table(table) if placed else pa.Table.from_pandas(table, preserve_index=False)
            pq.write_table(columns, temporary / f"{name}.parquet", compression="zstd")
            boxes[name] = bounding_box(table) if placed else None
        about = {"drives": len(chunk.length), "km": float(chunk.length.sum()) / 1000.0, "boxes": boxes}
        (temporary / "about.json").write_text(json.dumps(about), encoding="utf-8")


def _join(network: RoadNetwork, portions: Path, recording: Recording, run: Mapping[str, Any]) -> dict[str, float]:
    """Join the portions to the files of the recording; the last file marks the recording as complete."""
    parts = _complete(portions)
    abouts = [_about(part) for part in parts]
    counts: dict[str, float] = {"drives": sum(about["drives"] for about in abouts)}
    counts["km"] = round(sum(about["km"] for about in abouts), 3)
    crs = network.crs.to_json_dict()
    for name, file in _FILES.items():
        boxes = [box for about in abouts if (box := about["boxes"].get(name)) is not None]
        target = recording.folder / file
        target.unlink(missing_ok=True)
        if boxes or name == "routes":
            counts[name] = _join_table(parts, name, target, crs, boxes)
    write_graph(_counted(network, parts), recording.reference)
    counts.setdefault("points", 0)
    with atomic_path(recording.folder / RUN_FILE) as temporary:
        temporary.write_text(json.dumps({**run, "counts": counts}, indent=1), encoding="utf-8")
    shutil.rmtree(portions)
    return counts


def _join_table(parts: list[Path], name: str, target: Path, crs: Mapping[str, Any], boxes: list[list[float]]) -> int:
    """Copy a table of all portions into one file, with at least one row group for each; return the number of rows."""
    schema = pq.read_schema(parts[0] / f"{name}.parquet")
    if boxes:
        lows, highs = np.min(boxes, axis=0)[:2], np.max(boxes, axis=0)[2:]
        schema = with_geo(schema, crs, [*lows, *highs])
    # Times and ids rise in small steps: their differences take a third of the space.
    rising = {column: "DELTA_BINARY_PACKED" for column in ("trace_id", "t") if column in schema.names}
    repeated = [column for column in ("kind", "section", "lane") if column in schema.names]
    rows = 0
    with (
        atomic_path(target) as temporary,
        pq.ParquetWriter(
            temporary, schema, compression="zstd", use_dictionary=repeated, column_encoding=rising
        ) as writer,
    ):
        for part in parts:
            table = pq.read_table(part / f"{name}.parquet", partitioning=None)
            writer.write_table(table.replace_schema_metadata(schema.metadata), row_group_size=ROW_GROUP)
            rows += table.num_rows
    return rows


def _counted(network: RoadNetwork, parts: list[Path]) -> RoadGraph:
    """Return the true road graph with the drives of all portions added; no drive is in two portions."""
    reference = network.reference_graph()
    columns = ["support", "forward", "backward"]
    total = pd.DataFrame(0, index=reference.edges.index, columns=columns, dtype="Int64")
    turns = [reference.turns]
    for routes in _routes(parts):
        counted = count_drives(reference, routes)
        total += counted.edges[columns]
        turns.append(counted.turns)
    keys = ["from_edge", "via_node", "to_edge"]
    joined = pd.concat(turns, ignore_index=True).groupby(keys, as_index=False)["count"].sum().astype("int64")
    return replace(reference, edges=reference.edges.assign(**total), turns=joined)


def _routes(parts: list[Path]) -> Iterator[pd.DataFrame]:
    """Yield the routes of each portion."""
    return (pq.read_table(part / "routes.parquet", partitioning=None).to_pandas() for part in parts)


def _fingerprint(network: RoadNetwork) -> str:
    """Return a digest of everything in a network on which drives depend."""
    digest = hashlib.blake2b(f"{network.crs.to_wkt()}{network.driving_side}{network.markings}".encode(), digest_size=16)
    for table in (network.sections.drop(columns="geometry"), network.restrictions):
        digest.update(table.to_csv().encode())
    for line in shapely.to_wkb(network.sections.geometry.to_numpy()):
        digest.update(line)
    return digest.hexdigest()
