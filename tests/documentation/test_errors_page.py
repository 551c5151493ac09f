"""The error index quotes messages that exist, and has one for every message that reading and writing can raise."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import probe2road.errors

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "probe2road"
PAGE = (ROOT / "docs" / "guide" / "errors.md").read_text(encoding="utf-8")
READING_AND_WRITING = (
    "crs.py",
    "fleet",
    "io",
)  # what every user meets; the rest raises OptionError, or is for developers
CLASSES = [name for name in probe2road.errors.__all__ if name.endswith("Error")]


def quoted() -> list[str]:
    """Return the words of messages that the page quotes, from the first column of its tables."""
    cells = re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE)
    return [words for cell in cells for words in re.findall(r"`([^`]+)`", cell) if words not in CLASSES]


def constant_text(node: ast.expr) -> str:
    """Return the words of a text that do not depend on values."""
    if isinstance(node, ast.Constant):
        return str(node.value)
    parts = node.values if isinstance(node, ast.JoinedStr) else []
    return "\0".join(str(part.value) for part in parts if isinstance(part, ast.Constant))


def strings(path: Path) -> Iterator[str]:
    """Yield the texts of a module, docstrings left out."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.Constant | ast.JoinedStr) and id(node) not in docstrings:
            yield constant_text(node)


def raised(path: Path) -> Iterator[str]:
    """Yield the messages of a module: what stands in the call of an error, or in a variable called ``fault``."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and node.args and ast.unparse(node.func) in CLASSES:
            yield constant_text(node.args[0])
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "fault":
            branches = [node.value.body, node.value.orelse] if isinstance(node.value, ast.IfExp) else [node.value]
            yield from map(constant_text, branches)


def test_every_quoted_message_exists() -> None:
    texts = "\n".join(text for path in sorted(SOURCE.rglob("*.py")) for text in strings(path))
    assert [words for words in quoted() if words not in texts] == []


def test_every_message_of_reading_and_writing_is_on_the_page() -> None:
    roots = [SOURCE / name for name in READING_AND_WRITING]
    paths = [path for root in roots for path in ([root] if root.is_file() else sorted(root.rglob("*.py")))]
    messages = {text: path.name for path in paths for text in raised(path) if any(map(str.isalpha, text))}
    assert len(messages) > 40
    unexplained = {text: name for text, name in messages.items() if not any(words in text for words in quoted())}
    # Bounds of options, "NAME is VALUE", are one family.
    assert {text: name for text, name in unexplained.items() if text.strip("\0") != " is "} == {}


def test_every_class_of_errors_is_on_the_page() -> None:
    assert [name for name in CLASSES if f"`{name}`" not in PAGE] == []
