// A recording on the page: which, how fast, from where, again and again.

import { by, text } from "./panels.js";

export const REPLAY = "replay"; // what the replay is called among the skins
const END_S = 0.5;
const SILENT_MS = 400; // no frame for so long, at the end; at a lower speed longer
const ASK_MS = 400;
const OVER_MS = 3000; // so long the end is shown

export class Replays {
  /** command(name, args) -> answer; watch(name): show this skin, none: that of the list; said(text). */
  constructor(command, watch, said) {
    Object.assign(this, { command, watch, said, files: new Map(), playing: null, held: false });
    by("recordings").addEventListener("toggle", () => { if (by("recordings").open) this.list(); });
    by("play").addEventListener("click", () => (this.playing ? this.stop() : this.play(Number(by("scrub").value))));
    by("file").addEventListener("change", () => { this.length(); by("scrub").value = 0; this.tell(); if (this.playing) this.play(0); });
    by("speed").addEventListener("change", () => { if (this.playing) this.play(Number(by("scrub").value)); });
    by("scrub").addEventListener("input", () => { this.held = true; this.tell(); });
    by("scrub").addEventListener("change", () => { this.held = false; if (this.playing) this.play(Number(by("scrub").value)); });
  }

  async list() {
    const answer = await this.command("recordings", {});
    if (!answer.ok) return this.said(answer.error);
    const chosen = by("file").value;
    this.files = new Map(answer.result.files.map(({ name, seconds }) => [name, seconds === null ? null : Math.round(10 * seconds) / 10]));
    by("file").replaceChildren(...[...this.files.keys()].map((name) => new Option(name, name)));
    if (this.files.has(chosen)) by("file").value = chosen;
    this.length();
    if (!this.files.size) this.said("There is no recording yet: press Record, and again to end it.");
    return null;
  }

  get seconds() { return this.files.get(by("file").value) ?? null; }

  /** For the banner: {phase, name}. */
  get shown() {
    const { playing } = this;
    return playing && { name: playing.file, phase: playing.overMs !== null ? "over" : playing.first === null ? "begins" : "plays" };
  }

  length() {
    by("file").title = by("file").value;
    by("scrub").max = Math.max(1, this.seconds ?? 1);
    this.tell();
  }

  tell() {
    const of = this.seconds === null ? "" : ` of ${this.seconds.toFixed(1)}`;
    text("scrub-out", `${Number(by("scrub").value).toFixed(1)}${of} s`);
  }

  put(seconds) {
    const most = this.seconds ?? Infinity;
    if (seconds > Number(by("scrub").max)) by("scrub").max = Math.min(seconds, most);
    by("scrub").value = Math.min(seconds, most);
    this.tell();
  }

  async play(from) {
    const file = by("file").value;
    if (!file) return;
    const start = this.seconds !== null && from > this.seconds - END_S ? 0 : from;
    const playing = { file, from: start, first: null, heardMs: null, overMs: null, askedMs: Infinity, begun: false };
    this.playing = playing;
    this.put(start);
    by("play").textContent = "Stop";
    by("play").setAttribute("aria-pressed", "true");
    const answer = await this.command("replay", { file, speed: Number(by("speed").value), from: start, skin: by("skin").value });
    if (this.playing !== playing) return;
    if (answer.ok) {
      playing.begun = true;
      playing.askedMs = performance.now();
      this.watch(REPLAY);
    } else {
      this.said(answer.error);
      this.stop();
    }
  }

  stop() {
    const was = this.playing;
    this.playing = null;
    by("play").textContent = "Play";
    by("play").setAttribute("aria-pressed", "false");
    if (was) this.command("replay", {});
    this.watch();
  }

  /** A frame of the recording was measured at `sample` seconds of its own clock. */
  at(sample, nowMs) {
    const { playing } = this;
    if (!playing?.begun || playing.overMs !== null) return; // not begun: of the place before
    playing.first ??= sample;
    playing.heardMs = nowMs;
    if (!this.held) this.put(playing.from + sample - playing.first);
  }

  /** Notice the end. */
  look(nowMs) {
    const { playing } = this;
    if (!playing) return;
    if (playing.overMs !== null) {
      if (by("loop").checked) this.play(0);
      else if (nowMs - playing.overMs > OVER_MS) {
        this.said(`${playing.file} has been played to its end. The skin is shown again.`);
        this.stop();
      }
      return;
    }
    const last = this.seconds !== null && Number(by("scrub").value) > this.seconds - END_S;
    if (last && !this.held && playing.heardMs !== null && nowMs - playing.heardMs > SILENT_MS / Math.min(1, Number(by("speed").value))) this.over(playing, nowMs);
    else if (nowMs - playing.askedMs > ASK_MS) this.ask(playing, nowMs);
  }

  /** Whether it still runs: a file that was cut short says no length, and a process may fail. */
  async ask(playing, nowMs) {
    playing.askedMs = Infinity;
    const answer = await this.command("replaying", {});
    if (this.playing !== playing) return;
    playing.askedMs = nowMs + ASK_MS;
    if (!answer.ok || answer.result.playing) return;
    if (!answer.result.failed && playing.first !== null) this.over(playing, performance.now());
    else {
      this.said(`${playing.file} could not be replayed${playing.first === null ? "" : " to its end"}: the service's output says why.`);
      this.stop();
    }
  }

  over(playing, nowMs) {
    playing.overMs = nowMs;
    if (this.seconds !== null) this.put(this.seconds);
  }
}
