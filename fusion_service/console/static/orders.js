// Orders: a dialog that asks what, why and who before anything is sent, and the list of those that stand.

import { byId, clean, clock, make, pool, say } from "/static/dom.js";

const TIMES = [["", "for good"], ["600", "for 10 minutes"], ["3600", "for 1 hour"], ["86400", "for 1 day"]];
const KEEPS = ["delete", "link", "unlink", "never-link", "split", "mute", "quarantine", "supervise", "rename", "identify"];
const WHO = "fusion-console-who";

export class Orders {
  constructor(state) {
    this.state = state;
    this.dialog = byId("order-dialog");
    this.rows = make("ul", { class: "rows orders" });
    this.count = make("p", { class: "count", text: "" });
    this.look = make("button", { type: "button", text: "Look again" });
    this.look.addEventListener("click", () => this.list());
    byId("orders").append(make("div", { class: "buttons" }, this.look), this.count, this.rows);
    this.build();
  }

  /** Whether orders can be given, and why not. */
  offer({ orders, may_order: may }) {
    byId("tab-orders").hidden = !orders;
    this.look.hidden = !may;
    const why = "Orders need the token of this console: open the address that it printed when it was started.";
    say(this.count, may ? "" : why);
    if (!may) this.rows.replaceChildren();
  }

  build() {
    const field = (label, node) => make("label", { class: "field" }, make("span", { text: label }), node);
    this.title = make("h2", { id: "order-title" });
    this.what = make("select");
    this.says = make("p", { class: "says" });
    this.fields = make("div");
    this.until = make("select", {}, ...TIMES.map(([value, text]) => make("option", { value, text })));
    this.untilField = field("How long", this.until);
    this.why = make("input", { required: true, maxLength: 200, autocomplete: "off" });
    this.who = make("input", { required: true, maxLength: 80, autocomplete: "name" });
    this.answer = make("p", { class: "answer", role: "status" });
    this.send = make("button", { type: "submit", class: "order" });
    this.close = make("button", { type: "button", text: "Cancel" });
    this.form = make("form", { method: "dialog" }, this.title, field("Order", this.what), this.says, this.fields, this.untilField,
      field("Why", this.why), field("Who orders", this.who), this.answer, make("div", { class: "buttons" }, this.close, this.send));
    this.dialog.append(this.form);
    this.what.addEventListener("change", () => this.shape());
    this.close.addEventListener("click", () => this.dialog.close());
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.give();
    });
  }

  /** Open the dialog about a source, a standing order, or the chosen track. */
  open({ source = null, withdraw = null } = {}) {
    const { offers, chosen, detail } = this.state;
    if (!this.state.mayOrder || (source === null && withdraw === null && chosen === null)) return;
    this.subject = { source, withdraw, track: source || withdraw ? null : chosen };
    this.members = this.subject.track && detail?.id === chosen ? (detail.members ?? []) : [];
    const words = withdraw ? ["withdraw"] : source ? offers.source : offers.track;
    this.what.replaceChildren(...words.map((one) => make("option", { value: one, text: one })));
    const name = withdraw ? `order ${withdraw}` : source ?? `track ${detail?.label ?? chosen}`;
    this.name = name;
    say(this.title, `Order about ${name}`);
    this.why.value = "";
    this.who.value = this.state.who || this.remembered();
    this.who.readOnly = Boolean(this.state.who);
    this.close.textContent = "Cancel";
    this.send.hidden = false;
    say(this.answer, "");
    this.shape();
    this.dialog.showModal();
  }

  remembered() {
    try {
      return sessionStorage.getItem(WHO) ?? "";
    } catch {
      return "";
    }
  }

  /** The fields that the chosen order needs. */
  shape() {
    const what = this.what.value;
    const { words, states } = this.state.offers;
    say(this.says, words[what].says);
    const text = (name, label, given = {}) => ({ name, label, node: make("input", { maxLength: 64, autocomplete: "off", ...given }) });
    const pick = (name, label, options) => ({ name, label, node: make("select", {}, ...options.map(([value, said]) => make("option", { value, text: said }))) });
    const local = () => this.members.length
      ? pick("local", "Local track", this.members.map((one) => [JSON.stringify([one.source, one.epoch, one.id]), `${one.source} ${one.id}`]))
      : text("local", "Local track: source and its id, as in radar-1 17", { required: true });
    this.asked = {
      rename: () => [text("name", "Callsign"), text("shown", "Number", { inputMode: "numeric", pattern: "[0-9]{1,9}" })],
      identify: () => [text("identity", "Identity, as in mmsi:257054000", { required: true })],
      merge: () => [text("other", "The other track, which ends: number, callsign or id", { required: true })],
      link: () => [text("local", "Local track: source and its id, as in radar-1 17", { required: true })],
      unlink: () => [local()],
      split: () => [local()],
      "never-link": () => [local()],
      supervise: () => [pick("state", "How far it is trusted", states.map((one) => [one, one]))],
    }[what]?.() ?? [];
    this.fields.replaceChildren(...this.asked.map(({ label, node }) => make("label", { class: "field" }, make("span", { text: label }), node)));
    this.untilField.hidden = !KEEPS.includes(what);
    say(this.send, `Order: ${what} ${this.name}`);
  }

  request() {
    const { source, withdraw, track } = this.subject;
    const what = this.what.value;
    const order = { what, why: this.why.value.trim(), who: this.who.value.trim() };
    if (source) order.source = source;
    if (withdraw) order.number = withdraw;
    if (track && !["unlink", "split"].includes(what)) order.track = track;
    for (const { name, node } of this.asked) {
      const value = node.value.trim();
      if (!value) continue;
      if (name === "shown") order.shown = Number(value);
      else if (name !== "local") order[name] = value;
      else if (node.tagName === "SELECT") order.local = JSON.parse(value);
      else {
        const [from, id] = [value.replace(/\s+\S+$/, ""), /\S+$/.exec(value)?.[0] ?? ""];
        order.local = [from, -1, id];
      }
    }
    if (!this.untilField.hidden && this.until.value) order.for = Number(this.until.value);
    return order;
  }

  async give() {
    try {
      sessionStorage.setItem(WHO, this.who.value.trim());
    } catch {
      // a browser that keeps nothing
    }
    this.send.disabled = true;
    say(this.answer, "Asked; the centre answers when a step has obeyed …");
    const answer = await this.ask(this.request());
    this.send.disabled = false;
    say(this.answer, answer.words);
    this.answer.className = `answer ${answer.done ? "done" : "refused"}`;
    if (answer.done) {
      this.send.hidden = true;
      this.close.textContent = "Close";
      this.close.focus();
      this.list();
    }
  }

  /** Send an order; {done, words, said}. */
  async ask(order) {
    try {
      const answer = await fetch("/order", {
        method: "POST",
        headers: { "content-type": "application/json", authorization: `Bearer ${this.state.stream.token}` },
        body: JSON.stringify({ centre: this.state.centre, order }),
      });
      const said = await answer.json();
      if (!answer.ok) return { done: false, words: clean(said.wrong ?? `refused (${answer.status})`), said };
      const more = `${said.pending ? ", when a step is made: none is at the moment" : ""}${said.kept === false && said.done ? " (not on disk)" : ""}`;
      const words = said.done ? `Order ${said.number}: ${clean(said.outcome)}${more}` : `Order ${said.number} is refused: ${clean(said.outcome)}`;
      return { done: Boolean(said.done), words, said };
    } catch {
      return { done: false, words: "The console does not answer: it is not known whether the order was given. Look at the log.", said: {} };
    }
  }

  /** Look which orders stand. */
  async list() {
    if (!this.state.mayOrder || !this.state.centre) return;
    const { said, words } = await this.ask({ what: "list" });
    const orders = Array.isArray(said.orders) ? said.orders : null;
    say(this.count, orders === null ? words : orders.length ? `${orders.length} orders stand` : "No order stands");
    const shown = (orders ?? []).slice(0, 200);
    pool(this.rows, shown.length, () => {
      const button = make("button", { type: "button", text: "Withdraw…", class: "order" });
      button.addEventListener("click", () => this.open({ withdraw: Number(button.dataset.number) }));
      return make("li", {}, make("span"), button);
    }).forEach((item, k) => {
      const one = shown[k];
      const about = ["source", "name", "shown", "identity", "state"].map((name) => one[name]).filter(Boolean);
      if (one.label ?? one.track) about.unshift(`track ${one.label ?? one.track}`);
      for (const local of [one.local, one.against]) if (Array.isArray(local)) about.push(`${local[0]} ${local[2]}`);
      const until = Number.isFinite(one.until) ? `, until ${clock(one.until / 1e6)}` : "";
      say(item.firstChild, `${one.number} ${one.what} ${about.join(", ")}${until}, by ${one.who || "?"}${one.proven ? "" : " (unproven)"}${one.why ? `: ${one.why}` : ""}`);
      item.lastChild.dataset.number = one.number;
    });
  }
}
