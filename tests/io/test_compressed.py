"""Small files that grow: refused by size before they are read, whatever holds them."""

from __future__ import annotations

import bz2
import gzip
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from probe2road.errors import InputError
from probe2road.io.fleet_reader import read_fleet
from probe2road.io.graph_files import read_graph

MEGABYTES = 40  # that a bomb holds
LIMIT = 0.004  # GB that are allowed
HEADS = {
    "drives.csv.gz": b"trip,time,lon,lat\n",
    "drives.gpx.gz": b'<gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>',
    "roads.osm.gz": b'<osm version="0.6">',
    "roads.osm.bz2": b'<osm version="0.6">',
}
READERS = {"drives": read_fleet, "roads": read_graph}
BILLION_LAUGHS = "".join(f'<!ENTITY l{n} "{f"&l{n - 1};" * 10}">' for n in range(1, 10))


@pytest.mark.parametrize("name", list(HEADS))
def test_a_file_that_grows_beyond_its_limit_is_refused_before_it_is_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    pack: Any = gzip.compress if name.endswith("gz") else bz2.compress
    path.write_bytes(pack(HEADS[name] + b" " * (MEGABYTES << 20)))
    assert path.stat().st_size < 60_000
    read: Any = READERS[path.name.partition(".")[0]]
    tracemalloc.start()
    with pytest.raises(
        InputError, match=r"holds more than 0\.004 GB when it is decompressed; .*max_uncompressed=0\.04"
    ):
        read(path, max_uncompressed=LIMIT)
    assert tracemalloc.get_traced_memory()[1] < MEGABYTES << 20
    tracemalloc.stop()


@pytest.mark.parametrize(("name", "root"), [("drives.gpx", "gpx"), ("roads.osm", "osm"), ("roads.graphml", "graphml")])
def test_entities_that_grow_are_refused(tmp_path: Path, name: str, root: str) -> None:
    path = tmp_path / name
    path.write_text(f'<!DOCTYPE x [<!ENTITY l0 "{"ha" * 50}">{BILLION_LAUGHS}]><{root} version="1.1">&l9;</{root}>')
    read: Any = READERS[path.name.partition(".")[0]]
    with pytest.raises(InputError, match=name):
        read(path)


def test_a_long_gpx_is_read_in_blocks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("probe2road.io.gpx._POINTS", 4)
    monkeypatch.setattr("probe2road.io.gpx._BLOCK", 64)
    fixes = [
        f'<trkpt lat="48.0" lon="{9 + n * 1e-4:.4f}"><time>2024-05-01T08:00:{n:02d}Z</time></trkpt>' for n in range(11)
    ]
    segments = "".join(f"<trkseg>{''.join(part)}</trkseg>" for part in (fixes[:5], fixes[5:]))
    path = tmp_path / "drives.gpx"
    path.write_text(f"<gpx><trk>{segments}</trk></gpx>")
    traces = read_fleet(path).traces
    assert traces["trace_id"].value_counts().tolist() == [6, 5]
    assert traces["t"].dt.second.tolist() == list(range(11))
    assert traces["z"].isna().all()
    path.write_text(path.read_text().replace('lon="9.0007"', 'lon="east"').replace("08:00:09Z", "noon"))
    with pytest.raises(InputError, match=r"lon.* \(x\) is not a number in 1 of 11 rows"):
        read_fleet(path)
