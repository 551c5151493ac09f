"use strict";
// The page of probe2road.view: one map of density images, edges and nodes, all data in the page itself.
const data = JSON.parse(document.getElementById("data").textContent);
const element = (id) => document.getElementById(id);
const state = (value) => { document.body.dataset.state = value; };
const GREY = "#9aa5b1";

// Paint: every choice of attribute is a list of classes {label, color} and an expression that picks one.
function edgeColor(attribute) {
  if (!attribute.classes.length) return GREY;
  const value = ["get", attribute.name];
  const known = attribute.breaks
    ? ["step", ["to-number", value], attribute.classes[0].color,
       ...attribute.breaks.flatMap((limit, i) => [limit, attribute.classes[i + 1].color])]
    : ["match", ["to-string", value], ...attribute.classes.flatMap((c) => [c.value, c.color]), GREY];
  return ["case", ["==", value, null], GREY, known];
}

const width = (scale) => ["interpolate", ["exponential", 1.4], ["zoom"], 10, 0.8 * scale, 14, 1.8 * scale, 17, 4 * scale, 20, 9 * scale];

// Nodes that merely join two edges would clutter the overview.
const unlessJoint = (opacity) => ["step", ["zoom"], ["match", ["get", "kind"], "joint", 0, opacity], 15, opacity];

function style() {
  const sources = {
    edges: { type: "geojson", data: data.edges, tolerance: 0.2 },
    nodes: { type: "geojson", data: data.nodes, tolerance: 0 },
  };
  const layers = [{ id: "paper", type: "background", paint: { "background-color": "#fbfbf9" } }];
  for (const image of data.densities) {
    for (const [range, zooms] of [["far", { maxzoom: image.zoom }], ["close", { minzoom: image.zoom }]]) {
      const id = `${image.name}-${range}`;
      sources[id] = { type: "image", url: image[range], coordinates: image.corners };
      layers.push({ id, type: "raster", source: id, ...zooms,
        paint: { "raster-resampling": range === "far" ? "linear" : "nearest", "raster-fade-duration": 0 } });
    }
  }
  const line = { type: "line", source: "edges", layout: { "line-cap": "round", "line-join": "round" } };
  layers.push(
    { ...line, id: "casing", paint: { "line-color": "#ffffff", "line-opacity": 0.85, "line-width": width(1.9) } },
    { ...line, id: "selected", filter: ["==", ["get", "edge"], null], // a dark border that leaves the colour
      paint: { "line-color": "#111827", "line-width": width(2.6) } },
    { ...line, id: "edges", paint: { "line-color": edgeColor(data.attributes[0]), "line-width": width(1) } },
    { id: "nodes", type: "circle", source: "nodes", minzoom: 12, paint: {
      "circle-radius": ["interpolate", ["linear"], ["zoom"], 12, 1, 14, 1.8, 17, 4, 20, 7],
      "circle-opacity": unlessJoint(1), "circle-stroke-opacity": unlessJoint(1),
      "circle-color": ["match", ["get", "kind"], "dead end", "#ffffff", "junction", "#1f2933", "#cbd2d9"],
      "circle-stroke-color": ["match", ["get", "kind"], "dead end", "#c92a2a", "junction", "#ffffff", "#52606d"],
      "circle-stroke-width": ["interpolate", ["linear"], ["zoom"], 12, 0.4, 14, 0.8, 16, 1.5],
    } },
  );
  return { version: 8, sources, layers };
}

function addToggle(label, layerIds, swatch) {
  const row = document.createElement("label");
  const box = Object.assign(document.createElement("input"), { type: "checkbox", checked: true });
  box.addEventListener("change", () => {
    for (const id of layerIds) map.setLayoutProperty(id, "visibility", box.checked ? "visible" : "none");
  });
  row.append(box, swatch, label);
  element("layers").append(row);
}

function swatch(className, color) {
  const mark = document.createElement("span");
  mark.className = `swatch ${className}`;
  if (color) mark.style.background = color;
  return mark;
}

function legendRow(mark, label) {
  const row = document.createElement("li");
  row.append(mark, label);
  return row;
}

function showLegend(attribute) {
  const rows = attribute.missing ? [...attribute.classes, { label: "not known", color: GREY }] : attribute.classes;
  const nodes = [["dead-end", "dead end"], ["junction", "junction"]];
  element("legend").replaceChildren(
    ...rows.map((entry) => legendRow(swatch("", entry.color), entry.label)),
    ...nodes.map(([name, label]) => legendRow(swatch(`dot ${name}`), label)),
  );
}

// An edge is selected by a click, by the hash #edge=ID, or by selectEdge(id) from a script.
function selectEdge(id) {
  const feature = data.edges.features.find((candidate) => candidate.properties.edge === id);
  element("details").hidden = !feature;
  map.setFilter("selected", ["==", ["get", "edge"], feature ? id : null]);
  if (!feature) return false;
  element("details").querySelector("h2").textContent = `Edge ${id}`;
  element("details").querySelector("tbody").replaceChildren(...data.columns.map(({ name, label, unit, decimals }) => {
    const row = document.createElement("tr");
    const value = feature.properties[name];
    const text = value === null || value === undefined ? "not known"
      : typeof value === "number" && decimals !== null ? value.toFixed(decimals) : String(value);
    row.append(Object.assign(document.createElement("th"), { textContent: label, scope: "row" }),
      Object.assign(document.createElement("td"), { textContent: value === null || !unit ? text : `${text} ${unit}` }));
    return row;
  }));
  return true;
}

function selectFromHash() {
  const match = /^#edge=(-?\d+)$/.exec(location.hash);
  if (!match || !selectEdge(Number(match[1]))) return;
  const line = data.edges.features.find((f) => f.properties.edge === Number(match[1])).geometry.coordinates;
  const box = line.reduce((bounds, position) => bounds.extend(position.slice(0, 2)), new maplibregl.LngLatBounds());
  map.fitBounds(box, { padding: 160, maxZoom: 17, animate: false });
}

function edgeAt(point) {
  const reach = 5; // pixels around the pointer
  const box = [[point.x - reach, point.y - reach], [point.x + reach, point.y + reach]];
  return map.queryRenderedFeatures(box, { layers: ["edges"] })[0];
}

function onceIdle() {
  document.body.dataset.rendered = map.queryRenderedFeatures({ layers: ["edges"] }).length;
  document.body.dataset.densities = data.densities.filter((image) => map.isSourceLoaded(`${image.name}-far`)).length;
  state("ready");
}

let map;
try {
  map = new maplibregl.Map({
    container: "map", style: style(), bounds: data.bounds, fitBoundsOptions: { padding: { top: 40, bottom: 50, left: 270, right: 40 } },
    attributionControl: false, dragRotate: false, pitchWithRotate: false, maxZoom: 22,
    canvasContextAttributes: { preserveDrawingBuffer: true, antialias: true },
  });
  map.touchZoomRotate.disableRotation();
  map.addControl(new maplibregl.ScaleControl({ maxWidth: 140, unit: "metric" }), "bottom-left");
  map.addControl(new maplibregl.AttributionControl({ compact: false, customAttribution: "probe2road | MapLibre GL JS" }), "bottom-right");
  map.addControl(new maplibregl.NavigationControl({ showCompass: false }), "bottom-right");
  map.on("error", (event) => { document.body.dataset.error = event.error.message; state("error"); });
  map.on("load", () => {
    for (const image of data.densities) addToggle(image.label, [`${image.name}-far`, `${image.name}-close`], swatch("area", image.color));
    addToggle("Edges", ["casing", "edges", "selected"], swatch("", data.attributes[0].classes[0]?.color ?? GREY));
    addToggle("Nodes", ["nodes"], swatch("dot junction"));
    selectFromHash();
    map.once("idle", onceIdle);
  });
  map.on("click", (event) => {
    const feature = edgeAt(event.point);
    selectEdge(feature ? feature.properties.edge : null);
    if (location.protocol === "about:") return; // in the frame of a notebook there is no address to keep it in
    history.replaceState(null, "", feature ? `#edge=${feature.properties.edge}` : "#");
  });
  map.on("mousemove", (event) => { map.getCanvas().style.cursor = edgeAt(event.point) ? "pointer" : ""; });
  window.addEventListener("hashchange", selectFromHash);
  window.selectEdge = selectEdge;
} catch (error) { // no WebGL: say so instead of showing an empty page
  document.body.dataset.error = error.message;
  state("error");
  element("summary").textContent = /webgl/i.test(error.message) // MapLibre puts a record of the context there
    ? "The map needs WebGL, which this browser does not offer: turn on hardware acceleration, or draw a picture (.png)."
    : `The map cannot be drawn: ${String(error.message).slice(0, 200)}`;
}

element("close").addEventListener("click", () => selectEdge(null));
for (const attribute of data.attributes) element("color-by").add(new Option(attribute.label, attribute.name));
element("color-by").addEventListener("change", (event) => {
  const attribute = data.attributes.find((candidate) => candidate.name === event.target.value);
  map.setPaintProperty("edges", "line-color", edgeColor(attribute));
  showLegend(attribute);
});
showLegend(data.attributes[0]);
