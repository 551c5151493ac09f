"""Routing engines that drive on OSM files: OSRM and Valhalla, each prepared from a file and served on this machine.

Both come with wheels for Python 3.12 and later, whose programs run beside any Python: `tools/install_programs.sh`
unpacks them, and the environment variables PROBE2ROAD_OSRM and PROBE2ROAD_VALHALLA name the folders. Tests and
experiments share this module; it is no part of the package.
"""

from __future__ import annotations

import json
import os
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from probe2road.matching.osrm import serve_osm
from probe2road.matching.servers import free_port, run_program, served

__all__ = ["ENGINES", "Route", "Router"]


@dataclass(frozen=True)
class Route:
    """What an engine says of a way."""

    length: float  # m
    seconds: float


Router = Callable[[NDArray[np.float64]], Route | None]
"""Places ``(n, 2)`` in degrees to the route from the first to the last; None where there is no way."""


@contextmanager
def osrm(pbf: Path) -> Iterator[Router]:
    """Prepare an OSM file for OSRM's profile for cars, beside it, and serve it until the context ends.

    Raises
    ------
    MissingExtraError
        If OSRM is not there.
    """
    with serve_osm(pbf) as url:

        def route(places: NDArray[np.float64]) -> Route | None:
            text = ";".join(f"{lon:.7f},{lat:.7f}" for lon, lat in places)
            answer = _ask(f"{url}/route/v1/driving/{text}?overview=false")
            return Route(answer["routes"][0]["distance"], answer["routes"][0]["duration"]) if answer else None

        yield route


@contextmanager
def valhalla(pbf: Path) -> Iterator[Router]:
    """Build Valhalla's tiles of an OSM file, beside it, and serve them until the context ends.

    Raises
    ------
    FileNotFoundError
        If Valhalla is not there.
    """
    home = Path(os.environ.get("PROBE2ROAD_VALHALLA") or ".programs/valhalla", "valhalla")
    if not (home / "bin" / "valhalla_service").is_file():
        raise FileNotFoundError(f"{home} holds no bin/valhalla_service: run make programs")
    tiles, config, port = pbf.with_name("tiles"), pbf.with_name("valhalla.json"), free_port()
    tiles.mkdir()
    options = {
        "mjolnir-tile-dir": tiles, "mjolnir-tile-extract": "", "mjolnir-admin": "", "mjolnir-timezone": "",
        "mjolnir-concurrency": 1, "httpd-service-listen": f"tcp://127.0.0.1:{port}",
    }  # fmt: skip
    arguments = [part for name, value in options.items() for part in (f"--{name}", str(value))]
    config.write_text(run_program(sys.executable, home / "valhalla_build_config.py", *arguments, where="Valhalla"))
    run_program(home / "bin" / "valhalla_build_tiles", "--config", config, pbf, where="Valhalla")

    def route(places: NDArray[np.float64]) -> Route | None:
        # Where few roads can be reached from, Valhalla would look for a place elsewhere.
        locations = [{"lon": lon, "lat": lat, "minimum_reachability": 0} for lon, lat in places.tolist()]
        answer = _ask(f"http://127.0.0.1:{port}/route", {"locations": locations, "costing": "auto"})
        summary = answer["trip"]["summary"] if answer else {}
        return Route(summary["length"] * 1000.0, summary["time"]) if answer else None

    service = home / "bin" / "valhalla_service"
    with served(service, "--inproc-sockets", config, "1", port=port, where="Valhalla"):
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
