"""What a recording carries of its configuration: all that the stages need, and nothing that reaches beyond them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from models import bundle as bundles
from models.bundle import Bundle
from protocol.frames import RawFrame, pack
from services.contacts.force import calibration_file as calibration
from services.contacts.force.curve import Curve
from services.recordings import settings
from services.recordings.recorder import metadata
from services.recordings.recording import RecordingError, RecordingReader, RecordingWriter
from services.recordings.replay import ReplayError
from services.recordings.replay_session import configuration_of, replay_file
from services.runtime.config import BUNDLES, ROOT, ConfigFile, Skin, load, parse

pytestmark = pytest.mark.live

HERE = Path("recording.mcap")


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ConfigFile:
    """A configuration with everything that a recording must not carry, and everything that it must."""
    bundle = Bundle.load("square16")
    raw = {
        "skins": {
            "palm": {
                "port": "/dev/ttySECRET",
                "bundle": str(bundle.path),
                "frame_id": 'palm "left"',
                "pose": {"parent": "wrist", "position_m": [0.1, 0.0, -0.2]},
                "network": "fast",
                "indenter": {"radius_m": 0.01},
                "calibration": str(tmp_path / "SECRET.json"),
                "tare": {"frames": 32},
                "touch": {"hold": False},
            }
        },
        "sockets": {"addresses": {"publisher": "tcp://127.0.0.1:47999"}},
        "security": {"insecure": True, "secret_key": "SECRET.key_secret", "clients": "SECRET-clients"},
        "skip": {"batch": False},
    }
    found = parse(raw, tmp_path / "skin.toml")
    law = calibration.Calibration(Curve(7.0), "peak", 4.0, 0.1)
    calibration.save(tmp_path / "SECRET.json", law, "palm", found.skins["palm"], bundle)
    lines = ['[skins.palm]\nport = "/dev/ttySECRET"', f'bundle = "{bundle.path}"', 'frame_id = "palm \\"left\\""']
    lines += ['pose = { parent = "wrist", position_m = [0.1, 0.0, -0.2] }', 'network = "fast"']
    lines += ["indenter = { radius_m = 0.01 }", 'calibration = "SECRET.json"', "tare = { frames = 32 }"]
    lines += ["touch = { hold = false }", '[sockets.addresses]\npublisher = "tcp://127.0.0.1:47999"']
    lines += ['[security]\ninsecure = true\nsecret_key = "SECRET.key_secret"\nclients = "SECRET-clients"']
    lines += ["[skip]\nbatch = false"]
    (tmp_path / "skin.toml").write_text("\n".join(lines))
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "skin.toml"))
    return load()


def carried(tmp_path: Path, text: str) -> RecordingReader:
    path = tmp_path / "carried.mcap"
    with RecordingWriter(path, {settings.KEY: text}, overwrite=True) as writer:
        frame = RawFrame(skin="palm", z=np.ones(120, "c8"), status=np.zeros(120, "u1"))
        writer.write("raw/palm", pack(frame).partition(b"\0")[2], 10**18)
    return RecordingReader(path)


def test_a_replay_reads_forces_as_they_were_recorded(tmp_path: Path) -> None:
    skin = Skin(port="stub", bundle="square16", reads="peak")
    found = settings.read(settings.text_of({"palm": skin}), HERE)
    again = settings.configuration(
        found, settings.Known({Bundle.load("square16").hash: BUNDLES / "square16"}), tmp_path
    )
    assert Skin.model_validate(again["skins"]["palm"]).reads == "peak"


def test_the_stages_get_what_they_had_and_no_more(config: ConfigFile, tmp_path: Path) -> None:
    text = metadata(["raw"], None)[settings.KEY]
    assert not [word for word in ("SECRET", "tcp://", "47999", "insecure", str(ROOT), "/dev") if word in text]
    reader = carried(tmp_path, text)
    (tmp_path / "SECRET.json").unlink()
    os.environ["EITSKIN_CONFIG"] = str(tmp_path / "gone.toml")  # another machine (monkeypatch puts it back)
    folder = tmp_path / "private"
    folder.mkdir()
    file, warnings = configuration_of(["palm"], reader, None, folder)
    again, before = load(file), config.skins["palm"]
    skin = again.skins["palm"]
    assert warnings == [] and again.skip == config.skip
    assert again.sockets.addresses == {} and not again.security.insecure and again.security.secret_key is None
    assert Bundle.load(skin.bundle).hash == Bundle.load(before.bundle).hash and skin.port == "stub"
    same = ("frame_id", "pose", "network", "indenter", "tare", "touch", "scan", "dft_points", "rtia_ohm")
    assert [getattr(skin, key) for key in same] == [getattr(before, key) for key in same]
    assert skin.calibration is not None and skin.calibration.parent == folder
    law = calibration.load(skin.calibration, skin, Bundle.load(skin.bundle), "palm")
    assert (law.curve.scale, law.most_n) == (7.0, 4.0)


def test_a_recording_says_how_the_service_was_configured_not_who_records(config: ConfigFile, tmp_path: Path) -> None:
    other = tmp_path / "theirs.toml"
    other.write_text('[skins.theirs]\nport = "stub"\nbundle = "square16"\n')
    own, theirs = (settings.read(metadata(["raw"], None, file)[settings.KEY], HERE) for file in (None, other))
    assert list(own.skins) == list(config.skins) and list(theirs.skins) == ["theirs"]


def said(**changes: object) -> dict[str, object]:
    bundle = Bundle.load("square16")
    return {"bundle": "square16", "bundle_hash": bundle.hash, **changes}


HOSTILE: dict[str, tuple[object, str]] = {
    "an address": ({"skins": {}, "sockets": {"addresses": {"publisher": "tcp://0.0.0.0:1"}}}, "sockets"),
    "insecure": ({"skins": {}, "security": {"insecure": True}}, "security"),
    "a port": ({"skins": {"palm": said(port="socket://evil:1")}}, "port"),
    "a path as the bundle's name": ({"skins": {"palm": said(bundle="/tmp/evil")}}, "bundle"),
    "a hash that is none": ({"skins": {"palm": said(bundle_hash="../../evil")}}, "bundle_hash"),
    "a path as calibration": ({"skins": {"palm": said(calibration="/etc/passwd")}}, "calibration"),
    "a name that is TOML": ({"skins": {"x]\n[security]\ninsecure = true\n[y": said()}}, "skin names"),
    "a frame of two lines": ({"skins": {"palm": said(frame_id='a"\n[security]')}}, "frame_id"),
    "NaN": ({"skins": {"palm": said(rtia_ohm=float("nan"))}}, "rtia_ohm"),
    "infinity": ({"skins": {"palm": said(tare={"max_age_s": float("inf")})}}, "max_age_s"),
    "beyond its range": ({"skins": {"palm": said(tare={"frames": 10**9})}}, "frames"),
    "no map": ([1, 2], "dictionary"),
    "too many skins": ({"skins": {f"s{k}": said() for k in range(65)}}, "64"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_settings_that_reach_further_or_cannot_be_are_refused(what: str) -> None:
    content, says = HOSTILE[what]
    with pytest.raises(RecordingError, match="its settings cannot be used") as refused:
        settings.read(json.dumps(content), HERE)
    assert says in str(refused.value) and str(HERE) in str(refused.value)


@pytest.mark.parametrize("text", ["{", "[" * 100_000, '"' + "x" * 2**21 + '"'])
def test_settings_that_are_no_json_are_refused(text: str) -> None:
    with pytest.raises(RecordingError, match="its settings cannot be used"):
        settings.read(text, HERE)


@pytest.mark.parametrize(
    "law, says",
    [
        ({"newtons_per_siemens": -1}, "above 0"),
        ({"newtons_per_siemens": float("nan")}, "above 0"),
        ({"schema": "eitskin.force/2"}, "no calibration"),
        ({"newtons_per_siemens": [1]}, "no calibration"),
    ],
)
def test_a_recorded_calibration_is_checked_like_a_file(tmp_path: Path, law: dict[str, object], says: str) -> None:
    found = settings.read(json.dumps({"skins": {"palm": said(calibration=law)}}), HERE)
    with pytest.raises(RecordingError, match=says):
        settings.configuration(found, settings.Known.here(None), tmp_path)


def test_a_bundle_is_found_by_its_hash_and_never_by_a_path(
    tmp_path: Path, runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shipped = Bundle.load("square16")
    manifest = {k: v for k, v in shipped.manifest.items() if k not in ("files", "schema")} | {"name": "other"}
    other = bundles.write(tmp_path / "square16", manifest | {"network": None}, shipped.matrices)
    text = json.dumps({"skins": {"palm": said(bundle_hash=other.hash)}})
    reader = carried(tmp_path, text)
    monkeypatch.chdir(tmp_path)  # where a folder of the recorded name lies
    with pytest.raises(RecordingError, match="is not installed.*--bundle PATH"):
        configuration_of(["palm"], reader, None, runtime)
    file, warnings = configuration_of(["palm"], reader, other.path, runtime)
    assert load(file).skins["palm"].bundle == str(other.path) and warnings == []
    file, warnings = configuration_of(["palm"], reader, shipped.path, runtime)
    assert "contacts will differ" in warnings[0] and load(file).skins["palm"].bundle == str(shipped.path)
    (tmp_path / "skin.toml").write_text('[skins.any]\nport = "stub"\nbundle = "./square16"\n')
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "skin.toml"))
    file, _ = configuration_of(["palm"], reader, None, runtime)
    assert Bundle.load(load(file).skins["palm"].bundle).hash == other.hash


def test_without_settings_ours_count_else_the_bundle_that_is_named(runtime: Path, tmp_path: Path) -> None:
    reader = carried(tmp_path, "")
    assert load(configuration_of(["palm"], reader, None, runtime)[0]).skins["palm"].pose.parent == "wrist"
    with pytest.raises(ReplayError, match="--bundle PATH"):
        configuration_of(["elbow"], reader, None, runtime)
    file, _ = configuration_of(["elbow"], reader, Path("disc16"), runtime)
    assert Bundle.load(load(file).skins["elbow"].bundle).name == "disc16"


def test_a_service_that_stands_still_keeps_its_sockets(runtime: Path, tmp_path: Path) -> None:
    """acquisition stopped by SIGSTOP answers nothing; its lock says that it is there."""
    environment = os.environ | {"EITSKIN_CONFIG": str(tmp_path / "skin.toml")}
    (tmp_path / "skin.toml").write_text('[skins.palm]\nport = "socket://127.0.0.1:9"\nbundle = "square16"\n')
    process = subprocess.Popen([sys.executable, "-m", "services.acquisition"], cwd=ROOT, env=environment)
    try:
        end = time.monotonic() + 60
        while not (runtime / "acquisition.ipc").exists():
            assert time.monotonic() < end and process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGSTOP)
        before = (runtime / "acquisition.ipc").stat().st_ino
        reader = carried(tmp_path, json.dumps({"skins": {"palm": said()}}))
        with pytest.raises(ReplayError, match=f"a board feeds the service .*process {process.pid}"):
            replay_file(reader.path, None)
        assert (runtime / "acquisition.ipc").stat().st_ino == before
    finally:
        process.kill()
        process.wait(10)


def test_a_second_process_of_a_name_leaves_the_first_one_its_sockets(runtime: Path) -> None:
    from protocol.runtime import lock

    with lock(process="publisher"):
        second = [sys.executable, "-m", "services.publisher"]
        ran = subprocess.run(second, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 1 and f"has its publisher already, held by process {os.getpid()}" in ran.stderr
    assert not (runtime / "publisher.ipc").exists() and "Traceback" not in ran.stderr
