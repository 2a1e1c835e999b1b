"""What docs/ros.md and docs/foxglove.md show fits the code: topics, settings, the files beside them."""

from __future__ import annotations

import json
import re
import tomllib
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from bridges.foxglove.channels import FORCES
from bridges.ros2.definitions import TABLE
from bridges.ros2.tare_service import REQUEST_TYPE
from services.bridge import NEEDS
from services.runtime.config import parse
from tests.cli.conftest import Ran, skin  # noqa: F401

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/ros.md").read_text(encoding="utf-8")
ROWS = re.findall(r"^\| `(/[^`]+)`[^|]* \| (\w+/\w+)", PAGE, re.MULTILINE)
WRITER = r'(?:writer\(|RosWriter\(self\._participant, )f?"([^"]+)", "([^"]+)"'
WRITERS = re.findall(WRITER, (ROOT / "bridges/ros2/bridge.py").read_text(encoding="utf-8"))


def test_the_table_names_every_topic_with_its_type() -> None:
    shown = {(name.removeprefix("/eitskin/SKIN/").removesuffix("0").lstrip("/"), kind) for name, kind in ROWS}
    made = {(name.replace("{k}", "").lstrip("/"), kind) for name, kind in WRITERS}
    assert shown == made and len(made) >= 9
    assert {kind for _, kind in shown} <= TABLE.keys()
    assert "| `/eitskin/SKIN/tare` | service std_srvs/Trigger" in PAGE and REQUEST_TYPE.startswith("std_srvs::srv::")


def test_the_settings_are_such_that_the_service_takes_them() -> None:
    blocks = re.findall(r"^```toml\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    found: dict[str, Any] = tomllib.loads("".join(blocks))
    skins = {"palm": {"port": "stub", "bundle": "square16"}}
    config = parse({**found, "skins": skins})
    assert (
        config.bridges == ("ros2",)
        and config.ros2.interface == "lo"
        and config.ros2.domain == 0
        and config.ros2.commands
        and config.ros2.reference["palm"].axis == "-z"
    )


def test_commands_are_off_unless_asked_for() -> None:
    assert parse({"skins": {"palm": {"port": "stub", "bundle": "square16"}}}).ros2.commands is False


@pytest.mark.parametrize("wrong", [{"domain": 233}, {"domain": "0"}, {"interface": "a b"}, {"comands": True}])
def test_settings_that_are_none_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(Exception, match=r"ros2\.\w+: (found|unknown key)"):
        parse({"ros2": wrong, "skins": {"palm": {"port": "stub", "bundle": "square16"}}})


def test_rviz_shows_topics_that_there_are() -> None:
    displays = yaml.safe_load((ROOT / "docs/ros/eitskin.rviz").read_text())["Visualization Manager"]["Displays"]
    shown = {d["Topic"]["Value"].replace("palm", "SKIN"): d for d in displays if "Topic" in d}
    assert len(shown) == 3 and shown.keys() <= {name for name, _ in ROWS}
    assert shown["/eitskin/SKIN/pressure"]["Topic"]["Reliability Policy"] == "Best Effort"


def test_the_macro_is_well_formed() -> None:
    root = ElementTree.parse(ROOT / "docs/ros/eitskin.urdf.xacro").getroot()
    (macro,) = root
    assert macro.attrib["name"] == "eitskin" and {child.tag for child in macro} == {"link", "joint"}


def test_the_layout_shows_topics_and_fields_that_there_are() -> None:
    layout = json.loads((ROOT / "docs/foxglove-layout.json").read_text())
    text = json.dumps(layout["configById"])
    page = (ROOT / "docs/foxglove.md").read_text(encoding="utf-8")
    known = set(re.findall(r"`/SKIN/(\w+)`", page))
    assert set(re.findall(r"/palm/(\w+)", text)) <= known
    assert set(re.findall(r"/palm/forces\.(\w+)", text)) <= set(FORCES["properties"])
    panels = set(re.findall(r'"(\w+!\w+)"', json.dumps(layout["layout"])))
    assert panels == set(layout["configById"])


def test_a_bridge_whose_packages_are_missing_is_refused_before_anything_starts(
    skin: Callable[..., Ran],  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config = tmp_path / "skin.toml"
    config.write_text('bridges = ["ros2"]\n[skins.palm]\nport = "stub"\nbundle = "square16"\n')
    monkeypatch.setitem(NEEDS, "ros2", "no_such_package")
    for command in (("up",), ("bridge", "ros2")):
        ran = skin(*command, "--config", config)
        assert ran.code == 2 and "make venv EXTRAS=ros2" in ran.err and "Traceback" not in ran.err, ran.err
