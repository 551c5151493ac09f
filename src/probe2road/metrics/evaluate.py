"""Evaluation: any number of metrics of one proposal against one reference."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import pandas as pd

from probe2road.crs import extents_apart
from probe2road.errors import OptionError
from probe2road.graph.roadgraph import RoadGraph
from probe2road.metrics.apart import ApartOptions, apart_networks
from probe2road.metrics.apls import AplsOptions, apls_networks
from probe2road.metrics.buffer import BufferGeoOptions, buffer_geo_networks
from probe2road.metrics.geo import GeoOptions, geo_networks
from probe2road.metrics.graph_sampling import GraphSamplingOptions, graph_sampling_networks
from probe2road.metrics.itopo import ItopoOptions, itopo_networks
from probe2road.metrics.junctions import JunctionOptions, junctions_networks
from probe2road.metrics.lateral import LateralOptions, lateral_networks
from probe2road.metrics.network import network_from_graph
from probe2road.metrics.normalise import comparable
from probe2road.metrics.scores import Score, scores_table
from probe2road.metrics.topo import TopoOptions, topo_networks

__all__ = ["DEFAULT_METRICS", "METRICS", "MetricOptions", "evaluate"]

logger = logging.getLogger(__name__)

MetricOptions = (
    GeoOptions
    | ItopoOptions
    | TopoOptions
    | AplsOptions
    | BufferGeoOptions
    | GraphSamplingOptions
    | JunctionOptions
    | LateralOptions
    | ApartOptions
)

# The short names of metrics with their default parameters, for the command line and for quick calls.
METRICS: dict[str, MetricOptions] = {
    "geo": GeoOptions(),
    "itopo": ItopoOptions(),
    "itopo_strict": ItopoOptions(strict=True),
    "topo": TopoOptions(),
    "apls": AplsOptions(),
    "buffer_geo": BufferGeoOptions(),
    "graph_sampling": GraphSamplingOptions(),
    "junctions": JunctionOptions(),
    "lateral": LateralOptions(),
    "apart": ApartOptions(),
}
DEFAULT_METRICS = ("geo", "itopo", "itopo_strict", "topo", "apls")

_SCORERS: dict[type, Callable[..., Score | list[Score]]] = {
    GeoOptions: geo_networks,
    ItopoOptions: itopo_networks,
    TopoOptions: topo_networks,
    AplsOptions: apls_networks,
    BufferGeoOptions: buffer_geo_networks,
    GraphSamplingOptions: graph_sampling_networks,
    JunctionOptions: junctions_networks,
    LateralOptions: lateral_networks,
    ApartOptions: apart_networks,
}


def evaluate(
    proposal: RoadGraph,
    reference: RoadGraph,
    *,
    metrics: str | MetricOptions | Sequence[str | MetricOptions] = DEFAULT_METRICS,
    area: Any = None,
    merge: bool = True,
) -> pd.DataFrame:
    """Score a proposed road graph against a reference graph.

    Parameters
    ----------
    proposal, reference
        Road graphs in metric CRS; the proposal is reprojected to the CRS of the reference. Either may be empty and
        then scores 0. Where all scores are 0, a warning says why.
    metrics
        A name out of `METRICS`, or options of a metric where its defaults do not suit, or several of them: ``["geo",
        GeoOptions(radius=15)]`` scores twice.
    area
        Clip both graphs to this polygon or ``(left, bottom, right, top)`` first, in the CRS of the reference.
    merge
        Whether to drop twin edges and merge nodes of degree 2 first. Without it scores depend on how edges are cut.

    Returns
    -------
    DataFrame
        One row per score, see `SCORE_DTYPES`; parameters are JSON.

    Raises
    ------
    CRSError
        If a graph is not in metres.
    OptionError
        If a metric is unknown.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (100, 0)], [(100, 0), (100, 50)]], crs="EPSG:32616")
    >>> evaluate(graph, graph, metrics=["geo", GeoOptions(radius=15.0)])[["metric", "f1", "reference"]]
      metric   f1  reference
    0    geo  1.0       15.0
    1    geo  1.0       15.0
    """
    wanted = metrics if isinstance(metrics, Sequence) and not isinstance(metrics, str) else [metrics]
    options = [_resolve(metric) for metric in wanted]
    first, second = comparable(proposal, reference, area=area, merge=merge)
    networks = network_from_graph(first), network_from_graph(second)
    scores: list[Score] = []
    for option in options:
        started = perf_counter()
        result = _SCORERS[type(option)](*networks, option)
        scores += result if isinstance(result, list) else [result]
        logger.info("%s, %.1f s", scores[-1], perf_counter() - started)
    if not any(score.precision > 0 or score.recall > 0 for score in scores):
        logger.warning("nothing of the proposal is in the reference: %s", _reason(first, second))
    return scores_table(scores)


def _reason(proposal: RoadGraph, reference: RoadGraph) -> str:
    """Say why two graphs have nothing in common."""
    for name, graph in (("proposal", proposal), ("reference", reference)):
        if graph.edges.empty:
            return f"the {name} has no edges in the area"
    places = extents_apart(proposal, reference)
    if places is None:
        return "they are near each other, but no metric finds a road that both have"
    return f"the proposal is at {places[0]}, the reference at {places[1]}"


def _resolve(metric: str | MetricOptions) -> MetricOptions:
    if isinstance(metric, str):
        if metric not in METRICS:
            raise OptionError(f"there is no metric {metric!r}", where="evaluate", fix=f"use {', '.join(METRICS)}")
        return METRICS[metric]
    if type(metric) not in _SCORERS:
        raise OptionError(
            f"{type(metric).__name__} are not options of a metric", where="evaluate", fix="use GeoOptions or alike"
        )
    return metric
