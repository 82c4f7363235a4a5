// What lies below the tracks: graticule or grid, rings about the picture's origin, and sensors with their coverage.

import { clean, metres, round125, within180 } from "/static/dom.js";
import { palette } from "/static/palette.js";
import { placed, unit, world } from "/static/tracks.js";

/** States of sources that see nothing at the moment: hollow, and their coverage not filled. */
const AWAY = ["gone", "silent", "unheard", "resting"];
const APART = 110;
/** Px between two lines at least, and between two of their names. */
const [LEAST, GAP] = [84, 26];
const DEGREES = [30, 20, 10, 5, 2, 1, 1 / 2, 1 / 6, 1 / 12, 1 / 30, 1 / 60, 1 / 120, 1 / 360, 1 / 720, 1 / 1800, 1 / 3600];

function degrees(value) {
  const far = Math.abs(value) + 1e-9;
  const whole = Math.floor(far);
  const minutes = (far - whole) * 60;
  return minutes < 1e-5 ? `${whole}°` : `${whole}° ${Number(minutes.toFixed(3))}′`;
}

/** The places on an axis, from `low` to `high`, at which lines are drawn. */
function steps(low, high, step) {
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high && found.length < 60; k += 1) found.push(k * step);
  return found;
}

function lines(context, view, geo) {
  const across = view.width / view.scale;
  const [left, top] = [view.left / view.scale, view.top / view.scale];
  let [xs, ys, nameX, nameY] = [[], [], null, null];
  if (geo) {
    nameX = (x) => `${degrees(within180(x))} ${within180(x) < 0 ? "W" : "E"}`;
    const fits = (one) => {
      const widest = Math.max(...[left, left + across].map((w) => context.measureText(nameX(Math.round((w * 360 - 180) / one) * one)).width));
      return (one * view.width) / (360 * across) >= Math.max(LEAST, widest + GAP);
    };
    const chosen = DEGREES.findLast(fits) ?? DEGREES[0];
    const lat = (w) => (Math.atan(Math.sinh(Math.PI * (1 - 2 * w))) * 180) / Math.PI;
    xs = steps(left * 360 - 180, (left + across) * 360 - 180, chosen);
    ys = steps(lat(top + view.height / view.scale), lat(top), chosen);
    nameY = (y) => `${degrees(y)} ${y < 0 ? "S" : "N"}`;
  } else {
    const step = round125((2 * APART * across) / view.width);
    xs = steps(left, left + across, step);
    ys = steps(-(top + view.height / view.scale), -top, step);
    nameX = (x) => `x ${metres(x)}`;
    nameY = (y) => `y ${metres(y)}`;
  }
  context.beginPath();
  context.fillStyle = palette.faint;
  for (const x of xs) {
    const px = Math.round(world(geo, x, 0)[0] * view.scale - view.left) + 0.5;
    context.moveTo(px, 0);
    context.lineTo(px, view.height);
    if (px > view.pad[0]) context.fillText(nameX(x), px + 3, view.height - view.pad[1] - 6);
  }
  context.textAlign = "end";
  for (const y of ys) {
    const py = Math.round(world(geo, 0, y)[1] * view.scale - view.top) + 0.5;
    context.moveTo(0, py);
    context.lineTo(view.width, py);
    if (py < view.height - view.pad[1] - 24) context.fillText(nameY(y), view.width - view.pad[0] - 6, py - 3);
  }
  context.textAlign = "start";
  context.strokeStyle = palette.line;
  context.lineWidth = 0.6;
  context.stroke();
}

function rings(context, view, frame, around) {
  const geo = frame.kind === "enu";
  if (!geo && frame.kind !== "local") return;
  const [x, y] = geo ? [frame.lon + 360 * Math.round((around - frame.lon) / 360), frame.lat] : [0, 0];
  const [wx, wy] = world(geo, x, y);
  const [px, py] = [wx * view.scale - view.left, wy * view.scale - view.top];
  const metre = unit(geo, y) * view.scale;
  const step = round125((1.8 * APART) / metre);
  context.strokeStyle = palette.line;
  context.fillStyle = palette.faint;
  context.lineWidth = 1;
  context.setLineDash([2, 5]);
  for (let k = 1; k <= 5; k += 1) {
    context.beginPath();
    context.arc(px, py, k * step * metre, 0, 2 * Math.PI);
    context.stroke();
    context.fillText(metres(k * step), px + 3, py - k * step * metre - 3);
  }
  context.setLineDash([]);
  context.beginPath();
  context.moveTo(px - 5, py);
  context.lineTo(px + 5, py);
  context.moveTo(px, py - 5);
  context.lineTo(px, py + 5);
  context.strokeStyle = palette.faint;
  context.stroke();
}

function sensors(context, view, { places, colours, states, tracks }) {
  for (const [name, one] of Object.entries(places)) {
    const there = placed(tracks, one);
    if (!there) continue;
    const path = one.outline.map(there);
    const away = AWAY.includes(states.get(name)) ? states.get(name) : "";
    context.strokeStyle = context.fillStyle = colours.get(name) ?? palette.cover;
    if (path.length) {
      context.beginPath();
      path.forEach(([wx, wy]) => context.lineTo(wx * view.scale - view.left, wy * view.scale - view.top));
      context.closePath();
      context.globalAlpha = 0.05;
      if (!away) context.fill();
      context.globalAlpha = away ? 0.35 : 0.7;
      context.lineWidth = 1;
      context.setLineDash(away ? [2, 8] : [6, 4]);
      context.stroke();
      context.setLineDash([]);
    }
    context.globalAlpha = 1;
    const [wx, wy] = there(one.place);
    const [px, py] = [wx * view.scale - view.left, wy * view.scale - view.top];
    context.beginPath();
    context.moveTo(px, py - 6);
    context.lineTo(px + 5.5, py + 4);
    context.lineTo(px - 5.5, py + 4);
    context.closePath();
    context.lineWidth = 1.5;
    if (away) context.stroke();
    else context.fill();
    context.fillStyle = palette.text;
    context.fillText(`${clean(name).slice(0, 24)}${away && ` (${away})`}`, px + 8, py + 12);
  }
}

/** The drawing of all that; state: tracks, places, colours and options of the page. */
export const drawBase = (state) =>
  function* draw(context, view) {
    const { frame } = state.tracks;
    if (!frame) return;
    context.font = "11px system-ui, sans-serif";
    if (state.options.grid) {
      lines(context, view, frame.kind !== "local");
      rings(context, view, frame, state.tracks.around);
    }
    yield;
    if (state.options.coverage) sensors(context, view, state);
  };
