"""A skin's setting and line, from skin.toml to contacts: on the stub's board, line and link in simulated time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.tracking.host import Host
from firmware_stub.rig import Rig
from models.bundle import Bundle
from protocol.scan_setting import NAMED, ScanSetting
from services.board.rolling_order import rolling_order
from services.board.scanning import Scanning
from services.board.source import in_parts
from services.pipeline import Pipeline
from services.runtime.config import parse
from services.runtime.supervision import stub_arguments


def skin_of(**said: object):  # type: ignore[no-untyped-def]
    return parse({"skins": {"palm": {"port": "stub", "bundle": "square16"} | said}}).skin("palm")


@pytest.mark.parametrize("name", NAMED)
def test_a_press_is_found_with_every_setting(name: str) -> None:
    skin = skin_of(scan_setting=name)
    rig = Rig("square16", seed=5, snr_db=80.0)
    host, pipeline = Host(rig, seed=5, skin=skin), Pipeline(skin, "palm")
    contacts, begun, frames = None, False, 0
    while host.now < 4.6:
        if host.now > 4.0 and not begun:
            rig.press({"x": 0.02, "y": -0.01, "force": 2.0}, host.now)
            begun = True
        for raw, _ in host.step():
            frames += 1
            contacts = pipeline.step(raw) or contacts
    rig.close()
    assert host.problem == "" and frames > 0.85 * 4.6 * 10 / skin.setting.scan_s(120)
    assert contacts is not None and contacts.valid and len(contacts.contacts) == 1
    found = contacts.contacts[0]
    assert np.hypot(found.position[0] - 0.02, found.position[1] + 0.01) < 1e-3
    assert found.force_n == pytest.approx(2.0, rel=0.25)


def test_parts_arrive_sooner_by_a_faster_line() -> None:
    """By what twelve values take less on it: 0.8 ms, whatever the reading adds."""
    ages = {}
    for baud in (921_600, 2_000_000):
        rig = Rig("square16", seed=5, baud=baud)
        host = Host(rig, seed=5, skin=skin_of(baud=baud))
        arrived: list[float] = []
        while host.now < 2.0:
            arrived += [host.now - felt.middle for _, felt in host.step()]
        rig.close()
        ages[baud] = np.mean(arrived)
    assert ages[921_600] - ages[2_000_000] == pytest.approx(0.78e-3, abs=0.4e-3)


def test_a_slow_line_joins_parts_and_keeps_their_order() -> None:
    bundle = Bundle.load("square16")
    scanning = Scanning(bundle.pattern, ScanSetting(50_000, 32), 40_000.0)
    joined = in_parts(scanning, bundle, 921_600)
    assert 1 < joined.parts < 10 and 10 % joined.parts == 0
    assert joined.order is not None and (joined.order == rolling_order(bundle)).all()
    assert in_parts(scanning, bundle, 2_000_000).parts == 10
    assert in_parts(scanning, bundle, 115_200).parts == 1


def test_the_stub_is_told_the_lines_rate(tmp_path: Path) -> None:
    two = {"port": "stub", "bundle": "square16"}
    file = parse({"skins": {"left": two | {"baud": 2_000_000}, "right": two}}, tmp_path / "skin.toml")
    told = stub_arguments(file)
    assert told[-2:] == ("--baud", "left=2000000") and told.count("--baud") == 1
