// Canvases over the map: drawn in slices of a few ms, so that no frame is held up, and shown when they are whole.

const PAD = 0.15;
const SLICE = 6;

/** What of the map a drawing is of: `scale` px for a unit of the map; left and top of the canvas in px; its size. */
function viewOf(map) {
  const size = map.getSize();
  const pad = [Math.round(size.x * PAD), Math.round(size.y * PAD)];
  const zoom = map.getZoom();
  const corner = map.getPixelBounds().min;
  const local = map.options.crs === L.CRS.Simple;
  const left = corner.x - pad[0];
  const top = corner.y - pad[1];
  const width = size.x + 2 * pad[0];
  const height = size.y + 2 * pad[1];
  return { zoom, left, top, width, height, pad, scale: (local ? 1 : 256) * 2 ** zoom, place: map.containerPointToLayerPoint([-pad[0], -pad[1]]) };
}

/** One canvas that draws `draw(context, view)`, a generator that yields where it may be held up. */
export class Layer {
  constructor(pane, draw) {
    this.draw = draw;
    this.job = null;
    this.again = false;
    this.took = 0;
    this.shown = this.canvas(pane);
    this.hidden = this.canvas(pane);
  }

  canvas(pane) {
    const node = document.createElement("canvas");
    node.className = "drawn";
    node.hidden = true;
    pane.append(node);
    return node;
  }

  /** Whether the map has been moved so far that the rim of what is drawn comes into sight. */
  leaves(map) {
    if (!this.view) return true;
    const { left, top, pad } = this.view;
    const { x, y } = map.getPixelBounds().min;
    return Math.abs(x - left - pad[0]) > 0.6 * pad[0] || Math.abs(y - top - pad[1]) > 0.6 * pad[1];
  }

  /** Draw anew; what is being drawn is finished first, unless `now`. */
  ask(map, now = false) {
    this.map = map;
    if (this.job && !now) {
      this.again = true;
      return;
    }
    this.begin();
  }

  begin() {
    const view = viewOf(this.map);
    const ratio = Math.min(devicePixelRatio || 1, 2);
    const node = this.hidden;
    const width = Math.round(view.width * ratio);
    const height = Math.round(view.height * ratio);
    if (node.width !== width || node.height !== height) {
      node.width = width;
      node.height = height;
      node.style.width = `${view.width}px`;
      node.style.height = `${view.height}px`;
    }
    const context = node.getContext("2d");
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, view.width, view.height);
    context.setLineDash([]);
    context.globalAlpha = 1;
    this.again = false;
    this.job = { steps: this.draw(context, view), view, took: 0 };
    this.run(this.job);
  }

  run(job) {
    if (this.job !== job) return;
    const begin = performance.now();
    let done = false;
    while (!done && performance.now() - begin < SLICE) done = job.steps.next().done;
    job.took += performance.now() - begin;
    if (!done) {
      requestAnimationFrame(() => this.run(job));
      return;
    }
    this.job = null;
    this.took = job.took;
    this.swap(job.view);
    if (this.again) requestAnimationFrame(() => this.job || this.begin());
  }

  swap(view) {
    [this.shown, this.hidden] = [this.hidden, this.shown];
    this.view = view;
    L.DomUtil.setPosition(this.shown, view.place);
    this.shown.hidden = false;
    this.hidden.hidden = true;
  }

  /** Until it is drawn at the new zoom, what is shown is stretched to it. */
  stretch(map) {
    this.job = null;
    if (!this.view) return;
    const { view } = this;
    const factor = map.getZoomScale(map.getZoom(), view.zoom);
    const corner = map.getPixelBounds().min;
    const at = L.point(view.left * factor - corner.x, view.top * factor - corner.y);
    L.DomUtil.setTransform(this.shown, map.containerPointToLayerPoint(at), factor);
  }
}
