// The skin as a surface that dents where it is pressed, with its electrodes, and the contacts' forces as arrows. Drawn by
// WebGL 2, when something has changed and it is seen.

import { colour, lineColour, SIGNS, stateColour } from "./colours.js";
import { camera, drawing, picture, Program } from "./gl.js";
import { cone, pin, rod, sheet, square } from "./meshes.js";
import { relief, shadow } from "./relief.js";
import { SHADOW, SHEET, SOLID } from "./shaders.js";
import { Tags } from "./tags.js";

// Lengths are half-widths of the skin.
const CELL = 1 / 32;
const DEPTH = 0.27; // the dent of the drop that has the brightest colour
const THICK = 0.3;
const PIN = 0.042, PIN_BAD = 0.06;
const NUMBER = 0.11; // an electrode's number, from its pin inwards
const ARROW = 0.15, ARROW_A_NEWTON = 0.09;
const HEAD = [0.055, 0.15], SHAFT = 0.018; // radius and length, radius
const GROUND = 1.45; // half of what the shadow falls on
const LENS = Math.tan(0.26), ROUND = 1.62; // how much of the skin's surroundings is seen
const BARE = [92, 101, 120]; // the skin's colour where nothing presses
const START = { turn: -0.5, tilt: 0.85 }, LEAST_TILT = 0.2, MOST_TILT = 1.5;
const TURN = 0.08, TURN_A_PIXEL = 0.01;
const SLOW = /swiftshader|llvmpipe|software/i, SLOW_EVERY_MS = 150; // drawn by the processor, which has other work

const NONE = "The surface needs WebGL 2, which this browser does not have here: the map shows the same.";
const REFUSED = "This browser's WebGL 2 refuses what draws the surface (its console says why): the map shows the same.";
const LOST = "The browser took the surface's graphics away; it comes back when the browser gives them again. The map shows the same.";

const bytes = (css) => [1, 3, 5].map((at) => parseInt(css.slice(at, at + 2), 16));
const light = (rgb) => rgb.map((v) => v / 255);
const RAMP = Uint8Array.from({ length: 4 * 256 }, (_, at) => {
  const value = (at >> 2) / 255, share = Math.min(1, value / 0.2);
  return at % 4 === 3 ? 255 : BARE[at % 4] + share * (colour(0.15 + 0.85 * value)[at % 4] - BARE[at % 4]);
});

/** Columns of a matrix that turns z to `normal`, stretched to this radius and length. */
function axes(normal, radius, length) {
  const [x, y, z] = normal, side = Math.abs(z) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const cross = ([a, b, c], [d, e, f]) => [b * f - c * e, c * d - a * f, a * e - b * d];
  const first = cross(side, normal), long = Math.hypot(...first), unit = first.map((v) => v / long);
  return [...unit.map((v) => radius * v), ...cross([x, y, z], unit).map((v) => radius * v), ...[x, y, z].map((v) => length * v)];
}

export class Surface {
  /** said(text): called with why there is no surface, and with "" once there is one. */
  constructor(root, said) {
    Object.assign(this, { root, said, ...START, scene: null, seen: true, asked: 0, drawn: 0 });
    Object.assign(this, { outline: null, image: null, pins: [], states: [], arrows: [] });
    this.canvas = root.appendChild(document.createElement("canvas"));
    this.tags = new Tags(root);
    this.gl = this.canvas.getContext("webgl2", { alpha: true, antialias: true });
    if (!this.gl) {
      said(NONE);
      return;
    }
    const named = this.gl.getExtension("WEBGL_debug_renderer_info");
    this.slow = SLOW.test(named ? this.gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : "");
    this.canvas.addEventListener("webglcontextlost", (event) => {
      event.preventDefault();
      this.scene = null;
      said(LOST);
    });
    this.canvas.addEventListener("webglcontextrestored", () => this.begin());
    this.begin();
    this.hands();
    new ResizeObserver(() => this.ask()).observe(root);
    addEventListener("resize", () => this.ask()); // also another screen's pixels
    new IntersectionObserver(([{ isIntersecting }]) => {
      this.seen = isIntersecting;
      this.ask();
    }).observe(root);
  }

  /** All that the graphics processor keeps. */
  begin() {
    const { gl } = this;
    this.scene = {
      sheet: new Program(gl, ...SHEET, { field: 0, ramp: 1 }), solid: new Program(gl, ...SOLID), shadow: new Program(gl, ...SHADOW, { shade: 2 }),
      pin: drawing(gl, pin()), cone: drawing(gl, cone()), rod: drawing(gl, rod()), ground: drawing(gl, square()),
      field: picture(gl, 0), shade: picture(gl, 2), face: null, dented: false,
    };
    picture(gl, 1)(RAMP, 256, 1);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.said("");
    this.ask();
  }

  /** points: the outline [(x, y)]; electrodes: their places, x and y in turn; all in metres. */
  geometry(points, electrodes) {
    this.half = Math.max(...points.flat().map(Math.abs));
    this.outline = points.map((p) => p.map((v) => v / this.half));
    this.pins = Array.from({ length: electrodes.length / 2 }, (_, k) => [electrodes[2 * k] / this.half, electrodes[2 * k + 1] / this.half]);
    Object.assign(this, { states: [], image: null, arrows: [] });
    if (this.scene) Object.assign(this.scene, { face: null, dented: false });
    this.ask();
  }

  /** states: of each electrode, as the service numbers them. */
  electrodes(states) {
    if (states.length === this.states.length && this.states.every((state, k) => state === states[k])) return;
    this.states = Array.from(states);
    this.ask();
  }

  /** values: the conductivity drop in the pixels of this image frame, `top` being the brightest colour. */
  dent(values, frame, top) {
    this.image = { values, top, rows: frame.image.shape[0], columns: frame.image.shape[1], origin: frame.origin, side: frame.metres_per_pixel };
    if (this.scene) this.scene.dented = false;
    this.ask();
  }

  /** An arrow along each contact's normal, as long as its force. */
  contacts(contacts) {
    if (!contacts.length && !this.arrows.length) return;
    this.arrows = !this.half ? [] : contacts.map((c) => ({
      at: [c.position[0] / this.half, c.position[1] / this.half], normal: c.normal.map((v) => v / (Math.hypot(...c.normal) || 1)),
      long: ARROW + ARROW_A_NEWTON * (c.force_n ?? 1), colour: lineColour(c.id),
      text: `${c.id}${c.force_n === null ? "" : ` ${c.force_n.toFixed(1)} N`}`,
    }));
    this.ask();
  }

  /** The electrodes' numbers, with what is the matter, and the contacts' forces. */
  words() {
    const numbers = this.pins.map(([x, y], k) => {
      const state = this.states[k] ?? 0, away = Math.hypot(x, y) || 1, share = 1 - NUMBER / away;
      return state ? { kind: "fault", text: `${k} ${SIGNS[state] ?? "?"}`, colour: stateColour(state), place: [x, y, 0.16] }
        : { kind: "number", text: `${k}`, colour: "", place: [share * x, share * y, 0] };
    });
    const forces = this.arrows.map(({ at, normal, long, text, colour: each }) => ({
      kind: "force", text, colour: each, place: normal.map((v, k) => (at[k] ?? 0) + (long + HEAD[1]) * v),
    }));
    return [...numbers, ...forces];
  }

  hands() {
    const { root } = this;
    let held = null;
    root.addEventListener("pointerdown", (event) => {
      if (held) return;
      held = { id: event.pointerId, x: event.clientX, y: event.clientY };
      root.setPointerCapture(event.pointerId);
    });
    root.addEventListener("pointermove", (event) => {
      if (held?.id !== event.pointerId) return;
      this.look(TURN_A_PIXEL * (event.clientX - held.x), TURN_A_PIXEL * (event.clientY - held.y));
      Object.assign(held, { x: event.clientX, y: event.clientY });
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      root.addEventListener(end, (event) => { if (held?.id === event.pointerId) held = null; });
    }
    root.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, -TURN], ArrowDown: [0, TURN] }[event.key];
      if (!way && event.key !== "Home") return;
      event.preventDefault();
      if (!way) Object.assign(this, START);
      this.look(...(way ?? [0, 0]));
    });
  }

  look(turn, tilt) {
    this.turn -= turn;
    this.tilt = Math.min(MOST_TILT, Math.max(LEAST_TILT, this.tilt + tilt));
    this.ask();
  }

  /** Have it drawn with the display's next picture; nothing is drawn where it is not seen. */
  ask() {
    if (this.asked || !this.scene || !this.seen || !this.outline) return;
    this.asked = requestAnimationFrame((now) => {
      this.asked = 0;
      if (this.slow && now - this.drawn < SLOW_EVERY_MS) this.ask();
      else this.draw(now);
    });
  }

  /** Whether the shaders are compiled; asks again where they are not yet. */
  compiled() {
    const { sheet: face, solid, shadow: ground } = this.scene;
    try {
      const ready = [face, solid, ground].every((each) => each.ready);
      if (!ready) this.ask();
      return ready;
    } catch (why) {
      console.warn(why.message);
      this.scene = null;
      this.said(REFUSED);
      return false;
    }
  }

  draw(now) {
    const { scene, gl } = this;
    if (!scene || gl.isContextLost() || !this.fit() || !this.compiled()) return;
    this.drawn = now;
    if (!scene.face) this.build();
    if (!scene.dented) this.bend();
    this.view = this.camera();
    const { matrix, eye, right } = this.view;
    const sun = [0, 1, 2].map((k) => [-0.2, -0.2, 0.75][k] - 0.6 * right[k]), bright = Math.hypot(...sun);
    const all = { matrix, eye, sun: sun.map((v) => v / bright), depth: DEPTH, thick: THICK, box: this.box, wide: GROUND };
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    scene.shadow.use(all);
    scene.ground();
    scene.sheet.use({ ...all, mesh: 0.01 / this.half });
    scene.face();
    scene.solid.use(all);
    this.pins.forEach((place, k) => this.pin(place, this.states[k] ?? 0));
    for (const arrow of this.arrows) this.arrow(arrow);
    this.tags.draw(this.words(), (place) => this.project(place)); // not sooner: an arrow may have become another contact's
  }

  /** What the skin's geometry decides. */
  build() {
    this.scene.face = drawing(this.gl, sheet(this.outline, CELL));
    const { pixels, side } = shadow(this.outline, GROUND);
    this.scene.shade(pixels, side, side);
  }

  /** Whether there is room; the canvas has as many pixels as the screen there. */
  fit() {
    const { clientWidth: width, clientHeight: height } = this.root, ratio = this.slow ? 1 : Math.min(2, devicePixelRatio);
    const [across, down] = [width, height].map((v) => Math.round(ratio * v));
    if (!across || !down) return false;
    if (this.canvas.width !== across || this.canvas.height !== down) Object.assign(this.canvas, { width: across, height: down });
    this.gl.viewport(0, 0, across, down);
    return true;
  }

  /** What the newest image decides. */
  bend() {
    const { image, half, scene } = this;
    if (image) {
      const { values, top, rows, columns, origin, side } = image;
      this.field = relief(values, rows, columns, top, side / half);
      this.box = [origin[0] / half, origin[1] / half, half / (columns * side), half / (rows * side)];
      scene.field(this.field, columns, rows);
    } else {
      this.field = new Float32Array(4);
      this.box = [-1, -1, 0.5, 0.5];
      scene.field(this.field, 1, 1);
    }
    scene.dented = true;
  }

  /** The face's height there. */
  height([x, y]) {
    const [rows, columns] = this.image ? [this.image.rows, this.image.columns] : [1, 1], [left, low, wide, high] = this.box;
    const pixel = (v, count) => Math.min(count - 1, Math.max(0, Math.floor(v * count)));
    return -DEPTH * this.field[4 * (pixel((y - low) * high, rows) * columns + pixel((x - left) * wide, columns))];
  }

  camera() {
    const aspect = this.canvas.width / this.canvas.height, { turn, tilt } = this;
    const away = (ROUND / LENS) * Math.max(1 / aspect, Math.sin(tilt) + 0.1);
    return camera({ turn, tilt, away, aspect, lens: LENS, middle: [0, 0, -THICK / 2] });
  }

  /** Where a place (x, y, z) is in the panel, in CSS pixels. */
  project(place) {
    const { matrix: m } = this.view, along = (row) => m[row] * place[0] + m[4 + row] * place[1] + m[8 + row] * place[2] + m[12 + row];
    const w = along(3), { clientWidth: width, clientHeight: height } = this.root;
    return [(0.5 + along(0) / w / 2) * width, (0.5 - along(1) / w / 2) * height];
  }

  pin(place, state) {
    const radius = state ? PIN_BAD : PIN;
    this.solid("pin", [...place, 0.01], axes([0, 0, 1], radius, state ? 0.09 : PIN), stateColour(state));
  }

  /** Its tip where the skin is pressed. */
  arrow({ at, normal, long, colour: each }) {
    const tip = [...at, this.height(at) + 0.02], base = tip.map((v, k) => v + HEAD[1] * normal[k]);
    this.solid("cone", tip, axes(normal, ...HEAD), each);
    this.solid("rod", base, axes(normal, SHAFT, long), each);
  }

  solid(mesh, origin, turned, css) {
    this.scene.solid.use({ origin, axes: turned, colour: light(bytes(css)) });
    this.scene[mesh]();
  }
}
