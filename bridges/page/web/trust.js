// Whether what is shown may be trusted, and if not, why and what to do: the cause first, then what follows from it. Late,
// silent or invalid never looks fresh.

const SLOW_MS = 200; // from one picture to the next
const SLOW = "This browser draws too slowly for live data: give it more of the computer, or close other pages.";
const RESTART = "The service restarts by itself what has stopped: wait.";
const CHAIN = ["stub", "acquisition", "preprocessing", "inference", "publisher"];
const FOLLOWS = /: no (raw|delta|image|frames)\b/; // of a process that has nothing to work on
const NO_BOARD = /cable is out|waiting for the stub board|is not there|is gone|no board at|nobody listens/; // what the stub and acquisition say then
const WAITS = /: waiting for the stub board/; // which is no news where the stub itself says why
const ON_REQUEST = /: on request, /;
const OUTCOMES = new Set(["changing", "coarse", "late", "gap", "degraded", "extrapolated", "out_of_distribution", "low_snr", "uncalibrated_force", "replay", "separate"]);
const MOST_SAID = 3;
const QUIET = {
  nobody: ["Nothing has come yet", "Wait, or start the service: make up."],
  gone: ["The page's server does not answer", "The page looks for it again by itself. Is the service running?"],
};
const STANDS = { title: "The replay stands still", advice: "It waits for its next frame, or the recording is over.", calm: true };
const REPLAYED = "This is a recording: it shows what was, not what is.";

/** {ok, calm, title, reasons: [{name, text, advice}], said, advice} of the newest contact frame. calm: nothing is wrong,
 * though there is nothing to act on. replay: {phase: begins, plays or over; name} where a recording is shown. */
export function judge({ connected, clock, contact, statuses, hello, replay, recent, drawMs }) {
  if (!connected) return untrusted(...QUIET.gone);
  if (replay?.phase === "begins") return { ...untrusted("The replay begins", "Wait some seconds: it brings up stages of its own."), calm: true };
  if (replay?.phase === "over") return { ...untrusted("The recording is over", "This was its last frame. The page goes back to the skin by itself."), calm: true };
  if (!contact || !clock.known) return untrusted(...QUIET.nobody);
  const { frame, measured } = contact;
  const ageMs = measured === null ? Infinity : clock.now() - measured / 1e6;
  const limit = frame.valid_for_s * 1e3;
  if (!(ageMs >= -1000 && ageMs <= limit)) {
    return { ...silent(ageMs, complaints(statuses, clock, hello?.host), drawMs), ...(replay ? STANDS : {}) };
  }
  const names = frame.reasons.filter((name) => !(replay && name === "replay"));
  const explained = names.map((name) => explain(name, hello)).sort((a, b) => OUTCOMES.has(a.name) - OUTCOMES.has(b.name));
  if (!frame.valid) {
    const cause = explained[0] ? `${capital(plain(explained[0].name))}: not to be acted on` : "Not to be acted on";
    return { ...untrusted(cause, complaints(statuses, clock, hello?.host).join(" ")), reasons: explained };
  }
  const past = recent.filter(({ name }) => !names.includes(name)).map(({ name, agoMs }) => // its advice is for one that goes on
    ({ name: `${name} ${(agoMs / 1e3).toFixed(0)} s ago`, text: hello?.reasons[name] ?? "", advice: "" }));
  return { ok: true, calm: false, title: replay ? "Replay" : "Live", said: replay?.name ?? "", advice: replay ? REPLAYED : "", reasons: [...explained, ...past] };
}

/** No frame comes, or none in time: what the last one said of itself is old, too, and no cause. */
function silent(ageMs, found, drawMs) {
  const age = Number.isFinite(ageMs) ? `The newest contacts are ${(ageMs / 1e3).toFixed(1)} s old` : "Contacts without a time";
  if (!found.length) return untrusted(age, drawMs > SLOW_MS ? SLOW : RESTART);
  const gone = found.some((text) => NO_BOARD.test(text)), played = found.some((text) => ON_REQUEST.test(text));
  const todo = played ? "It ends by itself; All well again ends it now." : gone ? "The service goes on by itself once the board is there." : "";
  return { ...untrusted(gone ? "No board" : age, `${todo} ${gone ? `${age}.` : ""}`.trim()), said: found.join(" ") };
}

function untrusted(title, advice) { return { ok: false, calm: false, title, said: "", advice, reasons: [] }; }

function explain(name, hello) {
  return { name, text: hello?.reasons[name] ?? "", advice: hello?.advice[name] ?? "" };
}

export const plain = (name) => name.replaceAll("_", " ");
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

/** What the processes say is the matter, the cause before what follows from it. */
function complaints(statuses, clock, host) {
  const found = [];
  for (const { frame, heard } of [...statuses.values()].sort((a, b) => place(a) - place(b))) {
    const here = frame.host === host && clock.known;
    const quiet = (here ? clock.now() - frame.stamps.publish / 1e6 : performance.now() - heard) / 1e3;
    if (quiet > frame.valid_for_s) found.push(`${frame.process} has been silent for ${quiet.toFixed(0)} s.`);
    else if (frame.level !== "OK") found.push(...frame.messages.map((text) => `${frame.process}: ${text}.`));
  }
  const why = found.some((text) => ON_REQUEST.test(text)) ? found.filter((text) => !WAITS.test(text)) : found;
  const causes = why.filter((text) => !FOLLOWS.test(text));
  return (causes.length ? causes : why).slice(0, MOST_SAID);
}

function place({ frame }) {
  const at = CHAIN.indexOf(frame.process);
  return at < 0 ? CHAIN.length : at;
}
