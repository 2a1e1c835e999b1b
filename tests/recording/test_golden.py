"""What recordings gave when somebody accepted it, and still give: `make golden` accepts what they give now."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from protocol.frames import RawFrame, unpack
from services.pipeline import Pipeline
from services.recordings import golden
from services.recordings.recording import RecordingError, RecordingReader
from services.recordings.replay import steps
from services.runtime.stage import STAGES
from tests.cli.conftest import Ran, skin  # noqa: F401

HERE = Path(__file__).with_name("golden")
MOST_BYTES = 2_000_000
Skin = Callable[..., Ran]


@pytest.mark.parametrize("name", ["contacts", "faults", "adaptive", "rolling"])
def test_recordings_give_the_contacts_that_were_accepted(name: str) -> None:
    file = HERE / f"{name}.mcap"
    found = golden.compare(golden.accepted(file), golden.run(file))
    told = "\n".join([*map(str, found.differences[:20]), "", *found.summary()])
    assert not found.differences, f"{found.differing} of {found.frames} frames differ; `make golden` accepts:\n{told}"


def test_the_recordings_are_small_and_hold_what_they_are_for() -> None:
    assert sum(path.stat().st_size for path in HERE.iterdir()) < MOST_BYTES
    lines = {name: golden.accepted(HERE / f"{name}.mcap") for name in ("contacts", "faults")}
    contacts = {c["id"] for line in lines["contacts"] for c in line["contacts"]}
    assert len(contacts) >= 5 and max(len(line["contacts"]) for line in lines["contacts"]) == 2
    reasons = {reason for line in lines["faults"] for reason in line["reasons"]}
    assert {"electrode_open", "gap", "saturated"} <= reasons


def test_an_old_recording_with_an_adaptive_scan_still_gives_the_contacts_of_its_whole_scans() -> None:
    file = HERE / "adaptive.mcap"
    kinds = {}
    for message in RecordingReader(file).messages({"raw"}):
        raw = unpack(message.wire)
        assert isinstance(raw, RawFrame)
        kinds[raw.scan] = raw.kind
    assert set(kinds.values()) == {"full", "sentinel"}
    lines = {line["scan"]: line for line in golden.accepted(file)}
    assert lines.keys() == kinds.keys()
    short = [lines[scan] for scan, kind in kinds.items() if kind == "sentinel"]
    assert all(not line["valid"] and line["reasons"] == ["coarse"] and not line["contacts"] for line in short)
    touched = [line for line in lines.values() if line["valid"] and any(c["state"] == "hold" for c in line["contacts"])]
    assert len(touched) > 15
    for line in touched[4:-1]:
        (contact,) = line["contacts"]
        assert abs(contact["x_mm"] - 20) < 1 and abs(contact["y_mm"] + 10) < 1


def changed(**fields: object) -> list[dict[str, object]]:
    contact = {"id": 7, "state": "hold", "x_mm": 20.0, "force_n": 3.0, "shape": "circle", "confidence": 1.0}
    contact |= {name: value for name, value in fields.items() if name in contact}
    line = {"skin": "palm", "scan": 118, "at_s": 5.31, "valid": True, "reasons": [], "contacts": [contact]}
    return [line | {name: value for name, value in fields.items() if name in line}]


def test_a_difference_says_which_frame_which_field_and_by_how_much() -> None:
    (found,) = golden.compare(changed(), changed(force_n=3.5)).differences
    said = "scan 118 at 5.31 s, palm: contact 7 force_n: accepted 3.0, found 3.5 (by 0.5, tolerance 0.08)"
    assert str(found) == said
    assert golden.compare(changed(), changed(force_n=3.5)).summary() == [
        "contact force_n: 1 frames, the first is scan 118, at most by 0.5 (tolerance 0.08, scan 118)"
    ]


@pytest.mark.parametrize(
    ("fields", "differs"),
    [
        ({"force_n": 3.07}, []),
        ({"force_n": 3.09}, ["contact 7 force_n"]),
        ({"force_n": None}, ["contact 7 force_n"]),
        ({"force_n": float("nan")}, ["contact 7 force_n"]),
        ({"x_mm": 20.09}, []),
        ({"x_mm": 19.85}, ["contact 7 x_mm"]),
        ({"shape": "square"}, ["contact 7 shape"]),
        ({"valid": False, "reasons": ["gap"]}, ["valid", "reasons"]),
        (
            {"contacts": []},
            ["contacts", *(f"contact 7 {k}" for k in ("state", "x_mm", "force_n", "shape", "confidence"))],
        ),
    ],
)
def test_numbers_have_tolerances_all_else_must_be_the_same(fields: dict[str, object], differs: list[str]) -> None:
    found = golden.compare(changed(), changed(**fields))
    assert [d.name for d in found.differences] == differs


def test_frames_that_are_there_or_not_are_differences() -> None:
    assert [str(d.found) for d in golden.compare(changed(), []).differences] == ["not there"]
    assert [str(d.found) for d in golden.compare([], changed()).differences] == ["there"]


def test_what_was_accepted_is_not_taken_for_granted(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="--accept"):
        golden.accepted(tmp_path / "a.mcap")
    for bad in ("rubbish", "[1]", '{"skin": "palm"}', "[" * 100_000):
        (tmp_path / "a.golden").write_text(bad)
        with pytest.raises(RecordingError, match="accept them anew"):
            golden.accepted(tmp_path / "a.mcap")


def test_by_command(skin: Skin, tmp_path: Path) -> None:  # noqa: F811
    file = tmp_path / "faults.mcap"
    shutil.copy(HERE / "faults.mcap", file)
    assert "accept what faults.mcap gives now" in (ran := skin("golden", file)).err and ran.code == 2
    assert skin("golden", file, "--accept").code == 0
    accepted = file.with_suffix(".golden")
    lines = [json.loads(line) for line in accepted.read_text().splitlines()]
    touched = next(line for line in lines if line["contacts"])
    touched["contacts"][0]["force_n"] += 1.0
    accepted.write_text("".join(json.dumps(line) + "\n" for line in lines))
    ran = skin("golden", file)
    assert ran.code == 1 and "1 differ from faults.golden" in ran.out and f"scan {touched['scan']}" in ran.out
    assert skin("golden", file, "--accept").code == 0 and skin("golden", file).code == 0


@pytest.mark.parametrize("name", ["contacts", "faults"])
def test_it_begins_with_the_state_that_the_service_had(name: str) -> None:
    step = next(step for step in steps(RecordingReader(HERE / f"{name}.mcap")) if step.raw is None)
    pipeline = Pipeline("square16", step.skin)
    golden._load(pipeline, step.states, STAGES)
    assert pipeline.pre.state()["last_sample_ns"] > 0  # 0: the state was not taken over
