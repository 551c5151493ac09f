"""Routing engines that drive on the OSM files that are written: `from routers import ENGINES`.

Both come with wheels for Python 3.12 and later, whose programs run beside any Python: `tools/install_programs.sh`
unpacks them, and environment variables name the folders.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from probe2road.errors import MissingExtraError
from probe2road.matching.osrm import find_osrm

Router = Callable[[NDArray[np.float64]], "Route | None"]  # places (n, 2) in degrees to the route from first to last


@dataclass(frozen=True)
class Route:
    """What an engine says of a way."""

    length: float  # m
    seconds: float


@contextmanager
def osrm(pbf: Path, folder: Path) -> Iterator[Router]:
    """Prepare an OSM file for OSRM's profile for cars, and serve it."""
    try:
        home = find_osrm()
    except MissingExtraError as error:
        pytest.skip(str(error))
    base = folder / "roads.osrm"
    _run(
        home / "bin" / "osrm-extract", "--threads", "1", "--profile", home / "share" / "profiles" / "car.lua",
        "--output", base, pbf,
    )  # fmt: skip
    for tool in ("osrm-partition", "osrm-customize"):
        _run(home / "bin" / tool, "--threads", "1", base)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [home / "bin" / "osrm-routed", "--algorithm", "mld", "--ip", "127.0.0.1", "--port", str(port), base]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def route(places: NDArray[np.float64]) -> Route | None:
        text = ";".join(f"{lon:.7f},{lat:.7f}" for lon, lat in places)
        url = f"http://127.0.0.1:{port}/route/v1/driving/{text}?overview=false"
        try:
            with urllib.request.urlopen(url, timeout=10) as answer:
                best = json.load(answer)["routes"][0]
        except urllib.error.HTTPError:
            return None
        return Route(best["distance"], best["duration"])

    try:
        for _ in range(100):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        yield route
    finally:
        server.terminate()
        server.wait()


@contextmanager
def valhalla(pbf: Path, folder: Path) -> Iterator[Router]:
    """Build Valhalla's tiles of an OSM file; every route is a run of its program."""
    home = Path(os.environ.get("PROBE2ROAD_VALHALLA", ""), "valhalla")
    if not (home / "bin" / "valhalla_service").is_file():
        pytest.skip("PROBE2ROAD_VALHALLA names no folder with Valhalla: run make programs")
    tiles, config = folder / "tiles", folder / "valhalla.json"
    tiles.mkdir()
    options = {"tile-dir": tiles, "tile-extract": "", "admin": "", "timezone": "", "concurrency": 1}
    arguments = [part for name, value in options.items() for part in (f"--mjolnir-{name}", str(value))]
    config.write_text(_run(sys.executable, home / "valhalla_build_config.py", *arguments))
    _run(home / "bin" / "valhalla_build_tiles", "--config", config, pbf)

    def route(places: NDArray[np.float64]) -> Route | None:
        locations = [{"lon": lon, "lat": lat} for lon, lat in places.tolist()]
        request = json.dumps({"locations": locations, "costing": "auto"})
        command = [home / "bin" / "valhalla_service", config, "route", request]
        answer = subprocess.run(command, capture_output=True, text=True, check=False)
        trip = json.loads(answer.stdout).get("trip") if answer.stdout.startswith("{") else None
        if trip is None:
            return None
        return Route(trip["summary"]["length"] * 1000.0, trip["summary"]["time"])

    yield route


ENGINES = {"osrm": osrm, "valhalla": valhalla}


def _run(*command: str | Path) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{command[0]}: {done.stdout[-500:]}{done.stderr[-500:]}"
    return done.stdout
