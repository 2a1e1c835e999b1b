// The connection to the page's server: frames in, commands out, and what its clock says.

import { decode, frameOf } from "./msgpack.js";

const PING_MS = 1000;
const KEPT_MS = 10000;
const RETRY_MS = [200, 500, 1000, 2000];
const ANSWER_MS = 12000;

/** The server's clock, never behind what it really says: an age is rather stated too large than too small. */
export class Clock {
  constructor() { this.samples = []; }

  add(sent, back, nowNs) {
    this.samples = this.samples.filter((s) => back - s.back < KEPT_MS);
    this.samples.push({ trip: back - sent, back, ahead: nowNs / 1e6 - sent });
  }

  get known() { return this.samples.length > 0; }

  /** Milliseconds of the server's monotonic clock. */
  now() {
    const best = this.samples.reduce((a, b) => (b.trip < a.trip ? b : a));
    return performance.now() + best.ahead;
  }
}

export class Link {
  /** on: {hello, frames, state}; token: "" or that of the printed address. */
  constructor(on, token) {
    this.on = on;
    this.token = token;
    this.clock = new Clock();
    this.waiting = new Map();
    this.tries = 0;
    this.id = 0;
    this.malformed = 0;
    this.watched = null;
    this.open();
    setInterval(() => this.ping(), PING_MS);
  }

  get connected() { return this.socket?.readyState === WebSocket.OPEN; }

  open() {
    const query = this.token ? `?token=${encodeURIComponent(this.token)}` : "";
    this.socket = new WebSocket(`ws://${location.host}/live${query}`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => { this.tries = 0; this.ping(); this.on.state(true); };
    this.socket.onmessage = (event) => this.take(new Uint8Array(event.data));
    this.socket.onclose = () => this.lost();
  }

  lost() {
    this.clock = new Clock();
    for (const { done } of this.waiting.values()) done({ ok: false, error: "the page's server has gone" });
    this.waiting.clear();
    this.on.state(false);
    setTimeout(() => this.open(), RETRY_MS[Math.min(this.tries++, RETRY_MS.length - 1)]);
  }

  ping() { this.say({ ping: performance.now() }); }

  say(what) { if (this.connected) this.socket.send(JSON.stringify(what)); }

  watch(skin, topics) {
    this.watched = { skin, want: topics };
    this.say(this.watched);
  }

  take(bytes) {
    const back = performance.now();
    const message = decode(bytes);
    if (message.kind === "pong") this.clock.add(message.ping, back, message.now);
    else if (message.kind === "hello") this.on.hello(message);
    else if (message.kind === "answer") this.answered(message);
    else if (message.kind === "frames") {
      this.say({ ack: 1 });
      const frames = [];
      for (const [measured, packed] of message.frames) {
        try {
          frames.push({ measured, ...frameOf(packed) });
        } catch {
          this.malformed++;
        }
      }
      this.on.frames(message.skin, frames);
    }
  }

  answered(message) {
    this.waiting.get(message.id)?.done(message);
    this.waiting.delete(message.id);
  }

  /** {ok, result} or {ok, error}: always one of them, at the latest after ANSWER_MS. */
  command(skin, command, args = {}) {
    if (!this.connected) return Promise.resolve({ ok: false, error: "not connected" });
    const id = ++this.id;
    this.say({ command, skin, args, id, token: this.token });
    return new Promise((done) => {
      this.waiting.set(id, { done });
      setTimeout(() => { if (this.waiting.delete(id)) done({ ok: false, error: "no answer" }); }, ANSWER_MS);
    });
  }
}
