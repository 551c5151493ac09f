"""Damage small files of every format and see what the readers make of them.

A reader may read a damaged file or raise an error of ours; any other exception, a crash, a run of more than
`--seconds` or one that needs more than `--memory` is a fault. Inputs are made from sound files that this program writes
itself; the same `--seed` gives the same changes. Half of the inputs have changed values only, so that what stands
behind the parsers is reached: numbers and words of text, rows and columns of GeoPackage.

Usage: python tools/fuzz.py [--inputs 2000] [--readers graphml osm ...] [--seed 0] [--found FOLDER]
"""

from __future__ import annotations

import argparse
import contextlib
import logging
import multiprocessing
import random
import re
import resource
import shutil
import sqlite3
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import reduce
from multiprocessing.connection import Connection
from operator import xor
from pathlib import Path
from typing import Any

FLEET = ("csv", "parquet", "geoparquet", "gpx", "nmea", "plt", "porto", "clocks", "records", "layer", "layer-gpkg")
GRAPH = ("graph-parquet", "geojson", "gpkg", "fgb", "shp", "graphml", "osm", "pbf", "overpass", "lines", "osmnx")
READERS = FLEET + GRAPH
UTM = "EPSG:32632"

# What breaks readers: limits of number types, times, positions and encodings.
WORDS = (
    *(b"", b"0", b"-1", b"1e308", b"1e400", b"nan", b"inf", b"-inf", b"9223372036854775807", b"18446744073709551616"),
    *(b"null", b"true", b"[]", b"{}", b"\x00", b"\xff\xfe", b"\xc3\x28", b"A" * 300, b"%s%n", b"../..", b"-"),
    *(b"9999-99-99T99:99:99Z", b"0001-01-01T00:00:00Z", b"LINESTRING EMPTY", b"POINT (1 2)", b"EPSG:0", b"EPSG:3857"),
)
NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
TOKEN = re.compile(rb"[\w.:+-]+")


@dataclass
class Outcome:
    """What became of the inputs of one reader."""

    read: int = 0
    refused: int = 0
    others: Counter[str] = field(default_factory=Counter)
    hangs: int = 0
    slowest: float = 0.0  # s

    @property
    def inputs(self) -> int:
        """All inputs that were tried."""
        return self.read + self.refused + self.others.total() + self.hangs


def with_other_values(content: bytes, rng: random.Random) -> bytes:
    """Return a copy of a text with one to three numbers or words exchanged for troublesome ones."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        found = list(rng.choice((NUMBER, TOKEN)).finditer(content))
        if found:
            start, end = rng.choice(found).span()
            content = content[:start] + rng.choice(WORDS) + content[end:]
    return content


def with_other_rows(content: bytes, rng: random.Random) -> bytes:
    """Return a copy of a GeoPackage with values, columns, rows or tables changed through SQLite."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "own.gpkg"
        path.write_bytes(content)
        database = sqlite3.connect(path)
        query = "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name"
        name = rng.choice([row[0] for row in database.execute(query) if not row[0].startswith("sqlite")])
        column = rng.choice([row[1] for row in database.execute(f'PRAGMA table_info("{name}")')])
        word = rng.choice((None, -1, 0, 2**62, 1e308, float("inf"), "", "x", *WORDS))
        where = rng.choice(("", f" WHERE rowid = {rng.randrange(1, 6)}"))
        change = rng.choice(
            (
                *(f'UPDATE "{name}" SET "{column}" = ?{where}',) * 4,
                f'DELETE FROM "{name}"{where}',
                f'ALTER TABLE "{name}" DROP COLUMN "{column}"',
                f'ALTER TABLE "{name}" RENAME COLUMN "{column}" TO other',
                f'DROP TABLE "{name}"',
            )
        )
        # GeoPackage asks for functions that only GDAL has; constraints refuse some changes.
        with contextlib.suppress(sqlite3.Error):
            for trigger in database.execute("SELECT name FROM sqlite_master WHERE type = 'trigger'").fetchall():
                database.execute(f'DROP TRIGGER "{trigger[0]}"')
            database.execute(change, (word,) if "?" in change else ())
        database.commit()
        database.close()
        return path.read_bytes()


def mutated(content: bytes, rng: random.Random) -> bytes:
    """Return a damaged copy: a few changes of bytes, blocks, numbers or words, or the beginning only.

    Examples
    --------
    >>> mutated(b"trip,x,y", random.Random(1)) == mutated(b"trip,x,y", random.Random(1))
    True
    """
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        if not data:
            break
        at = rng.randrange(len(data))
        kind = rng.randrange(9)
        size = min(rng.choice((1, 2, 4, 8, 64, 512)), len(data) - at)
        if kind == 0:
            data[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            data[at : at + size] = rng.randbytes(size)
        elif kind == 2:
            del data[at : at + size]
        elif kind == 3:
            data[at:at] = data[at : at + size] * rng.choice((1, 2, 20))
        elif kind == 4:
            del data[at:]
        elif kind == 5:
            data[at : at + size] = rng.choice((b"\x00", b"\xff", b"\x7f")) * size
        elif kind in (6, 7):
            found = list((NUMBER if kind == 6 else TOKEN).finditer(data))
            if found:
                start, end = rng.choice(found).span()
                data[start:end] = rng.choice(WORDS)
        else:
            other = rng.randrange(len(data))
            block = bytes(data[other : other + size])
            data[at : at + len(block)] = block
    return bytes(data)


def write_seeds(folder: Path) -> dict[str, Path]:
    """Write one sound file for each reader and return their paths; siblings of a file lie beside it."""
    import geopandas as gpd
    import numpy as np
    import pandas as pd
    import pyarrow.parquet as pq
    import shapely

    import probe2road as p2r
    from probe2road.graph.roadgraph import graph_from_lines

    at = {name: folder / name for name in READERS}
    for place in at.values():
        place.mkdir(parents=True)
    step = np.arange(12)
    drives = pd.DataFrame(
        {
            "trace_id": np.repeat(["a", "b"], 6),
            "t": pd.Timestamp("2024-05-01T08:00:00Z") + pd.to_timedelta(step, unit="s"),
            "lon": 9.0 + step * 1e-4,
            "lat": 48.0 + step * 1e-5,
            "z": 400.0 + step,
            "speed": 9.0,
        }
    )
    paths = {"csv": at["csv"] / "drives.csv", "parquet": at["parquet"] / "drives.parquet"}
    drives.to_csv(paths["csv"], index=False)
    drives.to_parquet(paths["parquet"], compression=None)  # so that changes reach the values
    points = gpd.points_from_xy(drives["lon"], drives["lat"], drives["z"])
    paths["geoparquet"] = at["geoparquet"] / "drives.geoparquet"
    gpd.GeoDataFrame(drives.drop(columns=["lon", "lat"]), geometry=points, crs=4326).to_parquet(
        paths["geoparquet"], compression=None
    )
    fixes = "".join(
        f'<trkpt lat="{row.lat:.6f}" lon="{row.lon:.6f}"><ele>{row.z}</ele><time>{row.t:%FT%TZ}</time></trkpt>'
        for row in drives.itertuples()
    )
    paths["gpx"] = at["gpx"] / "drives.gpx"
    head = '<?xml version="1.0"?><gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">'
    paths["gpx"].write_text(f"{head}<trk><name>a</name><trkseg>{fixes}</trkseg></trk></gpx>")

    paths |= _write_other_fleets(at, drives, gpd.GeoDataFrame(drives, geometry=points, crs=4326))

    east, north = 500000.0, 5316000.0
    roads = [[(0, 0), (40, 3), (90, 0)], [(90, 0), (90, 70)], [(90, 0), (150, 1), (200, 0)]]
    lines = [shapely.LineString([(east + x, north + y, 400) for x, y in road]) for road in roads]
    named = pd.DataFrame({"name": ["See", "Berg", "Ä"], "oneway": ["yes", None, "no"], "lanes": [2, 1, 2]})
    graph = graph_from_lines(lines, crs=UTM, attributes=named)
    names = {"graph-parquet": "own.parquet", "pbf": "own.osm.pbf"}
    for kind in ("graph-parquet", "geojson", "gpkg", "fgb", "graphml", "osm", "pbf"):
        paths[kind] = at[kind] / names.get(kind, f"own.{kind}")
        p2r.write_graph(graph, paths[kind])
    for part in at["graph-parquet"].iterdir():
        pq.write_table(pq.read_table(part), part, compression="none")
    plain = gpd.GeoDataFrame(named, geometry=shapely.force_2d(lines), crs=UTM)
    paths["shp"], paths["lines"] = at["shp"] / "ref.shp", at["lines"] / "ref.geojson"
    plain.to_file(paths["shp"])
    plain.to_crs(4326).to_file(paths["lines"])
    paths["osmnx"] = at["osmnx"] / "net.graphml"
    paths["osmnx"].write_text(OSMNX)
    paths["overpass"] = at["overpass"] / "roads.json"
    paths["overpass"].write_text(OVERPASS)
    return paths


def _write_other_fleets(at: dict[str, Path], drives: Any, layer: Any) -> dict[str, Path]:
    """Write the drives as logs, lines, layers, and with times and degrees in words."""

    def summed(body: str) -> str:
        return f"${body}*{reduce(xor, body.encode()):02X}\n"

    names = {"nmea": "drive.nmea", "plt": "drive.plt", "porto": "porto.csv", "clocks": "clocks.csv"}
    names |= {"records": "fixes.json", "layer": "fixes.geojson", "layer-gpkg": "fixes.gpkg"}
    paths = {reader: at[reader] / name for reader, name in names.items()}
    paths["nmea"].write_text(
        "".join(
            summed(f"GPRMC,{row.t:%H%M%S}.00,A,4800.{row.Index:04d},N,00900.0000,E,9.0,90.0,010524,,,A")
            + summed(f"GPGGA,{row.t:%H%M%S}.00,4800.{row.Index:04d},N,00900.0000,E,1,08,0.9,{row.z},M,46.9,M,,")
            for row in drives.itertuples()
        )
    )
    fixes = (f"{row.lat:.6f},{row.lon:.6f},0,492,45413.3,{row.t:%F,%T}\n" for row in drives.itertuples())
    paths["plt"].write_text("Geolife trajectory\nWGS 84\nAltitude is in Feet\nReserved 3\n0\n0\n" + "".join(fixes))
    line = str(drives[["lon", "lat"]].round(6).to_numpy().tolist())
    rows = (f'"{number}","200","{1372636858 + number}","{line}"\n' for number in range(3))
    paths["porto"].write_text('"TRIP_ID","TAXI_ID","TIMESTAMP","POLYLINE"\n' + "".join(rows))
    worded = drives.assign(date=drives["t"].dt.strftime("%d.%m.%Y"), time=drives["t"].dt.strftime("%H:%M:%S"))
    worded = worded.assign(lat=worded["lat"].astype(str) + "N", ew="E", **{"speed (km/h)": 32.4})
    worded.drop(columns=["t", "speed"]).to_csv(paths["clocks"], index=False, sep=";", decimal=",")
    drives.to_json(paths["records"], orient="records", date_format="iso")
    for reader in ("layer", "layer-gpkg"):
        layer.to_file(paths[reader])
    return paths


OSMNX = """<?xml version="1.0"?><graphml xmlns="http://graphml.graphdrawing.org/xmlns">
<key id="c" for="graph" attr.name="crs" attr.type="string"/><key id="y" for="node" attr.name="y" attr.type="string"/>
<key id="x" for="node" attr.name="x" attr.type="string"/><key id="o" for="edge" attr.name="oneway" attr.type="string"/>
<key id="g" for="edge" attr.name="geometry" attr.type="string"/>
<graph edgedefault="directed"><data key="c">epsg:4326</data>
<node id="1"><data key="y">48.0</data><data key="x">9.0</data></node>
<node id="2"><data key="y">48.0</data><data key="x">9.003</data></node>
<edge source="1" target="2" id="0"><data key="o">False</data></edge>
<edge source="2" target="1" id="0"><data key="o">True</data>
<data key="g">LINESTRING (9.003 48.0, 9.001 48.001, 9.0 48.0)</data></edge></graph></graphml>
"""
OVERPASS = """{"version": 0.6, "osm3s": {}, "elements": [
{"type": "node", "id": 1, "lat": 48.0, "lon": 9.0, "tags": {"ele": "400"}},
{"type": "way", "id": 7, "nodes": [1, 2, 3], "geometry": [{"lat": 48.0, "lon": 9.0}, {"lat": 48.0, "lon": 9.003},
{"lat": 48.001, "lon": 9.003}], "tags": {"highway": "residential", "oneway": "yes"}},
{"type": "way", "id": 8, "geometry": [{"lat": 48.0, "lon": 9.0}, null, {"lat": 48.002, "lon": 9.003}],
"tags": {"highway": "service"}}]}
"""


def inputs_of(seed: Path, n: int, rng: random.Random) -> Iterator[dict[str, bytes]]:
    """Yield damaged copies of a file with its siblings; mostly the file itself is damaged, else one of the siblings."""
    sound = {path.name: path.read_bytes() for path in sorted(seed.parent.iterdir())}
    siblings = [name for name in sound if name != seed.name]
    for _ in range(n):
        name = rng.choice(siblings) if siblings and rng.random() < 0.25 else seed.name
        change = mutated if rng.random() < 0.5 else with_other_rows if name.endswith(".gpkg") else with_other_values
        yield {**sound, name: change(sound[name], rng)}


def read(reader: str, path: Path) -> None:
    """Read a file as the program does."""
    import probe2road as p2r
    from probe2road.io.describe import describe_graph

    if reader in FLEET:
        p2r.read_fleet(path)
    else:
        describe_graph(p2r.read_graph(path))


def outcome_of(reader: str, path: Path) -> str:
    """Return ``read``, ``refused``, or the exception that is not ours and where in our code it came up."""
    from probe2road.errors import Probe2RoadError

    try:
        read(reader, path)
    except Probe2RoadError:
        return "refused"
    except BaseException as error:
        frames = [frame for frame in traceback.extract_tb(error.__traceback__) if "/probe2road/" in frame.filename]
        place = f"{Path(frames[-1].filename).stem}.{frames[-1].name}" if frames else "outside"
        return f"{type(error).__name__} in {place}"
    return "read"


def _serve(connection: Connection, memory: int) -> None:
    """Read what is asked for, one file after the other; runs in a process of its own."""
    import probe2road as p2r

    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    _ = p2r.read_fleet, p2r.read_graph  # loads the readers before memory is measured
    if sys.platform == "linux":
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + memory, used + memory))
    while True:
        reader, path = connection.recv()
        connection.send(outcome_of(reader, path))


class Worker:
    """A process that reads files, and is replaced when it hangs or dies."""

    def __init__(self, memory: int) -> None:
        self.memory = memory
        self.start()

    def start(self) -> None:
        """Start the process."""
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, self.memory), daemon=True)
        self.process.start()
        theirs.close()

    def stop(self) -> None:
        """End the process."""
        self.process.kill()
        self.process.join()
        self.connection.close()

    def ask(self, reader: str, path: Path, seconds: float) -> str:
        """Return ``read``, ``refused``, ``hang``, ``crash of the process``, or an exception that is not ours."""
        try:
            self.connection.send((reader, path))
            answer = str(self.connection.recv()) if self.connection.poll(seconds) else "hang"
        except (EOFError, OSError):
            answer = "crash of the process"
        if answer in ("hang", "crash of the process"):
            self.stop()
            self.start()
        return answer


def fuzz(
    reader: str,
    seed: Path,
    *,
    inputs: int,
    rng: random.Random,
    worker: Worker,
    seconds: float = 10.0,
    found: Path | None = None,
) -> Outcome:
    """Try damaged copies of a file, and keep the first of each kind of fault in a folder."""
    if (answer := worker.ask(reader, seed, 10 * seconds)) != "read":
        raise RuntimeError(f"{reader}: the sound file is not read ({answer})")
    outcome = Outcome()
    for files in inputs_of(seed, inputs, rng):
        with tempfile.TemporaryDirectory() as folder:
            for name, content in files.items():
                (Path(folder) / name).write_bytes(content)
            start = time.monotonic()
            answer = worker.ask(reader, Path(folder) / seed.name, seconds)
            outcome.slowest = max(outcome.slowest, time.monotonic() - start)
            if answer == "read":
                outcome.read += 1
            elif answer == "refused":
                outcome.refused += 1
            else:
                if found is not None and answer not in outcome.others:
                    kept = found / f"{reader}-{re.sub(r'[^A-Za-z0-9_.]+', '-', answer)}"
                    shutil.copytree(folder, kept, dirs_exist_ok=True)
                if answer == "hang":
                    outcome.hangs += 1
                else:
                    outcome.others[answer] += 1
    return outcome


HEAD = """| Reader | Inputs | Read | Errors of ours | Others | Hangs | Slowest (s) |
|---|--:|--:|--:|--:|--:|--:|
"""


def row(name: str, one: Outcome) -> str:
    """Return the counts of a reader as a row of a table in Markdown, below `HEAD`."""
    counts = (one.inputs, one.read, one.refused, one.others.total(), one.hangs, f"{one.slowest:.1f}")
    return f"| {name} | {' | '.join(map(str, counts))} |\n"


def main(arguments: list[str] | None = None) -> int:
    """Run from the command line; 1 where a fault was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=2000, help="damaged files for each reader")
    parser.add_argument("--readers", nargs="+", choices=READERS, default=READERS, metavar="READER")
    parser.add_argument("--seed", type=int, default=0, help="of the random changes")
    parser.add_argument("--seconds", type=float, default=10.0, help="time for one file")
    parser.add_argument("--memory", type=int, default=1000, help="megabytes for one file")
    parser.add_argument("--found", type=Path, help="folder that keeps the first input of each kind of fault")
    said = parser.parse_args(arguments)
    outcomes: dict[str, Outcome] = {}
    worker = Worker(said.memory << 20)
    say: Callable[..., Any] = sys.stdout.write
    try:
        with tempfile.TemporaryDirectory() as folder:
            seeds = write_seeds(Path(folder))
            say(HEAD)
            for reader in said.readers:
                rng = random.Random(f"{said.seed} {reader}")
                outcomes[reader] = fuzz(
                    reader,
                    seeds[reader],
                    inputs=said.inputs,
                    rng=rng,
                    worker=worker,
                    seconds=said.seconds,
                    found=said.found,
                )
                say(row(reader, outcomes[reader]))
                for fault, times in outcomes[reader].others.most_common():
                    sys.stderr.write(f"{reader}: {fault} ({times})\n")
                sys.stdout.flush()
    finally:
        worker.stop()
    return int(any(one.others or one.hangs for one in outcomes.values()))


if __name__ == "__main__":
    sys.exit(main())
