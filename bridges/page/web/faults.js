// Buttons that let something go wrong with the stub, so that a visitor sees what the service does about it. What it did is
// said below them.

import { by, text } from "./panels.js";
import { plain } from "./trust.js";

const BUTTONS = [
  ["Unplug", "fault", { name: "unplug", seconds: 3 }, "The cable is out"],
  ["Dead electrode", "fault", { name: "electrode_open", args: { electrode: 5 }, seconds: 8 }, "The wire of electrode 5 is broken"],
  ["Swapped wires", "fault", { name: "electrodes_swapped", args: { electrodes: [2, 3] }, seconds: 8 }, "The wires of electrodes 2 and 3 are exchanged"],
  ["Noise", "fault", { name: "missed_interrupt", args: { fraction: 0.1 }, seconds: 5 }, "A tenth of the measurements is wrong"],
  ["Line noise", "fault", { name: "line_noise", seconds: 5 }, "Bits flip on the line to the board"],
  ["Gain step", "fault", { name: "gain", args: { factor: 1.02 }, seconds: 6 }, "An amplifier's gain has jumped by 2 %"],
  ["Frozen", "fault", { name: "frozen", seconds: 5 }, "The board sends the same scan again and again"],
  ["Drift", "scene", { name: "drift" }, "The sheet dries and electrodes age, over ten minutes; a press a minute"],
  ["All well again", "fault", { clear: true }, "Faults end; so does a scene"],
];
const AFTER_MS = 1500; // so long what follows a fault is still of it
const LEAST_MS = 50; // a tenth of a second, rounded
const OUTCOMES = ["replay", "coarse", "changing", "late"]; // of every touch, and of what is held up

export class Faults {
  /** command(name, args) -> answer. */
  constructor(command) {
    this.command = command;
    this.seen = null;
    by("faults").replaceChildren(...BUTTONS.map(([name, what, args, about]) => {
      const button = document.createElement("button");
      button.type = "button";
      button.textContent = name;
      button.title = `${about}${lasting(args)}.`;
      button.dataset.fault = args.name ?? "clear";
      button.addEventListener("click", () => this.begin(button, what, args, about));
      return button;
    }));
  }

  set enabled(value) { for (const button of by("faults").children) button.disabled = !value; }

  async begin(button, what, args, about) {
    const answer = await this.command(what, args);
    if (answer.ok && args.clear) await this.command("release", {});
    const begun = performance.now();
    this.end();
    if (!answer.ok) text("fault-said", answer.error);
    else if (!args.seconds) text("fault-said", `${about}.`);
    else {
      button.dataset.on = "";
      this.seen = { button, about, begun, until: begun + 1e3 * args.seconds, found: new Map(), lostMs: 0, lookedMs: begun };
    }
  }

  end() {
    if (this.seen) delete this.seen.button.dataset.on;
    this.seen = null;
  }

  /** What the service makes of it. frame: the newest contacts; bad: electrodes that are not well, in words; past: of
   * Remarks; stub: its status; texts: what the reasons mean. */
  look(nowMs, { verdict, frame, bad, past, stub, texts }) {
    const { seen } = this;
    if (!seen) return this.others(stub);
    const note = (what, means = "") => { if (!seen.found.has(what)) seen.found.set(what, { ms: nowMs - seen.begun, means }); };
    for (const each of bad) note(each);
    for (const name of reasonsOf(verdict, frame, past, nowMs - seen.begun)) {
      if (!OUTCOMES.includes(name) && !(bad.length && name.startsWith("electrode"))) note(plain(name), texts?.[name]);
    }
    if (verdict.title === "No board") note("no board");
    if (!verdict.ok) seen.lostMs += nowMs - seen.lookedMs;
    seen.lookedMs = nowMs;
    text("fault-said", this.told(nowMs));
    if (nowMs > seen.until + AFTER_MS && verdict.ok) this.end();
    return null;
  }

  told(nowMs) {
    const { about, until, found, lostMs } = this.seen, left = Math.ceil((until - nowMs) / 1e3);
    const named = [...found].map(([what, { ms, means }]) => `${what}, after ${(ms / 1e3).toFixed(1)} s${means ? ` (${means})` : ""}`).join("; ");
    const trust = lostMs > LEAST_MS ? `Contacts were not to be acted on for ${(lostMs / 1e3).toFixed(1)} s.` : "Contacts stayed valid.";
    const when = left > 0 ? `${about}, ${left} s more.` : `${about}: that is over.`;
    return `${when} The service found: ${named || (left > 0 ? "nothing yet" : "nothing")}. ${trust}`;
  }

  /** A fault that somebody else asked for, by the stub's word. */
  others(stub) {
    const going = stub?.level === "WARN" ? stub.messages.join("; ") : "";
    if (going) text("fault-said", `The stub: ${going}.`);
    else if (this.told_of) text("fault-said", "");
    this.told_of = going;
    return null;
  }
}

/** Of what is shown now, and of the last `sinceMs`: a frame that is too old says nothing of now. */
function reasonsOf(verdict, frame, past, sinceMs) {
  const now = verdict.ok || verdict.reasons.length ? frame?.reasons ?? [] : [];
  return [...now, ...past.filter(({ agoMs }) => agoMs <= sinceMs).map(({ name }) => name)];
}

function lasting({ seconds }) { return seconds ? `, for ${seconds} s` : ""; }
