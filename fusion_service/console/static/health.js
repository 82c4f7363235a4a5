// Sources with their health, alarms, and the log.

import { byId, clock, figure, make, pool, say, span } from "/static/dom.js";

const KEPT = 300;
// Seconds; what is later is of a mission with a clock of its own.
const SAME_CLOCK = 3600;

const short = (s) => (Math.abs(s) < 1 ? `${Math.round(1000 * s)} ms` : span(s));

export class Sources {
  constructor(state, order) {
    this.state = state;
    this.order = order;
    this.count = make("p", { class: "count" });
    this.rows = make("ul", { class: "rows sources" });
    byId("sources").append(this.count, this.rows);
  }

  item() {
    const order = make("button", { type: "button", class: "order", text: "Order…" });
    order.addEventListener("click", () => this.order(order.dataset.source));
    const head = make("div", { class: "head" }, make("span", { class: "dot" }), make("strong"), make("span", { class: "state" }), order);
    return make("li", {}, head, make("p", { class: "numbers" }), make("ul", { class: "wrong" }), make("ul", { class: "more" }), make("p", { class: "refusal" }));
  }

  show(health) {
    const { sources } = health;
    const there = sources.filter((one) => one.state === "there").length;
    say(this.count, `${there} of ${sources.length + health.beyond} sources are there${health.beyond ? `; ${health.beyond} more are not listed` : ""}`);
    pool(this.rows, sources.length, () => this.item()).forEach((item, k) => {
      const one = sources[k];
      const [head, numbers, wrong, more, refusal] = item.children;
      const [dot, name, state, order] = head.children;
      dot.style.backgroundColor = one.colour;
      say(name, one.name);
      item.className = one.state === "there" && !one.wrong.length ? "well" : "unwell";
      const trust = one.trust && one.trust !== "trusted" ? `, ${one.trust}` : "";
      say(state, `${one.state}${trust}`);
      if (state.title !== one.means) state.title = one.means;
      order.hidden = !this.state.mayOrder;
      order.dataset.source = one.name;
      order.setAttribute("aria-label", `Order about ${one.name}`);
      say(numbers, this.numbers(one));
      pool(wrong, one.wrong.length, () => make("li")).forEach((line, n) => say(line, one.wrong[n]));
      pool(more, one.more.length, () => make("li")).forEach((line, n) => say(line, one.more[n]));
      const last = one.refusal;
      refusal.hidden = !last || [...one.wrong, ...one.more].some((line) => line.includes(last.said));
      if (last) say(refusal, `Last refusal${Number.isFinite(last.time) ? ` ${clock(last.time)}` : ""} (${last.reason}, ${figure(last.count)} in all): ${last.said}`);
    });
  }

  numbers(one) {
    const parts = [
      one.tracks !== null && `${one.tracks} tracks`,
      one.share !== null && `${Math.round(100 * one.share)} % shared`,
      one.rate !== null && `${figure(one.rate)} a second${one.period ? `, one every ${figure(one.period)} s declared` : ""}`,
      one.latency !== null && Math.abs(one.latency) < SAME_CLOCK && `latency ${short(one.latency)}`,
      one.clock !== null && `clock ${one.clock < 0 ? "−" : "+"}${short(Math.abs(one.clock))}`,
      one.refused ? `${one.refused} refused` : false,
      one.gaps ? `${one.gaps} lost` : false,
    ];
    return parts.filter(Boolean).join(" · ");
  }
}

export class Alarms {
  constructor() {
    this.count = make("p", { class: "count" });
    this.rows = make("ul", { class: "rows alarms" });
    this.notesHead = make("h3", { text: "Notes of the centre" });
    this.notes = make("ul", { class: "rows notes" });
    byId("alarms").append(this.count, this.rows, this.notesHead, this.notes);
    this.before = null;
  }

  /** own: alarms of the page itself, before those of the centre. */
  show(health, own) {
    const alarms = [...own, ...(health?.alarms ?? [])];
    say(this.count, alarms.length ? `${alarms.length} alarm${alarms.length > 1 ? "s" : ""}` : "Nothing is wrong, as far as is known");
    pool(this.rows, alarms.length, () => make("li", {}, make("time"), make("span"))).forEach((item, k) => {
      say(item.firstChild, alarms[k].since ? `since ${clock(alarms[k].since)}` : "now");
      say(item.lastChild, alarms[k].text);
    });
    const notes = health?.notes ?? [];
    this.notesHead.hidden = !notes.length;
    pool(this.notes, notes.length, () => make("li")).forEach((item, k) => say(item, notes[k]));
    const tab = byId("tab-alarms");
    say(tab, alarms.length ? `Alarms ${alarms.length}` : "Alarms");
    tab.classList.toggle("raised", alarms.length > 0);
    if (this.before !== null && alarms.length > this.before) say(byId("spoken"), `New alarm: ${alarms[0].text}`);
    this.before = alarms.length;
  }
}

export class Log {
  constructor(choose) {
    this.kind = make("select", { "aria-label": "Which lines" }, ...[
      ["", "All lines"], ["decision", "Decisions"], ["event", "Events"], ["refusal", "Refusals"], ["order", "Orders"], ["console", "This console"],
    ].map(([value, text]) => make("option", { value, text })));
    this.kind.addEventListener("change", () => this.show());
    this.rows = make("ol", { class: "rows log" });
    this.choose = choose;
    this.lines = [];
    byId("log").append(make("p", { class: "count" }, this.kind), this.rows);
  }

  take(lines) {
    this.lines = [...this.lines, ...lines].slice(-KEPT);
    this.show();
  }

  clear() {
    this.lines = [];
    this.show();
  }

  item() {
    const button = make("button", { type: "button", text: "show", class: "small" });
    button.addEventListener("click", () => this.choose(button.dataset.id, true));
    return make("li", {}, make("time"), make("span"), button);
  }

  show() {
    const wanted = this.lines.filter((one) => !this.kind.value || one.kind === this.kind.value).reverse();
    pool(this.rows, wanted.length, () => this.item()).forEach((item, k) => {
      const one = wanted[k];
      const [time, words, button] = item.children;
      item.className = one.bad ? "bad" : "";
      say(time, clock(one.time));
      say(words, one.text);
      button.hidden = one.track === undefined;
      button.dataset.id = one.track ?? "";
      button.setAttribute("aria-label", "Show the track of this line");
    });
  }
}
