"""Labels: reference centrelines where enough traces drive them.

A segmentation network cannot be asked for roads that its input does not show. The paper therefore keeps a reference
centreline only where at least N = 4 traces were matched to it.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd

from probe2road.bounds import Above, AtMost, NotNegative, OneOf, Positive
from probe2road.crs import require_same_crs
from probe2road.fleet.contract import Fleet
from probe2road.graph.roadgraph import RoadGraph
from probe2road.graph.splitting import split_edges
from probe2road.graph.tables import empty_turns, finish_edges
from probe2road.matching.frame import frame
from probe2road.matching.match import MatchOptions, match
from probe2road.matching.osrm import OsrmOptions, osrm_network, osrm_segments, osrm_server
from probe2road.options import checked

__all__ = ["MATCHERS", "LabelOptions", "cut_reference", "label", "label_pieces"]

logger = logging.getLogger(__name__)

MATCHERS = ("own", "osrm")


@dataclass(frozen=True)
@checked
class LabelOptions:
    """When a piece of a reference counts as driven (METHOD 5.2)."""

    min_traces: NotNegative[int] = 4  # distinct traces; the N of the paper
    max_piece: Positive[float] = 100.0  # m; longer edges are first cut into equal pieces of at least half of this
    min_share: Annotated[float, Above(0), AtMost(1)] = 0.5  # least share of a piece that a trace must cover
    matcher: Annotated[str, OneOf(*MATCHERS)] = "own"  # which matcher finds the edges of a trace
    match: MatchOptions = field(default=MatchOptions())  # options of our own matcher
    osrm: OsrmOptions = field(default=OsrmOptions())
    osrm_url: str | None = None  # server that runs on the graph that osrm_network makes of the cut reference
    osrm_folder: Path | None = None  # folder of OSRM's programs; None: where find_osrm looks


def label(reference: RoadGraph, fleet: Fleet, *, options: LabelOptions | None = None) -> RoadGraph:
    """Keep the pieces of a reference graph that enough traces of a fleet drive.

    Parameters
    ----------
    reference
        Centrelines, connected where one can drive from one to the other; one-way where the graph says so.
    fleet
        Traces in the same CRS.
    options
        None takes the defaults.

    Returns
    -------
    RoadGraph
        The pieces, with ``support`` counted on this fleet; other attributes are those of their edges. The column
        ``reference_edge`` says which these were. Nodes without an edge and turns are left out.

    Raises
    ------
    CRSError
        If reference and fleet are in different CRS.
    MissingExtraError
        If OSRM is asked for and not installed.
    InputError
        If the OSRM server cannot be reached.

    Notes
    -----
    Paper, section III-A; METHOD 5.2 and 0.1 row 33.

    Examples
    --------
    >>> from probe2road.fleet.contract import fleet_from_tables
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> reference = graph_from_lines([[(0, 0), (240, 0)], [(240, 0), (240, 90)]], crs="EPSG:32616")
    >>> there = pd.DataFrame({"t": range(15), "x": np.arange(5.0, 155, 10), "y": 1.0})
    >>> drives = pd.concat([there.assign(trace_id=k) for k in range(4)])
    >>> fleet = fleet_from_tables(drives, crs="EPSG:32616", keep_crs=True)
    >>> label(reference, fleet).edges[["reference_edge", "length", "support"]].values.tolist()
    [[0, 80.0, 4], [0, 80.0, 4]]
    """
    options = options or LabelOptions()
    pieces, driven = label_pieces(reference, fleet, options)
    length = pieces.edges["length"].to_numpy()
    support = np.bincount(pieces.edges.index.get_indexer(driven["edge"]), minlength=len(length))
    kept = support >= options.min_traces
    edges = pieces.edges.assign(support=pd.array(support, "Int64"))[kept]
    nodes = pieces.nodes[pieces.nodes.index.isin(np.unique(edges[["u", "v"]]))]
    logger.info(
        "kept %.1f of %.1f km: pieces that at least %d traces drive (%s)",
        length[kept].sum() / 1000, length.sum() / 1000, options.min_traces, options.matcher,
    )  # fmt: skip
    return replace(pieces, nodes=nodes, edges=finish_edges(edges), turns=empty_turns())


def label_pieces(reference: RoadGraph, fleet: Fleet, options: LabelOptions) -> tuple[RoadGraph, pd.DataFrame]:
    """Cut a reference graph into pieces, and list which trace drives which piece.

    Parameters
    ----------
    reference, fleet, options
        As for `label`; the minimum number of traces is not looked at.

    Returns
    -------
    RoadGraph
        The pieces, see `cut_reference`.
    DataFrame
        ``trace_id``, ``edge`` (id of the piece): each pair once.

    Raises
    ------
    CRSError, MissingExtraError, InputError
        As `label`.
    """
    require_same_crs(fleet.crs, reference.crs, where="label", what=("the traces are", "the reference is"))
    pieces = cut_reference(reference, max_piece=options.max_piece)
    ask = _covered_by_osrm if options.matcher == "osrm" else _covered_by_own
    table = _joined(ask(pieces, fleet, options))
    covered = table.groupby(["trace", "edge"])["length"].sum().reset_index()
    length = pieces.edges["length"].to_numpy()
    driven = covered[covered["length"].to_numpy() >= options.min_share * length[covered["edge"]]]
    return pieces, pd.DataFrame(
        {"trace_id": fleet.ids[driven["trace"]], "edge": pieces.edges.index.to_numpy()[driven["edge"]]}
    )


def cut_reference(reference: RoadGraph, *, max_piece: float = 100.0) -> RoadGraph:
    """Cut edges that are longer than ``max_piece`` (m) into as few equal pieces as possible.

    The pieces are therefore at least half as long. The column ``reference_edge`` holds the id of the edge that a
    piece was cut from; the first piece keeps that id.

    Examples
    --------
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> graph = graph_from_lines([[(0, 0), (210, 0)], [(210, 0), (210, 60)]], crs="EPSG:32616")
    >>> cut_reference(graph).edges[["length", "reference_edge"]].values.tolist()
    [[70.0, 0.0], [60.0, 1.0], [70.0, 0.0], [70.0, 0.0]]
    """
    named = replace(reference, edges=reference.edges.assign(reference_edge=reference.edges.index.to_numpy()))
    length = reference.edges["length"].to_numpy()
    count = np.maximum(np.ceil(length / max_piece - 1e-9), 1).astype(np.int64)
    row = np.repeat(np.arange(len(length)), count - 1)
    number = np.arange(len(row)) - np.repeat(np.cumsum(count - 1) - (count - 1), count - 1) + 1
    along = number * (length / count)[row]
    return split_edges(named, reference.edges.index.to_numpy()[row], along)[0]


def _covered_by_own(pieces: RoadGraph, fleet: Fleet, options: LabelOptions) -> pd.DataFrame:
    """List the stretches that traces cover, from our matcher: ``trace``, ``edge`` (row), ``low``, ``high`` (m)."""
    driven, _ = frame(pieces, fleet, match(pieces, fleet, options=options.match))
    return pd.DataFrame({"trace": driven.trace, "edge": driven.edge, "low": driven.low, "high": driven.high})


def _covered_by_osrm(pieces: RoadGraph, fleet: Fleet, options: LabelOptions) -> pd.DataFrame:
    """List the stretches that traces cover, from OSRM, with the same columns as from our matcher."""
    if not len(pieces.edges):  # OSRM refuses to make a network of nothing
        return pd.DataFrame({name: np.zeros(0, np.int64) for name in ("trace", "edge", "low", "high")})
    network = osrm_network(pieces, options.osrm)
    if options.osrm_url is not None:
        trace, segment = osrm_segments(fleet, network, options.osrm_url, options.osrm)
    else:
        with osrm_server(network, folder=options.osrm_folder) as url:
            trace, segment = osrm_segments(fleet, network, url, options.osrm)
    stretch = {"edge": network.edge[segment], "low": network.low[segment], "high": network.high[segment]}
    return pd.DataFrame({"trace": trace, **stretch})


def _joined(table: pd.DataFrame) -> pd.DataFrame:
    """Shorten stretches of one trace on one edge so that they do not overlap, and add their ``length``."""
    table = table.sort_values(["trace", "edge", "low"], kind="stable")
    reached = table.groupby(["trace", "edge"])["high"].cummax()
    before = reached.groupby([table["trace"], table["edge"]]).shift(1).fillna(-np.inf)
    return table.assign(length=(table["high"] - np.maximum(table["low"], before)).clip(lower=0.0))
