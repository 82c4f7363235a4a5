// The tracks: trails, ellipses, velocities, marks by status, names; and the one that is chosen, with whom it comes from.
//
// confirmed: a filled disk; tentative: a small ring; coasting: a diamond, its ellipse dashed; a triangle above it: a mark.

import { clean } from "/static/dom.js";
import { palette } from "/static/palette.js";
import { placed, unit } from "/static/tracks.js";

const TOGETHER = 120;
const LEAST = 3;
const [LEAD, LEAD_LOCAL] = [60, 10];
const MOST_NAMES = 250;
const MANY = 1500;
export const [TENTATIVE, CONFIRMED, COASTING] = [0, 1, 2];
const NAMES = ["tentative", "confirmed", "coasting"];
const SIZES = [2.5, 3.5, 5];

/** Rows in sight, by status, with their places in px. */
function sighted(state, view) {
  const { tracks, options } = state;
  const { picture } = tracks;
  const rows = [[], [], []];
  const px = new Float32Array(tracks.count);
  const py = new Float32Array(tracks.count);
  for (let row = 0; row < tracks.count; row += 1) {
    const status = Math.min(picture.status[row], 2);
    if (status === TENTATIVE && !options.tentative) continue;
    const x = (px[row] = tracks.wx[row] * view.scale - view.left);
    const y = (py[row] = tracks.wy[row] * view.scale - view.top);
    const reach = view.scale * 3 * picture.major[row] * unit(tracks.geo, picture.y[row]) + 80;
    if (x > -reach && y > -reach && x < view.width + reach && y < view.height + reach) rows[status].push(row);
  }
  return { rows, px, py };
}

function* inParts(list, draw) {
  for (let k = 0; k < list.length; k += TOGETHER) {
    draw(list.slice(k, k + TOGETHER));
    yield;
  }
}

function ellipse(context, state, view, row, x, y, sigmas) {
  const { picture, geo } = state.tracks;
  const metre = view.scale * sigmas * unit(geo, picture.y[row]);
  const [major, minor] = [picture.major[row] * metre, picture.minor[row] * metre];
  if (major < LEAST || major > 8000) return;
  context.moveTo(x + major * Math.cos(picture.turn[row]), y - major * Math.sin(picture.turn[row]));
  context.ellipse(x, y, major, Math.max(minor, 0.5), -picture.turn[row], 0, 2 * Math.PI);
}

function trail(context, state, view, row, x, y) {
  let [lastX, lastY] = [x, y];
  context.moveTo(x, y);
  state.tracks.trails.each(state.tracks.picture.slot[row], (wx, wy) => {
    const px = wx * view.scale - view.left;
    const py = wy * view.scale - view.top;
    if (Math.abs(px - lastX) + Math.abs(py - lastY) < 2) return;
    context.lineTo(px, py);
    [lastX, lastY] = [px, py];
  });
}

function vector(context, state, view, row, x, y) {
  const { picture, geo } = state.tracks;
  const lead = (geo ? LEAD : LEAD_LOCAL) * view.scale * unit(geo, picture.y[row]);
  const [dx, dy] = [picture.vx[row] * lead, -picture.vy[row] * lead];
  const long = Math.hypot(dx, dy);
  if (!(long > 5) || long > 4000) return;
  context.moveTo(x, y);
  context.lineTo(x + dx, y + dy);
}

function mark(context, status, x, y, size) {
  if (status === COASTING) {
    context.moveTo(x, y - size);
    context.lineTo(x + size, y);
    context.lineTo(x, y + size);
    context.lineTo(x - size, y);
    context.closePath();
  } else {
    context.moveTo(x + size, y);
    context.arc(x, y, size, 0, 2 * Math.PI);
  }
}

function warn(context, x, y) {
  context.moveTo(x, y - 16);
  context.lineTo(x + 5, y - 8);
  context.lineTo(x - 5, y - 8);
  context.closePath();
}

/** Names where they have room: a cell of the screen takes one. */
function* names(context, state, view, { rows, px, py }) {
  const taken = new Set();
  let written = 0;
  context.font = "11px system-ui, sans-serif";
  context.lineWidth = 3;
  context.lineJoin = "round";
  context.strokeStyle = palette.halo;
  context.fillStyle = palette.text;
  for (const row of [...rows[CONFIRMED], ...rows[COASTING], ...rows[TENTATIVE]]) {
    const [x, y] = [px[row], py[row]];
    if (written >= MOST_NAMES) return;
    if (x < 0 || y < 0 || x > view.width || y > view.height) continue;
    const said = state.tracks.textOf(row);
    if (!said || said.id === state.chosen) continue;
    const name = clean(said.name).slice(0, 18);
    const [row0, from, to] = [Math.round(y / 14), Math.floor(x / 24), Math.floor((x + 12 + 6.5 * name.length) / 24)];
    let free = true;
    for (let k = from; k <= to && free; k += 1) free = !taken.has(`${row0} ${k}`) && !taken.has(`${row0 - 1} ${k}`);
    if (!free) continue;
    for (let k = from; k <= to; k += 1) taken.add(`${row0} ${k}`);
    context.strokeText(name, x + 8, y + 4);
    context.fillText(name, x + 8, y + 4);
    written += 1;
    if (written % 40 === 0) yield;
  }
}

/** The drawing of all tracks. */
export const drawTracks = (state) =>
  function* draw(context, view) {
    const { tracks, options } = state;
    if (!tracks.picture) return;
    const seen = sighted(state, view);
    const { rows, px, py } = seen;
    const size = rows.flat().length > MANY ? 0.7 : 1;
    const each = (list, one) => inParts(list, (part) => {
      context.beginPath();
      for (const row of part) one(row, px[row], py[row]);
      context.stroke();
    });
    yield;
    for (const status of [TENTATIVE, CONFIRMED, COASTING]) {
      context.strokeStyle = context.fillStyle = palette[NAMES[status]];
      context.lineWidth = 1;
      if (options.trails) {
        context.globalAlpha = 0.4;
        yield* each(rows[status], (row, x, y) => trail(context, state, view, row, x, y));
      }
      if (options.sigmas) {
        context.globalAlpha = 0.65;
        context.setLineDash(status === COASTING ? [4, 3] : []);
        yield* each(rows[status], (row, x, y) => ellipse(context, state, view, row, x, y, options.sigmas));
        context.setLineDash([]);
      }
      context.globalAlpha = 1;
      if (options.vectors) yield* each(rows[status], (row, x, y) => vector(context, state, view, row, x, y));
      context.lineWidth = 1.5;
      yield* inParts(rows[status], (part) => {
        context.beginPath();
        for (const row of part) mark(context, status, px[row], py[row], size * SIZES[status]);
        if (status === CONFIRMED) context.fill();
        else context.stroke();
      });
    }
    context.fillStyle = palette.alarm;
    context.beginPath();
    rows.flat().filter((row) => tracks.picture.marks[row] & 2).forEach((row) => warn(context, px[row], py[row]));
    context.fill();
    yield;
    if (options.labels) yield* names(context, state, view, seen);
  };

/** The drawing of the track that is chosen, and lines to the sensors that it comes from, as wide as their influence. */
export const drawChosen = (state) =>
  function* draw(context, view) {
    const { tracks } = state;
    const row = state.chosen === null ? -1 : tracks.row(state.chosen);
    if (row < 0) return;
    const [x, y] = [tracks.wx[row] * view.scale - view.left, tracks.wy[row] * view.scale - view.top];
    context.lineCap = "round";
    for (const { source, influence } of state.detail?.id === state.chosen ? (state.detail.members ?? []) : []) {
      const place = state.places[source];
      const there = place ? placed(tracks, place) : null;
      if (!there) continue;
      const [wx, wy] = there(place.place);
      context.strokeStyle = state.colours.get(source) ?? palette.cover;
      context.lineWidth = 1 + 4 * Math.max(0, Math.min(1, influence ?? 0));
      context.beginPath();
      context.moveTo(x, y);
      context.lineTo(wx * view.scale - view.left, wy * view.scale - view.top);
      context.stroke();
    }
    context.strokeStyle = context.fillStyle = palette.chosen;
    context.lineWidth = 2;
    context.beginPath();
    trail(context, state, view, row, x, y);
    context.stroke();
    context.beginPath();
    ellipse(context, state, view, row, x, y, state.options.sigmas || 2);
    context.stroke();
    context.beginPath();
    context.arc(x, y, 11, 0, 2 * Math.PI);
    context.stroke();
    const name = clean(tracks.textOf(row)?.name ?? "").slice(0, 40);
    context.font = "600 13px system-ui, sans-serif";
    context.lineWidth = 4;
    context.strokeStyle = palette.halo;
    context.strokeText(name, x + 15, y - 9);
    context.fillText(name, x + 15, y - 9);
    yield;
  };
