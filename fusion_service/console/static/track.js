// The track that is chosen, explained: what it is, from whom it comes, and what was decided of it.

import { byId, clock, figure, make, metres, placeWords, pool, say, span, terms } from "/static/dom.js";

export class Track {
  /** act(what): next, previous, centre or close; order(subject): opens the dialog. */
  constructor(state, act, order) {
    this.state = state;
    this.order = order;
    const button = (words, what, title) => {
      const node = make("button", { type: "button", text: words, title });
      node.addEventListener("click", () => act(what));
      return node;
    };
    this.none = make("p", { class: "none", text: "Choose a track on the map or in the list." });
    this.title = make("h2");
    this.sign = make("p", { class: "lead" });
    this.orderButton = make("button", { type: "button", class: "order", text: "Order…", title: "Order something about this track (o)" });
    this.orderButton.addEventListener("click", () => order());
    this.buttons = make("div", { class: "buttons" },
      button("Previous", "previous", "The track before (p)"), button("Next", "next", "The track after (n)"),
      button("Centre", "centre", "Bring it into the middle (c)"), button("Close", "close", "Let go of it (Esc)"), this.orderButton);
    this.facts = make("dl", { class: "facts" });
    this.members = make("tbody");
    this.table = make("table", {},
      make("caption", { text: "Comes from" }),
      make("thead", {}, make("tr", {}, ...["Source", "Its track", "Influence", "d²"].map((one) => make("th", { scope: "col", text: one })))),
      this.members);
    this.historyHead = make("h3", { text: "What was decided" });
    this.history = make("ol", { class: "rows history" });
    this.body = make("div", { hidden: true }, this.title, this.sign, this.buttons, this.facts, this.table, this.historyHead, this.history);
    byId("track").append(this.none, this.body);
  }

  show() {
    const { chosen, detail } = this.state;
    this.none.hidden = chosen !== null;
    this.body.hidden = chosen === null || detail?.id !== chosen;
    this.orderButton.hidden = !this.state.mayOrder;
    if (this.body.hidden) return;
    const name = detail.callsign || (detail.number ? String(detail.number) : "");
    say(this.title, name ? `${name} (track ${detail.label})` : `Track ${detail.label}`);
    const gone = detail.gone !== undefined;
    say(this.sign, gone ? `Not there any more: ${detail.gone}` : this.lead(detail));
    this.sign.className = `lead ${gone ? "gone" : detail.status}`;
    this.table.hidden = gone || !detail.members.length;
    terms(this.facts, gone ? [["Id", detail.id]] : this.factsOf(detail));
    if (!gone) this.showMembers(detail.members);
    const told = [...detail.history].reverse();
    this.historyHead.hidden = !told.length;
    pool(this.history, told.length, () => make("li", {}, make("time"), make("span"))).forEach((item, k) => {
      const [time, words, often] = told[k];
      say(item.firstChild, clock(time));
      say(item.lastChild, often > 1 ? `${words} (${often} times)` : words);
    });
  }

  lead(detail) {
    const what = { tentative: "Tentative: not enough seen yet", confirmed: "Confirmed", coasting: "Coasting: no source has it now" };
    const from = new Set(detail.members.map((one) => one.source)).size;
    const by = from ? `, from ${from} source${from > 1 ? "s" : ""}, fused by ${detail.way}` : "";
    return `${what[detail.status] ?? detail.status}${by}`;
  }

  factsOf(detail) {
    const { sigmas } = this.state.options;
    const [vx, vy] = detail.velocity;
    const speed = vx === null ? NaN : Math.hypot(vx, vy);
    const course = ((Math.atan2(vx, vy) * 180) / Math.PI + 360) % 360;
    const many = sigmas || 1;
    const [x, y, z] = detail.place;
    const said = detail.what.map(({ name, said: words, p }) => [name === "kind" ? "Kind" : "Identity", p === null ? words : `${words} (${Math.round(100 * p)} %)`]);
    return [
      ...said,
      ["Exists", `${(100 * detail.existence).toFixed(1)} %`],
      ["Place", placeWords(detail.geo, x ?? NaN, y ?? NaN)],
      ...(z === null ? [] : [["Height", metres(z)]]),
      ["Moves", Number.isFinite(speed) ? `${figure(speed)} m/s (${figure(speed * 1.943844)} kn)${speed > 0.05 ? `, course ${String(Math.round(course) % 360).padStart(3, "0")}°` : ""}` : "not known"],
      [`Ellipse, ${many} σ`, `${metres(many * detail.ellipse[0])} by ${metres(many * detail.ellipse[1])}`],
      ["Newest data", `${clock(detail.updated)} UTC, ${span((detail.time - detail.updated) / 1000)} before the picture`],
      ...(detail.origin === "live" ? [] : [["Origin", detail.origin]]),
      ...detail.marks.map((one) => ["Mark", one]),
      ["Id", detail.id],
    ];
  }

  showMembers(members) {
    const create = () => make("tr", {}, make("td", {}, make("span", { class: "dot" }), make("span")), make("td"), make("td", {}, make("meter", { min: 0, max: 1 }), make("span")), make("td"));
    pool(this.members, members.length, create).forEach((line, k) => {
      const { source, id, influence, d2 } = members[k];
      const [from, track, share, distance] = line.children;
      from.firstChild.style.backgroundColor = this.state.colours.get(source) ?? "";
      say(from.lastChild, source);
      say(track, id);
      share.firstChild.value = Math.max(0, Math.min(1, influence ?? 0));
      say(share.lastChild, influence === null ? "–" : ` ${Math.round(100 * influence)} %`);
      say(distance, d2 === null ? "–" : d2.toFixed(1));
    });
  }
}
