"""`skin doctor` with the service down, and what it makes of frames, judgements, orders, mountings and ports."""

import os
import pty
import shutil
import threading
import tty
from pathlib import Path

import numpy as np
import pytest

from models import geometry
from models.bundle import Bundle
from models.calibration import CalibrationFit
from models.fit_calibration import describe
from models.mounted import FieldModes, Mounting
from protocol import link
from protocol.advice import ADVICE
from protocol.frames import ContactFrame, DeltaFrame
from protocol.runtime import CONFIG_LINK, lock
from services.cli import doctor_live
from services.cli.doctor import _key, electrode_order
from services.cli.doctor_live import Finding, validity
from services.cli.doctor_mounting import mounting_found
from services.cli.judged import turned
from services.estimation.initialisation.baseline import TAKING
from services.estimation.values.estimate import judge
from services.judged import judged
from services.runtime.config import Skin


@pytest.fixture
def doctor(skin, tmp_path: Path):
    """Exit status and findings, with single blanks, of a configuration with this port, bundle and more."""

    def call(port: str = "stub", more: str = "", bundle: str = "square16") -> tuple[int, str]:
        file = tmp_path / "skin.toml"
        file.write_text(f'[skins.palm]\nport = "{port}"\nbundle = "{bundle}"\n{more}')
        ran = skin("doctor", "--config", file)
        return ran.code, " ".join(ran.out.split())

    return call


@pytest.mark.parametrize(("bundle", "more", "code", "says"), [
    ("square16", "", 0, "every sha256 right"),
    ("disc16", "", 0, "not checked with the bundle disc16: shorts"),
    ("square16", "indenter = { radius_m = 0.5 }", 1, "found 0.5 m; expected 0.00052 to 0.05 m with bundle"),
    ("square16", 'calibration = "none.json"', 1, "none.json is not there: correct `calibration`"),
    ("square16", 'calibration = "good.json"', 0, "good.json: 8.5 N per S/m, to 5 N"),
    ("square16", "{arm}, radius_m = 0.04 }", 0, "OK palm: surface cylinder of radius 0.04 m; contacts in 'arm'"),
    ("square16", "{arm}, radius_m = 0.01 }", 1, "reaches 100 mm round"),
    ("broken", "", 1, "was changed or damaged"),
])  # fmt: skip
def test_what_a_configuration_names_is_looked_at(doctor, tmp_path: Path, bundle, more, code, says) -> None:
    (tmp_path / "good.json").write_text('{"newtons_per_siemens": 8.5}')
    if bundle == "broken":
        shutil.copytree(Bundle.load("square16").path, bundle := tmp_path / bundle)
        with open(bundle / "matrices.npz", "r+b") as file:
            file.write(b"x")
    arm = 'pose = { parent = "arm" }\ncontacts_in = "parent"\nsurface = { kind = "cylinder"'
    found, said = doctor("stub", more.replace("{arm}", arm), bundle)
    assert found == code and says in said, said


def test_a_port_is_looked_at(doctor, tmp_path: Path, monkeypatch) -> None:
    code, said = doctor("/dev/ttyACM99")
    assert code == 1 and "/dev/ttyACM99 is not there: plug the board in" in said
    for there in (False, True):  # beside the configuration
        code, said = doctor("one.npz")
        assert code == (not there) and f"{tmp_path / 'one.npz'} is {'' if there else 'not '}there" in said
        (tmp_path / "one.npz").touch()
    for text in ("/dev/a is gone: is the cable plugged in?", "no answer"):  # of the service's acquisition
        monkeypatch.setattr(doctor_live, "_status", lambda *_, text=text: Finding("FAIL", "acquisition", text))
        (found,) = doctor_live.port("palm", Skin(port="/dev/a", bundle="square16"))
        assert found.text == ("/dev/a: " if text == "no answer" else "") + text


@pytest.mark.live
@pytest.mark.parametrize(("schema", "ends", "says"), [
    (link.SCHEMA_HASH, 0, "to scan at 50 kHz, N 128, raw, Hanning, 20 us: 22.9 a second"),
    (0xBAD0F00D, 1, "speaks schema bad0f00d"),
])  # fmt: skip
def test_the_board_is_asked_for_its_firmware(doctor, schema: int, ends: int, says: str) -> None:
    ours, theirs = pty.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    answer = link.encode(link.Ident(schema_hash=schema, unique_id=bytes(range(12)), max_scan=512, firmware="board 1.2"))

    def board() -> None:
        decoder = link.Decoder()
        while not any(isinstance(message, link.Hello) for message in decoder.feed(os.read(ours, 4096))):
            pass
        os.write(ours, answer)

    threading.Thread(target=board, daemon=True).start()
    code, said = doctor(os.ttyname(theirs))
    os.close(ours)
    os.close(theirs)
    assert code == ends and says in said


def test_beside_a_service_of_another_configuration_nothing_fails(doctor, runtime: Path, tmp_path: Path) -> None:
    running = tmp_path / "running.toml"
    running.write_text('[skins.another]\nport = "stub"\nbundle = "disc16"\n')
    (runtime / CONFIG_LINK).symlink_to(running)
    with lock():
        code, said = doctor()
    assert f"the service runs {running}, this is {tmp_path / 'skin.toml'}" in said
    assert code == 0 and "FAIL" not in said and "SKIP palm: contacts" in said


def contact(*reasons: str) -> ContactFrame:
    return ContactFrame(skin="palm", valid=not reasons, reasons=list(reasons), valid_for_s=0.25)


@pytest.mark.parametrize(("valid", "gap", "late", "level", "share"), [
    (0, 0, 0, "FAIL", "no contact frame came"),
    (49, 51, 0, "FAIL", "49 of 100 frames of 3 s are valid (49 %)"),
    (50, 50, 0, "WARN", "(50 %)"),
    (94, 2, 4, "WARN", "(94 %)"),
    (95, 5, 0, "OK", "(95 %)"),
])  # fmt: skip
def test_contacts_are_judged_by_the_share_of_valid_frames(valid, gap, late, level: str, share: str) -> None:
    first, *others = validity("palm", [contact()] * valid + [contact("gap")] * gap + [contact("late")] * late)
    assert first.level == level and share in first.text
    ordered = {"late": late, "gap": gap} if late > gap else {"gap": gap}
    for (reason, count), found in zip(ordered.items() if gap and level != "OK" else (), others, strict=True):
        assert found.level == level and found.text.startswith(f"{reason} in {count} of 100: ")
        assert ADVICE[reason].rstrip(".") in found.text


def test_which_judgement_turned_is_said_as_it_was_at_its_worst() -> None:
    frames = []
    for opened, lost in ((1.0, 2.0), (0.0, 3.0), (0.0, 2.5)):
        found = [judge("believed", 0.0, 1.0), judge("open", opened, 1.0, 5 if opened else -1), judge("gap", lost, 1.0)]
        frames.append(judged(DeltaFrame(skin="palm", scan=1), [*found, judge("touch", 90.0, 45.0)]))
    said = {"open": "1, limit 1, ratio 1, electrode 5: noted", "gap": "3, limit 1, ratio 3: refused"}
    assert turned(frames) == said and turned([]) == {}


def test_while_the_first_baseline_is_taken_it_waits(monkeypatch) -> None:
    said = [f"{TAKING}: 1 of 64 frames", f"{TAKING}: 2 of 64 frames", "well", "not asked again"]
    monkeypatch.setattr(doctor_live, "_status", lambda *_: Finding("OK", "preprocessing", said.pop(0)))
    monkeypatch.setattr(doctor_live.time, "sleep", lambda _: None)
    doctor_live.wait_for_baseline("palm")
    assert said == ["not asked again"]


def test_the_order_of_electrodes_is_seen_in_the_baseline() -> None:
    bundle, rng = Bundle.load("square16"), np.random.default_rng(0)
    rows = bundle.pattern.tolist()
    place = {_key(row): k for k, row in enumerate(rows)}
    assert electrode_order("palm", 3.0 * bundle.z0 * (1 + 1e-4 * rng.standard_normal(120)), bundle).level == "OK"
    swapped = [place[_key([{2: 9, 9: 2}.get(e, e) for e in row])] for row in rows]
    for z0, level, says in (
        (bundle.z0[swapped], "FAIL", "electrodes 2 and 9 look exchanged"),
        (bundle.z0 * rng.uniform(0.5, 2, 120), "WARN", "skin tare"),  # another skin is no exchange
        (np.zeros(120), "FAIL", "zero"),
    ):
        finding = electrode_order("palm", z0, bundle)
        assert finding.level == level and says in finding.text


@pytest.mark.parametrize(("name", "place", "value", "says"), [
    ("field", 0, 0.0, ""),
    ("contact", 5, np.log(4.0), "electrode 5: contact impedance 4 times the file's"),
    ("shift", 7, 0.05, "electrode 7: 2.5 mm further along the outline"),
    ("anisotropy", 1, 0.16, "17 % better along 45 degrees"),
    ("after", 0, 0.01, "1.0 % of the untouched impedances stay unexplained"),
])  # fmt: skip
def test_what_looks_wrong_with_the_mounting_is_named(name: str, place: int, value: float, says: str) -> None:
    skin = geometry.load("square16")
    nominal = Mounting.nominal(skin, FieldModes(skin).count)
    values = {each: np.array(getattr(nominal, each)) for each in ("contact", "shift", "field", "anisotropy")}
    values.get(name, np.zeros(1))[place] = value
    sd = nominal.with_vector(np.full(len(nominal.vector), 1e-3))
    fit = CalibrationFit(Mounting(0.0, **values), sd, 0.03, value if name == "after" else 1e-4, (0.001,))
    places = {"outline": skin.polygon(), "electrodes": skin.point(skin.electrodes)}
    found = mounting_found("palm", describe(skin, fit), {"geometry": places})
    assert found.level == ("WARN" if says else "OK") and says in found.text
    assert ("looks wrong" in found.text) == bool(says)
