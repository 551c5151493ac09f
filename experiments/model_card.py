"""Print what a weights file says about itself, as Markdown, and draw the curve of its training.

Usage: python experiments/model_card.py src/probe2road/weights/gnss.onnx [--picture docs/img/model-gnss.png]
"""

from __future__ import annotations

import argparse
from pathlib import Path

from probe2road.segmentation.weights import read_weights
from probe2road.training.curves import draw_curves

COLUMNS = ("soft_f1", "geo_f1", "geo_precision", "geo_recall", "itopo_f1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("weights", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    info = read_weights(options.weights).info
    training = info.training
    config = training["config"]
    print(f"| `{info.name}` | |\n|---|---|")
    print(f"| channels | {', '.join(info.channels)} |")
    print(f"| network | {info.network['architecture']}, {options.weights.stat().st_size / 2**20:.1f} MiB |")
    print(f"| tile, threshold | {info.tile} px, {info.threshold} |")
    print(f"| seed | {config['seed']} |")
    print(f"| steps | {training['step']:.0f} (the best of {config['steps']}), {config['batch']} samples each |")
    data = [f"{s['name']} {s['split']} {s['data']} ({s['weight']})".replace("  ", " ") for s in config["sources"]]
    print(f"| trained on | {', '.join(data)} |")
    print(f"| validated on | {', '.join(source['name'] for source in config['validation']['sources'])} |")
    names = " | ".join(name.replace("_", " ").replace("f1", "F1").replace("geo", "GEO") for name in COLUMNS)
    print(f"\n| threshold | {names} |\n|{'---|' * (len(COLUMNS) + 1)}")
    for row in training["thresholds"]:
        print(f"| {row['threshold']} | {' | '.join(f'{row[name]:.3f}' for name in COLUMNS)} |")
    if options.picture is not None:
        draw_curves(training["curve"], options.picture, title=info.name)


if __name__ == "__main__":
    main()
