"""Adaptive scan in the stub's timing: sooner contacts, none lost, full scans wherever there is doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bench.speed.sentinel_host import CHAIN_S, AdaptiveHost
from protocol import link
from protocol.frames import DeltaFrame
from services.board.adaptive import DEAF_S, FULL_EVERY_S, AdaptiveScan
from services.board.boardlink import SWITCH_S, BoardLink
from services.board.scanning import Scanning
from tests.services.fake_board import FakeBoard

REST_S = 6.6  # from power-up to an idling board


def touching(host: AdaptiveHost, since: float) -> list[tuple[float, bool]]:
    """(seconds since, coarse?) of each valid frame with a contact that goes on."""
    return [
        (t - since, "coarse" in frame.reasons)
        for t, frame in host.contacts
        if t > since and frame.valid and any(c.state != "end" for c in frame.contacts)
    ]


@pytest.fixture(scope="module")
def pair() -> tuple[AdaptiveHost, AdaptiveHost]:
    return AdaptiveHost("adaptive", seed=2), AdaptiveHost("full", seed=2)


def test_a_touch_is_told_three_times_sooner_and_in_full_no_later(pair: tuple[AdaptiveHost, AdaptiveHost]) -> None:
    first: dict[str, list[float]] = {"adaptive": [], "full": []}
    whole: dict[str, list[float]] = {"adaptive": [], "full": []}
    for host in pair:
        rng = np.random.default_rng(1)
        host.until(REST_S)
        for x, y, force in [
            (0.0, 0.0, 1.5),
            (0.03, -0.02, 3.0),
            (-0.035, 0.035, 2.0),
            (0.0, 0.035, 5.0),
            (0.02, 0.01, 1.0),
        ]:
            host.until(host.now + rng.uniform(0.2, 0.9))
            since = host.now
            host.press(x=x, y=y, force=force, radius=0.01)
            host.until(since + 0.3)
            seen = touching(host, since)
            first[host.scan].append(seen[0][0])
            whole[host.scan].append(next(t for t, coarse in seen if not coarse))
            ids = {c.id for t, f in host.contacts if t > since for c in f.contacts}
            assert len(ids) == 1, "the coarse contact and the full one are the same touch"
            host.release()
            host.until(host.now + 3.5)
            assert not host.contacts[-1][1].contacts
    assert np.median(first["full"]) > 3 * np.median(first["adaptive"])
    assert np.mean(whole["adaptive"]) < np.mean(whole["full"])


def test_contacts_keep_their_rate_while_the_board_idles(pair: tuple[AdaptiveHost, AdaptiveHost]) -> None:
    host, _ = pair
    host.until(max(host.now, REST_S) + 0.5)
    assert host.adaptive is not None and host.adaptive.idle
    start, full = host.now, host.kinds["full"]
    host.until(start + 4.0)
    when = np.array([t for t, _ in host.contacts if t > start])
    assert 20 < len(when) / 4 < 32
    assert np.diff(when).max() < 0.09
    assert 1 / FULL_EVERY_S * 4 * 0.7 <= host.kinds["full"] - full <= 1 / FULL_EVERY_S * 4 * 1.6
    frames = [f for t, f in host.contacts if t > start]
    assert all(f.valid for f in frames) and any("coarse" not in f.reasons for f in frames)


def test_without_verdicts_every_scan_is_full() -> None:
    host = AdaptiveHost("adaptive", seed=3)
    host.until(REST_S)
    assert host.adaptive is not None and host.adaptive.idle
    host.deaf = True
    host.until(host.now + DEAF_S + 0.2)
    assert not host.adaptive.idle
    before = dict(host.kinds)
    host.until(host.now + 1.0)
    assert host.kinds["full"] - before["full"] >= 20 and host.kinds["sentinel"] == before["sentinel"]


def test_an_electrode_in_doubt_ends_the_idling_and_makes_no_contact() -> None:
    host = AdaptiveHost("adaptive", seed=4)
    host.until(REST_S)
    since = host.now
    host.rig.fault("electrode_open", {"electrode": 5}, host.now, seconds=100)
    host.until(host.now + 1.5)
    assert host.adaptive is not None and not host.adaptive.idle
    assert not touching(host, since)


def test_gross_changes_make_no_coarse_contact() -> None:
    host = AdaptiveHost("adaptive", seed=5)
    host.until(REST_S)
    since = host.now
    host.rig.fault("electrodes_swapped", {"electrodes": [2, 9]}, host.now, seconds=100)
    host.until(host.now + 0.3)
    assert not [t for t, coarse in touching(host, since) if coarse]


def scan(config: int, n: int, seq: int) -> link.ScanFrame:
    return link.ScanFrame(seq, seq * 4000, 4000, config, np.full(n, 2 + 0j, np.complex64), np.zeros(n, np.uint8))


def verdict(**values: object) -> DeltaFrame:
    return DeltaFrame(skin="palm", valid=True, **values)  # type: ignore[arg-type]


def test_only_sound_quiet_full_frames_let_the_board_rest(pair: tuple[AdaptiveHost, AdaptiveHost]) -> None:
    sentinel = pair[0].pipeline.pre.sentinel_scans._coarse.sentinel  # type: ignore[union-attr]
    rng = np.random.default_rng(0)
    for spoiler in (verdict(touched=True), DeltaFrame(skin="palm"), verdict(electrodes=np.eye(1, 16, dtype="u1")[0])):
        adaptive, now = AdaptiveScan(sentinel, 7, quiet_frames=10), 0.0
        for k in range(25):
            full = scan(1, 120, k)
            full.z[:] *= 1 + 1e-4 * rng.standard_normal(120)
            adaptive.scanned(full, now)
            adaptive.heard(spoiler if k in (9, 18) else verdict(), now + CHAIN_S)
            now += 0.044
        assert not adaptive.idle, "ten in a row are needed"
        for k in range(25, 40):
            full = scan(1, 120, k)
            full.z[:] *= 1 + 1e-4 * rng.standard_normal(120)
            adaptive.scanned(full, now)
            adaptive.heard(verdict(), now + CHAIN_S)
        assert adaptive.idle and adaptive.wants(now) == "sentinel"
        adaptive.heard(spoiler, now)
        assert not adaptive.idle and adaptive.wants(now) == "full"


def test_a_switch_is_one_start_again_until_answered() -> None:
    full = Scanning(np.array([[0, 1, 0, 1], [1, 2, 1, 2]]), 128, 4e4)
    short = Scanning(full.pattern[:1], 128, 4e4)
    host = BoardLink(full, 0.0, short)
    decoder = link.Decoder()

    def said(now: float) -> list[link.Message]:
        return list(decoder.feed(host.to_send(now)))

    assert isinstance(said(0.0)[0], link.Hello)
    able = link.Ident(schema_hash=link.SCHEMA_HASH, capabilities=link.Capability.SENTINEL, firmware="able 1.0")
    host.received(link.encode(able), 0.0)
    for config in (full.config, short.config):
        (sent,) = said(0.0)
        assert isinstance(sent, link.Config) and sent.config == config
        host.received(link.encode(link.Ack(link.Config.number, config)), 0.0)
    assert isinstance(said(0.0)[0], link.Start)
    host.received(link.encode(link.Ack(link.Start.number, full.config)), 0.0)
    assert host.state == "running" and host.switches and not said(0.01)
    host.switch(short)
    assert [m.config for m in said(0.02) if isinstance(m, link.Start)] == [short.config]
    assert not said(0.03)
    assert said(0.03 + SWITCH_S), "not answered: again"
    host.received(link.encode(link.Ack(link.Start.number, full.config)), 0.1)  # late, of another START
    assert said(0.1 + 2 * SWITCH_S), "still not answered"
    host.received(link.encode(link.Ack(link.Start.number, short.config)), 0.2)
    assert not said(0.2 + 2 * SWITCH_S)
    taken = host.received(link.encode(scan(full.config, 2, 5)) + link.encode(scan(short.config, 1, 6)), 0.4)
    assert [len(s.z) for s in taken] == [2, 1] and host.reasons == {5: [], 6: []}


def test_a_board_lost_on_the_short_list_is_started_again() -> None:
    full = Scanning(np.array([[0, 1, 0, 1], [1, 2, 1, 2]]), 128, 4e4)
    short = Scanning(full.pattern[:1], 128, 4e4)
    host, board, now = BoardLink(full, 0.0, short), FakeBoard(), 0.0
    board.ident = replace(board.ident, capabilities=link.Capability.SENTINEL)

    def talk(until: float) -> float:
        at = now
        while at < until:
            host.received(board.receive(host.to_send(at)), at)
            at += 0.02
        return at

    now = talk(0.5)
    host.switch(short)
    now = talk(1.0)
    assert host.confirmed is short
    host._restart(now, "lost")
    now = talk(now + 1.0)
    assert host.state == "running" and host.confirmed is full


def test_a_board_that_cannot_switch_is_left_at_full_scans() -> None:
    full = Scanning(np.array([[0, 1, 0, 1], [1, 2, 1, 2]]), 128, 4e4)
    host = BoardLink(full, 0.0, Scanning(full.pattern[:1], 128, 4e4))
    host.to_send(0.0)
    host.received(link.encode(link.Ident(schema_hash=link.SCHEMA_HASH, firmware="old 1.0")), 0.0)
    assert host.state == "config" and not host.switches
    host.to_send(0.0)
    host.received(link.encode(link.Ack(link.Config.number, full.config)), 0.0)
    assert host.state == "start"
