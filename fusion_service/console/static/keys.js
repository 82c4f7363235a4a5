// Keys, tabs and the help that lists them.

import { byId, make } from "/static/dom.js";

const TABS = ["tracks", "track", "sources", "alarms", "log", "orders"];
const HELP = [
  ["/", "search; Enter takes the first, arrow down goes to the list"],
  ["n  p", "the next track, the one before"],
  ["c", "bring the track into the middle"],
  ["Esc", "let go of the track, close what is open"],
  ["+  −  f", "nearer, farther, show all"],
  ["arrows", "move the map, when it has the focus"],
  ["1 … 6", "tracks, track, sources, alarms, log, orders"],
  ["o", "order something about the track, where orders are allowed"],
  ["t", "theme: as the system, light, dark"],
];
const SIGNS = [
  ["disk", "confirmed"],
  ["small ring", "tentative: not enough seen yet"],
  ["diamond, dashed ellipse", "coasting: no source has it now"],
  ["triangle above", "its identity is in two places"],
  ["thin line", "where it was, the last minute or so; where it goes in a minute (10 s in a local frame)"],
  ["lines to sensors", "whom the chosen track comes from, as wide as their influence"],
];

/** Show one of the tabs. */
export function showTab(name) {
  for (const one of TABS) {
    const tab = byId(`tab-${one}`);
    const chosen = one === name;
    tab.setAttribute("aria-selected", String(chosen));
    tab.tabIndex = chosen ? 0 : -1;
    byId(one).hidden = !chosen;
  }
}

function tabs(shown) {
  for (const name of TABS) {
    byId(`tab-${name}`).addEventListener("click", () => {
      showTab(name);
      shown(name);
    });
  }
  byId("tabs").addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const open = TABS.filter((one) => !byId(`tab-${one}`).hidden);
    const at = open.findIndex((one) => byId(`tab-${one}`).getAttribute("aria-selected") === "true");
    const next = open[(at + step + open.length) % open.length];
    byId(`tab-${next}`).click();
    byId(`tab-${next}`).focus();
  });
}

function help() {
  const list = (pairs) => make("dl", { class: "facts" }, ...pairs.map(([one, two]) => make("div", {}, make("dt", { text: one }), make("dd", { text: two }))));
  const close = make("button", { type: "button", text: "Close" });
  const dialog = byId("help-dialog");
  close.addEventListener("click", () => dialog.close());
  dialog.append(make("h2", { id: "help-title", text: "Keys" }), list(HELP), make("h2", { text: "Signs on the map" }), list(SIGNS), make("div", { class: "buttons" }, close));
  byId("help").addEventListener("click", () => dialog.showModal());
}

/** Take keys; actions: by name, see `DOES`. */
export function takeKeys(actions) {
  tabs(actions.shown);
  help();
  const does = {
    "/": () => byId("search").focus(),
    n: () => actions.act("next"),
    p: () => actions.act("previous"),
    c: () => actions.act("centre"),
    Escape: () => actions.act("close"),
    "+": () => byId("nearer").click(),
    "=": () => byId("nearer").click(),
    "-": () => byId("farther").click(),
    f: () => byId("fit").click(),
    o: () => actions.order(),
    t: () => byId("theme").click(),
    "?": () => byId("help").click(),
  };
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return;
    if (event.target.matches?.("input, select, textarea")) return;
    const number = Number(event.key);
    const tab = number >= 1 && number <= TABS.length ? byId(`tab-${TABS[number - 1]}`) : null;
    const action = tab && !tab.hidden ? () => { tab.click(); tab.focus(); } : does[event.key];
    if (!action || (event.key !== "?" && event.target.closest?.("#map") && "+-=".includes(event.key))) return;
    event.preventDefault();
    action();
  });
}
