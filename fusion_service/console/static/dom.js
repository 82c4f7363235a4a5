// Nodes and words. What came from the bus becomes text by textContent alone, what would steer it written out.

const STEERING = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u200b\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]/g;

export const byId = (id) => document.getElementById(id);

/** Text as it may be shown: control characters and overrides of direction as their codes. */
export function clean(text) {
  return String(text ?? "").replace(STEERING, (one) => `\\u${one.charCodeAt(0).toString(16).padStart(4, "0")}`);
}

/** A node with properties (class, text, any other is a property or an aria/data attribute) and children. */
export function make(tag, given = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(given)) {
    if (name === "class") node.className = value;
    else if (name === "text") node.textContent = clean(value);
    else if (name.includes("-") || name === "role" || name === "for") node.setAttribute(name, value);
    else node[name] = value;
  }
  node.append(...children);
  return node;
}

/** Change the text of a node where it is another. */
export function say(node, text) {
  const said = clean(text);
  if (node.textContent !== said) node.textContent = said;
  return node;
}

/** Exactly `count` children of `parent`, made where they lack: nodes stay, so that focus does. */
export function pool(parent, count, create) {
  while (parent.children.length > count) parent.lastElementChild.remove();
  while (parent.children.length < count) parent.append(create());
  return [...parent.children];
}

/** A list of [term, words] in a dl. */
export function terms(list, pairs) {
  const rows = pool(list, pairs.length, () => make("div", {}, make("dt"), make("dd")));
  rows.forEach((row, k) => {
    say(row.firstChild, pairs[k][0]);
    say(row.lastChild, pairs[k][1]);
  });
}

const two = (number) => String(number).padStart(2, "0");

/** 12:34:56 UTC of ms. */
export function clock(ms) {
  if (!Number.isFinite(ms)) return "";
  const at = new Date(ms);
  return `${two(at.getUTCHours())}:${two(at.getUTCMinutes())}:${two(at.getUTCSeconds())}`;
}

/** Seconds in words. */
export function span(s) {
  if (!Number.isFinite(s)) return "?";
  const far = Math.abs(s);
  if (far < 10) return `${s.toFixed(1)} s`;
  if (far < 120) return `${Math.round(s)} s`;
  if (far < 7200) return `${Math.round(s / 60)} min`;
  return far < 172800 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86400)} d`;
}

/** Metres in words. */
export function metres(m) {
  if (!Number.isFinite(m)) return "?";
  if (Math.abs(m) >= 1e6) return `${Math.round(m / 1000)} km`;
  if (Math.abs(m) >= 10000) return `${(m / 1000).toPrecision(3)} km`;
  return `${Math.abs(m) < 10 ? m.toFixed(1) : Math.round(m)} m`;
}

export const figure = (value, digits = 3) => (Number.isFinite(value) ? Number(value.toPrecision(digits)).toString() : "–");

/** The same longitude, from -180 to below 180 degrees. */
export const within180 = (x) => x - 360 * Math.floor((x + 180) / 360);

/** A place in words: degrees and minutes, or x and y. */
export function placeWords(geo, x, y) {
  if (!Number.isFinite(x) || !Number.isFinite(y)) return "nowhere";
  if (!geo) return `x ${metres(x)}, y ${metres(y)}`;
  const part = (value, plus, minus) => {
    const far = Math.round(Math.abs(value) * 60000);
    return `${Math.floor(far / 60000)}° ${((far % 60000) / 1000).toFixed(3)}′ ${value < 0 ? minus : plus}`;
  };
  return `${part(y, "N", "S")}, ${part(within180(x), "E", "W")}`;
}

/** 1, 2 or 5 times a power of ten, not above `most`. */
export function round125(most) {
  const power = 10 ** Math.floor(Math.log10(most));
  return [5, 2, 1].find((one) => one * power <= most) * power;
}
