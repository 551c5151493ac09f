"""The appearance of results in a notebook: figures, never tables that name drives."""

from __future__ import annotations

import html
import sys
from collections.abc import Mapping

__all__ = ["figures_table", "in_notebook"]


def figures_table(heading: str, figures: Mapping[str, object]) -> str:
    """Return figures as a small HTML table under a heading, for ``_repr_html_``.

    Examples
    --------
    >>> figures_table("RoadGraph", {"nodes": 3, "CRS": "WGS 84 <UTM>"})
    '<b>RoadGraph</b><table><tr><th>nodes</th><td>3</td></tr><tr><th>CRS</th><td>WGS 84 &lt;UTM&gt;</td></tr></table>'
    """
    rows = "".join(
        f"<tr><th>{html.escape(name)}</th><td>{html.escape(str(value))}</td></tr>" for name, value in figures.items()
    )
    return f"<b>{html.escape(heading)}</b><table>{rows}</table>"


def in_notebook() -> bool:
    """Tell whether the code runs in a notebook, which shows results by itself.

    A terminal does not, one with IPython neither: only a kernel does.
    """
    if "IPython" not in sys.modules:
        return False
    shell = sys.modules["IPython"].get_ipython()
    return getattr(shell, "kernel", None) is not None
