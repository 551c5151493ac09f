"""Write or check constraints-minimum.txt: every dependency at the lower bound that pyproject.toml declares.

Usage: python tools/minimum_versions.py [--check]
"""

from __future__ import annotations

import argparse
import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
TARGET = ROOT / "constraints-minimum.txt"
HEAD = """\
# Lower bounds of pyproject.toml, as `python tools/minimum_versions.py` writes them. For `make test-minimum`.
"""
REQUIREMENT = re.compile(r"(?P<name>[A-Za-z0-9_.-]+)(?:\[[^\]]*\])?>=(?P<version>[0-9.]+)(?P<marker>\s*;.*)?")


def minimum_constraints() -> str:
    """Return the text of the constraints file, the core first and then each extra in the order of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    groups = {"core": project["dependencies"], **project["optional-dependencies"]}
    lines = [HEAD]
    for group, requirements in groups.items():
        pins = [found for found in map(REQUIREMENT.fullmatch, requirements) if found is not None]
        unread = [text for text in requirements if REQUIREMENT.fullmatch(text) is None and "probe2road[" not in text]
        if unread:
            raise SystemExit(f"{group}: no lower bound in {', '.join(unread)}")
        lines.append(f"# {group}\n")
        lines += [f"{found['name']}=={found['version']}{found['marker'] or ''}\n" for found in pins]
    return "".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; end with 1 if the file is out of date")
    wanted = minimum_constraints()
    if not parser.parse_args().check:
        TARGET.write_text(wanted, encoding="utf-8")
    elif not TARGET.exists() or TARGET.read_text(encoding="utf-8") != wanted:
        sys.exit(f"{TARGET.name} is out of date; run: python tools/minimum_versions.py")


if __name__ == "__main__":
    main()
