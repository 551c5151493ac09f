"""Run every benchmark in a process of its own; keep CPU seconds, memory and what each printed.

Usage: python benchmarks/run_all.py [NAME ...] [--against FILE] [--output FILE]

CPU seconds of one machine can be compared with each other, and the ratio to an earlier file is printed; seconds of
two machines cannot.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
DATA = Path(os.environ.get("PROBE2ROAD_DATA", HERE.parents[1] / "shared" / "data"))
WEIGHTS = HERE.parent / "src" / "probe2road" / "weights" / "gnss-vision.onnx"
# Arguments that make each take a minute or less.
ARGUMENTS = {
    "align": ["--drives", "25", "100"],
    "losses": [],
    "mapmatch": ["--traces", "150"],
    "metrics": [],
    "raster": [],
    "readers": [],
    "segmentation": [str(WEIGHTS), "--repeats", "2"],
    "simulate": [str(DATA / "osm" / "columbus.osm.pbf")],
    "vectorize": [],
}


def run(name: str) -> dict[str, Any]:
    """Run one benchmark and return what it took, twice: the first run compiles what is not compiled yet."""
    command = [sys.executable, str(HERE / f"bench_{name}.py"), *ARGUMENTS[name]]
    subprocess.run(command, capture_output=True, check=False)
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    finished = subprocess.run(command, capture_output=True, text=True, check=False)
    wall, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    result = {"cpu_seconds": round(cpu, 2), "wall_seconds": round(wall, 2), "printed": finished.stdout.splitlines()}
    return result if finished.returncode == 0 else {"failed": finished.stderr.splitlines()[-3:]}


def commit() -> str:
    """Return the commit that is measured, with a plus sign where files have changed since."""
    described = subprocess.run(
        ["git", "describe", "--always", "--dirty=+"], cwd=HERE, capture_output=True, text=True, check=False
    )
    return described.stdout.strip() or "unknown"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(ARGUMENTS)}; all without any")
    parser.add_argument("--against", type=Path, help="file of an earlier run on this machine")
    parser.add_argument("--output", type=Path, help="benchmarks/results/COMMIT.json without it")
    arguments = parser.parse_args()
    if unknown := sorted(set(arguments.names) - set(ARGUMENTS)):
        parser.error(f"there is no benchmark {', '.join(unknown)}")
    earlier = json.loads(arguments.against.read_text())["benchmarks"] if arguments.against else {}
    results = {}
    print(f"{'benchmark':14} {'CPU s':>8} {'before':>8} {'ratio':>6}")
    for name in arguments.names or ARGUMENTS:
        results[name] = run(name)
        cpu, old = results[name].get("cpu_seconds"), earlier.get(name, {}).get("cpu_seconds")
        ratio = f"{old:8.2f} {cpu / old:6.2f}" if cpu is not None and old else ""
        print(f"{name:14} {'failed' if cpu is None else f'{cpu:.2f}':>8} {ratio}", flush=True)
    output = arguments.output or HERE / "results" / f"{commit()}.json"
    output.parent.mkdir(exist_ok=True)
    about = {"commit": commit(), "python": platform.python_version(), "machine": platform.machine()}
    output.write_text(json.dumps({**about, "benchmarks": results}, indent=1) + "\n", encoding="utf-8")
    print(f"wrote {output}")


if __name__ == "__main__":
    main()
