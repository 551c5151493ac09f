"""Every section of the method notes that the code cites stands on their page, and so do the rows of its table."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
CITING = [*(ROOT / "src").rglob("*.py"), *(ROOT / "tests").rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py")]
CITING += [path for path in (ROOT / "docs").rglob("*.md") if path.name != "method.md"]
HERE = Path(__file__)

# "METHOD 0.1 rows 16 to 18, 7.3": sections, and the rows of section 0.1.
CITATION = re.compile(
    r"\bMETHOD (\d+(?:\.\d+)?(?:(?:, items? \d+|, last point| rows? \d+(?:(?:, | and | to )(?:and )?\d+(?!\.\d))*)"
    r"|(?:, | and | to |, and )\d+\.\d+)*)"
)


def citations() -> list[tuple[str, str]]:
    """Return every citation with its file."""
    return [
        (str(path.relative_to(ROOT)), found[1])
        for path in CITING
        if path != HERE
        for found in CITATION.finditer(" ".join(path.read_text(encoding="utf-8").split()))
    ]


def sections_of(citation: str) -> set[str]:
    """Return the sections that a citation names; a range counts by its ends."""
    without_rows = re.sub(r" rows? \d+(?:(?:, | and | to )(?:and )?\d+(?!\.\d))*|, items? \d+", "", citation)
    return set(re.findall(r"\d+(?:\.\d+)?", without_rows))


def rows_of(citation: str) -> set[int]:
    """Return the rows of section 0.1 that a citation names, ranges written out."""
    rows: set[int] = set()
    for listed in re.findall(r"rows? (\d+(?:(?:, | and | to )(?:and )?\d+(?!\.\d))*)", citation):
        numbers = [int(number) for number in re.findall(r"\d+", listed)]
        rows |= set(range(numbers[0], numbers[-1] + 1)) if " to " in listed else set(numbers)
    return rows


@pytest.mark.parametrize(
    ("citation", "sections", "rows"),
    [
        ("6.5", {"6.5"}, set()),
        ("0.1 rows 16 to 18", {"0.1"}, {16, 17, 18}),
        ("0.1 rows 23, 24, and 7.3", {"0.1", "7.3"}, {23, 24}),
        ("4.4, 5.1 and 0.1 rows 19 to 23", {"4.4", "5.1", "0.1"}, {19, 20, 21, 22, 23}),
        ("3.3, item 4", {"3.3"}, set()),
        ("0.1 row 29 and 6.1", {"0.1", "6.1"}, {29}),
    ],
)
def test_citations_are_understood(citation: str, sections: set[str], rows: set[int]) -> None:
    found = CITATION.search(f"METHOD {citation}.")
    assert found is not None
    assert found[1] == citation
    assert (sections_of(citation), rows_of(citation)) == (sections, rows)


def test_cited_sections_are_on_the_page() -> None:
    anchors = set(re.findall(r"\{ #s([\d-]+) \}", PAGE))
    numbers = set(re.findall(r"^#+ (\d+(?:\.\d+)?)\.? ", PAGE, re.MULTILINE))
    assert {number.replace(".", "-") for number in numbers} == anchors
    cited = citations()
    assert len(cited) > 60
    assert [(file, text) for file, text in cited if not sections_of(text) <= numbers] == []


def test_cited_rows_are_on_the_page() -> None:
    there = {int(number) for number in re.findall(r'<span id="s0-1-(\d+)">\1</span>', PAGE)}
    assert [(file, text) for file, text in citations() if not rows_of(text) <= there] == []
