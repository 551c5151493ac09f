"""MkDocs hooks: the changelog at the root of the repository, and the notebooks of the gallery, become pages.

A notebook is converted by hand, because all that is needed is its text and its code: outputs are not stored, the test
suite executes the notebooks, and one picture of each lies beside it.
"""

from __future__ import annotations

import json
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

__all__ = ["notebook_page", "on_files"]

ROOT = Path(__file__).parents[1]
REPOSITORY_PAGES = {"CHANGELOG.md": "changelog.md"}


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the pages that are not Markdown files in ``docs``; MkDocs calls this before it reads the navigation."""
    for name, page in REPOSITORY_PAGES.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text.replace("](docs/", "](")))
    for path in sorted((ROOT / "docs" / "gallery").glob("*.ipynb")):
        files.append(File.generated(config, f"gallery/{path.stem}.md", content=notebook_page(path)))
    return files


def notebook_page(path: Path) -> str:
    """Return a notebook as Markdown: text as it is, code in fences, and where to get the file."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    parts = []
    for cell in cells:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
    parts.append(f"This page is a notebook: [`{path.name}`]({path.name}).")
    return "\n\n".join(parts) + "\n"
