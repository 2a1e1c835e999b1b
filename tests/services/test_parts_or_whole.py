"""Skins scan in parts while the machine carries them: how many, how seldom that changes, what a touch sees of it."""

import numpy as np
import pytest

from bench.speed.simulated_host import SimulatedHost
from protocol.frames import StatusFrame
from protocol.sockets import Publisher
from services.acquisition import Load
from services.board.parts_or_whole import MOST_WAIT_S, PartsOrWhole
from services.board.source import BoardSource
from services.runtime.config import Skin

PART_HZ = 229.0


class Machine:
    """Skins of which so many fit in parts; each skin of too many loses its share."""

    def __init__(self, skins: int, fit: float) -> None:
        self.names = [f"skin{n}" for n in range(skins)]
        self.choice, self.fit = PartsOrWhole(self.names), fit
        self.now, self.behind, self.session, self.changes = 0.0, dict.fromkeys(self.names, 0.0), "a", 0

    @property
    def in_parts(self) -> list[str]:
        return [name for name in self.names if not self.choice.whole(name)]

    def run(self, seconds: float) -> list[int]:
        """How many scan in parts, each second."""
        found = []
        for _ in range(int(seconds)):
            self.now += 1.0
            before = self.in_parts
            for name in before:
                self.behind[name] += PART_HZ * (
                    0.1 if len(before) <= self.fit else 0.7
                )  # where touches begin, some are
            for name in self.names:
                skipped = {"skipped": int(self.behind[name])}
                status = StatusFrame(skin=name, process="preprocessing", session=self.session, drops=skipped)
                self.choice.heard(status, self.now)
            self.changes += before != self.in_parts
            found.append(len(self.in_parts))
        return found


def test_all_stay_in_parts_where_all_fit():
    machine = Machine(4, fit=4.0)
    assert machine.run(60.0) == [4] * 60 and machine.changes == 0


def test_as_many_stay_as_fit_and_attempts_grow_rare():
    machine = Machine(16, fit=5.5)
    first = machine.run(20.0)
    assert first[-1] <= 5 and min(first) >= 1  # within seconds
    machine.run(3600.0)
    before, hour = machine.changes, machine.run(3600.0)
    assert max(hour) <= 6 and machine.changes - before <= 4 * 3600 / MOST_WAIT_S + 8
    assert np.mean([count <= 5 for count in hour]) > 0.97


def test_they_come_back_when_the_load_is_gone():
    machine = Machine(8, fit=2.0)
    assert machine.run(120.0)[-1] <= 2
    machine.fit = 8.0
    machine.run(3 * MOST_WAIT_S)
    assert machine.run(1.0) == [8]


def test_a_preprocessing_that_starts_anew_counts_anew():
    machine = Machine(1, fit=1.0)
    machine.behind["skin0"] = 5000.0
    machine.run(2.0)
    machine.session, machine.behind["skin0"] = "b", 0.0
    machine.run(30.0)
    machine.session, machine.behind["skin0"] = "c", 9000.0
    assert machine.run(30.0) == [1] * 30


def test_parts_that_come_no_sooner_than_whole_scans_are_given_up():
    choice = PartsOrWhole(["palm"])
    for second, p50 in enumerate((5.0, 30.0, 8.0, 30.0, 31.0, 30.0)):
        choice.heard(StatusFrame(skin="palm", process="preprocessing", session="a", latency={"p50": p50}), second)
        assert choice.whole("palm") == (second >= 4), "one slow second is none"


def test_a_status_of_a_skin_that_scans_whole_changes_nothing():
    choice = PartsOrWhole(["palm"])
    for second in range(10):
        choice.heard(StatusFrame(skin="other", process="preprocessing", drops={"skipped": 200 * second}), second)
    assert not choice.whole("palm") and not choice.whole("other")


@pytest.mark.parametrize("in_parts", [True, False])
def test_a_board_that_knows_no_parts_says_nothing_of_the_load(runtime, bundle, monkeypatch, in_parts):
    board = BoardSource("palm", Skin(port="stub", bundle="square16"), bundle)  # the default
    whole = BoardSource("palm", Skin(port="stub", bundle="square16", scan="full"), bundle)
    assert board.in_parts and not whole.in_parts
    board.in_parts = in_parts
    upstream, load, now = Publisher("preprocessing"), Load([board]), [0.0]
    monkeypatch.setattr("services.acquisition.time.monotonic", lambda: now[0])
    for skipped in range(0, 1600, 200):
        now[0] += 1.0
        upstream.send(StatusFrame(skin="palm", process="preprocessing", valid=True, drops={"skipped": skipped}))
        upstream.poll()
        load._reader.socket.poll(200)
        load.look("palm")
    upstream.close()
    assert board.whole == in_parts


@pytest.mark.parametrize("touched", [False, True])
def test_a_board_goes_from_parts_to_whole_scans_and_back(touched):
    host = SimulatedHost("rolling", snr_db=80.0, seed=7)
    host.until(5.0)
    if touched:
        host.press(x=0.02, y=-0.01, force=2.0, radius=0.01, seconds=60.0)
    host.until(7.0)
    baseline = host.pipeline.pre.baseline
    for scanning, part in ((host.source.scanning.whole, 0), (host.source.scanning, 10)):
        since, asked = len(host.contacts), host.now
        host.link.scan_as(scanning, host.now)
        host.newest = host.source.newest()
        host.until(host.now + 3.0)
        seen = host.contacts[since:]
        good = [t for t, frame in seen if frame.valid and len(frame.contacts) == touched]
        assert good[-1] > host.now - 0.06 and good[0] < asked + 0.25
        assert np.diff(good).max() < 0.15
        assert sum(len(frame.contacts) != touched for _, frame in seen if frame.valid) == 0
        assert len({contact.id for _, frame in seen for contact in frame.contacts}) == touched
        assert {frame.part for _, frame in seen[len(seen) // 2 :]} >= {part}
        assert part or {frame.part for _, frame in seen[len(seen) // 2 :]} == {0}
    assert host.pipeline.pre.baseline is baseline
    host.rig.close()
