// A recording on the page: which, how fast, from where, again and again.

import { by } from "./panels.js";

const SILENT_MS = 3000;
const END_S = 0.5;

export class Replays {
  /** command(name, args) -> answer; watch(name): show this skin, none: that of the list; said(text). */
  constructor(command, watch, said) {
    Object.assign(this, { command, watch, said, files: new Map(), playing: null, held: false });
    by("recordings").addEventListener("toggle", () => { if (by("recordings").open) this.list(); });
    by("play").addEventListener("click", () => (this.playing ? this.stop() : this.play(Number(by("scrub").value))));
    by("file").addEventListener("change", () => { this.length(); by("scrub").value = 0; if (this.playing) this.play(0); });
    by("speed").addEventListener("change", () => { if (this.playing) this.play(Number(by("scrub").value)); });
    by("scrub").addEventListener("input", () => { this.held = true; this.tell(); });
    by("scrub").addEventListener("change", () => { this.held = false; if (this.playing) this.play(Number(by("scrub").value)); });
  }

  async list() {
    const answer = await this.command("recordings", {});
    if (!answer.ok) return this.said(answer.error);
    const chosen = by("file").value;
    this.files = new Map(answer.result.files.map((file) => [file.name, file]));
    by("file").replaceChildren(...[...this.files.keys()].map((name) => new Option(name, name)));
    if (this.files.has(chosen)) by("file").value = chosen;
    this.length();
    if (!this.files.size) this.said("There is no recording yet: press Record, and again to end it.");
    return null;
  }

  get seconds() { return this.files.get(by("file").value)?.seconds ?? null; }

  length() {
    by("scrub").max = Math.max(1, this.seconds ?? 1);
    this.tell();
  }

  tell() {
    const of = this.seconds === null ? "" : ` of ${this.seconds.toFixed(1)}`;
    by("scrub-out").textContent = `${Number(by("scrub").value).toFixed(1)}${of} s`;
  }

  async play(from) {
    const file = by("file").value;
    if (!file) return;
    const start = this.seconds !== null && from > this.seconds - END_S ? 0 : from;
    this.playing = { from: start, first: null, heard: null };
    by("play").textContent = "Stop";
    by("play").setAttribute("aria-pressed", "true");
    const answer = await this.command("replay", { file, speed: Number(by("speed").value), from: start, skin: by("skin").value });
    if (answer.ok) this.watch("replay");
    else {
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
    if (!playing) return;
    playing.first ??= sample;
    playing.heard = nowMs;
    if (this.held) return;
    const place = playing.from + sample - playing.first;
    if (place > Number(by("scrub").max)) by("scrub").max = place;
    by("scrub").value = place;
    this.tell();
  }

  /** Notice the end. */
  look(nowMs) {
    if (!this.playing?.heard || nowMs - this.playing.heard < SILENT_MS) return;
    if (by("loop").checked) this.play(0);
    else this.stop();
  }
}
