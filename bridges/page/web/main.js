// The page: what comes is put into a state, what is drawn is drawn from it, thirty times a second at most.

import { paint } from "./colours.js";
import { Faults } from "./faults.js";
import { Link } from "./link.js";
import { SkinMap } from "./map.js";
import * as panels from "./panels.js";
import { Press } from "./press.js";
import { Remarks } from "./remarks.js";
import { REPLAY, Replays } from "./replays.js";
import { Surface } from "./surface.js";
import { Timeline } from "./timeline.js";
import { judge } from "./trust.js";

const { by } = panels;
const TOPICS = ["contact", "image", "delta", "stack", "truth", "shape"];
const PICTURE_MS = 28; // thirty a second
const NO_PICTURES = { image: null, stack: null };
const TRUTH_MS = 500;
const WORDS_MS = 250;
const SUMMARY_MS = 2000;
const still = matchMedia("(prefers-reduced-motion: reduce)");

const token = keptToken();
const map = new SkinMap(by("map"));
const timeline = new Timeline(by("timeline"));
const state = { skin: "", hello: null, newest: {}, pictures: { ...NO_PICTURES }, statuses: new Map(), info: null, session: "", noise: 0 };
const recent = { scans: new panels.Recent(), latency: new panels.Recent(), shown: new panels.Recent(), draw: new panels.Recent() };
const surface = new Surface(by("surface"), noSurface);
const remarks = new Remarks();
let verdict = { ok: false }, undrawn = false;
const drawn = { ms: 0, words: 0, summary: 0 };

/** The token of the printed address; kept for this tab, and taken out of the address bar. */
function keptToken() {
  const given = location.hash.slice(1);
  if (given) {
    sessionStorage.setItem("token", given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem("token") ?? "";
}

const link = new Link({
  hello(message) {
    state.hello = message;
    const select = by("skin");
    select.replaceChildren(...message.skins.map((name) => new Option(name, name)));
    select.value = message.skins.includes(state.skin) ? state.skin : message.skins[0];
    by("record").hidden = by("snapshot").hidden = by("recordings").hidden = !message.buttons.includes("record");
    if (replays.playing) replays.stop();
    else watch();
  },
  frames(skin, frames) {
    if (skin !== state.skin) return;
    for (const each of frames) take(each);
    undrawn = true;
  },
  state() { look(); },
}, token);

/** Without a surface the map has its room, and says why. */
function noSurface(why) {
  by("surface-panel").hidden = why !== "";
  by("surface-why").hidden = !why;
  panels.text("surface-why", why);
}

function watch(name = by("skin").value) {
  Object.assign(state, { skin: name, newest: {}, pictures: { ...NO_PICTURES }, statuses: new Map(), info: null });
  for (const each of Object.values(recent)) each.clear();
  Object.assign(state, { session: "", noise: 0 });
  remarks.clear();
  timeline.show(name, name === REPLAY);
  map.image(null);
  undrawn = true;
  link.watch(state.skin, TOPICS);
}

function take({ topic, frame, measured }) {
  const now = performance.now();
  if (topic === "status") {
    state.statuses.set(frame.process, { frame, measured, heard: now });
    if (frame.process === "preprocessing") remarks.steps(now, frame.counters.gain_steps ?? 0);
  } else if (topic === "info") {
    know(frame.info);
  } else {
    state.newest[topic] = { frame, measured, heard: now };
    ({ contact, image, delta, stack, truth() {}, shape() {} })[topic]?.(frame, now);
  }
}

function know(info) {
  state.info = info;
  const shape = JSON.stringify([...info.geometry.outline, ...info.geometry.electrodes]);
  if (know.shape === shape) return;
  know.shape = shape;
  map.geometry(info.geometry);
  surface.geometry(map.points, info.geometry.electrodes);
}

function contact(frame, now) {
  if (frame.stamps.sample <= 0) return; // of no scan: the first trial of stages that begin
  if (frame.session !== state.session) {
    if (state.session) timeline.anew();
    state.session = frame.session;
  }
  recent.scans.add(now, frame.scan);
  if (state.skin === REPLAY) replays.at(frame.stamps.sample / 1e9, now);
  remarks.add(now, frame.reasons);
  const { sample, publish } = frame.stamps;
  if (frame.source !== "replay" && publish >= sample) recent.latency.add(now, (publish - sample) / 1e6);
  timeline.add(now, present(frame));
}

function present(frame) { return frame.contacts.filter((c) => c.state !== "end"); }

function image(frame) {
  if (frame.image.length) {
    state.pictures.image = frame;
    if (map.bounds) map.image(frame);
    undrawn = true;
  } else if (!frame.held) {
    state.pictures.image = null;
    map.image(null);
  }
}

function delta(frame) {
  if (!frame.touched || !state.noise) state.noise = panels.noiseOf(frame.sigma); // of one scan: a touch's may be of a mean
  if (!frame.touched) state.pictures.stack = null;
}

function stack(frame) { state.pictures.stack = frame; }

/** Judge what is there, and say so. Called often, whether anything comes or not: silence is news too. */
function look() {
  const before = verdict.ok;
  const now = performance.now(), replay = state.skin === REPLAY ? replays.shown : null, past = remarks.recent(now);
  verdict = judge({ connected: link.connected, clock: link.clock, contact: state.newest.contact, statuses: state.statuses, hello: state.hello, replay, recent: past, drawMs: recent.draw.median });
  panels.banner(verdict);
  panels.text("no-contacts", verdict.ok ? "Nothing touches." : "Whether something touches is not known now.");
  const bad = panels.trouble(state.newest.delta?.frame.electrodes ?? [], state.hello?.electrode_states ?? [], past);
  faults.look(now, { verdict, frame: state.newest.contact?.frame, bad, past, stub: state.statuses.get("stub")?.frame, texts: state.hello?.reasons });
  timeline.trust(now, verdict.ok || verdict.calm);
  if (before !== verdict.ok && !verdict.calm) timeline.event(now, verdict.ok ? "✓" : "✕", verdict.title);
  const source = state.newest.contact?.frame.source ?? "";
  const chip = by("source");
  chip.hidden = !source || source === "board";
  if (chip.textContent !== source) chip.textContent = source;
  press.on = source === "stub" && token !== "" && link.connected;
  const why = token === "" ? "To press, open the address that the service printed: it ends with a token."
    : source === "stub" ? "" : source === "replay" ? "This is a recording." : source ? `This skin is measured by a ${source}: press the real one.` : "";
  by("press-why").hidden = !why;
  by("press-why").textContent = why;
  by("tools").disabled = !press.enabled;
  faults.enabled = Boolean(token) && link.connected && state.statuses.has("stub");
  const replaying = state.skin === REPLAY; // whose statuses are those of its own stages
  by("play").disabled = !(token && link.connected);
  const recorder = panels.recorder(state.statuses, link.clock, state.hello?.host);
  for (const id of ["tare", "record"]) by(id).disabled = by("play").disabled || replaying;
  by("snapshot").disabled = by("record").disabled || !recorder.there;
  by("record").setAttribute("aria-pressed", `${recorder.recording}`);
  panels.text("record", recorder.recording ? "Stop recording" : "Record");
}

function draw(now) {
  requestAnimationFrame(draw);
  const elapsed = now - drawn.ms;
  if (elapsed < PICTURE_MS) return;
  if (drawn.ms) recent.draw.add(now, elapsed);
  drawn.ms = now;
  look();
  press.step();
  if (map.draw(elapsed, still.matches)) {
    surface.dent(map.shown, map.last, map.top);
    by("ramp-top").textContent = `${map.top.toFixed(2)} S/m`;
  }
  if (undrawn && map.bounds) {
    undrawn = false;
    news(now);
  }
  replays.look(now);
  timeline.draw(now, still.matches ? 500 : 66);
  if (now - drawn.words > WORDS_MS) words(now);
}

/** What a new frame changes. */
function news(now) {
  const { contact: found, shape, truth, delta: change, image: picture } = state.newest, list = found ? present(found.frame) : [];
  if (found) {
    const same = shape?.frame.session === found.frame.session && Math.abs(shape.frame.scan - found.frame.scan) <= 1;
    const outlines = new Map(same ? shape.frame.ids.map((id, k) => [id, shape.frame.outlines[k]]) : []);
    map.contacts(list, outlines, now);
    if (found.measured !== null && link.clock.known) recent.shown.add(now, link.clock.now() - found.measured / 1e6);
  }
  if (!found) map.contacts([], new Map(), now);
  surface.contacts(list);
  panels.contacts(list);
  map.truth(truth && now - truth.heard < TRUTH_MS ? truth.frame.touches : []);
  if (change) {
    map.electrodes(change.frame.electrodes, state.hello?.electrode_states ?? []);
    surface.electrodes(change.frame.electrodes);
  }
  const none = !picture ? "Nothing has come yet." : picture.frame.touched ? "No image of this touch yet." : "Nothing touches.";
  panels.compare({ made: state.pictures.stack, image: state.pictures.image, stack: state.info?.stack, none });
  panels.fade("one-step", state.pictures.stack !== null && change?.frame.held === true);
}

function words(now) {
  drawn.words = now;
  panels.numbers({
    rate: verdict.ok ? recent.scans.rate : null, latency: verdict.ok ? recent.latency.median : null,
    shown: verdict.ok ? recent.shown.median : null, noise: verdict.ok ? state.noise : 0,
  });
  panels.processes(state.statuses, link.clock, state.hello?.host);
  if (now - drawn.summary > SUMMARY_MS) {
    drawn.summary = now;
    const found = state.newest.contact?.frame;
    panels.summary(found ? present(found) : [], verdict.ok);
  }
}

const said = (what) => { by("said").textContent = what; };
const tools = { force: by("force"), radius: by("radius"), shape: by("shape") };
const press = new Press(map, tools, (name, args) => link.command(state.skin, name, args), said);
const faults = new Faults((name, args) => link.command(state.skin, name, args));
for (const [id, unit] of [["force", "N"], ["radius", "mm"]]) {
  tools[id].addEventListener("input", () => { by(`${id}-out`).textContent = `${tools[id].value} ${unit}`; });
}
by("skin").addEventListener("change", () => replays.stop());
const replays = new Replays((name, args) => link.command(by("skin").value, name, args), watch, said);
by("tare").addEventListener("click", async () => {
  const answer = await link.command(state.skin, "tare");
  said(answer.ok ? `New baseline from ${answer.result.frames} frames, ${answer.result.snr_db.toFixed(0)} dB.` : answer.error);
});
by("record").addEventListener("click", async () => {
  const on = by("record").getAttribute("aria-pressed") !== "true";
  const answer = await link.command(state.skin, "record", { on });
  said(!answer.ok ? answer.error : on ? "" : `Recorded ${answer.result.file}`);
});
by("snapshot").addEventListener("click", async () => {
  const answer = await link.command(state.skin, "snapshot");
  said(answer.ok ? `Snapshot: ${answer.result.file}` : answer.error);
});
by("picture").addEventListener("click", () => {
  const away = document.createElement("a");
  away.download = `eitskin-${state.skin}-scan-${state.newest.contact?.frame.scan ?? 0}.png`;
  away.href = by("heat").toDataURL("image/png");
  away.click();
});
paint(by("ramp"), Float32Array.from({ length: 256 }, (_, k) => k / 255), 1, 256, 1);
paint(by("heat"), new Float32Array(4), 2, 2, 1);
setInterval(() => { look(); press.step(); }, 100); // also where nothing is drawn, as in a tab at the back
requestAnimationFrame(draw);

export { link, map, state, surface, timeline }; // for tests, and for who looks with the browser's tools
