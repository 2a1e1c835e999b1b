// Pressing the stub's skin: by mouse, by several fingers, by keys. A press is told again while it lasts, so that a page
// that vanishes lets go within KEEP_S.

const KEEP_S = 2.5;
const AGAIN_MS = 400;
const FIRST_N = 1.5; // a press begins with so much, and grows while it is held
const GROW_N_PER_S = 4;
const STEP_N = 0.5;
const MOVE_M = 0.002, MOVE_FINE_M = 0.0005;

class Finger {
  constructor(name, x, y, force) {
    Object.assign(this, { name, x, y, force, began: performance.now(), sent: null, sentMs: 0, busy: false, up: false });
  }

  get now() {
    const grown = FIRST_N + (GROW_N_PER_S * (performance.now() - this.began)) / 1e3;
    return Math.min(this.force, Math.max(STEP_N, Math.floor(grown / STEP_N) * STEP_N));
  }
}

export class Press {
  /** command(name, args) -> answer; failed(text); tools: {force, radius, shape} elements. */
  constructor(map, tools, command, failed) {
    Object.assign(this, { map, tools, command, failed });
    this.fingers = new Map();
    this.aim = { x: 0, y: 0, shown: false };
    this.enabled = false;
    this.hands();
    this.keys();
  }

  get radius() { return Number(this.tools.radius.value) / 1e3; }

  set on(value) {
    if (this.enabled && !value) this.letGo();
    this.enabled = value;
  }

  down(name, x, y) {
    this.fingers.set(name, new Finger(name, x, y, Number(this.tools.force.value)));
    this.step();
  }

  up(name) {
    const finger = this.fingers.get(name);
    if (!finger) return;
    finger.up = true;
    this.step();
  }

  letGo() { for (const name of this.fingers.keys()) this.up(name); }

  /** Tell the board what has changed; one command of a finger at a time, the newest. Called with every picture. */
  step() {
    for (const finger of this.fingers.values()) {
      if (finger.busy) continue;
      if (finger.up) {
        this.fingers.delete(finger.name);
        if (finger.sent) this.send(finger, "release", { finger: finger.name });
        continue;
      }
      const args = { x: round(finger.x), y: round(finger.y), force: finger.now, radius: this.radius, shape: this.tools.shape.value };
      const said = JSON.stringify(args);
      if (said !== finger.sent || performance.now() - finger.sentMs > AGAIN_MS) {
        finger.sent = said;
        finger.sentMs = performance.now();
        this.send(finger, "press", { ...args, finger: finger.name, seconds: KEEP_S });
      }
    }
    const aimed = this.aim.shown && this.enabled && !this.fingers.has("key");
    this.map.pointers([...this.fingers.values()].map(({ x, y }) => ({ x, y, radius: this.radius, down: true }))
      .concat(aimed ? [{ ...this.aim, radius: this.radius, down: false }] : []));
  }

  async send(finger, command, args) {
    finger.busy = true;
    const answer = await this.command(command, args);
    finger.busy = false;
    if (!answer.ok) {
      this.failed(answer.error);
      this.fingers.delete(finger.name);
    }
    if (this.fingers.has(finger.name)) this.step();
  }

  inside([x, y]) {
    const { left, right, low, high } = this.map.bounds ?? {};
    return x >= left && x <= right && y >= low && y <= high;
  }

  hands() {
    const { root } = this.map;
    root.addEventListener("pointerdown", (event) => {
      const place = this.map.metres(event.clientX, event.clientY);
      if (!this.enabled || event.button !== 0 || !this.inside(place)) return;
      event.preventDefault();
      root.focus({ preventScroll: true, focusVisible: false });
      try {
        root.setPointerCapture(event.pointerId);
      } catch { /* it has gone up already */ }
      this.aim.shown = false;
      this.down(`p${event.pointerId}`, ...place);
    });
    root.addEventListener("pointermove", (event) => {
      const finger = this.fingers.get(`p${event.pointerId}`), place = this.map.metres(event.clientX, event.clientY);
      if (finger && this.inside(place)) [finger.x, finger.y] = place;
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      root.addEventListener(end, (event) => this.up(`p${event.pointerId}`));
    }
    root.addEventListener("wheel", (event) => {
      if (!this.enabled) return;
      event.preventDefault();
      this.harder(event.deltaY < 0 ? STEP_N : -STEP_N);
    }, { passive: false });
    root.addEventListener("contextmenu", (event) => { if (this.fingers.size) event.preventDefault(); });
  }

  keys() {
    const { root } = this.map;
    root.addEventListener("keydown", (event) => {
      if (!this.enabled || !this.key(event)) return;
      event.preventDefault();
      this.step();
    });
    root.addEventListener("keyup", (event) => { if (event.key === " ") this.up("key"); });
    root.addEventListener("blur", () => this.up("key"));
    root.addEventListener("focus", () => { this.aim.shown = root.matches(":focus-visible"); });
  }

  /** Whether a key means something here. */
  key(event) {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (way) {
      const far = event.shiftKey ? MOVE_FINE_M : MOVE_M;
      const place = [this.aim.x + far * way[0], this.aim.y + far * way[1]];
      if (this.inside(place)) [this.aim.x, this.aim.y] = place;
      this.aim.shown = true;
      const finger = this.fingers.get("key");
      if (finger) [finger.x, finger.y] = [this.aim.x, this.aim.y];
    } else if (event.key === " ") {
      if (!event.repeat && !this.fingers.has("key")) this.down("key", this.aim.x, this.aim.y);
    } else if (event.key === "Enter") {
      if (this.fingers.has("key")) this.up("key");
      else this.down("key", this.aim.x, this.aim.y);
    } else if (event.key === "+" || event.key === "-") {
      this.harder(event.key === "+" ? STEP_N : -STEP_N);
    } else if (event.key === "Escape") {
      this.letGo();
    } else {
      return false;
    }
    return true;
  }

  harder(by) {
    const slider = this.tools.force;
    slider.value = Number(slider.value) + by;
    slider.dispatchEvent(new Event("input"));
    for (const finger of this.fingers.values()) finger.force = Number(slider.value);
  }
}

/** To a tenth of a millimetre: a pose that is solved once. */
function round(metres) { return Math.round(metres * 1e4) / 1e4; }
