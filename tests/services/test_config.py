"""skin.toml: what it may say, and that errors name file, key, what was found and what is allowed."""

import re
import tomllib
from pathlib import Path

import pytest

from protocol.scan_setting import COHERENT, PAPER, ScanSetting
from services.runtime.config import ROOT, ConfigError, load, parse

PALM = {"port": "stub", "bundle": "square16"}
BOARD = PALM | {"port": "socket://board:4000"}

# what [skins.palm] says besides port and bundle; found and allowed as the error names them
OF_A_SKIN = [
    ({"port": 5}, "skins.palm.port: found 5; allowed: a valid string"),
    ({"port": "com1"}, "skins.palm.port: found 'com1'; allowed: "),
    *(({"port": url}, f"skins.palm.port: found '{url}'; allowed: {allowed}") for url, allowed in {
        "hwgrep://(": "hwgrep:// and a regular expression", "hwgrep://a&n=1": "hwgrep:// and a regular expression",
        "hwgrep://": "hwgrep:// and a regular expression that a port's name matches (found no expression)",
        "socket://h": "socket://HOST:PORT (found the host h, the port missing)", "socket://:1": "socket://HOST:PORT",
        "socket://h:x": "socket://HOST:PORT", "socket://[::1": "socket://HOST:PORT", "socket://h:70000": "socket://HO",
        "rfc2217://h": "rfc2217://HOST:PORT", "rfc2217://h:1?timeout=x": "rfc2217://HOST:PORT (found timeout=x",
        "rfc2217://a..b:1": "rfc2217://HOST:PORT (found no name", "socket://::1:4000": "socket://HOST:PORT (found no n",
        "spy://ttyUSB0": "spy:///dev/ttyACM0", "alt:///dev/a?class=os": "alt:///dev/ttyACM0 (found class=os",
        "loop://?x": "loop:// (found x=", "cp2110://x": "cp2110:// and", "tcp://h:1": "a pyserial URL, one of socket:",
    }.items()),
    ({"pot": "stub"}, "skins.palm.pot: unknown key; allowed here: port, bundle"),
    ({"dft_points": 100}, "dft_points: found 100; allowed: 128, 256 or 512"),
    ({"scan_setting": "slow"}, "scan_setting: found 'slow'; allowed: 'coherent', 'paper'"),
    ({"scan_setting": "quick", "dft_points": 256}, "the others have points of their own (found 256"),
    ({"scan": "adaptive"}, """allowed: "full" or "rolling": the adaptive scan is no more, write "rolling\""""),
    ({"tare": {"frames": 2}}, "skins.palm.tare.frames: found 2; allowed: "),
    ({"tare": {"max_age_s": float("inf")}}, "tare.max_age_s: found inf; allowed: a finite"),
    ({"pose": {"quaternion_xyzw": [1, 1, 0, 0]}}, "a quaternion of length 1"),
    ({"pose": {"position_m": [0, 0, True]}}, "position_m.2: found True; allowed: a va"),
    ({"reads": "peak", "calibration": "c.json"}, "`reads` or `calibration`: a calibra"),
    ({"rtia_ohm": True}, "rtia_ohm: found True"),
    ({"tare": {"frames": True}}, "tare.frames: found True"),
    ({"surface": {"kind": "cylinder", "radius_m": True}}, "radius_m: found True"),
    ({"rtia_ohm": 1e300}, "skins.palm.rtia_ohm: found 1e+300; allowed: less than or equal to 1000000"),
    ({"indenter": {"kind": "any"}}, "indenter: found {'kind': 'any'}; allowed: `radius_m` alone: no fit of their"),
    ({"indenter": {"kind": "circle", "refine": True}}, "Take `kind` and `refine` out, and `indenter` too where no"),
    ({"frame_id": "palm\x1b[2J"}, r"skins.palm.frame_id: found 'palm\x1b[2J'; allowed: text without control"),
]
# what a file says besides [skins.palm]
BESIDE = [
    ({"sockets": {"addresses": {"publsher": "tcp://*:1"}}}, "found 'publsher'"),
    ({"sockets": {"addresses": {"publisher": "tcp://*:70000"}}}, "tcp://HOST:PORT"),
    ({"sockets": {"addresses": {"publisher": "tcp://h:1", "publisher.ctl": "tcp://*:1"}}}, "addresses: found {"),
    ({"security": {"insecure": 1}}, "security.insecure: found 1; allowed: a valid boolean"),
    ({"security": {"secret_key": "me"}}, "allowed: clients or server_keys too (found sec"),
    ({"security": {"server_keys": {"palm": "k"}}}, "security.server_keys: found {'palm'"),
    ({"realtime": {"cpus": {"inference": [True]}}}, "cpus.inference.0: found True; allo"),
    ({"realtime": {"cpus": {"infrence": [0]}}}, "infrence"),
    ({"realtime": {"priority": 100}}, "realtime.priority"),
    ({"loging": {}}, "unknown key; allowed here: skins, sockets, security, realtime, skip, bridges, page, foxglove, "),
    ({"ros2": {"domain": 0}}, "take `ros2` out of skin.toml, and start it by `ros2 launch"),
    ({"bridges": ["page", "ros2"]}, "take `ros2` out of skin.toml"),
]
OF_SKINS = [
    ({}, "skins: found {}"),
    ({"palm": {"bundle": "square16"}}, "skins.palm.port: is missing"),
    ({"Palm one": PALM}, "found 'Palm one'"),
    ({"palm": BOARD, "arm": BOARD}, "a port of its own for each skin (palm has 'socket://board:4000', arm has"),
    ({f"s{k}": PALM for k in range(1000)}, "at most 64 skins (found 1000): run the others in a service of their own"),
]


WRONG = [({"skins": {"palm": PALM | said}}, expected) for said, expected in OF_A_SKIN]
WRONG += [({"skins": {"palm": PALM}} | said, expected) for said, expected in BESIDE]
WRONG += [({"skins": skins}, expected) for skins, expected in OF_SKINS]


@pytest.mark.parametrize(("raw", "expected"), [({}, "skins: is missing"), *WRONG])
def test_errors_name_file_key_found_and_allowed(raw, expected):
    with pytest.raises(ConfigError, match=f"^robot.toml: (.|\n)*{re.escape(expected)}"):
        parse(raw, Path("robot.toml"))


def test_every_key_of_the_shipped_file_is_one_that_exists():
    """Also those that are commented out: taking one's comment sign away must give a valid file."""
    text = re.sub(r"^# (?=[a-z_]+ = |\"|\[)", "", (ROOT / "skin.toml").read_text(), flags=re.MULTILINE)
    for key, says in (("reads", "`reads` or `calibration`"), ("mismatch", "`world` and `mismatch`")):  # one of each two
        with pytest.raises(ConfigError, match=says):
            parse(tomllib.loads(text))
        text = re.sub(f"^{key} = ", f"# {key} = ", text, flags=re.MULTILINE)
    config = parse(tomllib.loads(text))
    assert config.skin("palm").calibration == Path("palm.json") and config.sockets.addresses
    config = load(ROOT / "skin.toml")  # the demo
    palm = config.skin("palm")
    assert list(config.skins) == ["palm"] and palm.port == "stub" and palm.bundle == "square16"
    with pytest.raises(ConfigError, match="configured: palm"):
        config.skin("plam")


@pytest.mark.parametrize(("key", "found", "expected"), [
    ("port", "presses.npz", "/robot/presses.npz"),
    ("port", "socket://host:4000", "socket://host:4000"),
    ("bundle", "unknown", "unknown"),  # so that the error that follows speaks of names
    ("bundle", "calibration/palm", "/robot/calibration/palm"),
    ("calibration", "palm.json", Path("/robot/palm.json")),
])  # fmt: skip
def test_paths_are_relative_to_the_file_also_a_bundles_that_is_no_shipped_one(key, found, expected, tmp_path):
    config = parse({"skins": {"palm": PALM | {key: found}}}, Path("/robot/skin.toml"))
    assert getattr(config.skin("palm"), key) == expected
    for name, says in (("mine", str(tmp_path / "mine")), ("square16", "square16")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "manifest.json").write_text("{}")
        assert parse({"skins": {"a": PALM | {"bundle": name}}}, tmp_path / "skin.toml").skin("a").bundle == says


def test_every_mistake_is_named_at_once_and_so_are_files_that_are_no_toml(tmp_path):
    with pytest.raises(ConfigError, match=r"(.*\n){2}.*typo"):  # port, bundle, typo
        parse({"skins": {"palm": {"port": 1, "typo": 2}}})
    for text in ("[skins\n", "a = " + "[" * 10_000, "a = " + "9" * 10_000):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(ConfigError, match=r"bad\.toml"):
            load(tmp_path / "bad.toml")


def test_addresses_keys_and_scan_settings_reach_those_who_use_them():
    raw = {
        "skins": {"palm": PALM | {"scan_setting": "paper", "dft_points": 256, "rtia_ohm": 20_000}, "arm": PALM},
        "sockets": {"addresses": {"publisher": "tcp://0.0.0.0:47600"}},
        "security": {"secret_key": "keys/me.key_secret", "clients": "keys/clients"},
    }
    config = parse(raw, Path("/robot/skin.toml"))
    transport, palm = config.transport(), config.skin("palm")
    assert transport.data_address("publisher") == "tcp://0.0.0.0:47600"
    assert transport.secret_key == Path("/robot/keys/me.key_secret")
    assert palm.setting == ScanSetting(40_000, 256) and PAPER == ScanSetting(40_000, 128) and palm.rtia_ohm == 20_000.0
    assert config.skin("arm").setting == COHERENT
    assert parse({"skins": {"palm": PALM | {"scan_setting": "quick"}}}).skin("palm").setting.points == 64
