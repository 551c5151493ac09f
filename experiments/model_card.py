"""Print what a weights file says about itself, as Markdown, and draw the curve of its training.

Usage: python experiments/model_card.py src/probe2road/weights/gnss.onnx [--picture docs/img/model-gnss.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from probe2road.segmentation.weights import read_weights
from probe2road.training.curves import draw_curves

COLUMNS = ("soft_f1", "geo_f1", "geo_precision", "geo_recall", "itopo_f1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    info = read_weights(options.weights).info
    print(f"| `{info.name}` | |\n|---|---|")
    print(f"| channels | {', '.join(info.channels)} |")
    print(f"| network | {info.network['architecture']}, {options.weights.stat().st_size / 2**20:.1f} MiB |")
    print(f"| tile, threshold | {info.tile} px, {info.threshold} |")
    runs = [info.training]
    while "before" in runs[0]:
        runs.insert(0, runs[0]["before"])
    print("\n| run | seed | steps | samples | label | trained on | validated on |\n|---|---|---|---|---|---|---|")
    for number, run in enumerate(runs, start=1):
        print(f"| {number} | {' | '.join(described(run))} |")
    names = " | ".join(name.replace("_", " ").replace("f1", "F1").replace("geo", "GEO") for name in COLUMNS)
    print(f"\n| threshold | {names} |\n|{'---|' * (len(COLUMNS) + 1)}")
    for row in info.training["thresholds"]:
        print(f"| {row['threshold']} | {' | '.join(f'{row[name]:.3f}' for name in COLUMNS)} |")
    if options.picture is not None:
        draw_curves(runs[0]["curve"], options.picture, title=info.name)
        for number, run in enumerate(runs[1:], start=2):
            picture = options.picture.with_stem(f"{options.picture.stem}-{number}")
            draw_curves(run["curve"], picture, title=f"{info.name}, run {number}")


def described(run: dict[str, Any]) -> list[str]:
    """Describe one run of training."""
    config = run["config"]
    data = [f"{s['name']} {s['split']} {s['data']} ({s['weight']})".replace("  ", " ") for s in config["sources"]]
    return [
        str(config["seed"]),
        f"{run['step']:.0f} (the best of {config['steps']})",
        f"{config['batch']} of {config['sample']['size']} px a step",
        f"{config['sample']['min_drives']} drives",
        ", ".join(data),
        ", ".join(source["name"] for source in config["validation"]["sources"]),
    ]


if __name__ == "__main__":
    main()
