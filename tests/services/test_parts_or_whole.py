"""Skins scan in parts while the machine carries them: how many, how seldom that changes, what a touch sees of it."""

import numpy as np
import pytest

from protocol.frames import StatusFrame
from services.board.parts_or_whole import MOST_WAIT_S, PartsOrWhole
from simulation.host import SimulatedHost


class Machine:
    """Skins of which so many fit in parts; each skin of too many loses its share."""

    def __init__(self, skins, fit):
        self.names = [f"skin{n}" for n in range(skins)]
        self.choice, self.fit = PartsOrWhole(self.names), fit
        self.now, self.behind, self.session, self.changes = 0.0, dict.fromkeys(self.names, 0.0), "a", 0

    def run(self, seconds):
        """How many scan in parts, each second."""
        found = []
        for _ in range(int(seconds)):
            self.now += 1.0
            before = [name for name in self.names if not self.choice.whole(name)]
            for name in before:  # where touches begin, some are behind
                self.behind[name] += 229.0 * (0.1 if len(before) <= self.fit else 0.7)
            for name, behind in self.behind.items():
                said = {"process": "preprocessing", "session": self.session, "drops": {"skipped": int(behind)}}
                self.choice.heard(StatusFrame(skin=name, **said), self.now)
            found.append(sum(not self.choice.whole(name) for name in self.names))
            self.changes += found[-1] != len(before)
        return found


def test_as_many_stay_as_fit_attempts_grow_rare_and_they_come_back_when_the_load_is_gone():
    assert (all_fit := Machine(4, fit=4.0)).run(60.0) == [4] * 60 and all_fit.changes == 0
    machine = Machine(16, fit=5.5)
    first = machine.run(20.0)
    assert first[-1] <= 5 and min(first) >= 1  # within seconds
    machine.run(3600.0)
    before, hour = machine.changes, machine.run(3600.0)
    assert max(hour) <= 6 and machine.changes - before <= 4 * 3600 / MOST_WAIT_S + 8
    assert np.mean([count <= 5 for count in hour]) > 0.97
    machine = Machine(8, fit=2.0)
    assert machine.run(120.0)[-1] <= 2
    machine.fit = 8.0
    assert machine.run(3 * MOST_WAIT_S + 1)[-1] == 8


def test_parts_that_come_no_sooner_than_whole_scans_are_given_up():
    choice = PartsOrWhole(["palm"])
    for second, p50 in enumerate((5.0, 30.0, 8.0, 30.0, 31.0, 30.0)):
        choice.heard(StatusFrame(skin="palm", process="preprocessing", session="a", latency={"p50": p50}), second)
        choice.heard(StatusFrame(skin="other", process="preprocessing", drops={"skipped": 200 * second}), second)
        assert choice.whole("palm") == (second >= 4) and not choice.whole("other"), "one slow second is none"


@pytest.mark.parametrize("touched", [False, True])
def test_a_board_goes_from_parts_to_whole_scans_and_back(touched):
    host = SimulatedHost("rolling", snr_db=80.0, seed=7)
    host.until(4.0)
    if touched:
        host.press(x=0.02, y=-0.01, force=2.0, radius=0.01, seconds=60.0)
    host.until(5.0)
    baseline = host.pipeline.pre.baseline
    for scanning, part in ((host.source.scanning.whole, 0), (host.source.scanning, 10)):
        since, asked = len(host.contacts), host.now
        host.link.scan_as(scanning, host.now)
        host.newest = host.source.newest()
        host.until(host.now + 2.0)
        seen = host.contacts[since:]
        good = [t for t, frame in seen if frame.valid and len(frame.contacts) == touched]
        assert good[-1] > host.now - 0.06 and good[0] < asked + 0.25 and np.diff(good).max() < 0.15
        assert sum(len(frame.contacts) != touched for _, frame in seen if frame.valid) == 0
        assert len({contact.id for _, frame in seen for contact in frame.contacts}) == touched
        parts = {frame.part for _, frame in seen[len(seen) // 2 :]}
        assert part in parts and (part or parts == {0})
    assert host.pipeline.pre.baseline is baseline
    host.rig.close()
