// The map: Leaflet with canvases of our own; on the Earth with or without tiles, or flat in a local frame.

import { byId, metres, placeWords, round125, say } from "/static/dom.js";
import { Layer } from "/static/layers.js";
import { RADIUS, unit } from "/static/tracks.js";

const NEAR = 14;
const BAR = 110;
/** Px that are left free where all is shown: of the tools on the left, and of names of tracks and axes on the right. */
const [TOOLS, NAMES] = [[112, 36], [64, 60]];

export class Chart {
  /** tracks: what is drawn; base, picture, mark: the drawings, the lowest first; ground(): the pairs of places that are
   *  shown where there are no tracks; picked(id or null): by a click. */
  constructor(tracks, { base, picture, mark }, ground, picked) {
    this.tracks = tracks;
    this.ground = ground;
    this.draw = { base, picture, mark };
    this.picked = picked;
    this.map = null;
    this.touched = false;
    this.tiles = "";
    byId("nearer").addEventListener("click", () => this.map?.zoomIn());
    byId("farther").addEventListener("click", () => this.map?.zoomOut());
    byId("fit").addEventListener("click", () => this.fit());
  }

  /** Make the map for pictures on the Earth, or in a flat frame; nothing where it is that already. */
  make(geo) {
    if (this.map && this.geo === geo) return;
    this.map?.remove();
    this.geo = geo;
    this.touched = false;
    const map = L.map("map", {
      crs: geo ? L.CRS.EPSG3857 : L.CRS.Simple,
      center: [0, 0],
      zoom: geo ? 2 : -2,
      minZoom: geo ? 1 : -16,
      maxZoom: geo ? 22 : 12,
      zoomSnap: 0.25,
      zoomDelta: 0.5,
      wheelPxPerZoomLevel: 120,
      zoomAnimation: false,
      fadeAnimation: false,
      markerZoomAnimation: false,
      inertia: !matchMedia("(prefers-reduced-motion: reduce)").matches,
      attributionControl: false,
      zoomControl: false,
      boxZoom: true,
    });
    this.map = map;
    if (geo && this.tiles) L.tileLayer(this.tiles, { maxZoom: 22, maxNativeZoom: 18, referrerPolicy: "no-referrer" }).addTo(map);
    const pane = map.getPane("overlayPane");
    this.layers = ["base", "picture", "mark"].map((name) => new Layer(pane, this.draw[name]));
    map.on("moveend resize", () => this.redraw());
    map.on("move", () => this.layers.forEach((one) => one.leaves(map) && one.ask(map)));
    map.on("zoom viewreset", () => {
      this.layers.forEach((one) => one.stretch(map));
      this.redraw();
    });
    map.on("dragstart zoomstart", () => { this.touched ||= !this.fitting; });
    map.on("click", ({ containerPoint }) => this.picked(this.at(containerPoint)));
    map.on("mousemove", ({ latlng }) => say(byId("place-said"), placeWords(geo, latlng.lng, latlng.lat)));
    map.on("mouseout", () => say(byId("place-said"), ""));
  }

  /** Draw all anew, or what has changed: of "base", "picture", "mark". */
  redraw(...names) {
    if (!this.map) return;
    const all = ["base", "picture", "mark"];
    all.forEach((name, k) => {
      if (!names.length || names.includes(name)) this.layers[k].ask(this.map, name === "mark");
    });
    if (!names.length) this.scale();
  }

  /** The id of the track at a point of the screen, or null. */
  at(point) {
    const { tracks } = this;
    const { x, y } = this.map.getPixelBounds().min;
    const scale = (this.geo ? 256 : 1) * 2 ** this.map.getZoom();
    let best = NEAR ** 2;
    let found = null;
    for (let row = 0; row < tracks.count; row += 1) {
      const apart = (tracks.wx[row] * scale - x - point.x) ** 2 + (tracks.wy[row] * scale - y - point.y) ** 2;
      if (apart < best) {
        best = apart;
        found = row;
      }
    }
    return found === null ? null : (tracks.textOf(found)?.id ?? null);
  }

  /** Where a row is on the screen, px in the map. */
  pixel(row) {
    return this.place([this.tracks.wx[row], this.tracks.wy[row]]);
  }

  /** Where a place in the map's unit is on the screen. */
  place([wx, wy]) {
    const { x, y } = this.map.getPixelBounds().min;
    const scale = (this.geo ? 256 : 1) * 2 ** this.map.getZoom();
    return [wx * scale - x, wy * scale - y];
  }

  /** Show all tracks, but for the few that are far from all others. */
  fit() {
    const { picture, count } = this.tracks;
    if (!this.map) return;
    if (!count) {
      const ground = this.ground();
      if (ground.length) this.look([Math.min, Math.max].map((of) => [1, 0].map((k) => of(...ground.map((one) => one[k])))));
      return;
    }
    const span = (column) => {
      const sorted = Float64Array.from(column).sort();
      const out = Math.floor(0.01 * count);
      return [sorted[out], sorted[count - 1 - out]];
    };
    const [left, right] = span(picture.x);
    const [bottom, top] = span(picture.y);
    this.look([[bottom, left], [top, right]]);
  }

  /** Show what lies between two corners. */
  look(corners) {
    this.fitting = true;
    this.map.fitBounds(corners, { paddingTopLeft: TOOLS, paddingBottomRight: NAMES, maxZoom: this.geo ? 16 : 8, animate: false });
    this.fitting = false;
  }

  /** Bring a track into sight. */
  show(row) {
    const [px, py] = this.pixel(row);
    const size = this.map.getSize();
    const inside = px > 40 && py > 40 && px < size.x - 40 && py < size.y - 40;
    if (!inside) this.map.panTo([this.tracks.picture.y[row], this.tracks.picture.x[row]], { animate: false });
  }

  /** The bar that says how long a metre is here. */
  scale() {
    const perUnit = (this.geo ? 256 : 1) * 2 ** this.map.getZoom();
    const perMetre = perUnit * unit(this.geo, this.map.getCenter().lat);
    const length = round125(Math.min(BAR / perMetre, Math.PI * RADIUS));
    const [bar, words] = byId("scale").children;
    bar.style.width = `${Math.round(length * perMetre)}px`;
    say(words, metres(length));
  }
}
