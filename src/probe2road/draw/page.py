"""One self-contained HTML file: traces as a density layer, the road graph over it, and attributes on a click.

The page needs no network: MapLibre, the style and all data are inside, and its content security policy
forbids every request. Densities are counted in Web Mercator, the projection of the page, so that traces and
edges lie on each other at every zoom.
"""

from __future__ import annotations

import base64
import html
import io
import json
import logging
import re
from importlib import resources
from os import PathLike
from typing import Any

import geopandas as gpd
import numpy as np
import pandas as pd
from numpy.typing import NDArray
from PIL import Image
from pyproj import CRS

from probe2road.crs import WGS84, crs_title, transform
from probe2road.errors import OptionError
from probe2road.fleet.contract import Fleet, TraceGaps
from probe2road.graph.roadgraph import RoadGraph
from probe2road.io.atomic import atomic_path
from probe2road.io.graph_tables import outgoing
from probe2road.io.graph_writers import geojson_features
from probe2road.raster.counts import rasterize, without_rare
from probe2road.raster.grid import Grid

__all__ = ["page_text", "write_page"]

logger = logging.getLogger(__name__)

_WEB_MERCATOR = CRS.from_epsg(3857)
_MAPLIBRE = "_vendor/maplibre-gl-5.24.1"
_LARGEST_IMAGE = 4096  # pixels of the longer side; a texture that every graphics card takes
_MARGIN = 50.0  # m around the traces in which semantic points are shown
_FAR = 4  # pixels of the image for close views in one of the image for far views
_MERCATOR_PER_PIXEL = 40075016.686 / 512  # Web Mercator metres per screen pixel at zoom 0
_DECIMALS = 7  # of a degree: 1 cm
_MOST_CATEGORIES = 8
_CLASSES = 5  # of a number, with equally many edges each

_DENSITIES = (  # name, label, lightest and darkest colour (paper Fig. 1: markings green, boundaries red)
    ("traces", "Traces", (172, 186, 201), (36, 52, 71)),
    ("lane_markings", "Lane markings", (150, 208, 150), (16, 96, 36)),
    ("road_boundaries", "Road boundaries", (245, 170, 160), (168, 22, 22)),
)
_ORIGIN_COLORS = {"segmentation": "#1c7ed6", "gap": "#f08c00", "reference": "#7048e8"}
_CATEGORY_COLORS = ("#1c7ed6", "#f08c00", "#2f9e44", "#ae3ec9", "#e03131", "#0c8599", "#a07200", "#5c5f66")
_SEQUENCE = ("#fdc328", "#f07f4f", "#cc4778", "#8305a7", "#2c0594")  # light to dark: few to many
_UNITS = {"length": "m"}


def write_page(
    graph: RoadGraph,
    path: str | PathLike[str],
    *,
    fleet: Fleet | None = None,
    title: str = "Road graph",
    color_by: str = "origin",
    resolution: float = 1.0,
    min_drives: int = 1,
) -> None:
    """Write a road graph, and the fleet data it came from, as one HTML page.

    Parameters
    ----------
    graph
        The graph; an empty one gives a page that shows the traces only.
    path
        The HTML file.
    fleet
        Fleet data for the density layers: traces, and semantic points where there are any. Only counts per
        pixel enter the page, never a trace.
    title
        Heading of the page; any text.
    color_by
        Edge column to colour by at first; the page lets the reader choose among all that have values.
    resolution
        Metres per pixel of the densities; made coarser where the image would exceed 4096 pixels.
    min_drives
        Traces that a pixel needs to be drawn.

    Raises
    ------
    OptionError
        If no edge has a value in the column to colour by, or the resolution is not positive.
    OutputError
        If the file cannot be written, or the graph holds columns that may identify drives.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> from probe2road.graph.roadgraph import graph_from_lines
    >>> page = Path(tempfile.mkdtemp()) / "roads.html"
    >>> graph = graph_from_lines([[(446000, 4636000), (446100, 4636000)]], crs="EPSG:32616")
    >>> write_page(graph, page, title="A & B")
    >>> "<h1>A &amp; B</h1>" in page.read_text()
    True
    """
    page = page_text(
        graph, where=path, fleet=fleet, title=title, color_by=color_by, resolution=resolution, min_drives=min_drives
    )
    with atomic_path(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    logger.info("wrote a view of %d edges to %s (%.1f MB)", len(graph.edges), path, len(page) / 1e6)


def page_text(
    graph: RoadGraph,
    *,
    where: object,
    fleet: Fleet | None = None,
    title: str = "Road graph",
    color_by: str = "origin",
    resolution: float = 1.0,
    min_drives: int = 1,
) -> str:
    """Return the page as text (see `write_page`); errors name ``where`` as its place."""
    if not resolution > 0:
        raise OptionError(f"resolution is {resolution}", where="view", fix="use metres per pixel, for example 1.0")
    graph = outgoing(graph, where=where)
    data = {
        "bounds": _bounds(graph, fleet),
        "edges": {"type": "FeatureCollection", "features": geojson_features(_edge_table(graph), decimals=_DECIMALS)},
        "nodes": {"type": "FeatureCollection", "features": _node_features(graph)},
        "densities": [] if fleet is None or fleet.traces.empty else _densities(fleet, resolution, min_drives),
        "attributes": _attributes(graph.edges, color_by),
        "columns": _columns(graph.edges),
    }
    return _page(title=title, summary=_summary(graph, fleet), data=data)


def _page(*, title: str, summary: str, data: dict[str, Any]) -> str:
    """Fill the template in one pass, so that inserted text is never taken for a placeholder."""
    package = resources.files("probe2road")
    read = {
        "maplibre_css": f"{_MAPLIBRE}/maplibre-gl.css",
        "maplibre_js": f"{_MAPLIBRE}/maplibre-gl.js",
        "page_css": "draw/page_files/page.css",
        "page_js": "draw/page_files/page.js",
    }
    parts = {name: package.joinpath(file).read_text(encoding="utf-8") for name, file in read.items()}
    parts["maplibre_js"] = re.sub(r"\n//# sourceMappingURL=.*", "", parts["maplibre_js"])
    # Inside a script element only "<" can end it or open a comment; in JSON it may be written as an escape.
    parts["data"] = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    parts |= {"title": html.escape(title), "summary": html.escape(summary)}
    template = package.joinpath("draw/page_files/page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)


def _summary(graph: RoadGraph, fleet: Fleet | None) -> str:
    parts = [f"{len(graph.edges):,} edges", f"{len(graph.nodes):,} nodes", f"{graph.length / 1000:,.1f} km"]
    if fleet is not None:
        parts.append(f"from {fleet.n_traces:,} traces")
    return f"{', '.join(parts)}. {crs_title(graph.crs)}."


def _bounds(graph: RoadGraph, fleet: Fleet | None) -> list[float]:
    """Return ``[west, south, east, north]`` of everything shown, degrees; the whole world if nothing is shown."""
    boxes = [] if graph.edges.empty else [(graph.bounds, graph.crs)]
    if fleet is not None and not fleet.traces.empty:
        boxes.append((fleet.bounds, fleet.crs))
    if not boxes:
        return [-170.0, -70.0, 170.0, 70.0]
    corners = [
        transform([left, right, left, right], [bottom, bottom, top, top], crs, WGS84)
        for (left, bottom, right, top), crs in boxes
    ]
    lon, lat = (np.concatenate([np.asarray(corner[axis]) for corner in corners]) for axis in (0, 1))
    return [float(value) for value in (lon.min(), lat.min(), lon.max(), lat.max())]


def _edge_table(graph: RoadGraph) -> gpd.GeoDataFrame:
    """Return the edges without empty columns, and with rounded numbers."""
    edges = graph.edges.reset_index().drop(columns="key")
    edges = edges.drop(columns=[name for name in edges if name != "geometry" and edges[name].isna().all()])
    return edges.round(dict.fromkeys((name for name in edges if pd.api.types.is_float_dtype(edges[name].dtype)), 3))


def _node_features(graph: RoadGraph) -> list[dict[str, Any]]:
    position = graph.nodes.get_coordinates().to_numpy()
    lon, lat = transform(position[:, 0], position[:, 1], graph.crs, WGS84)
    places = np.column_stack([lon, lat]).round(_DECIMALS).tolist()
    kinds = graph.degrees().map(lambda degree: {0: "dead end", 1: "dead end", 2: "joint"}.get(degree, "junction"))
    return [
        {"type": "Feature", "properties": {"kind": kind}, "geometry": {"type": "Point", "coordinates": place}}
        for kind, place in zip(kinds, places, strict=True)
    ]


def _columns(edges: gpd.GeoDataFrame) -> list[dict[str, Any]]:
    """Return how the panel shows each column: label, unit, decimals."""
    shown = [name for name in edges if name not in ("key", "geometry")]
    return [
        {
            "name": name,
            "label": _label(name),
            "unit": _UNITS.get(name),
            "decimals": _decimals(edges[name], name),
        }
        for name in shown
    ]


def _decimals(values: pd.Series, name: str) -> int | None:
    if not pd.api.types.is_float_dtype(values.dtype):
        return None
    return 1 if name == "length" else 3


def _label(name: str) -> str:
    special = {"u": "From node", "v": "To node", "forward": "Driven forward", "backward": "Driven backward"}
    return special.get(name, name.replace("_", " ").capitalize())


def _attributes(edges: gpd.GeoDataFrame, color_by: str) -> list[dict[str, Any]]:
    """Return the colour classes of every column with values, the chosen column first."""
    names = [name for name in edges if name not in ("u", "v", "key", "geometry") and edges[name].notna().any()]
    classified = {name: found for name in names if (found := _classes(edges[name])) is not None}
    if edges.empty:
        return [{"name": "origin", "label": "Origin", "classes": [], "missing": False}]
    if color_by not in classified:
        raise OptionError(
            f"edges cannot be coloured by {color_by!r}", where="view", fix=f"use one of {', '.join(classified)}"
        )
    order = [color_by, *(name for name in classified if name != color_by)]
    return [
        {"name": name, "label": _label(name), "missing": bool(edges[name].isna().any()), **classified[name]}
        for name in order
    ]


def _classes(values: pd.Series) -> dict[str, Any] | None:
    """Return colour classes of a column: quantiles of numbers, or its values if there are few, else None."""
    known = values.dropna()
    is_number = pd.api.types.is_numeric_dtype(values.dtype) and not pd.api.types.is_bool_dtype(values.dtype)
    if not is_number:
        found = known.astype(str).str.lower() if pd.api.types.is_bool_dtype(values.dtype) else known.astype(str)
        categories = list(found.value_counts().index)
        if len(categories) > _MOST_CATEGORIES:
            return None
        color_of = dict(zip(categories, _CATEGORY_COLORS, strict=False)) | _ORIGIN_COLORS
        return {"classes": [{"value": value, "label": value, "color": color_of[value]} for value in categories]}
    numbers = known.to_numpy(np.float64)
    limits = _rounded(np.unique(np.quantile(numbers, np.arange(1, _CLASSES) / _CLASSES)))
    limits = limits[limits > numbers.min()]
    lows, highs = [float(numbers.min()), *limits], [*limits, float(numbers.max())]
    colors = [_SEQUENCE[index] for index in np.linspace(0, _CLASSES - 1, len(lows)).round().astype(int)]
    labels = [f"{low:.4g} to {high:.4g}" for low, high in zip(lows, highs, strict=True)]
    classes = [{"label": label, "color": color} for label, color in zip(labels, colors, strict=True)]
    return {"classes": classes, "breaks": limits.tolist()}


def _rounded(limits: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round class limits to three significant digits, but keep them distinct."""
    digits = 2 - np.floor(np.log10(np.maximum(np.abs(limits), 1e-9))).astype(int)
    return np.unique([round(float(limit), int(digit)) for limit, digit in zip(limits, digits, strict=True)])


def _densities(fleet: Fleet, resolution: float, min_drives: int) -> list[dict[str, Any]]:
    """Count fleet data per pixel in Web Mercator; return a near and a far image for each channel that is not empty."""
    left, bottom, right, top = fleet.bounds
    _, lat = transform([(left + right) / 2], [(bottom + top) / 2], fleet.crs, WGS84)
    stretch = float(1 / np.cos(np.radians(lat[0])))  # of Web Mercator against the ground
    mercator = fleet.to_crs(_WEB_MERCATOR)
    grid = _image_grid(mercator.bounds, resolution * stretch, _MARGIN * stretch)
    limits = TraceGaps()
    gaps = TraceGaps(max_step=limits.max_step * stretch, max_speed=limits.max_speed * stretch)
    counts = without_rare(rasterize(mercator, grid, gaps=gaps), grid, least=min_drives)
    left, bottom, right, top = grid.bounds
    lon, lat = transform([left, right, right, left], [top, top, bottom, bottom], _WEB_MERCATOR, WGS84)
    corners = [[round(x, 9), round(y, 9)] for x, y in zip(lon, lat, strict=True)]
    return [
        {
            "name": name,
            "label": label,
            "color": "rgb({}, {}, {})".format(*np.mean([light, dark], axis=0).astype(int)),
            "close": _density_image(channel, light, dark),
            "far": _density_image(_block_maxima(channel), light, dark),
            "zoom": float(np.log2(_MERCATOR_PER_PIXEL / (2 * grid.resolution))),  # half a screen pixel per image pixel
            "corners": corners,
        }
        for (name, label, light, dark), channel in zip(_DENSITIES, counts, strict=True)
        if channel.any()
    ]


def _image_grid(bounds: tuple[float, float, float, float], resolution: float, margin: float) -> Grid:
    """Return a grid whose sides are multiples of the far pixels, small enough for every image."""
    left, bottom, right, top = bounds
    coarsest = (max(right - left, top - bottom) + 2 * margin) / (_LARGEST_IMAGE - 2 * _FAR)
    grid = Grid.from_bounds(bounds, resolution=max(resolution, coarsest), crs=_WEB_MERCATOR, margin=margin)
    return grid.window(0, 0, -(-grid.rows // _FAR) * _FAR, -(-grid.cols // _FAR) * _FAR)


def _block_maxima(counts: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Shrink counts by a factor of `_FAR`, so that a single thin trace stays visible from afar."""
    rows, cols = counts.shape
    return counts.reshape(rows // _FAR, _FAR, cols // _FAR, _FAR).max(axis=(1, 3))


def _density_image(counts: NDArray[np.uint32], light: tuple[int, ...], dark: tuple[int, ...]) -> str:
    """Return counts as a PNG data URL: transparent for zero, else from light to dark by the logarithm.

    Parameters
    ----------
    counts
        Shape ``(rows, cols)``.
    light, dark
        Colours of the least and the greatest count, red, green and blue to 255.
    """
    top = np.log1p(np.quantile(counts[counts > 0], 0.995))  # one crowded pixel must not pale all others
    shade = np.clip(np.log1p(counts) / top, 0, 1)
    index = np.where(counts > 0, 1 + np.round(254 * shade), 0).astype(np.uint8)
    ramp = np.linspace(0, 1, 255)[:, None]
    colors = np.round(np.array(light) * (1 - ramp) + np.array(dark) * ramp).astype(np.uint8)
    opacity = np.round(120 + 135 * ramp[:, 0]).astype(np.uint8)
    png = _indexed_png(index, np.vstack([[255, 255, 255], colors]).astype(np.uint8), np.append(np.uint8(0), opacity))
    return f"data:image/png;base64,{base64.b64encode(png).decode('ascii')}"


def _indexed_png(index: NDArray[np.uint8], palette: NDArray[np.uint8], opacity: NDArray[np.uint8]) -> bytes:
    """Encode an image of palette indices, shape ``(rows, cols)``, with a palette ``(256, 3)`` and its opacities."""
    image = Image.fromarray(index)
    image.putpalette(palette.tobytes())
    png = io.BytesIO()
    image.save(png, "PNG", transparency=opacity.tobytes())
    return png.getvalue()
