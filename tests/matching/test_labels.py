from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import ndimage

from probe2road.errors import CRSError, InputError, MissingExtraError, OptionError
from probe2road.fleet.contract import Fleet
from probe2road.graph.check import check_graph
from probe2road.graph.roadgraph import RoadGraph, empty_graph, graph_from_lines
from probe2road.matching import osrm as osrm_module
from probe2road.matching.labels import LabelOptions, cut_reference, label
from probe2road.matching.osrm import OsrmOptions, find_osrm, osrm_network, osrm_segments, osrm_server
from probe2road.raster.drawing import label_mask
from probe2road.raster.grid import Grid
from probe2road.simulation.drawn.generate import generate_interchange
from probe2road.simulation.fleet_simulation import simulate
from sketches import EAST, NORTH, UTM, fleet_of, graph_of, spaced


def road(*corners: tuple[float, float]) -> list[tuple[float, float]]:
    """Move a line to a place that exists, which OSRM asks for."""
    return [(EAST + x, NORTH + y) for x, y in corners]


TEE = [road((0, 0), (200, 0)), road((200, 0), (500, 0)), road((200, 0), (200, 90))]


def fleet(*lines: list[tuple[float, float]], spacing: float = 10.0) -> Fleet:
    """Return one trace per line, with fixes at 10 m/s."""
    return fleet_of(*(spaced(*line, spacing=spacing, start=1.0) for line in lines), interval=spacing / 10.0)


@pytest.fixture
def tee() -> RoadGraph:
    return graph_of(*TEE)


@pytest.fixture
def osrm() -> Path:
    try:
        return find_osrm()
    except MissingExtraError as error:
        pytest.skip(str(error))


@pytest.fixture(params=["own", "osrm"])
def options(request: pytest.FixtureRequest) -> LabelOptions:
    if request.param == "osrm":
        request.getfixturevalue("osrm")
    return LabelOptions(matcher=request.param)


def kept(labels: RoadGraph) -> list[tuple[int, int]]:
    """Return the reference edge and support of every piece."""
    return sorted(zip(labels.edges["reference_edge"].tolist(), labels.edges["support"].tolist(), strict=True))


def test_pieces_that_four_traces_drive_are_kept(tee: RoadGraph, options: LabelOptions) -> None:
    data = fleet(*[road((0, 1), (500, 1))] * 3, road((0, 1), (370, 1)), road((200, 90), (200, 0), (0, 0)))
    labels = label(tee, data, options=options)
    check_graph(labels)
    # The last of three pieces between 200 m and 500 m has three traces; the fourth ends halfway through the second.
    assert kept(labels) == [(0, 5), (0, 5), (1, 4), (1, 4)]
    assert set(labels.nodes.index) == set(np.unique(labels.edges[["u", "v"]]))
    assert labels.turns.empty
    assert kept(label(tee, data, options=replace(options, min_traces=1)))[-1] == (2, 1)


def test_a_trace_counts_once_however_often_it_comes(tee: RoadGraph) -> None:
    to_and_fro = road(*[(x, 0) for x in (0, 190, 10, 190, 10, 190)])
    assert kept(label(tee, fleet(to_and_fro), options=LabelOptions(min_traces=1))) == [(0, 1), (0, 1)]


def test_the_same_stretch_twice_is_not_half_a_piece(tee: RoadGraph) -> None:
    there_and_back = road((165, 0), (199, 0), (165, 0))
    assert label(tee, fleet(there_and_back), options=LabelOptions(min_traces=1)).edges.empty


def test_pieces_are_between_half_and_whole() -> None:
    lengths = np.array([40.0, 100.0, 100.5, 260.0, 999.0])
    graph = graph_of(*([(0, 50 * k), (length, 50 * k)] for k, length in enumerate(lengths)))
    cut = cut_reference(graph, max_piece=100.0)
    check_graph(cut)
    assert cut.edges.groupby("reference_edge")["length"].sum().tolist() == pytest.approx(lengths.tolist())
    assert cut.edges["length"].max() <= 100.0
    assert (cut.edges["length"] >= 50.0).sum() == len(cut.edges) - 1
    assert len(cut_reference(graph, max_piece=5000.0).edges) == len(graph.edges)


def test_own_labels_are_true_on_a_simulated_interchange() -> None:
    result = simulate(
        generate_interchange("diamond", rng=np.random.default_rng(1)), preset="mixed", n_drives=12, seed=1
    )
    labels = label(result.reference, result.fleet)
    truth = result.reference.edges["support"]
    driven = labels.edges["reference_edge"].map(truth) >= 4
    assert labels.edges["length"][driven].sum() > 0.98 * labels.length
    assert labels.length == pytest.approx(result.reference.edges["length"][truth >= 4].sum(), rel=0.03)


def test_mask_is_thin_and_connected() -> None:
    rng = np.random.default_rng(2)
    graph = graph_of(rng.uniform(0, 200, (5, 2)))
    grid = Grid.from_bounds(graph.bounds, crs=UTM)
    mask = label_mask(graph, grid)
    _, parts = ndimage.label(mask, np.ones((3, 3)))
    assert parts == 1
    straight = label_mask(graph_of([(0.5, 0.5), (90.5, 30.5)]), Grid.from_bounds((0, 0, 99, 40), crs=UTM))
    assert straight.sum() == 91
    assert (straight.sum(axis=0) <= 1).all()


def test_mask_does_not_depend_on_the_direction_of_edges_and_ends_at_the_grid() -> None:
    lines = [[(0.5, 0.5), (60.5, 37.5)], [(60.5, 37.5), (300.5, 10.5)]]
    grid = Grid.from_bounds((0, 0, 100, 50), crs=UTM)
    one, other = (label_mask(graph_of(*drawn), grid) for drawn in (lines, [x[::-1] for x in lines]))
    assert (one == other).all()
    assert one[:, -1].sum() == 1


def test_wide_mask_is_the_thin_one_dilated() -> None:
    graph = graph_of([(10.5, 10.5), (40.5, 22.5)])
    grid = Grid.from_bounds((0, 0, 50, 40), crs=UTM)
    wide = ndimage.binary_dilation(label_mask(graph, grid), np.ones((3, 3)))
    assert (label_mask(graph, grid, width=3) == wide).all()


def test_bad_options_and_crs(tee: RoadGraph) -> None:
    for wrong in ({"matcher": "magic"}, {"min_share": 0.0}, {"max_piece": -5.0}):
        with pytest.raises(OptionError, match=next(iter(wrong))):
            LabelOptions(**wrong)  # type: ignore[arg-type]
    with pytest.raises(OptionError, match="overlap"):
        OsrmOptions(chunk=5)
    with pytest.raises(CRSError):
        label(tee.to_crs("EPSG:32617"), fleet(road((0, 0), (200, 0))))
    grid = Grid.from_bounds(tee.bounds, crs="EPSG:32617")
    with pytest.raises(CRSError):
        label_mask(tee, grid)
    with pytest.raises(OptionError, match="width"):
        label_mask(tee, Grid.from_bounds(tee.bounds, crs=UTM), width=0)


def test_missing_osrm_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch, tee: RoadGraph) -> None:
    monkeypatch.delenv("PROBE2ROAD_OSRM", raising=False)
    monkeypatch.setattr(osrm_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'probe2road\[osrm\]'"):
        label(tee, fleet(road((0, 0), (200, 0))), options=LabelOptions(matcher="osrm"))
    monkeypatch.setenv("PROBE2ROAD_OSRM", "/nowhere")
    with pytest.raises(InputError, match="osrm-routed"):
        find_osrm()


@pytest.mark.parametrize("matcher", ["own", "osrm"])
def test_empty_reference_has_no_labels(matcher: str) -> None:
    labels = label(empty_graph(UTM), fleet(road((0, 0), (200, 0))), options=LabelOptions(matcher=matcher))
    assert labels.edges.empty
    assert label_mask(labels, Grid.from_bounds((0, 0, 9, 9), crs=UTM)).sum() == 0


def test_server_that_is_not_there(tee: RoadGraph) -> None:
    options = LabelOptions(matcher="osrm", osrm_url="http://127.0.0.1:9")
    with pytest.raises(InputError, match="cannot be reached"):
        label(tee, fleet(road((0, 0), (200, 0))), options=options)


def test_segments_are_found_in_either_order(tee: RoadGraph) -> None:
    network = osrm_network(tee)
    assert (network.high - network.low).max() <= 20.0 + 1e-6
    there = network.segment(network.vertices[:, 0], network.vertices[:, 1])
    assert there.tolist() == network.segment(network.vertices[:, 1], network.vertices[:, 0]).tolist()
    assert there.tolist() == list(range(len(network.edge)))
    assert network.segment(np.array([0]), np.array([0])).tolist() == [-1]


@pytest.fixture
def server(tee: RoadGraph, osrm: Path) -> Iterator[str]:
    with osrm_server(osrm_network(tee), folder=osrm) as url:
        yield url


def test_requests_in_pieces_find_the_same(tee: RoadGraph, server: str) -> None:
    network = osrm_network(tee)
    data = fleet(road((0, 1), (500, 1)), road((200, 90), (200, 0), (0, 0)), road((0, 3000), (500, 3000)))
    whole, pieces = (osrm_segments(data, network, server, OsrmOptions(chunk=chunk)) for chunk in (200, 15))
    assert (whole[0].tolist(), whole[1].tolist()) == (pieces[0].tolist(), pieces[1].tolist())
    assert set(whole[0]) == {0, 1}  # the third is far from any road


def test_server_is_gone_afterwards(tee: RoadGraph, osrm: Path) -> None:
    with osrm_server(osrm_network(tee), folder=osrm) as url:
        pass
    with pytest.raises(InputError, match="cannot be reached"):
        osrm_segments(fleet(road((0, 0), (200, 0))), osrm_network(tee), url)


def test_one_way_roads_are_closed_to_osrm(osrm: Path) -> None:
    graph = graph_from_lines(TEE[:2], crs=UTM, attributes=pd.DataFrame({"oneway": ["yes", "yes"]}))
    against = fleet(*[road((500, 1), (0, 1))] * 4)
    options = LabelOptions(matcher="osrm", osrm_folder=osrm)
    closed = label(graph, against, options=options)
    opened = label(graph, against, options=replace(options, osrm=OsrmOptions(respect_oneway=False)))
    assert closed.length < opened.length == pytest.approx(500.0)


def test_environment_names_the_folder(osrm: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PROBE2ROAD_OSRM", os.fspath(osrm.parent))
    assert find_osrm() == osrm
