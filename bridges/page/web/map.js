// The flat map: the image of the conductivity drop, and over it the outline, axes, electrodes, contacts and the truth.
// Lengths of the overlay are millimetres, y downwards as SVG has it.

import { FULL_SCALE, lineColour, paint, SIGNS, stateColour } from "./colours.js";

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = 0.16; // of the skin's width, for axes and electrodes
const TRAIL_MS = 2000;
const EASE_MS = 30;
const PIXELS_A_CELL = 4; // the network's own grid is so much coarser: errors of neighbouring pixels are the same error

function make(name, attributes = {}, text = "") {
  const found = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) found.setAttribute(key, value);
  if (text) found.textContent = text;
  return found;
}

const mm = (metres) => (metres * 1e3).toFixed(2);
const path = (points) => points.map(([x, y]) => `${mm(x)},${mm(-y)}`).join(" ");

export class SkinMap {
  constructor(root) {
    this.root = root;
    this.heat = root.querySelector("canvas");
    this.svg = root.querySelector("svg");
    this.layers = {};
    for (const name of ["frame", "electrodes", "truth", "contacts", "pointers"]) {
      this.layers[name] = this.svg.appendChild(make("g", { class: name }));
    }
    this.trails = new Map();
    this.shown = null;
    this.target = null;
    this.top = FULL_SCALE;
  }

  /** outline, electrodes: typed arrays (n, 2) in metres. */
  geometry({ outline, electrodes }) {
    const xs = [], ys = [];
    for (let k = 0; k < outline.length; k += 2) { xs.push(outline[k]); ys.push(outline[k + 1]); }
    const [left, right, low, high] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
    const size = Math.max(right - left, high - low), pad = MARGIN * size;
    this.bounds = { left, right, low, high };
    this.view = { x: left - pad, y: -high - pad, width: right - left + 2 * pad, height: high - low + 2 * pad };
    this.svg.setAttribute("viewBox", ["x", "y", "width", "height"].map((k) => mm(this.view[k])).join(" "));
    this.root.style.aspectRatio = `${this.view.width} / ${this.view.height}`;
    this.points = xs.map((x, k) => [x, ys[k]]);
    this.unit = (size * 1e3) / 100; // text and dots keep their size on skins of any
    this.place({ left, low, width: right - left, height: high - low });
    this.axes();
    this.dots = [];
    this.layers.electrodes.replaceChildren();
    for (let k = 0; k < electrodes.length / 2; k++) {
      const [x, y] = [electrodes[2 * k], electrodes[2 * k + 1]];
      const dot = make("g", { transform: `translate(${mm(x)} ${mm(-y)})` });
      dot.append(make("circle", { r: 2.6 * this.unit }), make("text", { class: "sign" }), make("title"));
      const away = Math.hypot(x, y) || 1;
      dot.append(make("text", { class: "number", x: (x / away) * 5.4 * this.unit, y: (-y / away) * 5.4 * this.unit }, `${k}`));
      this.dots.push(this.layers.electrodes.appendChild(dot));
    }
    this.electrodes(new Uint8Array(this.dots.length), []);
    this.svg.style.setProperty("--unit", `${this.unit}px`);
  }

  axes() {
    const { left, right, low, high } = this.bounds, u = this.unit, layer = this.layers.frame;
    layer.replaceChildren(make("polygon", { class: "outline", points: path(this.points) }));
    const step = [1, 2, 5, 10, 20, 50, 100, 200].find((each) => (right - left) * 1e3 <= 5 * each) ?? 500;
    const mark = (x, y, text, anchor) => layer.append(make("text", { x, y, "text-anchor": anchor, class: "axis" }, text));
    for (let v = Math.ceil((left * 1e3) / step) * step; v <= right * 1e3 + 1e-6; v += step) {
      layer.append(make("line", { x1: v, x2: v, y1: mm(-low), y2: +mm(-low) + 1.5 * u, class: "tick" }));
      mark(v, +mm(-low) + 12.4 * u, `${v}`, "middle");
    }
    for (let v = Math.ceil((low * 1e3) / step) * step; v <= high * 1e3 + 1e-6; v += step) {
      layer.append(make("line", { x1: mm(left), x2: +mm(left) - 1.5 * u, y1: -v, y2: -v, class: "tick" }));
      mark(+mm(left) - 8.6 * u, -v + 1.3 * u, `${v}`, "end");
    }
    mark(+mm(right) + 14 * u, +mm(-low) + 12.4 * u, "x mm", "end");
    mark(+mm(left) - 14.5 * u, +mm(-high) - 8 * u, "y mm", "start");
  }

  /** Lay the heat map over this box, in metres, clipped to the skin. */
  place({ left, low, width, height }) {
    const { view } = this, style = this.heat.style, per = (v) => `${(100 * v).toFixed(4)}%`;
    [style.left, style.width] = [per((left - view.x) / view.width), per(width / view.width)];
    [style.top, style.height] = [per((-low - height - view.y) / view.height), per(height / view.height)];
    style.clipPath = `polygon(${this.points.map(([x, y]) => `${per((x - left) / width)} ${per(1 - (y - low) / height)}`)})`;
  }

  /** states: of each electrode; names: what the states are called. */
  electrodes(states, names) {
    this.dots.forEach((dot, k) => {
      const state = states[k] ?? 0;
      if (dot.dataset.state === `${state}`) return;
      dot.dataset.state = state;
      dot.style.setProperty("--colour", stateColour(state));
      dot.dataset.name = names[state] ?? "ok";
      dot.children[1].textContent = SIGNS[state] ?? "?";
      dot.children[2].textContent = `electrode ${k}: ${names[state] ?? "ok"}`;
    });
  }

  /** frame: an image frame with its picture, or null where nothing is touched. */
  image(frame) {
    if (frame === null) {
      this.target?.fill(0);
      return;
    }
    const [rows, columns] = frame.image.shape, side = frame.metres_per_pixel;
    if (this.target?.length !== rows * columns) this.shown = new Float32Array(rows * columns);
    this.target = Float32Array.from(frame.image, (v) => (Number.isFinite(v) ? v : 0));
    this.rows = rows;
    this.columns = columns;
    this.last = frame;
    const box = `${frame.origin} ${side} ${rows} ${columns}`;
    if (this.box !== box && this.bounds) {
      this.place({ left: frame.origin[0], low: frame.origin[1], width: columns * side, height: rows * side });
      this.box = box;
    }
  }

  /** Draw towards the newest image; whether anything changed. Between two images the picture flows, the numbers do not. */
  draw(elapsedMs, still) {
    if (!this.target) return false;
    const share = still ? 1 : 1 - Math.exp(-elapsedMs / EASE_MS);
    let moved = 0, most = 0;
    for (let k = 0; k < this.target.length; k++) {
      const step = this.target[k] - this.shown[k];
      this.shown[k] += share * step;
      if (Math.abs(step) > moved) moved = Math.abs(step);
      if (this.shown[k] > most) most = this.shown[k];
    }
    if (moved < 1e-4) return false;
    this.top = Math.max(FULL_SCALE, most);
    paint(this.heat, this.shown, this.rows, this.columns, this.top);
    return true;
  }

  truth(touches) {
    this.layers.truth.replaceChildren(...touches.map((t) => {
      const group = make("g", { "data-x": mm(t.x), "data-y": mm(t.y), "data-force": t.force_n ?? "" });
      group.append(t.outline?.length ? make("polygon", { points: path(t.outline) })
        : make("circle", { cx: mm(t.x), cy: mm(-t.y), r: mm(t.radius_m) }));
      return group;
    }));
  }

  /** contacts: those that are there; outlines: by id. */
  contacts(contacts, outlines, nowMs) {
    const groups = contacts.map((c) => {
      const [x, y] = c.position, u = this.unit, colour = lineColour(c.id);
      const trail = [...(this.trails.get(c.id) ?? []), [nowMs, x, y]].filter(([t]) => nowMs - t < TRAIL_MS);
      this.trails.set(c.id, trail);
      const group = make("g", { class: "contact", "data-id": c.id, "data-x": mm(x), "data-y": mm(y), "data-force": c.force_n ?? "" });
      group.style.setProperty("--colour", colour);
      const edge = outlines.get(c.id);
      if (edge?.length) group.append(make("polygon", { class: "edge", points: path(edge) }));
      group.append(make("polyline", { class: "trail", points: path(trail.map(([, a, b]) => [a, b])) }));
      const sure = this.ellipse(c);
      if (sure) group.append(sure);
      group.append(make("circle", { class: "place", cx: mm(x), cy: mm(-y), r: 0.8 * u }));
      const left = x > this.bounds.left + 0.75 * (this.bounds.right - this.bounds.left);
      const force = c.force_n === null ? "" : ` ${c.force_n.toFixed(1)} N`;
      group.append(make("text", { class: "label", x: +mm(x) + (left ? -5 : 5) * u, y: +mm(-y) - 5 * u, "text-anchor": left ? "end" : "start" }, `${c.id}${force}`));
      return group;
    });
    const present = new Set(contacts.map((c) => c.id));
    for (const id of this.trails.keys()) if (!present.has(id)) this.trails.delete(id);
    this.layers.contacts.replaceChildren(...groups);
  }

  /** Two standard deviations of the centroid, from the image's own uncertainty within the patch. */
  ellipse(c) {
    const frame = this.last;
    if (!frame?.sigma.length || frame.sigma.length !== frame.image.length) return null;
    const side = frame.metres_per_pixel, [x0, y0] = frame.origin, reach = Math.max(2 * side, Math.sqrt(c.area_m2 / Math.PI));
    let total = 0, xx = 0, xy = 0, yy = 0;
    for (let row = 0; row < this.rows; row++) {
      const dy = y0 + (row + 0.5) * side - c.position[1];
      if (Math.abs(dy) > reach) continue;
      for (let column = 0; column < this.columns; column++) {
        const dx = x0 + (column + 0.5) * side - c.position[0], k = row * this.columns + column;
        if (dx * dx + dy * dy > reach * reach) continue;
        const variance = frame.sigma[k] ** 2;
        total += Math.max(0, frame.image[k]);
        xx += variance * dx * dx;
        xy += variance * dx * dy;
        yy += variance * dy * dy;
      }
    }
    if (!(total > 0)) return null;
    const scale = (PIXELS_A_CELL / total) ** 2, half = Math.hypot((xx - yy) / 2, xy), mean = (xx + yy) / 2;
    const [long, short] = [mean + half, Math.max(0, mean - half)].map((v) => 2 * Math.sqrt(v * scale));
    const angle = (-Math.atan2(2 * xy, xx - yy) / 2) * (180 / Math.PI);
    const place = `translate(${mm(c.position[0])} ${mm(-c.position[1])}) rotate(${angle.toFixed(1)})`;
    return make("ellipse", { class: "sure", rx: mm(long), ry: mm(short), transform: place });
  }

  /** Metres on the skin of a place on the screen. */
  metres(clientX, clientY) {
    const point = new DOMPoint(clientX, clientY).matrixTransform(this.svg.getScreenCTM().inverse());
    return [point.x / 1e3, -point.y / 1e3];
  }

  /** Where the page presses, or would: {x, y, radius, down}. */
  pointers(places) {
    this.layers.pointers.replaceChildren(...places.map(({ x, y, radius, down }) =>
      make("circle", { class: down ? "down" : "aim", cx: mm(x), cy: mm(-y), r: mm(radius) })));
  }
}
