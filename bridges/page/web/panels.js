// What is told in words and bars: the banner, the contacts, the processes, the numbers, the two small images.

import { lineColour, paint } from "./colours.js";
import { plain } from "./trust.js";

const MOST_N = 10;
const WINDOW_MS = 3000;
const SIGN = { OK: "✓", WARN: "!", ERROR: "✕", STALE: "…" };

export const by = (id) => document.getElementById(id);

export function text(id, value) {
  const element = by(id);
  if (element.textContent !== value) element.textContent = value;
}

function element(name, className, content = "") {
  const found = document.createElement(name);
  if (className) found.className = className;
  if (content) found.textContent = content;
  return found;
}

/** Whether data may be trusted, and why not; everything that shows data greys with body's data-trust. */
export function banner(verdict) {
  const { dataset } = document.body, { reasons } = verdict, trust = verdict.ok ? "yes" : "no", tone = verdict.calm ? "calm" : "";
  if (dataset.trust !== trust) dataset.trust = trust;
  if (dataset.tone !== tone) dataset.tone = tone;
  text("trust-title", verdict.title + (verdict.ok && reasons.length ? ", with a remark" : ""));
  text("trust-reasons", [verdict.said, ...reasons.map((r) => `${plain(r.name)}: ${r.text}`)].filter(Boolean).join("; "));
  text("trust-advice", [...reasons.map((r) => r.advice), verdict.advice].filter(Boolean).join(" "));
}

/** The newest values within a window, and their median. */
export class Recent {
  constructor() { this.clear(); }

  clear() { this.values = []; }

  add(nowMs, value) {
    this.values.push([nowMs, value]);
    while (nowMs - this.values[0][0] > WINDOW_MS) this.values.shift();
  }

  get median() {
    const sorted = this.values.map(([, v]) => v).sort((a, b) => a - b);
    return sorted.length ? sorted[sorted.length >> 1] : null;
  }

  /** Of counts that go up: how much in a second. */
  get rate() {
    if (this.values.length < 2) return null;
    const [[t0, n0]] = this.values, [t1, n1] = this.values.at(-1);
    return t1 > t0 && n1 >= n0 ? (1e3 * (n1 - n0)) / (t1 - t0) : null;
  }
}

export function numbers({ rate, latency, shown, noise }) {
  const with_ = (value, digits, unit) => (value === null ? "–" : `${value.toFixed(digits)} ${unit}`);
  text("rate", with_(rate, 1, "/s"));
  text("latency", with_(latency, 0, "ms"));
  text("shown", with_(shown, 0, "ms"));
  text("noise", noise > 0 ? `${(-20 * Math.log10(noise)).toFixed(0)} dB` : "–");
}

/** rms of the uncertainties of the measurements in use. */
export function noiseOf(sigma) {
  let sum = 0, n = 0;
  for (const s of sigma) if (Number.isFinite(s)) { sum += s * s; n++; }
  return n ? Math.sqrt(sum / n) : 0;
}

export function contacts(list) {
  by("no-contacts").hidden = list.length > 0;
  const parent = by("contacts");
  while (parent.children.length > list.length) parent.lastChild.remove();
  while (parent.children.length < list.length) parent.append(row());
  list.forEach((c, k) => fill(parent.children[k], c));
}

function row() {
  const item = element("li");
  const bar = element("div", "bar");
  bar.append(element("div", "fill"), element("div", "sigma"));
  item.append(element("strong"), element("span", "newton"), bar, element("span", "where"));
  return item;
}

function fill(item, c) {
  const [name, newton, bar, where] = item.children, force = c.force_n;
  item.style.setProperty("--colour", lineColour(c.id));
  item.dataset.id = c.id;
  const per = (v) => `${(100 * Math.min(1, Math.max(0, v / MOST_N))).toFixed(2)}%`;
  name.textContent = `${c.id}`;
  newton.textContent = force === null ? "no force law" : `${force.toFixed(2)} N${c.force_sigma_n === null ? "" : ` ± ${c.force_sigma_n.toFixed(2)}`}`;
  bar.children[0].style.width = per(force ?? 0);
  const sigma = c.force_sigma_n ?? 0;
  bar.children[1].style.left = per((force ?? 0) - sigma);
  bar.children[1].style.width = per(Math.min(2 * sigma, MOST_N));
  const [x, y] = c.position.map((v) => (v * 1e3).toFixed(1)), sure = c.shape_probability;
  const shape = c.shape === "unknown" ? "shape unknown" : `${c.shape}${sure === null ? "" : ` ${Math.round(100 * sure)} %`}`;
  const hard = c.pressure_pa ?? null, unsure = c.pressure_sigma_pa ?? null;
  const pressure = hard === null ? "" : ` · ${(hard / 1e3).toFixed(1)}${unsure === null ? "" : ` ± ${(unsure / 1e3).toFixed(1)}`} kPa`;
  where.textContent = `at ${x}, ${y} mm · ${(c.area_m2 * 1e4).toFixed(1)} cm²${pressure} · ${shape}`;
}

/** For a screen reader, in a sentence. */
export function summary(list, ok) {
  if (!ok) return text("summary", "The data are not to be trusted just now.");
  const each = list.map((c) => `${c.force_n === null ? "a contact" : `${c.force_n.toFixed(0)} newtons`} at ${(c.position[0] * 1e3).toFixed(0)}, ${(c.position[1] * 1e3).toFixed(0)} millimetres`);
  text("summary", list.length ? `${list.length} ${list.length > 1 ? "contacts" : "contact"}: ${each.join("; ")}.` : "Nothing touches.");
}

/** Seconds since a process last said how it does. */
function quietOf({ frame, heard }, clock, host) {
  const here = frame.host === host && clock.known;
  return (here ? clock.now() - frame.stamps.publish / 1e6 : performance.now() - heard) / 1e3;
}

export function processes(statuses, clock, host) {
  const rows = [...statuses.values()].sort((a, b) => (a.frame.process < b.frame.process ? -1 : 1)).map(({ frame, heard }) => {
    const quiet = quietOf({ frame, heard }, clock, host);
    const level = quiet > frame.valid_for_s ? "STALE" : frame.level;
    const item = element("li", `level-${level}`);
    const says = level === "STALE" && quiet > frame.valid_for_s ? `silent for ${quiet.toFixed(0)} s` : frame.messages.join("; ");
    item.append(element("span", "sign", SIGN[level]), element("strong", "", frame.process),
      element("span", "cpu", `${(100 * frame.cpu).toFixed(0)} %`), element("span", "says", says));
    item.title = `${frame.process}: ${level}${says ? `: ${says}` : ""}`;
    return item;
  });
  by("processes").replaceChildren(...rows);
}

/** What the recorder does, by its own word: {there, recording}. One that is silent does nothing that could be shown. */
export function recorder(statuses, clock, host) {
  const found = statuses.get("recorder"), line = by("recorder");
  const silent = !found || quietOf(found, clock, host) > found.frame.valid_for_s;
  const said = found?.frame.counters ?? {}, there = !silent, recording = there && said.recording > 0;
  line.hidden = !found;
  line.dataset.level = !found ? "" : silent ? "STALE" : found.frame.level;
  const [doing, ...problems] = found?.frame.messages ?? [];
  const file = doing?.match(/^recording to .*?([^/]+\.mcap)/)?.[1];
  text("recorder", !found ? "" : silent ? "The recorder is silent: nothing is recorded." : [
    recording ? `Recording to ${file ?? "a file"}` : "Not recording",
    said.writing ? "a snapshot is being written" : `the last ${said.held_s ?? 0} s are kept for a snapshot`,
    ...problems].join("; ") + ".");
  return { there, recording };
}

/** The same frame by two methods: {made, image} that brought the pictures, or null where there is none; none: why. */
export function compare({ made, image, stack, none }) {
  if (side("one-step", made && stack ? "" : none)) {
    const [, rows, columns] = made.stack.shape, size = rows * columns;
    const plane = made.stack.subarray(size * stack.one_step, size * (stack.one_step + 1));
    paint(by("one-step"), plane, rows, columns, Math.max(1e-6, ...plane));
    text("one-step-note", `λ = ${Math.sqrt(stack.lambda_squared[stack.one_step]).toPrecision(2)}, scan ${made.scan}`);
  }
  if (side("network", image ? "" : none)) {
    const [rows, columns] = image.image.shape;
    let top = 1e-6;
    for (const v of image.image) if (v > top) top = v;
    paint(by("network"), image.image, rows, columns, top);
    text("network-note", `scan ${image.reconstructed || image.scan}`);
  }
}

/** Whether this side has a picture; where it has none, nothing of an earlier one stays. */
function side(id, none) {
  text(`${id}-none`, none);
  if (!none) return true;
  const canvas = by(id);
  canvas.getContext("2d").clearRect(0, 0, canvas.width, canvas.height);
  text(`${id}-note`, "");
  return false;
}

/** The picture is of an earlier frame than what is shown beside it. */
export function fade(id, old) { by(id).closest("figure").classList.toggle("old", old); }

/** What is the matter with the skin itself, over the surface: electrodes that are not well, and what the board did. */
export function trouble(states, names, recent) {
  const bad = [...states].map((state, k) => (state ? `electrode ${k}: ${names[state] ?? "unknown"}` : "")).filter(Boolean);
  const past = recent.filter(({ name }) => name === "gain").map(({ agoMs }) => `gain step, ${(agoMs / 1e3).toFixed(0)} s ago`);
  text("trouble", [...bad, ...past].join(" · "));
  by("surface-panel").toggleAttribute("data-trouble", bad.length + past.length > 0);
  return bad;
}
