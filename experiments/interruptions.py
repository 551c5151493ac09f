"""Kill build, align and simulate at random moments, start them again, and compare with a run that was left alone.

    python experiments/interruptions.py --kills 200

Every run is a process of its own that gets SIGKILL at a random moment of the time that the uninterrupted run takes. The
same command is then started again, and must end with exit code 0, the same bytes in every file, and nothing else in the
folder. The moments come from ``--seed``. A GeoPackage holds the time of its last change, which is fixed here.
"""

from __future__ import annotations

import argparse
import hashlib
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probe2road.cli.main import main as command_line
from probe2road.demo import demo_fleet
from probe2road.io.fleet_writer import write_fleet

os.environ.setdefault("OGR_CURRENT_DATE", "2000-01-01T00:00:00.000Z")

_OSM = """<osm version="0.6" generator="experiments">
<node id="1" lat="52.5" lon="13.4" version="1"/><node id="2" lat="52.5" lon="13.42" version="1"/>
<node id="3" lat="52.51" lon="13.42" version="1"/>
<way id="10" version="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/></way>
<way id="11" version="1"><nd ref="2"/><nd ref="3"/><tag k="highway" v="primary"/></way></osm>"""

VERBS = {
    "build": "build ../drives.parquet --segmenter density -o roads.gpkg -o roads.parquet -o roads.geojson",
    "align": "align ../drives.parquet -o aligned.parquet",
    "simulate": "simulate ../net.osm -o recording --drives 12 --seed 3",
}


@dataclass(frozen=True)
class Result:
    """What became of the kills of one verb."""

    verb: str
    seconds: float  # of the uninterrupted run
    kills: int  # that found the process alive
    failed: int  # reruns with another exit code than 0
    differ: int  # reruns with other bytes
    left: int  # runs after which something else lay in the folder

    @property
    def sound(self) -> bool:
        """Whether nothing went wrong."""
        return not (self.failed or self.differ or self.left)


def _run(words: str, folder: Path) -> None:
    """Run the command line in a folder; for a process of its own."""
    os.chdir(folder)
    sys.stdout = sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    command_line(["-q", *words.split()])


def _started(words: str, folder: Path) -> multiprocessing.process.BaseProcess:
    """Start a run; a fork saves the seconds that imports take, and kills hit the work."""
    process = multiprocessing.get_context("fork").Process(target=_run, args=(words, folder))
    process.start()
    return process


def _content(folder: Path) -> dict[str, str]:
    """Digest of every file, and the name of every folder."""
    return {
        str(path.relative_to(folder)): hashlib.blake2b(path.read_bytes()).hexdigest() if path.is_file() else "folder"
        for path in sorted(folder.rglob("*"))
    }


def _prepared(base: Path) -> Path:
    """Write what the verbs read."""
    write_fleet(demo_fleet(n_drives=12), base / "drives.parquet")
    (base / "net.osm").write_text(_OSM, encoding="utf-8")
    return base


def interrupted(
    base: Path, verb: str, kills: int, rng: np.random.Generator, say: Callable[[str], object] = print
) -> Result:
    """Kill a verb so many times, each in a folder of its own.

    Parameters
    ----------
    base
        Empty folder.
    verb
        Of `VERBS`.
    kills
        How many kills are to find the process at work.
    rng
        For the moments.
    say
        Told of everything that goes wrong.
    """
    words = VERBS[verb]
    if not (base / "drives.parquet").exists():
        _prepared(base)
    (base / verb).mkdir()
    for _ in range(2):  # the first run may compile
        shutil.rmtree(base / verb)
        (base / verb).mkdir()
        start = time.perf_counter()
        process = _started(words, base / verb)
        process.join()
        seconds = time.perf_counter() - start
        if process.exitcode != 0:
            raise RuntimeError(f"{verb} fails without a kill: exit code {process.exitcode}")
    whole = _content(base / verb)
    counts = dict.fromkeys(("kills", "failed", "differ", "left"), 0)
    for moment in _moments(rng, seconds):
        if counts["kills"] == kills:
            break
        folder = base / f"{verb}-killed"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        process = _started(words, folder)
        process.join(moment)
        if process.exitcode is not None:
            continue
        os.kill(process.pid or 0, signal.SIGKILL)
        process.join()
        counts["kills"] += process.exitcode == -signal.SIGKILL
        again = _started(words, folder)
        again.join()
        found = _content(folder)
        counts["failed"] += again.exitcode != 0
        different = sorted(name for name in whole if found.get(name) != whole[name])
        more = sorted(set(found) - set(whole))
        counts["differ"] += bool(different)
        counts["left"] += bool(more)
        if again.exitcode or different or more:
            say(f"{verb} killed after {moment:.3f} s: exit code {again.exitcode}, differ {different}, left {more}")
    return Result(verb, seconds, **counts)


def _moments(rng: np.random.Generator, seconds: float) -> Iterator[float]:
    while True:
        yield float(rng.uniform(0.0, seconds))


def main() -> None:
    """Print a table; the exit code is 1 where something was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20, help="of each verb")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbs", nargs="*", default=list(VERBS), choices=list(VERBS))
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    print("| verb | seconds | kills | reruns that failed | other bytes | leftovers |\n|---|---|---|---|---|---|")
    sound = True
    with tempfile.TemporaryDirectory() as base:
        for verb in options.verbs:
            result = interrupted(Path(base), verb, options.kills, rng)
            row = (result.kills, result.failed, result.differ, result.left)
            print(f"| {verb} | {result.seconds:.1f} | {' | '.join(map(str, row))} |", flush=True)
            sound &= result.sound
    sys.exit(0 if sound else 1)


if __name__ == "__main__":
    main()
