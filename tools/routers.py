"""Routing engines that drive on OSM files: OSRM and Valhalla, each prepared from a file and served on this machine.

Both come with wheels for Python 3.12 and later, whose programs run beside any Python: `tools/install_programs.sh`
unpacks them, and the environment variables PROBE2ROAD_OSRM and PROBE2ROAD_VALHALLA name the folders. Tests and
experiments share this module; it is no part of the package.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe2road.matching.osrm import find_osrm

__all__ = ["ENGINES", "Route", "Router"]

_START = 20.0  # s that a server may take to answer


@dataclass(frozen=True)
class Route:
    """What an engine says of a way."""

    length: float  # m
    seconds: float


Router = Callable[[NDArray[np.float64]], Route | None]
"""Places ``(n, 2)`` in degrees to the route from the first to the last; None where there is no way."""


@contextmanager
def osrm(pbf: Path, folder: Path) -> Iterator[Router]:
    """Prepare an OSM file for OSRM's profile for cars, and serve it until the context ends.

    Raises
    ------
    MissingExtraError
        If OSRM is not there.
    """
    home, base = find_osrm(), folder / "roads.osrm"
    profile = home / "share" / "profiles" / "car.lua"
    _run(home / "bin" / "osrm-extract", "--threads", "1", "--profile", profile, "--output", base, pbf)
    for tool in ("osrm-partition", "osrm-customize"):
        _run(home / "bin" / tool, "--threads", "1", base)
    port = _free_port()
    server = home / "bin" / "osrm-routed"
    command: list[str | Path] = [server, "--algorithm", "mld", "--ip", "127.0.0.1", "--port", str(port), base]

    def route(places: NDArray[np.float64]) -> Route | None:
        text = ";".join(f"{lon:.7f},{lat:.7f}" for lon, lat in places)
        answer = _ask(f"http://127.0.0.1:{port}/route/v1/driving/{text}?overview=false")
        return Route(answer["routes"][0]["distance"], answer["routes"][0]["duration"]) if answer else None

    with _served(command, port):
        yield route


@contextmanager
def valhalla(pbf: Path, folder: Path) -> Iterator[Router]:
    """Build Valhalla's tiles of an OSM file, and serve them until the context ends.

    Raises
    ------
    FileNotFoundError
        If Valhalla is not there.
    """
    home = Path(os.environ.get("PROBE2ROAD_VALHALLA") or ".programs/valhalla", "valhalla")
    if not (home / "bin" / "valhalla_service").is_file():
        raise FileNotFoundError(f"{home} holds no bin/valhalla_service: run make programs")
    tiles, config, port = folder / "tiles", folder / "valhalla.json", _free_port()
    tiles.mkdir()
    options = {
        "mjolnir-tile-dir": tiles, "mjolnir-tile-extract": "", "mjolnir-admin": "", "mjolnir-timezone": "",
        "mjolnir-concurrency": 1, "httpd-service-listen": f"tcp://127.0.0.1:{port}",
    }  # fmt: skip
    arguments = [part for name, value in options.items() for part in (f"--{name}", str(value))]
    config.write_text(_run(sys.executable, home / "valhalla_build_config.py", *arguments))
    _run(home / "bin" / "valhalla_build_tiles", "--config", config, pbf)

    def route(places: NDArray[np.float64]) -> Route | None:
        # Where few roads can be reached from, Valhalla would look for a place elsewhere.
        locations = [{"lon": lon, "lat": lat, "minimum_reachability": 0} for lon, lat in places.tolist()]
        answer = _ask(f"http://127.0.0.1:{port}/route", {"locations": locations, "costing": "auto"})
        summary = answer["trip"]["summary"] if answer else {}
        return Route(summary["length"] * 1000.0, summary["time"]) if answer else None

    with _served([home / "bin" / "valhalla_service", "--inproc-sockets", config, "1"], port):
        yield route


ENGINES = {"osrm": osrm, "valhalla": valhalla}


def _ask(url: str, body: Mapping[str, Any] | None = None) -> dict[str, Any] | None:
    """Return the answer of a server, None where it finds no way."""
    try:
        data = None if body is None else json.dumps(body).encode()
        with urllib.request.urlopen(urllib.request.Request(url, data=data), timeout=30) as answer:
            return dict(json.load(answer))
    except urllib.error.HTTPError as error:
        if error.code == 400:
            return None
        raise


@contextmanager
def _served(command: list[str | Path], port: int) -> Iterator[None]:
    """Run a server until the context ends."""
    server = subprocess.Popen([str(part) for part in command], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        started = time.monotonic()
        while time.monotonic() - started < _START:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        yield
    finally:
        server.terminate()
        server.wait()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _run(*command: str | Path) -> str:
    """Run a program, and return what it prints."""
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{command[0]} ended with {done.returncode}: {(done.stdout + done.stderr)[-500:]}")
    return done.stdout
