"""Check what would be released: the wheel and the source distribution in a folder.

Usage: python tools/check_release.py [dist]
"""

from __future__ import annotations

import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
MEGABYTE = 1_000_000
# The two shipped networks are 22.5 MB however they are compressed: float32 weights do not get smaller.
LARGEST = {"wheel": 25 * MEGABYTE, "source": 25 * MEGABYTE}
WANTED = (
    "probe2road/py.typed",
    "probe2road/draw/page_files/page.html",
    "probe2road/draw/page_files/page.js",
    "probe2road/draw/page_files/page.css",
    "probe2road/weights/gnss.onnx",
    "probe2road/weights/gnss-vision.onnx",
)
UNWANTED = ("tests/", "test_", ".pt", "__pycache__", ".nbc", "experiments/", "benchmarks/")


def faults_of_wheel(path: Path) -> list[str]:
    """Return what a wheel lacks, and what it should not have."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    faults = [f"{path.name} lacks {wanted}" for wanted in WANTED if wanted not in names]
    faults += [f"{path.name} has {name}" for name in names for part in UNWANTED if part in name]
    if not any("/_vendor/" in name and name.endswith("LICENSE.txt") for name in names):
        faults.append(f"{path.name} lacks the licences of what is vendored")
    return faults + faults_of_size(path, "wheel")


def faults_of_source(path: Path) -> list[str]:
    """Return what a source distribution lacks, and what it should not have."""
    with tarfile.open(path) as archive:
        names = [name.partition("/")[2] for name in archive.getnames()]
    faults = [f"{path.name} lacks src/{wanted}" for wanted in WANTED if f"src/{wanted}" not in names]
    faults += [f"{path.name} lacks {wanted}" for wanted in ("LICENSE", "NOTICE", "CHANGELOG.md") if wanted not in names]
    faults += [f"{path.name} has {name}" for name in names if name.endswith((".pt", ".nbc", ".pyc"))]
    return faults + faults_of_size(path, "source")


def faults_of_size(path: Path, kind: str) -> list[str]:
    size = path.stat().st_size
    print(f"{path.name}: {size / MEGABYTE:.1f} MB (limit {LARGEST[kind] / MEGABYTE:.0f} MB)")
    return [f"{path.name} has {size / MEGABYTE:.1f} MB"] if size > LARGEST[kind] else []


def faults_of_version(wheel: Path) -> list[str]:
    """Return where the version of the wheel is not the one that the documents name."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    faults = [] if f"-{version}-" in wheel.name else [f"{wheel.name} is not version {version}"]
    return faults if f"\nversion: {version}\n" in citation else [*faults, f"CITATION.cff does not name {version}"]


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "dist")
    wheels, sources = sorted(folder.glob("*.whl")), sorted(folder.glob("*.tar.gz"))
    if (len(wheels), len(sources)) != (1, 1):
        sys.exit(f"{folder} holds {len(wheels)} wheels and {len(sources)} source distributions, not one of each")
    faults = faults_of_wheel(wheels[0]) + faults_of_source(sources[0]) + faults_of_version(wheels[0])
    if faults:
        sys.exit("\n".join(faults))
    print("ready to release")


if __name__ == "__main__":
    main()
