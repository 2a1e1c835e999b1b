"""`skin doctor` with the service down, and what it makes of electrode orders and ports."""

from __future__ import annotations

import contextlib
import itertools
import os
import pty
import re
import threading
import tty
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from models.bundle import Bundle
from protocol import link
from protocol.advice import ADVICE
from protocol.control import ControlServer
from protocol.frames import ContactFrame, DeltaFrame, Frame, JudgementsFrame
from protocol.runtime import CONFIG_LINK, lock
from protocol.sockets import Publisher
from services.cli.doctor import _key, electrode_order
from services.estimation.first.baseline import TAKING
from services.estimation.values.judgement import judge
from services.judged import judged


@pytest.fixture(scope="module")
def bundle() -> Bundle:
    return Bundle.load("square16")


def test_the_service_being_down_is_no_failure(skin) -> None:  # type: ignore[no-untyped-def]
    ran = skin("doctor")
    assert ran.code == 0 and "no service runs" in ran.out and "every sha256 right" in ran.out


def test_what_the_bundle_cannot_tell_is_said(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    assert "checks all of them" in " ".join(skin("doctor").out.split())
    file = tmp_path / "disc.toml"
    file.write_text('[skins.palm]\nport = "stub"\nbundle = "disc16"\n')
    assert "not checked with the bundle disc16: shorts" in " ".join(skin("doctor", "--config", file).out.split())


@pytest.mark.parametrize(
    ("key", "said", "is_on", "is_off"),
    [
        (
            'indenter = { kind = "any" }',
            "refine",
            "touches are refined by a fit",
            "refinement off: bundle disc16 is measured",
        ),
        (
            "touch = { symmetry = true }",
            "symmetry",
            "OK palm: symmetry a held touch's image becomes the mean",
            "WARN palm: symmetry symmetry off: the mean is of a network's images",
        ),
    ],
)
def test_why_an_option_is_off_is_said(skin, tmp_path, key: str, said: str, is_on: str, is_off: str) -> None:  # type: ignore[no-untyped-def]
    for bundle, says in (("square16", is_on), ("disc16", is_off)):
        file = tmp_path / f"{bundle}.toml"
        file.write_text(f'[skins.palm]\nport = "stub"\nbundle = "{bundle}"\n{key}\n')
        assert says in " ".join(skin("doctor", "--config", file).out.split())
    assert said not in skin("doctor").out


def test_an_indenter_larger_than_the_skin_stops_doctor_and_service(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    file = configured(tmp_path, "stub", "indenter = { radius_m = 0.5 }\n")
    ran = skin("doctor", "--config", file)
    says = "skins.palm.indenter.radius_m: found 0.5 m; expected 0.00052 to 0.05 m with bundle square16"
    assert ran.code == 1 and says in " ".join(ran.out.split())
    ran = skin("up", "--config", file)
    assert ran.code == 2 and says in " ".join((ran.out + ran.err).split())
    ran = skin("doctor", "--config", configured(tmp_path, "stub", "indenter = { radius_m = 0.001 }\n"))
    assert "WARN palm: indenter refinement off: `radius_m` is 0.001 m" in " ".join(ran.out.split())


@contextlib.contextmanager
def service(runtime: Path, config: Path, frames: Iterable[Frame], others: Iterable[Frame] = ()) -> Iterator[None]:
    """What `skin up` holds of a runtime folder; its publisher sends these frames again and again, preprocessing the
    others.
    """
    over = threading.Event()

    def publish(process: str, frames: Iterable[Frame]) -> None:
        publisher = Publisher(process)
        for frame in itertools.cycle(frames):
            publisher.poll()
            publisher.send(frame)
            if over.wait(0.02):
                break
        publisher.close()

    (runtime / CONFIG_LINK).symlink_to(Path(config).resolve())
    sent = {"publisher": frames, "preprocessing": others}
    threads = [threading.Thread(target=publish, args=each) for each in sent.items()]
    with lock():
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            over.set()
            for thread in threads:
                thread.join()


def contact(*reasons: str) -> ContactFrame:
    return ContactFrame(skin="palm", valid=not reasons, reasons=list(reasons), valid_for_s=0.25)


@pytest.mark.parametrize(
    ("frames", "level", "expected"),
    [
        ([contact("out_of_distribution")], "FAIL", r"0 of \d+ frames of 3 s are valid \(0 %\)"),
        ([contact()] * 3 + [contact("gap")], "WARN", r"\d+ of \d+ frames of 3 s are valid \(7\d %\)"),
        ([contact()], "OK", r"(\d+) of \1 frames of 3 s are valid \(100 %\)"),
    ],
)
def test_contacts_are_judged_by_the_share_of_valid_frames(  # type: ignore[no-untyped-def]
    skin, runtime, tmp_path, frames, level, expected
) -> None:
    config = configured(tmp_path, "stub", "")
    with service(runtime, config, frames):
        out = skin("doctor", "--config", config).out
    assert re.search(rf"{level} +palm: contacts +{expected}", out), out
    for reason in {reason for frame in frames for reason in frame.reasons}:
        line = next(line for line in out.splitlines() if "palm: not valid" in line and reason in line)
        assert re.search(rf"{level} .*{reason} in \d+ of \d+", line) and ADVICE[reason].rstrip(".") in line
    assert ("not valid" in out) == (level != "OK")


def judgements(opened: float, lost: float) -> JudgementsFrame:
    found = [judge("believed", 0.0, 1.0), judge("open", opened, 1.0, 5 if opened else -1), judge("gap", lost, 1.0)]
    return judged(DeltaFrame(skin="palm", scan=1), [*found, judge("touch", 90.0, 45.0)])


OPEN, GAP = "open: 1, limit 1, ratio 1, electrode 5: noted", "gap: 3, limit 1, ratio 3: refused"


@pytest.mark.parametrize(
    ("reasons", "sent", "expected"),
    [
        (
            ["gap"],
            [judgements(1.0, 2.0), judgements(0.0, 3.0)],
            [f"FAIL palm: judged {OPEN}", f"FAIL palm: judged {GAP}"],
        ),
        (["gap"], [judgements(0.0, 0.0)], []),
        (["gap"], [], []),
        ([], [judgements(1.0, 2.0)], []),
    ],
)
def test_which_judgement_turned_is_said_where_frames_have_reasons(  # type: ignore[no-untyped-def]
    skin, runtime, tmp_path, reasons, sent, expected
) -> None:
    config = configured(tmp_path, "stub", "")
    with service(runtime, config, [contact(*reasons)], sent):
        out = skin("doctor", "--config", config).out
    found = [" ".join(line.split()) for line in out.splitlines() if "palm: judged" in line]
    assert sorted(found) == sorted(expected), out


def test_while_the_first_baseline_is_taken_it_waits(skin, runtime, tmp_path) -> None:  # type: ignore[no-untyped-def]
    """For three seconds after the start frames are `stale_baseline`: nothing is the matter, a tare no help."""
    config, asked, over = configured(tmp_path, "stub", ""), [], threading.Event()

    def status(_: dict[str, Any]) -> dict[str, Any]:
        asked.append(1)
        taken = len(asked) > 2
        return {
            "level": "OK" if taken else "WARN",
            "messages": [] if taken else [f"{TAKING}: {len(asked)} of 64 frames"],
        }

    def answer() -> None:
        server = ControlServer("preprocessing", {"status": status})
        while not over.is_set():
            server.serve_once(0.05)
        server.close()

    thread = threading.Thread(target=answer)
    thread.start()
    frames = (contact() if len(asked) > 2 else contact("stale_baseline") for _ in itertools.count())
    try:
        with service(runtime, config, frames):
            out = skin("doctor", "--config", config).out
    finally:
        over.set()
        thread.join()
    assert re.search(r"OK +palm: preprocessing", out) and "stale_baseline" not in out, out


def test_no_contact_frame_is_a_failure(skin, runtime, tmp_path) -> None:  # type: ignore[no-untyped-def]
    config = configured(tmp_path, "stub", "")
    other = ContactFrame(skin="sole", valid=True)
    with service(runtime, config, [other]):
        assert re.search(r"FAIL +palm: contacts +no contact frame came", skin("doctor", "--config", config).out)


@pytest.mark.parametrize("port", ["stub", "/dev/null"])
def test_against_another_configuration_that_is_named_and_nothing_fails(skin, runtime, tmp_path, port) -> None:  # type: ignore[no-untyped-def]
    config = configured(tmp_path, port, "")
    running = tmp_path / "running.toml"
    running.write_text('[skins.another]\nport = "stub"\nbundle = "disc16"\n')
    with service(runtime, running, [contact("late")]):
        ran = skin("doctor", "--config", config)
    assert f"the service runs {running}, this is {config}" in ran.out
    assert ran.code == 0 and "FAIL" not in ran.out, ran.out


def test_electrodes_in_order(bundle: Bundle) -> None:
    noise = 1 + 1e-4 * np.random.default_rng(0).standard_normal(120)
    assert electrode_order("palm", 3.0 * bundle.z0 * noise, bundle).level == "OK"


@pytest.mark.parametrize(("i", "j"), [(2, 9), (0, 1)])
def test_exchanged_wires_are_named(bundle: Bundle, i: int, j: int) -> None:
    rows = bundle.pattern.tolist()
    place = {_key(row): k for k, row in enumerate(rows)}
    swapped = [place[_key([{i: j, j: i}.get(e, e) for e in row])] for row in rows]
    finding = electrode_order("palm", bundle.z0[swapped], bundle)
    assert finding.level == "FAIL" and f"electrodes {i} and {j} look exchanged" in finding.text


def test_a_baseline_of_zeros_is_said(bundle: Bundle) -> None:
    finding = electrode_order("palm", np.zeros(120), bundle)
    assert finding.level == "FAIL" and "zero" in finding.text and "nan" not in finding.text


def test_another_skin_is_no_exchange(bundle: Bundle) -> None:
    z0 = bundle.z0 * np.random.default_rng(1).uniform(0.5, 2, 120)
    finding = electrode_order("palm", z0, bundle)
    assert finding.level == "WARN" and "skin tare" in finding.text


def configured(tmp_path, port: str, more: str = "") -> str:  # type: ignore[no-untyped-def]
    file = tmp_path / "skin.toml"
    file.write_text(f'[skins.palm]\nport = "{port}"\nbundle = "square16"\n{more}')
    return str(file)


def test_a_missing_port_is_named(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    ran = skin("doctor", "--config", configured(tmp_path, "/dev/ttyACM99"))
    assert ran.code == 1 and "/dev/ttyACM99 is not there: plug the board in" in ran.out


def test_a_recording_beside_the_configuration_is_found(skin, tmp_path) -> None:  # type: ignore[no-untyped-def]
    ran = skin("doctor", "--config", configured(tmp_path, "one.npz"))
    assert ran.code == 1 and f"{tmp_path / 'one.npz'} is not there" in ran.out
    (tmp_path / "one.npz").touch()
    ran = skin("doctor", "--config", configured(tmp_path, "one.npz"))
    assert ran.code == 0 and f"{tmp_path / 'one.npz'} is there" in ran.out


@pytest.mark.parametrize(
    ("content", "code", "expected"),
    [
        (None, 1, "palm.json is not there: correct `calibration`"),
        ("newtons_per_siemens = 10.0", 1, "is no calibration of forces"),
        ('{"newtons_per_siemens": 8.5}', 0, "palm.json: 8.5 N per S/m, to 5 N"),
    ],
)
def test_the_calibration_is_looked_at(skin, tmp_path, content, code, expected) -> None:  # type: ignore[no-untyped-def]
    if content is not None:
        (tmp_path / "palm.json").write_text(content)
    ran = skin("doctor", "--config", configured(tmp_path, "stub", 'calibration = "palm.json"\n'))
    assert ran.code == code and expected in ran.out


@pytest.mark.parametrize(
    ("radius", "code", "expected"),
    [(0.04, 0, "OK palm: surface cylinder of radius 0.04 m; contacts in 'arm'"), (0.01, 1, "reaches 100 mm round")],
)
def test_what_the_sheet_is_wrapped_round_is_looked_at(skin, tmp_path, radius, code, expected) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "arm.toml"
    file.write_text(
        '[skins.palm]\nport = "stub"\nbundle = "square16"\npose = { parent = "arm" }\ncontacts_in = "parent"\n'
        f'surface = {{ kind = "cylinder", radius_m = {radius} }}\n'
    )
    ran = skin("doctor", "--config", file)
    assert ran.code == code and expected in " ".join(ran.out.split())


def test_a_damaged_bundle_is_named(skin, tmp_path, bundle) -> None:  # type: ignore[no-untyped-def]
    import shutil

    shutil.copytree(bundle.path, tmp_path / "broken")
    with open(tmp_path / "broken" / "matrices.npz", "r+b") as file:
        file.write(b"x")
    file_name = tmp_path / "skin.toml"
    file_name.write_text(f'[skins.palm]\nport = "stub"\nbundle = "{tmp_path / "broken"}"\n')
    ran = skin("doctor", "--config", file_name)
    assert ran.code == 1 and "was changed or damaged" in ran.out


@pytest.mark.parametrize("schema", [link.SCHEMA_HASH, 0xBAD0F00D])
def test_the_board_is_asked_for_its_firmware(skin, tmp_path, schema) -> None:  # type: ignore[no-untyped-def]
    """A board behind a pty that answers HELLO with its IDENT, of our firmware version or of another."""
    import threading

    ours, theirs = pty.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    answer = link.encode(link.Ident(schema_hash=schema, unique_id=bytes(range(12)), max_scan=512, firmware="board 1.2"))

    def board() -> None:
        decoder = link.Decoder()
        while True:
            try:
                data = os.read(ours, 4096)
            except OSError:
                return
            if any(isinstance(message, link.Hello) for message in decoder.feed(data)):
                os.write(ours, answer)
                return

    thread = threading.Thread(target=board, daemon=True)
    thread.start()
    try:
        ran = skin("doctor", "--config", configured(tmp_path, os.ttyname(theirs)))
    finally:
        os.close(ours)
        os.close(theirs)
    if schema == link.SCHEMA_HASH:
        assert ran.code == 0 and "firmware 'board 1.2'" in ran.out
        assert "to scan at 50 kHz, N 128, raw, Hanning, 20 us: 22.9 a second" in ran.out.replace("\n", " ")
    else:
        assert ran.code == 1 and "speaks schema bad0f00d" in ran.out and "flash a matching one" in ran.out
