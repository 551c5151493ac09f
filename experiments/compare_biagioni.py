"""Compare settings of the Biagioni baseline on training tiles of Columbus.

    probe2road benchmark prepare columbus --output SETS
    python experiments/compare_biagioni.py SETS/columbus            a few minutes on one core

Logs a Markdown table of GEO and iTOPO for the published settings and for those that suit fleet data better, pooled over
the tiles that ``fit_kde.py`` draws. Every tile is built on its own, because the method's memory follows the area.
"""

from __future__ import annotations

import argparse
import logging
from pathlib import Path

import numpy as np
from fit_kde import chosen_tiles, within

from probe2road import evaluate, read_fleet, read_graph
from probe2road.baselines.biagioni.recipe import FLEET, BiagioniOptions, build_biagioni
from probe2road.benchmark.sets.prepare import check_dataset, read_tiles
from probe2road.benchmark.sets.recording import Recording
from probe2road.benchmark.sets.reference import labelled_reference
from probe2road.benchmark.sets.tiles import split_area

logger = logging.getLogger("compare_biagioni")

SETTINGS = {
    "as published": BiagioniOptions(),
    "last runs kept": BiagioniOptions(last_runs=True),
    "and simplified to 2 m": BiagioniOptions(last_runs=True, simplify_tolerance=2.0),
    "and closed with 4 m": BiagioniOptions(last_runs=True, simplify_tolerance=2.0, closing=4.0),
    "and closed with 2 m": BiagioniOptions(last_runs=True, simplify_tolerance=2.0, closing=2.0),
    "and not closed (`FLEET`)": FLEET,
}


def main() -> None:
    """Build every tile with every setting and log what they score."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="the prepared data set")
    parser.add_argument("--tiles", type=int, default=8, help="training tiles to use")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logger.setLevel(logging.INFO)
    check_dataset(arguments.folder)
    recording = Recording(arguments.folder)
    tiles = chosen_tiles(read_tiles(arguments.folder), arguments.tiles)
    fleet = read_fleet(recording.modelled)
    truth = labelled_reference(read_graph(recording.reference), min_drives=4)
    parts = [(within(fleet, tile), split_area(tile, "train")) for tile in (tiles.iloc[[k]] for k in range(len(tiles)))]
    logger.info("| settings | GEO F1/P/R | iTOPO F1/P/R |\n|---|---|---|")
    for name, options in SETTINGS.items():
        counts = np.zeros((2, 3))
        for part, area in parts:
            scores = evaluate(build_biagioni(part, options=options), truth, metrics=["geo", "itopo"], area=area)
            counts += scores[["matched_proposal", "proposal", "reference"]].to_numpy(np.float64)
        logger.info("| %s | %s |", name, " | ".join(triple(*count) for count in counts))


def triple(matched: float, proposed: float, wanted: float) -> str:
    """F1, precision and recall of pooled counts."""
    precision, recall = matched / proposed, matched / wanted
    return f"{2 * precision * recall / (precision + recall):.3f}/{precision:.3f}/{recall:.3f}"


if __name__ == "__main__":
    main()
