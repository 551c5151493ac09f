"""The numbers in the paper's tables, for comparison with ours.

Its data are private and other than ours, so only order and magnitude can be compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

__all__ = ["METHODS_TABLE", "SOFT_F1_TABLE", "STAGES_TABLE", "VISION_TABLE", "Triple"]


class Triple(NamedTuple):
    """Precision, recall and F1 of one metric in a row of the paper."""

    precision: float
    recall: float
    f1: float


# Tables I and II: area and method of ours, to GEO and iTOPO. San Jose is columbus, San Francisco is boston, Tokyo is
# hannover. DeepMG's GEO on San Francisco does not obey F1 = 2PR/(P+R); it is as printed.
METHODS_TABLE: Mapping[tuple[str, str], tuple[Triple, Triple]] = {
    ("columbus, train", "probe2road"): (Triple(0.991, 0.968, 0.980), Triple(0.906, 0.794, 0.847)),
    ("columbus, validation", "probe2road"): (Triple(0.959, 0.941, 0.950), Triple(0.787, 0.778, 0.783)),
    ("columbus, test", "probe2road"): (Triple(0.949, 0.938, 0.943), Triple(0.759, 0.734, 0.746)),
    ("boston", "kde"): (Triple(0.698, 0.692, 0.695), Triple(0.641, 0.584, 0.611)),
    ("boston", "biagioni"): (Triple(0.464, 0.828, 0.595), Triple(0.388, 0.799, 0.522)),
    ("boston", "deepmg"): (Triple(0.648, 0.670, 0.673), Triple(0.567, 0.883, 0.691)),
    ("boston", "probe2road"): (Triple(0.962, 0.935, 0.948), Triple(0.844, 0.729, 0.783)),
    ("hannover", "kde"): (Triple(0.928, 0.050, 0.094), Triple(0.968, 0.158, 0.271)),
    ("hannover", "biagioni"): (Triple(0.971, 0.968, 0.970), Triple(0.877, 0.778, 0.825)),
    ("hannover", "deepmg"): (Triple(0.625, 0.569, 0.596), Triple(0.652, 0.822, 0.727)),
    ("hannover", "probe2road"): (Triple(0.979, 0.950, 0.964), Triple(0.925, 0.654, 0.767)),
}

# Table III.
SOFT_F1_TABLE: Mapping[str, Triple] = {
    "columbus, train": Triple(0.992, 0.999, 0.995),
    "columbus, validation": Triple(0.870, 0.968, 0.916),
    "columbus, test": Triple(0.789, 0.931, 0.854),
    "boston": Triple(0.721, 0.901, 0.801),
    "hannover": Triple(0.862, 0.975, 0.915),
}

# Table IV, on San Francisco: method of ours to GEO and iTOPO.
VISION_TABLE: Mapping[str, tuple[Triple, Triple]] = {
    "probe2road-gnss": (Triple(0.880, 0.920, 0.900), Triple(0.483, 0.776, 0.596)),
    "probe2road": (Triple(0.962, 0.935, 0.948), Triple(0.844, 0.729, 0.783)),
}

# Table V, on San Francisco: stage to GEO and iTOPO.
STAGES_TABLE: Mapping[str, tuple[Triple, Triple]] = {
    "no post-processing": (Triple(0.9607, 0.9297, 0.9449), Triple(0.8859, 0.6839, 0.7719)),
    "gap filling": (Triple(0.9618, 0.9348, 0.9481), Triple(0.8426, 0.7285, 0.7814)),
    "full": (Triple(0.9618, 0.9348, 0.9481), Triple(0.8445, 0.7293, 0.7826)),
}
