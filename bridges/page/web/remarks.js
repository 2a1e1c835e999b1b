// What frames said a moment ago: a reason that one frame alone gives is gone before a person has read it.

const BRIEF = ["gain", "clock", "fifo", "frozen"]; // of the board, which may last one scan
const SHOWN_MS = 5000;

export class Remarks {
  constructor() { this.clear(); }

  /** Another skin. */
  clear() { Object.assign(this, { seen: new Map(), counted: null }); }

  /** Of a contact frame. */
  add(nowMs, reasons) { for (const name of reasons) if (BRIEF.includes(name)) this.seen.set(name, nowMs); }

  /** How many gain steps preprocessing has followed: the frame that said so may have been replaced by a newer one. */
  steps(nowMs, count) {
    if (this.counted !== null && count > this.counted && nowMs - (this.seen.get("gain") ?? -Infinity) > SHOWN_MS) this.seen.set("gain", nowMs);
    this.counted = count;
  }

  /** [{name, agoMs}] of the last seconds. */
  recent(nowMs) {
    return [...this.seen].map(([name, at]) => ({ name, agoMs: nowMs - at })).filter(({ agoMs }) => agoMs < SHOWN_MS);
  }
}
