// The tracks as they are now: columns of the newest picture, texts by slot, and where each was.
//
// `wx`, `wy` are places on the map before it is zoomed: Mercator from 0 to 1 on the Earth, else metres with y down.

const POINTS = 60;
export const RADIUS = 6378137;
const ROUND = 2 * Math.PI * RADIUS;
const EDGE = 85.05;

/** Longitude and latitude, or x and y, to the map's unit. */
export function world(geo, x, y) {
  if (!geo) return [x, -y];
  const phi = (Math.max(-EDGE, Math.min(EDGE, y)) * Math.PI) / 180;
  return [(x + 180) / 360, (1 - Math.asinh(Math.tan(phi)) / Math.PI) / 2];
}

/** Units of the map for one metre at this place. */
export function unit(geo, y) {
  return geo ? 1 / (ROUND * Math.max(Math.cos((y * Math.PI) / 180), 0.05)) : 1;
}

/** From a source's own longitude and latitude, or x and y, to the map's unit, near to the picture; null where the source
 *  is in a frame that is not shown. */
export function placed(tracks, place) {
  const { geo, frame, around } = tracks;
  if (geo ? place.local !== undefined : place.local !== frame.name) return null;
  const turns = geo ? Math.round((around - place.place[0]) / 360) : 0;
  return ([x, y]) => world(geo, x + 360 * turns, y);
}

class Trails {
  constructor() {
    this.rows = new Map();
    this.room = 0;
    this.free = [];
    this.grow(1024);
  }

  grow(room) {
    const old = this;
    const places = new Float64Array(2 * POINTS * room);
    const counts = new Uint32Array(room);
    if (old.places) {
      places.set(old.places);
      counts.set(old.counts);
    }
    for (let row = room - 1; row >= this.room; row -= 1) this.free.push(row);
    this.places = places;
    this.counts = counts;
    this.room = room;
  }

  add(slot, wx, wy) {
    let row = this.rows.get(slot);
    if (row === undefined) {
      if (!this.free.length) this.grow(2 * this.room);
      row = this.free.pop();
      this.rows.set(slot, row);
      this.counts[row] = 0;
    }
    const at = 2 * (row * POINTS + (this.counts[row] % POINTS));
    this.places[at] = wx;
    this.places[at + 1] = wy;
    this.counts[row] += 1;
  }

  keep(slots) {
    if (this.rows.size <= slots.size) return;
    for (const [slot, row] of this.rows) {
      if (!slots.has(slot)) {
        this.rows.delete(slot);
        this.free.push(row);
      }
    }
  }

  /** visit(wx, wy) of every point of a track, the newest first. */
  each(slot, visit) {
    const row = this.rows.get(slot);
    if (row === undefined) return;
    const count = this.counts[row];
    for (let k = count - 1; k >= Math.max(0, count - POINTS); k -= 1) {
      const at = 2 * (row * POINTS + (k % POINTS));
      visit(this.places[at], this.places[at + 1]);
    }
  }
}

export class Tracks {
  constructor() {
    this.clear();
  }

  clear() {
    this.picture = null;
    this.count = 0;
    this.geo = true;
    this.frame = null;
    this.texts = new Map();
    this.rowOf = new Map();
    this.slotOf = new Map();
    this.trails = new Trails();
    this.marked = 0;
  }

  takeTexts(list) {
    for (const [slot, id, label, callsign, identity, kind, number] of list) {
      const search = [number || "", label, callsign, identity, kind, id].join("\n").toLowerCase();
      this.texts.set(slot, { slot, id, label, callsign, identity, kind, number, search, name: callsign || String(number || label) });
      this.slotOf.set(id, slot);
    }
  }

  takeTrail(message) {
    this.past = message;
  }

  takePicture(message) {
    const geo = message.frame.kind !== "local";
    if (geo !== this.geo) {
      this.geo = geo;
      this.trails = new Trails();
    }
    this.frame = message.frame;
    this.around = message.around;
    this.picture = message;
    this.count = message.slot.length;
    this.rowOf = new Map();
    this.wx = new Float64Array(this.count);
    this.wy = new Float64Array(this.count);
    const now = performance.now();
    const mark = now - this.marked > 900;
    if (this.past) this.unpackTrail();
    for (let row = 0; row < this.count; row += 1) {
      const slot = message.slot[row];
      const [wx, wy] = world(geo, message.x[row], message.y[row]);
      this.wx[row] = wx;
      this.wy[row] = wy;
      this.rowOf.set(slot, row);
      if (mark) this.trails.add(slot, wx, wy);
    }
    if (mark) this.marked = now;
    this.trails.keep(this.rowOf);
    if (this.texts.size > this.count) {
      for (const [slot, text] of this.texts) {
        if (!this.rowOf.has(slot)) {
          this.texts.delete(slot);
          if (this.slotOf.get(text.id) === slot) this.slotOf.delete(text.id);
        }
      }
    }
  }

  unpackTrail() {
    const { counts, slot, x, y } = this.past;
    let at = 0;
    for (const count of counts) {
      for (let k = at; k < at + count; k += 1) this.trails.add(slot[k], ...world(this.geo, x[k], y[k]));
      at += count;
    }
    this.past = null;
  }

  /** The row of a track by its id as text, or -1. */
  row(id) {
    return this.rowOf.get(this.slotOf.get(id)) ?? -1;
  }

  textOf(row) {
    return this.texts.get(this.picture.slot[row]);
  }

  /** The texts of tracks that have `words` in one of them, exact ones first, then by number. */
  found(words) {
    const wanted = words.trim().toLowerCase();
    const all = [];
    for (const [slot, one] of this.texts) {
      if (this.rowOf.has(slot) && (!wanted || one.search.includes(wanted))) all.push(one);
    }
    const exact = (one) => (wanted && one.search.split("\n").includes(wanted) ? 0 : 1);
    return all.sort((one, other) => exact(one) - exact(other) || one.slot - other.slot);
  }
}
