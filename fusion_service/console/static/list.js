// The search and its findings: the tracks, a line each.

import { byId, make, pool, say } from "/static/dom.js";

const MOST = 100;
export const STATUS = ["tentative", "confirmed", "coasting"];

export class List {
  constructor(state, choose) {
    this.state = state;
    this.choose = choose;
    this.count = make("p", { class: "count" });
    this.rows = make("ul", { class: "rows tracks" });
    byId("tracks").append(this.count, this.rows);
    this.search = byId("search");
    this.search.addEventListener("input", () => this.show());
    this.search.addEventListener("keydown", (event) => {
      if (event.key === "Enter" && this.found.length) choose(this.found[0].id, true);
      if (event.key === "ArrowDown") this.rows.querySelector("button")?.focus();
      if (event.key === "Escape") {
        this.search.value = "";
        this.show();
        this.search.blur();
      }
    });
    this.rows.addEventListener("keydown", (event) => {
      const step = { ArrowDown: "nextElementSibling", ArrowUp: "previousElementSibling" }[event.key];
      if (!step) return;
      event.preventDefault();
      (event.target.closest("li")?.[step]?.firstChild ?? this.search).focus();
    });
    this.found = [];
  }

  line() {
    const button = make("button", { type: "button" }, ...["sign", "name", "who", "kind", "from"].map((one) => make("span", { class: one })));
    button.addEventListener("click", () => this.choose(button.dataset.id, true));
    return make("li", {}, button);
  }

  show() {
    const { tracks, chosen } = this.state;
    this.found = tracks.found(this.search.value);
    const shown = this.found.slice(0, MOST);
    const all = tracks.count;
    const more = this.found.length > MOST ? `, the first ${MOST} shown: search for others` : "";
    say(this.count, this.search.value.trim() ? `${this.found.length} of ${all} tracks${more}` : `${all} tracks${more}`);
    const { picture } = tracks;
    pool(this.rows, shown.length, () => this.line()).forEach((item, k) => {
      const one = shown[k];
      const button = item.firstChild;
      const row = tracks.rowOf.get(one.slot);
      const status = picture.status[row];
      const [sign, name, who, kind, from] = button.children;
      button.dataset.id = one.id;
      sign.className = `sign ${STATUS[status] ?? ""}`;
      if (sign.title !== STATUS[status]) sign.title = STATUS[status] ?? "";
      say(name, one.name);
      say(who, one.identity);
      say(kind, one.kind);
      say(from, `${picture.sources[row]} src`);
      const pressed = String(one.id === chosen);
      if (button.getAttribute("aria-current") !== pressed) button.setAttribute("aria-current", pressed);
    });
  }
}
