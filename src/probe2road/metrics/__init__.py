"""Scores of a proposed road graph, or of a mask, against a reference.

Each metric has a module, a frozen dataclass of parameters, and a function of two road graphs; `evaluate` runs
several of them on graphs that are normalised once.
"""

from __future__ import annotations

from probe2road.metrics.apls import AplsOptions, apls
from probe2road.metrics.buffer import BufferGeoOptions, buffer_geo
from probe2road.metrics.evaluate import DEFAULT_METRICS, METRICS, evaluate
from probe2road.metrics.geo import HE_BALAKRISHNAN_2022, GeoOptions, GeoSamples, geo, geo_samples
from probe2road.metrics.graph_sampling import GraphSamplingOptions, graph_sampling
from probe2road.metrics.itopo import ItopoOptions, Pairs, itopo, itopo_pairs
from probe2road.metrics.junctions import JunctionOptions, JunctionPairs, junction_pairs, junctions
from probe2road.metrics.lateral import LateralOptions, lateral, lateral_gaps
from probe2road.metrics.normalise import clip_graph, comparable
from probe2road.metrics.scores import SCORE_DTYPES, Score, scores_table
from probe2road.metrics.soft_f1 import soft_f1
from probe2road.metrics.topo import TopoOptions, topo

__all__ = [
    "DEFAULT_METRICS",
    "HE_BALAKRISHNAN_2022",
    "METRICS",
    "SCORE_DTYPES",
    "AplsOptions",
    "BufferGeoOptions",
    "GeoOptions",
    "GeoSamples",
    "GraphSamplingOptions",
    "ItopoOptions",
    "JunctionOptions",
    "JunctionPairs",
    "LateralOptions",
    "Pairs",
    "Score",
    "TopoOptions",
    "apls",
    "buffer_geo",
    "clip_graph",
    "comparable",
    "evaluate",
    "geo",
    "geo_samples",
    "graph_sampling",
    "itopo",
    "itopo_pairs",
    "junction_pairs",
    "junctions",
    "lateral",
    "lateral_gaps",
    "scores_table",
    "soft_f1",
    "topo",
]
