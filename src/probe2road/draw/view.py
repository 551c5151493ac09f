"""A road graph to look at: one function for the page and the picture, and the page for a notebook or the browser."""

from __future__ import annotations

import html
import logging
import tempfile
import webbrowser
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from probe2road.crs import extents_apart
from probe2road.draw.page import page_text, write_page
from probe2road.draw.picture import draw_graph
from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet
from probe2road.graph.disclosure import withhold
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path
from probe2road.notebook import in_notebook

__all__ = ["Page", "explore", "require_drawable", "view"]

logger = logging.getLogger(__name__)

_PAGES, _PICTURES = (".html", ".htm"), (".png",)
_HEIGHT = 600  # pixels of the page in a notebook


@dataclass(frozen=True, eq=False)
class Page:
    """The HTML page of a road graph, as returned by `explore`: a notebook shows it, and `save` writes it to a file.

    Attributes
    ----------
    title
        Heading of the page.
    text
        The whole page, which works offline.
    """

    title: str
    text: str

    def save(self, path: str | PathLike[str]) -> None:
        """Write the page to an HTML file.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        with atomic_path(path) as temporary:
            temporary.write_text(self.text, encoding="utf-8")

    def show_in_browser(self) -> Path:
        """Open the page in the web browser, from a temporary file, and return the path of the file."""
        path = Path(tempfile.mkdtemp(prefix="probe2road-")) / "roads.html"
        self.save(path)
        opened = webbrowser.open(path.as_uri())
        logger.info("%s %s", "opened" if opened else "there is no browser to open", path)
        return path

    def __repr__(self) -> str:
        return f"Page({self.title!r}, {len(self.text) / 1e6:.1f} MB)"

    def _repr_html_(self) -> str:
        """Show the page in a frame in the notebook."""
        style = f"width: 100%; height: {_HEIGHT}px; border: none"
        return f'<iframe srcdoc="{html.escape(self.text)}" style="{style}" allowfullscreen></iframe>'


def require_drawable(path: str | PathLike[str]) -> None:
    """Refuse a file name with a suffix that `view` cannot write.

    Raises
    ------
    OptionError
        If the suffix is neither that of a page nor that of a picture.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in (*_PAGES, *_PICTURES):
        raise OptionError(f"cannot draw {suffix or 'no suffix'}", where=path, fix="use .html or .png")


def view(
    graph: RoadGraph,
    path: str | PathLike[str],
    *,
    fleet: Fleet | None = None,
    reference: RoadGraph | None = None,
    title: str | None = None,
    color_by: str | None = None,
    min_drives: int = 1,
) -> None:
    """Draw a road graph over the fleet data that it came from, as an HTML page or a picture.

    The suffix of the file decides which of the two is drawn. The page works offline, and a click on an edge shows its
    attributes. Only counts per pixel of the fleet are drawn, never single traces.

    Parameters
    ----------
    graph
        The graph; an empty one shows the traces only.
    path
        File with the suffix ``.html``, ``.htm`` or ``.png``.
    fleet
        Fleet data to draw underneath.
    reference
        Graph to compare with, drawn underneath as a broad pale band; only in a picture.
    title
        Heading.
    color_by
        Edge column to colour by at first, where it is not the origin; only in a page.
    min_drives
        Leave out the edges with fewer drives, as `withhold` does, the pixels that fewer traces cross, and semantic
        points away from all other pixels.

    Raises
    ------
    OptionError
        If the suffix is of no format we draw, if the format does not show what was given, or if no edge has a value in
        the column to colour by.
    OutputError
        If the file cannot be written, or the graph holds columns that may identify drives.
    InputError
        If there is nothing to draw in a picture.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(446000, 4636000), (446100, 4636000)]], crs="EPSG:32616")
    >>> folder = Path(tempfile.mkdtemp())
    >>> view(graph, folder / "roads.html")
    >>> view(graph, folder / "roads.png", reference=graph)
    >>> view(graph, folder / "roads.html", reference=graph)
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: ...roads.html: a page shows no reference; use .png
    """
    require_drawable(path)
    graph = withhold(graph, min_drives=min_drives)
    for name, other in (("traces are", fleet), ("reference is", reference)):
        if other is not None and (places := extents_apart(graph, other)):
            logger.warning("the graph is at %s, but the %s at %s", places[0], name, places[1])
    if Path(path).suffix.lower() in _PICTURES:
        if color_by is not None:
            raise OptionError("a picture is coloured by origin only", where=path, fix="use .html")
        draw_graph(graph, path, fleet=fleet, reference=reference, title=title or "", min_drives=min_drives)
        return
    if reference is not None:
        raise OptionError("a page shows no reference", where=path, fix="use .png")
    write_page(
        graph, path, fleet=fleet, title=title or "Road graph", color_by=color_by or "origin", min_drives=min_drives
    )


def explore(
    graph: RoadGraph, *, fleet: Fleet | None = None, title: str = "Road graph", color_by: str = "origin"
) -> Page:
    """Show a road graph as an interactive page: in the notebook, or else in the web browser.

    Parameters
    ----------
    graph
        The graph.
    fleet
        Fleet data to draw underneath.
    title
        Heading.
    color_by
        Edge column to colour by at first.

    Returns
    -------
    Page
        A notebook shows it where it is the last value of a cell.

    Raises
    ------
    OptionError
        If no edge has a value in the column to colour by.
    OutputError
        If the graph holds columns that may identify drives.
    """
    page = Page(title, page_text(graph, where="explore", fleet=fleet, title=title, color_by=color_by))
    if not in_notebook():
        page.show_in_browser()
    return page
