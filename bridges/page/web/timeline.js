// The last minute: the force of each contact, when it began and ended, and when data were not to be trusted.

import { lineColour } from "./colours.js";

const SPAN_MS = 60000;
const GAP_MS = 1000;
const [LEFT, RIGHT, TOP, BOTTOM] = [34, 8, 16, 20];

export class Timeline {
  constructor(canvas) {
    this.canvas = canvas;
    this.courses = new Map();
    this.show("");
    this.drawn = 0;
  }

  /** Go on with the course of this skin; anew: it has none yet. What a recording shows is no part of a skin's. */
  show(name, anew = false) {
    // lines: id -> [ms, newton, newton] ...; doubts: [from, to]
    if (anew || !this.courses.has(name)) this.courses.set(name, { lines: new Map(), events: [], doubts: [] });
    this.course = this.courses.get(name);
    this.drawn = 0;
  }

  add(nowMs, contacts) {
    for (const c of contacts) {
      if (!this.course.lines.has(c.id)) {
        this.course.lines.set(c.id, []);
        this.event(nowMs, "▲", `contact ${c.id} began`);
      }
      this.course.lines.get(c.id).push([nowMs, c.force_n ?? 0, c.force_sigma_n ?? 0]);
    }
    for (const [id, points] of this.course.lines) {
      const over = !contacts.some((c) => c.id === id);
      if (over && !points.ended) {
        points.ended = true;
        this.event(nowMs, "▽", `contact ${id} ended`);
      }
      while (points.length && nowMs - points[0][0] > SPAN_MS) points.shift();
      if (!points.length) this.course.lines.delete(id);
    }
  }

  /** Another producer: its ids have nothing to do with those before. */
  anew() {
    for (const points of this.course.lines.values()) points.ended = true;
    this.course.lines = new Map([...this.course.lines].map(([id, points]) => [`${id}.${performance.now()}`, points]));
  }

  event(nowMs, sign, text) { this.course.events.push({ nowMs, sign, text }); }

  trust(nowMs, ok) {
    const last = this.course.doubts.at(-1);
    if (!ok && (!last || nowMs - last[1] > GAP_MS)) this.course.doubts.push([nowMs, nowMs]);
    else if (!ok) last[1] = nowMs;
  }

  draw(nowMs, everyMs) {
    if (nowMs - this.drawn < everyMs) return;
    this.drawn = nowMs;
    const { canvas } = this, ratio = Math.min(2, devicePixelRatio), { clientWidth: w, clientHeight: h } = canvas;
    if (!w || !h) return;
    const size = [Math.round(w * ratio), Math.round(h * ratio)];
    if (canvas.width !== size[0] || canvas.height !== size[1]) [canvas.width, canvas.height] = size;
    const c = canvas.getContext("2d"), style = getComputedStyle(canvas);
    const ink = style.color, faint = style.getPropertyValue("--faint"), doubt = style.getPropertyValue("--doubt");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, w, h);
    this.course.events = this.course.events.filter((e) => nowMs - e.nowMs < SPAN_MS);
    this.course.doubts = this.course.doubts.filter(([, to]) => nowMs - to < SPAN_MS);
    const most = Math.max(4, ...[...this.course.lines.values()].flat().map(([, n, s]) => n + s));
    const step = most > 8 ? 4 : 2, top = Math.ceil(most / step) * step;
    const x = (ms) => LEFT + (w - LEFT - RIGHT) * Math.max(0, 1 - (nowMs - ms) / SPAN_MS);
    const y = (n) => h - BOTTOM - (h - TOP - BOTTOM) * (n / top);
    c.fillStyle = doubt;
    for (const [from, to] of this.course.doubts) c.fillRect(x(from), TOP, Math.max(2, x(to) - x(from)), h - TOP - BOTTOM);
    c.font = "12px system-ui, sans-serif";
    c.textBaseline = "middle";
    c.textAlign = "right";
    for (let n = 0; n <= top; n += step) {
      c.fillStyle = faint;
      c.fillRect(LEFT, y(n), w - LEFT - RIGHT, 1);
      c.fillStyle = ink;
      c.fillText(n === top ? `${n} N` : `${n}`, LEFT - 5, y(n));
    }
    c.textAlign = "center";
    for (let s = 60; s >= 0; s -= w < 420 ? 20 : 10) {
      const at = x(nowMs - s * 1e3);
      c.textAlign = s === 0 ? "right" : s === 60 ? "left" : "center";
      c.fillText(s === 0 ? "now" : s === 60 ? "−60 s" : `−${s}`, s === 0 ? at + 4 : s === 60 ? at - 4 : at, h - 8);
    }
    for (const [id, points] of this.course.lines) {
      c.strokeStyle = lineColour(Number.parseInt(id, 10));
      c.fillStyle = c.strokeStyle;
      c.lineWidth = 1.6;
      c.beginPath();
      points.forEach(([t, n], k) => (k && t - points[k - 1][0] < GAP_MS ? c.lineTo(x(t), y(n)) : c.moveTo(x(t), y(n))));
      c.stroke();
    }
    c.fillStyle = ink;
    c.textAlign = "center";
    c.font = "9px system-ui, sans-serif";
    let before = -Infinity;
    for (const e of this.course.events) {
      if (x(e.nowMs) - before < 9) continue;
      before = x(e.nowMs);
      c.fillText(e.sign, before, 7);
    }
  }
}
