from __future__ import annotations

import base64
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread

from probe2road.errors import OptionError, OutputError
from probe2road.fleet import Fleet, fleet_from_tables
from probe2road.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.view import write_view

EAST, NORTH = 446000.0, 4636000.0
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture
def graph() -> RoadGraph:
    """A street with a side street; edge ids that are not row numbers."""
    lines = [
        [(EAST, NORTH), (EAST + 200, NORTH)],
        [(EAST + 200, NORTH), (EAST + 400, NORTH)],
        [(EAST + 200, NORTH), (EAST + 200, NORTH + 150)],
    ]
    attributes = pd.DataFrame({"support": pd.array([12, None, 3], "Int64"), "score": [0.91234, 0.8, None]})
    plain = graph_from_lines(lines, crs="EPSG:32616", attributes=attributes)
    return replace(plain, edges=plain.edges.set_axis(pd.Index([10, 11, 12], name="edge")))


@pytest.fixture
def fleet() -> Fleet:
    """Two drives along the street, and one marking and one boundary point beside it."""
    x = np.tile(np.arange(0.0, 400.0, 20.0), 2)
    traces = pd.DataFrame({"trace_id": np.repeat(["secret-A", "secret-B"], 20), "x": EAST + x, "y": NORTH})
    points = pd.DataFrame(
        {
            "trace_id": "secret-A",
            "x": [EAST + 100, EAST + 100],
            "y": [NORTH + 2, NORTH + 6],
            "kind": ["lane_marking", "road_boundary"],
        }
    )
    return fleet_from_tables(traces, points, crs="EPSG:32616", target_crs="EPSG:32616")


def embedded(page: str) -> dict[str, object]:
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert match is not None
    return json.loads(match[1])


def test_the_page_holds_edges_nodes_and_densities_but_no_trace(graph: RoadGraph, fleet: Fleet, tmp_path: Path) -> None:
    write_view(graph, tmp_path / "roads.html", traces=fleet, title="Main Street")
    page = (tmp_path / "roads.html").read_text()
    data = embedded(page)
    assert [feature["properties"]["edge"] for feature in data["edges"]["features"]] == [10, 11, 12]
    assert [feature["properties"]["kind"] for feature in data["nodes"]["features"]] == [
        "dead end",
        "junction",
        "dead end",
        "dead end",
    ]
    assert [image["name"] for image in data["densities"]] == ["traces", "lane_markings", "road_boundaries"]
    assert "secret" not in page
    assert "3 edges, 4 nodes, 0.6 km, from 2 traces" in page


def test_densities_lie_where_the_traces_are(graph: RoadGraph, fleet: Fleet, tmp_path: Path) -> None:
    write_view(graph, tmp_path / "roads.html", traces=fleet)
    data = embedded((tmp_path / "roads.html").read_text())
    image = data["densities"][0]
    (tmp_path / "traces.png").write_bytes(base64.b64decode(image["close"].removeprefix("data:image/png;base64,")))
    opacity = imread(tmp_path / "traces.png")[:, :, 3]
    col = int(np.flatnonzero(opacity.any(axis=0))[0])  # where the traces start
    row = int(np.flatnonzero(opacity[:, col])[0])
    (west, north), (east, south) = image["corners"][0], image["corners"][2]
    lon = west + (col + 0.5) / opacity.shape[1] * (east - west)
    lat = north + (row + 0.5) / opacity.shape[0] * (south - north)
    start = data["edges"]["features"][0]["geometry"]["coordinates"][0]
    assert abs(lon - start[0]) < 1.0 / 83000  # 1 m, the resolution
    assert abs(lat - start[1]) < 1.0 / 111000


def test_the_title_cannot_break_out_of_the_page(graph: RoadGraph, tmp_path: Path) -> None:
    evil = "</title></script><script>alert(1)</script>{{data}}"
    named = replace(graph, edges=graph.edges.assign(name=evil))
    write_view(named, tmp_path / "roads.html", title=evil)
    page = (tmp_path / "roads.html").read_text()
    assert "<script>alert" not in page
    assert embedded(page)["edges"]["features"][0]["properties"]["name"] == evil


def test_the_page_names_no_host_that_a_browser_would_ask(graph: RoadGraph, tmp_path: Path) -> None:
    write_view(graph, tmp_path / "roads.html")
    page = (tmp_path / "roads.html").read_text()
    assert "default-src 'none'" in page
    assert not re.search(r'(src|href)="?https?:', page.replace('href="https://maplibre.org/"', ""))
    assert "sourceMappingURL" not in page


def test_numbers_are_classed_by_quantiles_and_missing_values_said(graph: RoadGraph, tmp_path: Path) -> None:
    write_view(graph, tmp_path / "roads.html", color_by="support")
    first, *others = embedded((tmp_path / "roads.html").read_text())["attributes"]
    assert (first["name"], first["missing"]) == ("support", True)
    assert len(first["classes"]) == len(first["breaks"]) + 1
    assert "forward" not in [attribute["name"] for attribute in others]


def test_impossible_requests_are_named(graph: RoadGraph, tmp_path: Path) -> None:
    with pytest.raises(
        OptionError, match="edges cannot be coloured by 'forward'; use one of length, origin, support, score"
    ):
        write_view(graph, tmp_path / "roads.html", color_by="forward")
    with pytest.raises(OptionError, match="resolution is 0"):
        write_view(graph, tmp_path / "roads.html", resolution=0)
    with pytest.raises(OutputError, match="column 'vehicle_id' of the edges may identify drives"):
        write_view(replace(graph, edges=graph.edges.assign(vehicle_id=1)), tmp_path / "roads.html")
    assert list(tmp_path.iterdir()) == []


def in_browser(page: Path, url_hash: str = "", *, script: str = "") -> str:
    """Open a page headless and return its DOM when it has been drawn."""
    page.write_text(page.read_text().replace("</body>", f"<script>{script}</script></body>"))
    options = "--headless --no-sandbox --disable-gpu --use-angle=swiftshader --enable-unsafe-swiftshader"
    profile = f"--user-data-dir={page.parent / 'profile'}"
    command = [
        CHROMIUM,
        *options.split(),
        profile,
        "--virtual-time-budget=20000",
        "--dump-dom",
        f"{page.as_uri()}{url_hash}",
    ]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return result.stdout.replace(page.read_text(), "")


def body(dom: str) -> dict[str, str]:
    match = re.search(r"<body([^>]*)>", dom)
    assert match is not None
    return dict(re.findall(r'data-(\w+)="([^"]*)"', match[1]))


def panel(dom: str) -> dict[str, str]:
    details = dom[dom.index('<aside id="details"') : dom.index('id="data"')]
    rows = dict(re.findall(r'<th scope="row">(.*?)</th><td>(.*?)</td>', details))
    return {"heading": re.findall(r"<h2>(.*?)</h2>", details)[0], **rows} if 'hidden=""' not in details else {}


# A real click on the middle of edge 12, and a count of what the page asked the network for.
CLICK = """
const timer = setInterval(() => {
  if (document.body.dataset.state !== "ready") return;
  clearInterval(timer);
  const [a, b] = data.edges.features.find((f) => f.properties.edge === 12).geometry.coordinates;
  const lngLat = new maplibregl.LngLat((a[0] + b[0]) / 2, (a[1] + b[1]) / 2);
  map.fire("click", { point: map.project(lngLat), lngLat });
  document.body.dataset.hash = location.hash;
  const asked = performance.getEntriesByType("resource").filter((entry) => !/^(data|blob):/.test(entry.name));
  document.body.dataset.requests = asked.length;
}, 50);
"""


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium on the path to draw the page")
def test_chromium_draws_the_map_and_a_click_shows_the_edge(graph: RoadGraph, fleet: Fleet, tmp_path: Path) -> None:
    write_view(graph, tmp_path / "roads.html", traces=fleet)
    dom = in_browser(tmp_path / "roads.html", script=CLICK)
    state = body(dom)
    assert state["state"] == "ready", state
    assert int(state["rendered"]) >= 3
    assert (state["densities"], state["requests"], state["hash"]) == ("3", "0", "#edge=12")
    assert panel(dom) == {
        "heading": "Edge 12",
        "From node": "1",
        "To node": "3",
        "Length": "150.0 m",
        "Origin": "segmentation",
        "Support": "3",
        "Score": "not known",
        "Driven forward": "not known",
        "Driven backward": "not known",
    }


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium on the path to draw the page")
@pytest.mark.parametrize(("url_hash", "heading"), [("#edge=10", "Edge 10"), ("#edge=99", None)])
def test_chromium_opens_the_edge_that_the_address_names(
    graph: RoadGraph, tmp_path: Path, url_hash: str, heading: str | None
) -> None:
    write_view(graph, tmp_path / "roads.html")
    dom = in_browser(tmp_path / "roads.html", url_hash)
    assert body(dom)["state"] == "ready"
    assert panel(dom).get("heading") == heading


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium on the path to draw the page")
def test_chromium_draws_the_graph_without_roads(fleet: Fleet, tmp_path: Path) -> None:
    write_view(empty_graph("EPSG:32616"), tmp_path / "nothing.html", traces=fleet)
    state = body(in_browser(tmp_path / "nothing.html"))
    assert (state["state"], state["rendered"], state["densities"]) == ("ready", "0", "3")
