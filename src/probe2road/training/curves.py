"""The log of a training run: JSON, TensorBoard's format, and a picture."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from probe2road.io.atomic import atomic_path

__all__ = ["draw_curves", "write_curve"]

_PANELS = (
    ("loss", ("loss",)),
    ("validation F1", ("soft_f1", "geo_f1")),
    ("validation GEO", ("geo_precision", "geo_recall")),
)


def write_curve(curve: Sequence[dict[str, float]], path: str | Path) -> None:
    """Write the rows of a curve as JSON."""
    with atomic_path(Path(path)) as temporary:
        temporary.write_text(json.dumps(list(curve), indent=1), encoding="utf-8")


def draw_curves(curve: Sequence[dict[str, float]], path: str | Path, *, title: str = "") -> None:
    """Draw a curve as a PNG: the loss, and the scores by which the weights are chosen.

    Parameters
    ----------
    curve
        Rows with ``step``, ``loss`` and the keys of `probe2road.training.validation.validate`.
    path
        The picture.
    title
        Above it.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(10, 3), layout="constrained")
        steps = [row["step"] for row in curve]
        for axis, (label, names) in zip(figure.subplots(1, len(_PANELS)), _PANELS, strict=True):
            for name in names:
                axis.plot(steps, [row[name] for row in curve], label=name.replace("_", " "))
            axis.set(xlabel="step", ylabel=label)
            axis.grid(alpha=0.3)
            axis.legend(frameon=False)
        figure.suptitle(title)
        with atomic_path(Path(path)) as temporary:
            figure.savefig(temporary, dpi=90, format="png")
