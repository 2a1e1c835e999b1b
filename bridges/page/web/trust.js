// Whether what is shown may be trusted, and if not, why and what to do. Late, silent or invalid never looks fresh.

const QUIET = {
  nobody: ["Nothing has come yet", "Wait, or start the service: make up."],
  replay: ["The replay begins", "Wait some seconds: it brings up stages of its own."],
  gone: ["The page's server does not answer", "The page looks for it again by itself. Is the service running?"],
};

/** {ok, title, reasons: [{name, text, advice}], notes: [...], ageMs} of the newest contact frame. */
export function judge({ connected, clock, contact, statuses, hello, replay }) {
  if (!connected) return untrusted(...QUIET.gone);
  if (!contact || !clock.known) return untrusted(...(replay ? QUIET.replay : QUIET.nobody));
  const { frame, measured } = contact;
  const ageMs = measured === null ? Infinity : clock.now() - measured / 1e6;
  const explained = frame.reasons.map((name) => explain(name, hello));
  const limit = frame.valid_for_s * 1e3;
  if (!(ageMs >= -1000 && ageMs <= limit)) {
    const said = Number.isFinite(ageMs) ? `The newest contacts are ${(ageMs / 1e3).toFixed(1)} s old` : "Contacts without a time";
    return untrusted(said, complaints(statuses, clock, hello?.host) || "The service restarts by itself what has stopped: wait.", explained, ageMs);
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

/** What the processes say is the matter. */
export function complaints(statuses, clock, host) {
  const found = [];
  for (const { frame, heard } of statuses.values()) {
    const here = frame.host === host && clock.known;
    const quiet = (here ? clock.now() - frame.stamps.publish / 1e6 : performance.now() - heard) / 1e3;
    if (quiet > frame.valid_for_s) found.push(`${frame.process} has been silent for ${quiet.toFixed(0)} s.`);
    else if (frame.level !== "OK") found.push(...frame.messages.map((text) => `${frame.process}: ${text}.`));
  }
  return found.join(" ");
}
