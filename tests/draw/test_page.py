from __future__ import annotations

import base64
import fcntl
import json
import os
import re
import select
import shutil
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.image import imread
from PIL import Image

from probe2road.draw.page import _indexed_png, write_page
from probe2road.errors import OptionError, OutputError
from probe2road.fleet.contract import Fleet, fleet_from_tables
from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from sketches import EAST, NORTH, UTM

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
    plain = graph_from_lines(lines, crs=UTM, attributes=attributes)
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
    return fleet_from_tables(traces, points, crs=UTM, keep_crs=True)


def embedded(page: str) -> dict[str, object]:
    match = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert match is not None
    return json.loads(match[1])


def test_the_page_holds_edges_nodes_and_densities_but_no_trace(graph: RoadGraph, fleet: Fleet, tmp_path: Path) -> None:
    write_page(graph, tmp_path / "roads.html", fleet=fleet, title="Main Street")
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
    write_page(graph, tmp_path / "roads.html", fleet=fleet)
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


def test_a_density_image_has_the_palette_colour_of_every_index(tmp_path: Path) -> None:
    """Opaque or not, each pixel is what its index says."""
    rng = np.random.default_rng(0)
    index = rng.integers(0, 256, (37, 53)).astype(np.uint8)
    palette, opacity = rng.integers(0, 256, (256, 3)).astype(np.uint8), rng.integers(0, 256, 256).astype(np.uint8)
    (tmp_path / "image.png").write_bytes(_indexed_png(index, palette, opacity))
    with Image.open(tmp_path / "image.png") as image:
        assert (image.mode, image.size) == ("P", (53, 37))
        assert (np.asarray(image) == index).all()
        colours = np.asarray(image.convert("RGBA"))
    assert (colours == np.column_stack([palette, opacity])[index]).all()


def test_the_title_cannot_break_out_of_the_page(graph: RoadGraph, tmp_path: Path) -> None:
    evil = "</title></script><script>alert(1)</script>{{data}}"
    named = replace(graph, edges=graph.edges.assign(name=evil))
    write_page(named, tmp_path / "roads.html", title=evil)
    page = (tmp_path / "roads.html").read_text()
    assert "<script>alert" not in page
    assert embedded(page)["edges"]["features"][0]["properties"]["name"] == evil


def test_the_page_names_no_host_that_a_browser_would_ask(graph: RoadGraph, tmp_path: Path) -> None:
    write_page(graph, tmp_path / "roads.html")
    page = (tmp_path / "roads.html").read_text()
    assert "default-src 'none'" in page
    assert not re.search(r'(src|href)="?https?:', page.replace('href="https://maplibre.org/"', ""))
    assert "sourceMappingURL" not in page


def test_numbers_are_classed_by_quantiles_and_missing_values_said(graph: RoadGraph, tmp_path: Path) -> None:
    write_page(graph, tmp_path / "roads.html", color_by="support")
    first, *others = embedded((tmp_path / "roads.html").read_text())["attributes"]
    assert (first["name"], first["missing"]) == ("support", True)
    assert len(first["classes"]) == len(first["breaks"]) + 1
    assert "forward" not in [attribute["name"] for attribute in others]


def test_impossible_requests_are_named(graph: RoadGraph, tmp_path: Path) -> None:
    with pytest.raises(
        OptionError, match="edges cannot be coloured by 'forward'; use one of length, origin, support, score"
    ):
        write_page(graph, tmp_path / "roads.html", color_by="forward")
    with pytest.raises(OptionError, match="resolution is 0"):
        write_page(graph, tmp_path / "roads.html", resolution=0)
    with pytest.raises(OutputError, match="column 'vehicle_id' of the edges may identify drives"):
        write_page(replace(graph, edges=graph.edges.assign(vehicle_id=1)), tmp_path / "roads.html")
    assert list(tmp_path.iterdir()) == []


needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium on the path to draw the page")


class Tab:
    """A page in headless Chromium, driven over the pipe of its DevTools protocol."""

    def __init__(self, commands: IO[bytes], answers: int) -> None:
        self.commands, self.answers = commands, answers
        self.buffer, self.last, self.session = b"", 0, ""
        self.requests: list[str] = []

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.last += 1
        session = {"sessionId": self.session} if self.session else {}
        self.commands.write(
            json.dumps({"id": self.last, "method": method, "params": params, **session}).encode() + b"\0"
        )
        self.commands.flush()
        while (answer := self.receive()).get("id") != self.last:
            if answer.get("method") == "Network.requestWillBeSent":
                self.requests.append(answer["params"]["request"]["url"])
        assert "error" not in answer, answer
        return answer["result"]

    def receive(self) -> dict[str, Any]:
        while b"\0" not in self.buffer:
            assert select.select([self.answers], [], [], 20)[0], "Chromium does not answer"
            self.buffer += os.read(self.answers, 1 << 20)
        message, self.buffer = self.buffer.split(b"\0", 1)
        return json.loads(message)

    def evaluate(self, expression: str) -> Any:
        return self.call("Runtime.evaluate", expression=expression, returnByValue=True)["result"].get("value")

    def state(self) -> dict[str, str]:
        return self.evaluate("({...document.body.dataset})")

    def panel(self) -> dict[str, str] | None:
        """Return what the panel of the selected edge shows, None where it is hidden."""
        rows = (
            "[...document.querySelectorAll('#details tr')].map((row) => [...row.cells].map((cell) => cell.textContent))"
        )
        shown = f"[['heading', document.querySelector('#details h2').textContent], ...{rows}]"
        return self.evaluate(f"document.getElementById('details').hidden ? null : Object.fromEntries({shown})")


@contextmanager
def opened(page: Path, url_hash: str = "") -> Iterator[Tab]:
    """Open a page in headless Chromium and wait until it is drawn, or says that it cannot be."""
    assert CHROMIUM is not None
    pipes = [os.pipe(), os.pipe()]
    (ours_out, theirs_out), (theirs_in, ours_in) = pipes[0], pipes[1]
    # Chromium reads commands from descriptor 3 and writes answers to 4: keep our own numbers clear of those.
    moved = [fcntl.fcntl(descriptor, fcntl.F_DUPFD, 20) for descriptor in (theirs_in, theirs_out)]
    actions = [
        (os.POSIX_SPAWN_DUP2, moved[0], 3),
        (os.POSIX_SPAWN_DUP2, moved[1], 4),
        (os.POSIX_SPAWN_OPEN, 2, os.devnull, os.O_WRONLY, 0),
    ]
    options = "--headless --no-sandbox --disable-gpu --use-angle=swiftshader --enable-unsafe-swiftshader"
    arguments = [CHROMIUM, *options.split(), "--remote-debugging-pipe", f"--user-data-dir={page.parent / 'profile'}"]
    process = os.posix_spawn(
        CHROMIUM, [*arguments, "--window-size=1000,700", "about:blank"], os.environ, file_actions=actions
    )
    for descriptor in (theirs_in, theirs_out, *moved):
        os.close(descriptor)
    with os.fdopen(ours_in, "wb") as commands:
        tab = Tab(commands, ours_out)
        try:
            target = next(found for found in tab.call("Target.getTargets")["targetInfos"] if found["type"] == "page")
            tab.session = tab.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
            tab.call("Network.enable")
            tab.call("Page.navigate", url=f"{page.as_uri()}{url_hash}")
            deadline = time.monotonic() + 60
            while (
                tab.evaluate("document.body?.dataset.state ?? 'loading'") == "loading" and time.monotonic() < deadline
            ):
                time.sleep(0.05)
            yield tab
        finally:
            os.close(ours_out)
            os.kill(process, signal.SIGKILL)
            os.waitpid(process, 0)


@needs_chromium
def test_chromium_draws_the_map_and_a_click_shows_the_edge(graph: RoadGraph, fleet: Fleet, tmp_path: Path) -> None:
    write_page(graph, tmp_path / "roads.html", fleet=fleet)
    with opened(tmp_path / "roads.html") as tab:
        state = tab.state()
        assert (state["state"], state["densities"]) == ("ready", "3")
        assert int(state["rendered"]) >= 3  # an edge may be drawn in two tiles
        assert tab.panel() is None
        middle = "data.edges.features[2].geometry.coordinates.reduce((a, b) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2])"
        point = tab.evaluate(f"map.project({middle})")
        for kind in ("mousePressed", "mouseReleased"):
            tab.call("Input.dispatchMouseEvent", type=kind, button="left", clickCount=1, x=point["x"], y=point["y"])
        assert tab.panel() == {
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
        assert tab.evaluate("location.hash") == "#edge=12"
        asked = [url for url in tab.requests if not url.startswith(("data:", "blob:"))]
        assert asked == [(tmp_path / "roads.html").as_uri()]


@needs_chromium
def test_chromium_hides_layers_and_changes_colours(graph: RoadGraph, fleet: Fleet, tmp_path: Path) -> None:
    write_page(graph, tmp_path / "roads.html", fleet=fleet)
    with opened(tmp_path / "roads.html") as tab:
        tab.evaluate("document.querySelector('#layers input').click()")
        assert tab.evaluate("map.getLayoutProperty('traces-far', 'visibility')") == "none"
        choose = (
            "const s = document.getElementById('color-by'); s.value = 'support'; s.dispatchEvent(new Event('change'))"
        )
        tab.evaluate(f"{{ {choose} }}")
        assert "not known" in tab.evaluate("document.getElementById('legend').textContent")
        assert tab.evaluate("JSON.stringify(map.getPaintProperty('edges', 'line-color'))").count("support") == 2


@needs_chromium
def test_chromium_opens_the_edge_that_the_address_names(graph: RoadGraph, tmp_path: Path) -> None:
    write_page(graph, tmp_path / "roads.html")
    with opened(tmp_path / "roads.html", "#edge=10") as tab:
        assert tab.state()["state"] == "ready"
        panel = tab.panel()
        assert panel is not None
        assert panel["heading"] == "Edge 10"
        assert tab.evaluate("selectEdge(99)") is False
        assert tab.panel() is None


@needs_chromium
def test_chromium_draws_the_graph_without_roads(fleet: Fleet, tmp_path: Path) -> None:
    write_page(empty_graph("EPSG:32616"), tmp_path / "nothing.html", fleet=fleet)
    with opened(tmp_path / "nothing.html") as tab:
        assert tab.state() == {"state": "ready", "rendered": "0", "densities": "3"}
