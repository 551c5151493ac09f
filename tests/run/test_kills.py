"""A process that is killed as it writes leaves old or new; `experiments/interruptions.py` kills whole runs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from probe2road.graph.roadgraph import graph_from_lines
from probe2road.io.graph_files import read_graph, write_graph

KILLS = 4
OLD = graph_from_lines([[(0, 0), (100, 0)]], crs="EPSG:32616")
SUFFIXES = (".parquet", ".gpkg", ".geojson")
PROGRAM = """
import os, random, signal, sys, time
import geopandas, pyarrow.parquet, pyogrio
from pathlib import Path
from probe2road.graph.roadgraph import graph_from_lines
from probe2road.io.graph_files import write_graph

rng = random.Random(5)
for folder in sys.argv[1:]:
    child = os.fork()  # before anything has started a thread
    if not child:
        lines = [[(0, 0), (100, 0)], [(100, 0), (100, 90)]]
        graphs = [graph_from_lines(lines[:number], crs="EPSG:32616") for number in (1, 2)]
        while True:
            for graph in graphs:
                for suffix in (".parquet", ".gpkg", ".geojson"):
                    write_graph(graph, f"{folder}/roads{suffix}")
    while not Path(folder, "roads.geojson").exists():
        time.sleep(0.01)
    time.sleep(rng.uniform(0.0, 0.5))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
"""


def test_a_killed_process_leaves_old_or_new_and_the_next_write_nothing_else(tmp_path: Path) -> None:
    folders = [tmp_path / str(number) for number in range(KILLS)]
    for folder in folders:
        folder.mkdir()
    subprocess.run([sys.executable, "-c", PROGRAM, *map(str, folders)], check=True, timeout=300)
    for folder in folders:
        for suffix in SUFFIXES:
            assert len(read_graph(folder / f"roads{suffix}").edges) in (1, 2)
            write_graph(OLD, folder / f"roads{suffix}")
            assert len(read_graph(folder / f"roads{suffix}").edges) == 1
        names = ["roads.geojson", "roads.gpkg", "roads.nodes.parquet", "roads.parquet", "roads.turns.parquet"]
        assert sorted(path.name for path in folder.iterdir()) == names
