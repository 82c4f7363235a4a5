// The page: takes what the stream brings, and keeps map, panels and the words on top as it is.

import { Chart } from "/static/chart.js";
import { byId, clean, clock, make, say, span, terms } from "/static/dom.js";
import { drawChosen, drawTracks } from "/static/drawing.js";
import { drawBase } from "/static/grid.js";
import { Alarms, Log, Sources } from "/static/health.js";
import { showTab, takeKeys } from "/static/keys.js";
import { List } from "/static/list.js";
import { Orders } from "/static/orders.js";
import { followTheme } from "/static/palette.js";
import { Stream } from "/static/stream.js";
import { Track } from "/static/track.js";
import { placed, Tracks } from "/static/tracks.js";

const state = {
  tracks: new Tracks(), places: {}, colours: new Map(), states: new Map(), chosen: null, detail: null, health: null, pulse: null, heard: 0,
  centre: "", open: false, why: "", mayOrder: false, offers: null, who: "", stream: null,
  options: { sigmas: 2, trails: true, vectors: true, labels: true, tentative: true, coverage: true, grid: true },
};
const chart = new Chart(state.tracks, { base: drawBase(state), picture: drawTracks(state), mark: drawChosen(state) }, ground, (id) => choose(id));
const list = new List(state, choose);
const track = new Track(state, act, () => orders.open());
const orders = new Orders(state);
const sources = new Sources(state, (source) => orders.open({ source }));
const alarms = new Alarms();
const log = new Log(choose);

/** The corners of what is known of the place where there are no tracks: origin of the frame, the centre's
 *  sensors with their coverage. */
function ground() {
  const { frame, around, geo } = state.tracks;
  const near = (x) => (geo ? x + 360 * Math.round((around - x) / 360) : x);
  const [x, y] = frame?.kind === "enu" ? [near(frame.lon), frame.lat] : [NaN, NaN];
  const origin = Number.isFinite(x) ? [[x - 0.1, y - 0.05], [x + 0.1, y + 0.05]] : [];
  const shown = Object.entries(state.places).filter(([name, one]) => state.colours.has(name) && placed(state.tracks, one));
  return [...origin, ...shown.flatMap(([, one]) => [one.place, ...one.outline].map(([east, north]) => [near(east), north]))];
}

function choose(id, look = false) {
  const before = state.chosen;
  state.chosen = id;
  if (id !== before) {
    state.detail = null;
    state.stream.say({ track: id });
  }
  if (id !== null) {
    showTab("track");
    const row = state.tracks.row(id);
    if (look && row >= 0) chart.show(row);
  } else if (before !== null) showTab("tracks");
  chart.redraw("mark");
  track.show();
  list.show();
}

function act(what) {
  const row = state.chosen === null ? -1 : state.tracks.row(state.chosen);
  if (what === "close") choose(null);
  else if (what === "centre") {
    if (row >= 0) chart.map.panTo([state.tracks.picture.y[row], state.tracks.picture.x[row]], { animate: false });
  } else {
    const all = list.found.length ? list.found : state.tracks.found("");
    if (!all.length) return;
    const at = all.findIndex((one) => one.id === state.chosen);
    const step = what === "next" ? 1 : -1;
    const next = at < 0 ? (step > 0 ? 0 : all.length - 1) : (at + step + all.length) % all.length;
    choose(all[next].id, true);
  }
}

/** How all is, in a word and a form: link, hub, centre, picture. */
function condition() {
  const { pulse } = state;
  if (!state.open) return ["closed", state.why ? `not let in: ${state.why}` : "no connection to the console, trying again"];
  if (!pulse) return ["waiting", "connecting"];
  if (!pulse.hub) return ["closed", "the hub is away, waiting for it"];
  if (!state.centre) return ["waiting", "no centre is heard yet"];
  const age = pulse.age === null ? NaN : pulse.age + (performance.now() - state.heard) / 1000;
  if (pulse.alive === false) return ["closed", `centre ${state.centre} is gone${Number.isFinite(age) ? `, its picture is ${span(age)} old` : ""}`];
  if (!Number.isFinite(age)) return ["waiting", "no picture yet"];
  if (age > (pulse.patience ?? 3)) return ["stale", `the picture is ${span(age)} old`];
  return ["live", `live, ${state.centre}`];
}

function showCondition() {
  const [how, words] = condition();
  document.body.dataset.link = how;
  say(byId("link").lastElementChild, words);
  const banner = byId("banner");
  banner.hidden = how === "live" || (how === "waiting" && !state.tracks.count);
  say(banner, state.tracks.picture ? `Stale: ${words}` : words);
  const own = how === "closed" || how === "stale" ? [{ text: words, since: null }] : [];
  alarms.show(state.health, own);
}

function showFigures() {
  const { picture, count } = state.tracks;
  if (!picture) return;
  const counts = [0, 0, 0];
  for (const one of picture.status) counts[Math.min(one, 2)] += 1;
  const leftOut = picture.left_out ? [["not shown", String(picture.left_out)]] : [];
  const figures = [["confirmed", counts[1]], ["tentative", counts[0]], ["coasting", counts[2]]].map(([one, two]) => [one, String(two)]);
  terms(byId("figures"), [["UTC", clock(picture.time)], ...figures, ...leftOut]);
  byId("map").dataset.tracks = count;
}

const takes = {
  hello(message) {
    Object.assign(state, { mayOrder: message.may_order, offers: message.orders, who: message.who });
    chart.tiles = message.tiles;
    say(byId("owed"), message.tiles ? message.attribution || "map: as configured" : "");
    document.title = `Fusion console · ${clean(message.realm)}`;
    orders.offer(message);
    track.show();
  },
  pulse(message) {
    state.pulse = message;
    state.heard = performance.now();
    if (message.centre !== state.centre) begin(message.centre);
    const choice = byId("centre");
    byId("centre-choice").hidden = message.centres.length < 2;
    if ([...choice.options].map((one) => one.value).join() !== message.centres.join()) {
      choice.replaceChildren(...message.centres.map((value) => make("option", { value, text: value })));
    }
    choice.value = state.centre;
    showCondition();
  },
  trail: (message) => state.tracks.takeTrail(message),
  texts: (message) => state.tracks.takeTexts(message.tracks),
  picture(message) {
    state.tracks.takePicture(message);
    const fresh = chart.map === null || chart.geo !== state.tracks.geo;
    chart.make(state.tracks.geo);
    if (state.pulse) Object.assign(state.pulse, { age: 0 });
    state.heard = performance.now();
    if (!chart.touched && state.chosen === null && (fresh || state.tracks.count !== chart.fitted)) {
      chart.fitted = state.tracks.count;
      chart.fit();
    }
    if (fresh) chart.redraw();
    else chart.redraw("picture", "mark");
    showFigures();
    showCondition();
    if (!byId("tracks").hidden) list.show();
  },
  places(message) {
    state.places = message.sources;
    chart.redraw("base", "mark");
  },
  health(message) {
    state.health = message;
    state.colours = new Map(message.sources.map((one) => [one.name, one.colour]));
    state.states = new Map(message.sources.map((one) => [one.name, one.state]));
    sources.show(message);
    showCondition();
    const coloured = JSON.stringify([...state.colours, ...state.states]);
    if (coloured !== chart.coloured) {
      chart.coloured = coloured;
      chart.redraw("base", "mark");
    }
  },
  log: (message) => log.take(message.lines),
  track(message) {
    if (message.id !== state.chosen) return;
    state.detail = message;
    track.show();
    chart.redraw("mark");
  },
};

/** Another centre, or the first: nothing of the one before stays. */
function begin(centre) {
  if (state.centre) {
    state.tracks.clear();
    log.clear();
    state.health = null;
    state.colours = new Map();
    state.states = new Map();
    choose(null);
    chart.touched = false;
  }
  state.centre = centre;
}

function takeOptions() {
  byId("sigmas").addEventListener("change", ({ target }) => set("sigmas", Number(target.value)));
  for (const name of ["trails", "vectors", "labels", "tentative", "coverage", "grid"]) {
    byId(name).addEventListener("change", ({ target }) => set(name, target.checked));
  }
  const set = (name, value) => {
    state.options[name] = value;
    saySigmas();
    chart.redraw();
    track.show();
  };
  const saySigmas = () => say(byId("sigma-said"), state.options.sigmas ? `ellipses: ${state.options.sigmas} σ` : "no ellipses");
  saySigmas();
}

byId("centre").addEventListener("change", ({ target }) => state.stream.say({ centre: target.value }));
takeOptions();
takeKeys({ act, order: () => orders.open(), shown: (name) => (name === "orders" ? orders.list() : name === "tracks" && list.show()) });
followTheme(() => chart.redraw());
state.stream = new Stream(() => ({ centre: state.centre, track: state.chosen }), (message) => takes[message.type]?.(message), (open, why) => {
  if (open) log.clear();
  Object.assign(state, { open, why });
  showCondition();
});
setInterval(showCondition, 1000);
byId("layers").open = false;

/** For tests and measurements: where a track and a sensor are on the screen, and what drawing took. */
globalThis.fusionConsole = {
  at: (id) => (state.tracks.row(id) < 0 ? null : chart.pixel(state.tracks.row(id))),
  sensor: (name) => chart.place(placed(state.tracks, state.places[name])(state.places[name].place)),
  figures: () => ({ tracks: state.tracks.count, bytes: state.stream.bytes, took: chart.layers?.map((one) => one.took) ?? [] }),
};
