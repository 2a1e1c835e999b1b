// Whether what is shown may be trusted, and if not, why and what to do. Late, silent or invalid never looks fresh.

const SLOW_MS = 200; // from one picture to the next
const SLOW = "This browser draws too slowly for live data: give it more of the computer, or close other pages.";
const RESTART = "The service restarts by itself what has stopped: wait.";
const CHAIN = ["stub", "acquisition", "preprocessing", "inference", "publisher"];
const FOLLOWS = /: no (raw|delta|image|frames)\b/; // of a process that has nothing to work on
const MOST_SAID = 3;
const QUIET = {
  nobody: ["Nothing has come yet", "Wait, or start the service: make up."],
  replay: ["The replay begins", "Wait some seconds: it brings up stages of its own."],
  gone: ["The page's server does not answer", "The page looks for it again by itself. Is the service running?"],
};

/** {ok, title, reasons: [{name, text, advice}], notes: [...], ageMs} of the newest contact frame. */
export function judge({ connected, clock, contact, statuses, hello, replay, drawMs }) {
  if (!connected) return untrusted(...QUIET.gone);
  if (!contact || !clock.known) return untrusted(...(replay ? QUIET.replay : QUIET.nobody));
  const { frame, measured } = contact;
  const ageMs = measured === null ? Infinity : clock.now() - measured / 1e6;
  const explained = frame.reasons.map((name) => explain(name, hello));
  const limit = frame.valid_for_s * 1e3;
  if (!(ageMs >= -1000 && ageMs <= limit)) {
    const said = Number.isFinite(ageMs) ? `The newest contacts are ${(ageMs / 1e3).toFixed(1)} s old` : "Contacts without a time";
    return untrusted(said, complaints(statuses, clock, hello?.host) || (drawMs > SLOW_MS ? SLOW : RESTART), explained, ageMs);
  }
  if (!frame.valid) {
    return untrusted("Not to be acted on", complaints(statuses, clock, hello?.host), explained, ageMs);
  }
  return { ok: true, title: replay ? "Replay" : "Live", advice: "", reasons: [], notes: explained, ageMs };
}

function untrusted(title, advice, reasons = [], ageMs = null) {
  return { ok: false, title, advice, reasons, notes: [], ageMs };
}

function explain(name, hello) {
  return { name, text: hello?.reasons[name] ?? "", advice: hello?.advice[name] ?? "" };
}

/** What the processes say is the matter, the cause before what follows from it. */
export function complaints(statuses, clock, host) {
  const found = [];
  for (const { frame, heard } of [...statuses.values()].sort((a, b) => place(a) - place(b))) {
    const here = frame.host === host && clock.known;
    const quiet = (here ? clock.now() - frame.stamps.publish / 1e6 : performance.now() - heard) / 1e3;
    if (quiet > frame.valid_for_s) found.push(`${frame.process} has been silent for ${quiet.toFixed(0)} s.`);
    else if (frame.level !== "OK") found.push(...frame.messages.map((text) => `${frame.process}: ${text}.`));
  }
  const causes = found.filter((text) => !FOLLOWS.test(text));
  return (causes.length ? causes : found).slice(0, MOST_SAID).join(" ");
}

function place({ frame }) {
  const at = CHAIN.indexOf(frame.process);
  return at < 0 ? CHAIN.length : at;
}
