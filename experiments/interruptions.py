"""Kill build, align and simulate at random moments, start them again, and compare with a run that was left alone.

    python experiments/interruptions.py --kills 70

Every run is a process of its own that gets SIGKILL at a random moment of the time that the uninterrupted run takes.
The same command is then started again, and killed again, up to three times; the run after that must end with exit
code 0, the same bytes in every file, and nothing else in the folder. The moments come from ``--seed``. A GeoPackage
holds the time of its last change, which is fixed here.
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
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from probe2road.demo import demo_fleet
from probe2road.io.fleet_writer import write_fleet

os.environ["OGR_CURRENT_DATE"] = "2000-01-01T00:00:00.000Z"
# Runs are forked from a process that has imported this and does nothing else: the seconds that imports take are saved,
# kills hit the work, and no lock of a thread that is not there any more is waited for.
_SERVER = multiprocessing.get_context("forkserver")
_IMPORTED = ["probe2road.cli.main", "probe2road.recipe", "probe2road.alignment.align", "probe2road.alignment.report"]
_IMPORTED += ["probe2road.io.fleet_reader", "probe2road.io.graph_files", "probe2road.benchmark.sets.recording"]
_IMPORTED += ["probe2road.draw.stages", "probe2road.segmentation.density", "probe2road.simulation.networks.osm"]
_KILLED = -signal.SIGKILL
_IN_A_ROW = 3  # kills before a run is let go on to its end
_PATIENCE = 20.0  # x the time of the uninterrupted run, after which a rerun hangs

_OSM = """<osm version="0.6" generator="experiments">
<node id="1" lat="52.5" lon="13.4" version="1"/><node id="2" lat="52.5" lon="13.42" version="1"/>
<node id="3" lat="52.51" lon="13.42" version="1"/>
<way id="10" version="1"><nd ref="1"/><nd ref="2"/><tag k="highway" v="primary"/></way>
<way id="11" version="1"><nd ref="2"/><nd ref="3"/><tag k="highway" v="primary"/></way></osm>"""

VERBS = {
    "build": "build ../drives.parquet --segmenter density -o roads.gpkg -o roads.parquet -o roads.geojson",
    "align": "align ../drives.parquet -o aligned.parquet",
    "simulate": "simulate ../net.osm -o recording --drives 6 --seed 3",
}


@dataclass(frozen=True)
class Result:
    """What became of the kills of one verb."""

    verb: str
    seconds: float  # of the uninterrupted run
    kills: int  # that found the process alive
    failed: int  # reruns with another exit code than 0, or that hung
    differ: int  # reruns with other bytes
    left: int  # runs after which something else lay in the folder

    @property
    def sound(self) -> bool:
        """Whether nothing went wrong."""
        return not (self.failed or self.differ or self.left)


def _run(words: str, folder: Path) -> None:
    """Run the command line in a folder; for a process of its own."""
    from probe2road.cli.main import main as command_line

    os.chdir(folder)
    sys.stdout = sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    command_line(["-q", *words.split()])


def _started(words: str, folder: Path) -> multiprocessing.process.BaseProcess:
    """Start a run."""
    process = _SERVER.Process(target=_run, args=(words, folder), daemon=True)
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
    write_fleet(demo_fleet(n_drives=6), base / "drives.parquet")
    (base / "net.osm").write_text(_OSM, encoding="utf-8")
    return base


def interrupted(
    base: Path, verb: str, kills: int, rng: np.random.Generator, say: Callable[[str], object] = print
) -> Result:
    """Kill a verb so many times, and look at what the run after the last kill leaves.

    Parameters
    ----------
    base
        Folder for all of them.
    verb
        Of `VERBS`.
    kills
        How many kills are to find the process at work; up to three in a row, then the run is let go on.
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
    folder = base / f"{verb}-killed"
    counts = dict.fromkeys(("kills", "failed", "differ", "left"), 0)
    while counts["kills"] < kills:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        moments: list[float] = []
        code = _KILLED
        while code == _KILLED and len(moments) < min(_IN_A_ROW, kills - counts["kills"]):
            moments.append(round(float(rng.uniform(0.0, seconds)), 3))
            code = _exit_code(words, folder, moments[-1])
        counts["kills"] += len(moments) - (code != _KILLED)
        if code == _KILLED:
            code = _exit_code(words, folder, _PATIENCE * (1.0 + seconds))
        found = _content(folder)
        different = sorted(name for name in whole if found.get(name) != whole[name])
        more = sorted(set(found) - set(whole))
        for name, wrong in (("failed", code != 0), ("differ", different), ("left", more)):
            counts[name] += bool(wrong)
        if code or different or more:
            say(f"{verb} killed after {moments} s: exit code {code}, differ {different}, left {more}")
    return Result(verb, seconds, **counts)


def _exit_code(words: str, folder: Path, seconds: float) -> int:
    """Run, and kill what goes on for longer."""
    process = _started(words, folder)
    process.join(seconds)
    if process.exitcode is None:
        process.kill()
        process.join()
    return process.exitcode or 0


def main() -> None:
    """Print a table; the exit code is 1 where something was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=70, help="of each verb")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--verbs", nargs="*", default=list(VERBS), choices=list(VERBS))
    options = parser.parse_args()
    _SERVER.set_forkserver_preload(_IMPORTED)
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
