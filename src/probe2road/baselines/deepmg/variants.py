"""The two variants of DeepMG: like its published code, and with the defects of that code repaired."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from probe2road.errors import OptionError

__all__ = ["VARIANTS", "Variant", "find_variant"]


@dataclass(frozen=True)
class Variant:
    """Where the published code differs from its paper (METHOD 3.3, 3.5 to 3.7)."""

    name: str
    batch_size: int  # tiles of a training step; the published loader ignores its option and takes one
    local_cells: int  # cells along a side of the grid of neighbours; 300 by mistake, so that 8 of 300 are recorded
    saturate: bool  # whether 2 fixes and 16 traces are the most that a cell can show; else the log of the count
    halo: int  # cells of context around a tile in prediction; without any, roads break at the seams
    multigraph: bool  # whether parallel edges and loops of the mask survive
    simplify_tolerance: float  # m, Douglas-Peucker
    true_angles: bool  # whether links are compared by angles on the ground; else by angles of longitude and latitude
    crosses_at_target: bool  # whether a link may fail for touching a road at the very node that it leads to
    min_path: int  # edges below which a matched piece of a trace counts for nothing


VARIANTS: Mapping[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant("as_published", 1, 300, True, 0, False, 10.0, False, True, 3),
        Variant("fixed", 8, 8, False, 32, True, 2.0, True, False, 1),
    )
}


def find_variant(name: str) -> Variant:
    """Return a variant by name.

    Raises
    ------
    OptionError
        If there is none of that name.

    Examples
    --------
    >>> find_variant("fixed").batch_size, find_variant("as_published").batch_size
    (8, 1)
    >>> find_variant("paper")
    Traceback (most recent call last):
        ...
    probe2road.errors.OptionError: there is no variant 'paper' of DeepMG; use as_published or fixed
    """
    if name not in VARIANTS:
        raise OptionError(f"there is no variant {name!r} of DeepMG", fix=f"use {' or '.join(VARIANTS)}")
    return VARIANTS[name]
