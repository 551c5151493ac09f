"""From a simulated drive to the tables of fleet data, and from routes to the true numbers of drives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from probe2road.fleet.contract import POINT_KINDS
from probe2road.graph.roadgraph import RoadGraph
from probe2road.simulation.driving.routes import LinkGraph, route_moves
from probe2road.simulation.driving.traffic import TruePoses
from probe2road.simulation.sensors.camera import Detections

__all__ = ["DriveLabels", "RecordedPoses", "count_drives", "drive_tables"]

_CENTIMETRES = 2  # decimals kept of recorded coordinates


@dataclass(frozen=True)
class DriveLabels:
    """The ids and the start time of one drive in the data."""

    trace_id: int
    vehicle_id: int
    departure: np.datetime64  # UTC, to the millisecond


@dataclass(frozen=True)
class RecordedPoses:
    """The n poses that a vehicle recorded of its motion."""

    rows: NDArray[np.int64]  # (n,) row of the true pose
    xyz: NDArray[np.float64]  # (n, 3) m
    heading: NDArray[np.float64]  # (n,) radians clockwise from north
    sigma: NDArray[np.float64]  # (n,) m, horizontal, 1 sigma, as the vehicle believes


def drive_tables(
    graph: LinkGraph,
    section_id: NDArray[np.int64],
    labels: DriveLabels,
    poses: TruePoses,
    recorded: RecordedPoses,
    seen: Detections | None,
) -> dict[str, pd.DataFrame]:
    """Convert one drive to tables.

    Parameters
    ----------
    graph
        The links that ``poses.route`` counts in.
    section_id
        Id of each section row.
    labels
        Which drive this is.
    poses, recorded, seen
        What happened, what the vehicle recorded of it, and what its camera saw (None without camera).

    Returns
    -------
    dict of str to DataFrame
        ``traces``, ``points``, ``poses``, ``routes``: see `probe2road.simulation.fleet_simulation.SimulatedFleet`.
    """
    rows, route, number = recorded.rows, poses.route, labels.trace_id
    t = pd.DatetimeIndex(labels.departure + (poses.t * 1000.0).round().astype("timedelta64[ms]"), tz="UTC").as_unit(
        "ns"
    )
    heading = np.degrees(recorded.heading) % 360.0
    speed = poses.speed[rows]
    base = {"trace_id": number, "t": t[rows]}
    traces = pd.DataFrame(
        base
        | dict(zip("xyz", recorded.xyz.round(_CENTIMETRES).T, strict=True))
        | {"vehicle_id": labels.vehicle_id, "heading": heading.round(2)}
        | {"speed": speed.round(2), "accuracy": recorded.sigma.round(2)}
    )
    truth = pd.DataFrame(
        base
        | dict(zip("xyz", poses.xyz[rows].round(_CENTIMETRES).T, strict=True))
        | {"heading": (np.degrees(poses.heading[rows]) % 360.0).round(2)}
        | {"section": section_id[poses.section[rows]], "lane": poses.lane[rows]}
    )
    via = np.concatenate([[-1], graph.via[route_moves(graph, route)]])
    driven = pd.DataFrame(
        {
            "trace_id": number,
            "position": np.arange(len(route)),
            "section": section_id[graph.section[route]],
            "direction": graph.direction[route],
            "via_node": via,
        }
    )
    return {"traces": traces, "points": _points(number, t, recorded, seen), "poses": truth, "routes": driven}


def _points(number: int, t: pd.DatetimeIndex, recorded: RecordedPoses, seen: Detections | None) -> pd.DataFrame:
    """Place camera points with the pose that the vehicle recorded: the fused pose, applied to the vehicle frame."""
    if seen is None:
        frame, body, kind = np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, np.int8)
    else:
        frame, body, kind = seen.keyframe, seen.body, seen.kind
    heading, origin = recorded.heading[frame], recorded.xyz[frame]
    sin, cos = np.sin(heading), np.cos(heading)
    world = {
        "x": origin[:, 0] + body[:, 0] * sin + body[:, 1] * cos,
        "y": origin[:, 1] + body[:, 0] * cos - body[:, 1] * sin,
        "z": origin[:, 2] + body[:, 2],
    }
    rounded = {name: values.round(_CENTIMETRES) for name, values in world.items()}
    kinds = pd.Categorical.from_codes(kind, categories=POINT_KINDS)
    return pd.DataFrame({"trace_id": number, "t": t[frame], **rounded, "kind": kinds}).astype({"trace_id": "int64"})


def count_drives(reference: RoadGraph, routes: pd.DataFrame) -> RoadGraph:
    """Write the true numbers of drives into a reference graph.

    Parameters
    ----------
    reference
        Edges indexed by section id.
    routes
        As in `SimulatedFleet`; those of several chunks may be concatenated.

    Returns
    -------
    RoadGraph
        ``support``: distinct drives; ``forward``, ``backward``: traversals; turns: traversals of each transition. Zero
        where nobody drove.
    """
    edges = reference.edges.index
    support = routes.drop_duplicates(["trace_id", "section"])["section"].value_counts()
    ways = {name: routes.loc[routes["direction"] == way, "section"] for name, way in (("forward", 1), ("backward", -1))}
    counts = {"support": support} | {name: driven.value_counts() for name, driven in ways.items()}
    columns = {name: values.reindex(edges, fill_value=0).astype("Int64") for name, values in counts.items()}
    entered = routes["via_node"] >= 0
    turns = pd.DataFrame(
        {
            "from_edge": routes["section"].shift(1)[entered],
            "via_node": routes.loc[entered, "via_node"],
            "to_edge": routes.loc[entered, "section"],
        }
    ).astype("int64")
    turns = turns.value_counts().rename("count").reset_index().sort_values(["from_edge", "via_node", "to_edge"])
    return replace(
        reference, edges=reference.edges.assign(**columns), turns=turns.astype("int64").reset_index(drop=True)
    )
