"""The page's own scripts that need no browser, run by node: its reader of messages, and what its banner says."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import needs
from tests.needs import ROOT

pytestmark = pytest.mark.live

VECTORS = sorted((ROOT / "protocol" / "vectors" / "frames").glob("*.bin"))
READ = """
import { readFileSync } from "node:fs";
import { frameOf } from "./msgpack.js";
import { judge } from "./trust.js";
const asked = JSON.parse(readFileSync(0));
const plain = v => ArrayBuffer.isView(v) && v.shape ? { shape: v.shape, values: Array.from(v, Number) }
  : Array.isArray(v) ? v.map(plain) : !v || typeof v !== "object" ? v
  : Object.fromEntries(Object.entries(v).map(([k, x]) => [k, plain(x)]));
const bytes = hex => Uint8Array.from(hex.match(/../g) ?? [], h => parseInt(h, 16));
const read = hex => { const { frame, ...of } = frameOf(bytes(hex)); return { ...of, fields: plain(frame) }; };
const refuses = hex => { try { frameOf(bytes(hex)); return ""; } catch (why) { return why.name; } };
const verdict = ([ageS, reasons, acquisition]) => {
  const status = (process, level, messages) =>
    [process, { frame: { process, level, messages, host: "x", valid_for_s: 3 }, heard: performance.now() }];
  const statuses = new Map(acquisition ? [status("publisher", "STALE", ["no image/palm for 1 s"]),
    status("acquisition", "ERROR", [acquisition])] : []);
  const frame = { reasons, valid: false, valid_for_s: 0.25 };
  return judge({ connected: true, clock: { known: true, now: () => 9000 }, statuses, recent: [], drawMs: 30,
    contact: { frame, measured: (9000 - 1e3 * ageS) * 1e6 }, hello: { host: "y", reasons: {}, advice: {} } });
};
const sayable = (k, v) => typeof v === "number" && !Number.isFinite(v) ? String(v) : v;
console.log(JSON.stringify(asked.of.map({ read, refuses, verdict }[asked.what]), sayable));
"""


def ask(folder: Path, what: str, of: list[Any]) -> Any:
    needs.NODE.here()
    for script in (ROOT / "bridges" / "page" / "web").glob("*.js"):
        shutil.copy(script, folder)
    (folder / "package.json").write_text('{"type": "module"}')
    (folder / "read.js").write_text(READ)
    asked = json.dumps({"what": what, "of": of})
    done = subprocess.run(["node", "read.js"], cwd=folder, input=asked, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_it_reads_the_wire_as_the_vectors_say_and_refuses_what_is_no_message(tmp_path: Path) -> None:
    assert len(VECTORS) >= 9
    for file, got in zip(VECTORS, ask(tmp_path, "read", [file.read_bytes().hex() for file in VECTORS]), strict=True):
        expected = json.loads(file.with_suffix(".json").read_text())
        assert (got["topic"], got["skin"]) == (expected["topic"], expected["skin"])
        same(got["fields"], expected["fields"], file.stem)
    head = b"contact/palm\0"
    endless = [b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", 100 * b"\x91"]
    bad = [b"", head, head + b"\xc1", head + b"\x81\xa1\xff\x01", *(head + more for more in endless)]
    assert all(ask(tmp_path, "refuses", [each.hex() for each in bad]))


def same(got: Any, expected: Any, where: str) -> None:
    if isinstance(expected, dict) and "dtype" in expected:
        assert got["shape"] == expected["shape"], where
        got, expected = (np.array(each["values"], object).ravel().astype(float) for each in (got, expected))
        np.testing.assert_allclose(got, expected, rtol=1e-6, err_msg=where)
    elif isinstance(expected, (dict, list)):
        for key in expected if isinstance(expected, dict) else range(max(len(expected), len(got))):
            same(got[key], expected[key], f"{where}.{key}")
    else:
        number = isinstance(expected, (int, float)) and not isinstance(expected, bool)
        assert got == (pytest.approx(expected, rel=1e-6) if number else expected), where


CABLE = "/dev/ttyACM0 is not there: plug the board in, or correct `port` in skin.toml"
VERDICTS = [  # age [s], reasons, what acquisition says, the banner's title and what it says
    (2.0, ["changing"], CABLE, "No board", f"acquisition: {CABLE}."),
    (2.0, ["changing"], "", "The newest contacts are 2.0 s old", ""),
    (0.0, ["changing", "electrode_open"], "", "Electrode open: not to be acted on", ""),
]


def test_the_banner_names_the_cause_before_what_follows_from_it(tmp_path: Path) -> None:
    verdicts = ask(tmp_path, "verdict", [row[:3] for row in VERDICTS])
    for (age_s, reasons, _, title, said), verdict in zip(VERDICTS, verdicts, strict=True):
        assert (verdict["ok"], verdict["title"], verdict["said"]) == (False, title, said)
        named = [reason["name"] for reason in verdict["reasons"]]
        assert named == ([] if age_s else reasons[::-1])  # those of an old frame are no cause
