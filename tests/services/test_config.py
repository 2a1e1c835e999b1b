"""skin.toml: what it may say, and that errors name file, key, what was found and what is allowed."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, get_args

import pytest

from models.bundle import Bundle
from protocol.scan_setting import COHERENT, PAPER, ScanSetting
from services.contacts.force.curve import Curve
from services.contacts.force.law import ForceLaw
from services.runtime.config import (
    ROOT,
    ConfigError,
    ConfigFile,
    Skin,
    Surface,
    TareConfig,
    TouchConfig,
    load,
    parse,
)
from services.runtime.config_sections import RecorderSection

NAN, INF = float("nan"), float("inf")
PALM: dict[str, Any] = {"port": "stub", "bundle": "square16"}


def test_the_shipped_configuration_is_the_demo() -> None:
    config = load(ROOT / "skin.toml")
    assert list(config.skins) == ["palm"]
    assert config.skin("palm").port == "stub" and config.skin("palm").bundle == "square16"


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ({}, "skins: is missing"),
        ({"skins": {}}, "skins: found {}"),
        ({"skins": {"palm": {"bundle": "square16"}}}, "skins.palm.port: is missing"),
        ({"skins": {"palm": PALM | {"port": 5}}}, "skins.palm.port: found 5; allowed: a valid string"),
        ({"skins": {"palm": PALM | {"port": "com1"}}}, "skins.palm.port: found 'com1'; allowed: \"stub\""),
        ({"skins": {"palm": PALM | {"port": "com1"}}}, "*.npz"),
        ({"skins": {"palm": PALM | {"pot": "stub"}}}, "skins.palm.pot: unknown key; allowed here: port, bundle"),
        ({"skins": {"palm": PALM | {"dft_points": 100}}}, "dft_points: found 100; allowed: 128, 256 or 512"),
        (
            {"skins": {"palm": PALM | {"scan_setting": "slow"}}},
            "scan_setting: found 'slow'; allowed: 'coherent', 'paper'",
        ),
        (
            {"skins": {"palm": PALM | {"scan_setting": "quick", "dft_points": 256}}},
            "`dft_points` with scan_setting = 'coherent' or 'paper': the others have points of their own (found 256",
        ),
        ({"skins": {"palm": PALM | {"tare": {"frames": 2}}}}, "skins.palm.tare.frames: found 2; allowed: "),
        ({"skins": {"palm": PALM | {"tare": {"frame": 64}}}}, "unknown key; allowed here: frames, max_age_s"),
        ({"skins": {"palm": PALM | {"pose": {"quaternion_xyzw": [1, 1, 0, 0]}}}}, "a quaternion of length 1"),
        ({"skins": {"Palm one": PALM}}, "found 'Palm one'"),
        ({"skins": {"palm": PALM}, "sockets": {"addresses": {"publsher": "tcp://*:1"}}}, "found 'publsher'"),
        ({"skins": {"palm": PALM}, "sockets": {"addresses": {"publisher": "here"}}}, "tcp://HOST:PORT"),
        ({"skins": {"palm": PALM | {"reads": "integral"}}}, "reads: found 'integral'; allowed: 'pressure' or 'peak'"),
        ({"skins": {"palm": PALM | {"reads": "peak", "calibration": "c.json"}}}, "`reads` or `calibration`: a calibra"),
        ({"skins": {"palm": PALM | {"rtia_ohm": NAN}}}, "skins.palm.rtia_ohm: found nan; allowed: a finite number"),
        ({"skins": {"palm": PALM | {"tare": {"max_age_s": INF}}}}, "tare.max_age_s: found inf; allowed: a finite"),
        ({"skins": {"palm": PALM | {"indenter": {"radius_m": NAN}}}}, "radius_m: found nan; allowed: a finite number"),
        ({"skins": {"palm": PALM | {"pose": {"position_m": [0, -INF, 0]}}}}, "position_m.1: found -inf; allowed: a"),
        ({"skins": {"palm": PALM | {"pose": {"quaternion_xyzw": [0, 0, NAN, 1]}}}}, "found nan; allowed: a finite"),
        ({"skins": {"palm": PALM | {"tare": {"scale_per_s": NAN}}}}, "scale_per_s: found nan; allowed: a finite"),
        ({"skins": {"palm": PALM | {"touch": {"hold": "yes"}}}}, "touch.hold: found 'yes'; allowed: a valid boolean"),
        ({"skins": {"palm": PALM | {"indenter": {"radius_m": True}}}}, "radius_m: found True; allowed: a valid number"),
        ({"skins": {"palm": PALM | {"indenter": {"radius_m": "0.01"}}}}, "radius_m: found '0.01'; allowed: a valid nu"),
        ({"skins": {"palm": PALM | {"pose": {"position_m": [0, 0, True]}}}}, "position_m.2: found True; allowed: a va"),
        ({"skins": {"palm": PALM | {"tare": {"frames": True}}}}, "tare.frames: found True; allowed: a valid integer"),
        ({"skins": {"palm": PALM}, "realtime": {"cpus": {"inference": [True]}}}, "cpus.inference.0: found True; allo"),
        (
            {"skins": {"palm": PALM | {"scan": "adaptive"}}},
            """scan: found 'adaptive'; allowed: "full" or "rolling": the adaptive scan is no more, write "rolling\"""",
        ),
        ({"skins": {"palm": PALM | {"rtia_ohm": 16**9000}}}, "rtia_ohm: found a int too long to show"),
        (
            {"skins": {"palm": PALM}, "security": {"insecure": "yes"}},
            "security.insecure: found 'yes'; allowed: a valid",
        ),
        (
            {"skins": {"palm": PALM}, "security": {"insecure": 1}},
            "security.insecure: found 1; allowed: a valid boolean",
        ),
        (
            {"skins": {"palm": PALM}, "security": {"clients": "keys"}},
            "security: found {'clients': 'keys'}; allowed: sec",
        ),
        ({"skins": {"palm": PALM}, "security": {"secret_key": "me"}}, "allowed: clients or server_keys too (found sec"),
        ({"skins": {"palm": PALM}, "security": {"server_keys": {"palm": "k"}}}, "security.server_keys: found {'palm'"),
        (
            {
                "skins": {"palm": PALM},
                "sockets": {"addresses": {"publisher": "tcp://h:1", "publisher.ctl": "tcp://*:1"}},
            },
            "sockets.addresses: found {",
        ),
        (
            {"skins": {"palm": PALM}, "sockets": {"addresses": {"inference": "ipc://a", "publisher": "ipc://a"}}},
            "(inference has 'ipc://a', publisher has 'ipc://a'",
        ),
        ({"skins": {"palm": PALM}, "sockets": {"addresses": {"publisher": "tcp://*:70000"}}}, "tcp://HOST:PORT"),
        (
            {"skins": {name: PALM | {"port": "/dev/ttyACM0"} for name in ("palm", "arm")}},
            "skins: found {",
        ),
        (
            {"skins": {name: PALM | {"port": "socket://board:4000"} for name in ("palm", "arm")}},
            "allowed: a port of its own for each skin (palm has 'socket://board:4000', arm has 'socket://board:4000'",
        ),
        (
            {"skins": {"palm": PALM | {"port": "hwgrep://("}}},
            "skins.palm.port: found 'hwgrep://('; allowed: hwgrep:// and a regular expression",
        ),
        (
            {"skins": {"palm": PALM | {"rtia_ohm": 1e300}}},
            "skins.palm.rtia_ohm: found 1e+300; allowed: less than or equal to 1000000",
        ),
        (
            {"skins": {"palm": PALM}, "recorder": {"folder": "a\0b"}},
            r"recorder.folder: found 'a\x00b'; allowed: text without control characters",
        ),
        (
            {"skins": {"palm": PALM | {"frame_id": "palm\x1b[2J"}}},
            r"skins.palm.frame_id: found 'palm\x1b[2J'; allowed: text without control characters",
        ),
        (
            {"skins": {"palm\x07": PALM}},
            r"skins: found the name 'palm\x07'; allowed: printable characters",
        ),
        (
            {"skins": {"palm": PALM}, "page": {"names": ["robot", "a\x85b"]}},
            r"page.names.1: found 'a\x85b'; allowed: text without control characters",
        ),
        (
            {"skins": {f"s{k}": PALM for k in range(1000)}},
            "allowed: at most 64 skins (found 1000): run the others in a service of their own",
        ),
        (
            {"skins": {"palm": PALM}, "loging": {}},
            "unknown key; allowed here: skins, sockets, security, realtime, skip, bridges, "
            "page, ros2, foxglove, recorder, logging",
        ),
    ],
)
def test_errors_name_file_key_found_and_allowed(raw: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError) as error:
        parse(raw, Path("robot.toml"))
    assert str(error.value).startswith("robot.toml: ")
    assert expected in str(error.value)


def test_no_number_is_read_from_true() -> None:
    """Of every key of every section: true would be taken for 1."""
    sections = {name: ConfigFile.model_fields[name].annotation for name in ("realtime", "page", "ros2", "foxglove")}
    sections["recorder"] = RecorderSection
    tried = 0
    for path, section in (
        (("skins", "palm"), Skin),
        (("skins", "palm", "tare"), TareConfig),
        (("skins", "palm", "touch"), TouchConfig),
        (("skins", "palm", "surface"), Surface),
        *(((name,), section) for name, section in sections.items()),
    ):
        for key, field in section.model_fields.items():  # type: ignore[union-attr]
            if not {int, float} & {field.annotation, *get_args(field.annotation)}:
                continue
            raw: Any = {"skins": {"palm": dict(PALM)}}
            at = raw
            for part in path:
                at = at.setdefault(part, {})
            at[key], tried = True, tried + 1
            with pytest.raises(ConfigError, match=re.escape(f"{'.'.join((*path, key))}: found True")):
                parse(raw)
    assert tried > 15
    assert parse({"skins": {"palm": PALM | {"rtia_ohm": 20_000}}}).skin("palm").rtia_ohm == 20_000.0


@pytest.mark.parametrize(
    "text", ["a = nan.", "a = " + "[" * 10_000, "a = " + "9" * 10_000, "\x00", "[skins.palm]\nport = 0x" + "f" * 10_000]
)
def test_a_file_that_is_no_configuration_is_one_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "skin.toml").write_text(text)
    with pytest.raises(ConfigError, match=r"skin\.toml"):
        load(tmp_path / "skin.toml")


def test_every_key_of_the_shipped_file_is_one_that_exists() -> None:
    """Also those that are commented out: taking one's comment sign away must give a valid file."""
    text = (ROOT / "skin.toml").read_text()
    with_all = re.sub(r"^# (?=[a-z_]+ = |\"|\[)", "", text, flags=re.MULTILINE)
    assert with_all.count("#") < text.count("#")
    with pytest.raises(ConfigError, match="`reads` or `calibration`"):  # one of these two
        parse(tomllib.loads(with_all))
    with_all = re.sub(r"^reads = ", "# reads = ", with_all, flags=re.MULTILINE)
    with pytest.raises(ConfigError, match="`world` and `mismatch`"):  # and one of these
        parse(tomllib.loads(with_all))
    config = parse(tomllib.loads(re.sub(r"^mismatch = ", "# mismatch = ", with_all, flags=re.MULTILINE)))
    assert config.skin("palm").calibration == Path("palm.json") and config.sockets.addresses


def test_the_calibration_that_the_shipped_file_shows_is_read(tmp_path: Path) -> None:
    shown = re.search(r"calibration = .*# .*(\{.*\})", (ROOT / "skin.toml").read_text())
    assert shown
    (tmp_path / "palm.json").write_text(shown[1])
    config = parse({"skins": {"palm": PALM | {"calibration": "palm.json"}}}, tmp_path / "skin.toml")
    law = ForceLaw.of(config.skin("palm"), Bundle.load("square16"))
    assert (law.curve, law.most_n, law.calibrated) == (Curve(10.0), 5.0, True)


@pytest.mark.parametrize(
    ("key", "found", "expected"),
    [
        ("port", "presses.npz", "/robot/presses.npz"),
        ("port", "takes/one.mcap", "/robot/takes/one.mcap"),
        ("port", "/data/one.mcap", "/data/one.mcap"),
        ("port", "stub", "stub"),
        ("port", "/dev/ttyACM0", "/dev/ttyACM0"),
        ("port", "socket://host:4000", "socket://host:4000"),
        ("bundle", "square16", "square16"),
        ("bundle", "unknown", "unknown"),  # so that the error that follows speaks of names
        ("bundle", "calibration/palm", "/robot/calibration/palm"),
        ("bundle", "/data/palm", "/data/palm"),
        ("calibration", "palm.json", Path("/robot/palm.json")),
    ],
)
def test_paths_are_relative_to_the_file(key: str, found: str, expected: object) -> None:
    config = parse({"skins": {"palm": PALM | {key: found}}}, Path("/robot/skin.toml"))
    assert getattr(config.skin("palm"), key) == expected


def test_a_bundle_beside_the_file_is_found_unless_its_name_is_a_shipped_one(tmp_path: Path) -> None:
    for name in ("mine", "square16"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "manifest.json").write_text("{}")
    skins = {"a": PALM | {"bundle": "mine"}, "b": PALM}
    config = parse({"skins": skins}, tmp_path / "skin.toml")
    assert config.skin("a").bundle == str(tmp_path / "mine") and config.skin("b").bundle == "square16"


def test_every_mistake_is_named_at_once() -> None:
    with pytest.raises(ConfigError) as error:
        parse({"skins": {"palm": {"port": 1, "typo": 2}}})
    assert len(str(error.value).splitlines()) == 3  # port, bundle, typo


def test_files_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"nothing\.toml: cannot be read"):
        load(tmp_path / "nothing.toml")
    (tmp_path / "bad.toml").write_text("[skins\n")
    with pytest.raises(ConfigError, match=r"bad\.toml: is not TOML"):
        load(tmp_path / "bad.toml")


def test_an_unknown_skin_is_told_the_known_ones() -> None:
    with pytest.raises(ConfigError, match="configured: palm"):
        load(ROOT / "skin.toml").skin("plam")


def test_addresses_and_keys_reach_the_sockets() -> None:
    config = parse(
        {
            "skins": {"palm": PALM},
            "sockets": {"addresses": {"publisher": "tcp://0.0.0.0:47600"}},
            "security": {"secret_key": "keys/me.key_secret", "clients": "keys/clients"},
        },
        Path("/robot/skin.toml"),
    )
    transport = config.transport()
    assert transport.data_address("publisher") == "tcp://0.0.0.0:47600"
    assert transport.secret_key == Path("/robot/keys/me.key_secret")


def test_a_scan_setting_has_a_name() -> None:
    assert parse({"skins": {"palm": PALM}}).skin("palm").setting == COHERENT
    paper = parse({"skins": {"palm": PALM | {"scan_setting": "paper", "dft_points": 256}}}).skin("palm").setting
    assert paper == ScanSetting(40_000, 256) and PAPER == ScanSetting(40_000, 128)
    assert parse({"skins": {"palm": PALM | {"scan_setting": "quick"}}}).skin("palm").setting.points == 64
