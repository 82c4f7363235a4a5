// The connection to the console: it comes back by itself, and says what came to whoever wants that kind of message.

const FIRST = 500;
const LONGEST = 8000;
const ARRAYS = { u1: Uint8Array, u4: Uint32Array, f4: Float32Array, f8: Float64Array };
const KEY = "fusion-console-token";
const WHY = { 4401: "the token is missing or wrong: open the address that the console printed", 4429: "too many pages are open", 4408: "too much was said" };

/** The header and columns of a binary message (see packing.py). */
export function unpacked(buffer) {
  const length = new DataView(buffer).getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  for (const [name, kind, count, offset] of header.columns) {
    header[name] = new ARRAYS[kind](buffer, 4 + length + offset, count);
  }
  return header;
}

/** The token of the address, which is taken out of it, or of this tab. */
export function token() {
  const found = /[#&]token=([\w.~-]+)/.exec(location.hash);
  try {
    if (found) {
      sessionStorage.setItem(KEY, found[1]);
      history.replaceState(null, "", location.pathname);
    }
    return sessionStorage.getItem(KEY) ?? "";
  } catch {
    return found ? found[1] : "";
  }
}

export class Stream {
  /** first(): what is said with the token; take(message): of every message; link(open, why): when the connection opens
   *  or closes. */
  constructor(first, take, link) {
    this.first = first;
    this.take = take;
    this.link = link;
    this.token = token();
    this.bytes = 0;
    this.wait = FIRST;
    this.socket = null;
    this.open();
    addEventListener("hashchange", () => {
      this.token = token();
      this.wait = FIRST;
      this.socket?.close();
    });
  }

  open() {
    const socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/stream`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => socket.send(JSON.stringify({ token: this.token, ...this.first() }));
    socket.onmessage = ({ data }) => {
      this.bytes += data.byteLength ?? data.length;
      const message = typeof data === "string" ? JSON.parse(data) : unpacked(data);
      if (message.type === "hello") {
        this.wait = FIRST;
        this.link(true, "");
      }
      this.take(message);
    };
    socket.onclose = ({ code }) => {
      this.socket = null;
      this.link(false, WHY[code] ?? "");
      setTimeout(() => this.open(), this.wait);
      this.wait = Math.min(2 * this.wait, LONGEST);
    };
  }

  say(words) {
    if (this.socket?.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(words));
  }
}
