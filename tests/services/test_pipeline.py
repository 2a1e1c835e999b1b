"""The stages together: on frames of another solver (EIDORS: the reference data), and with every setting of a scan."""

import numpy as np
import pytest

from protocol.frames import RawFrame
from protocol.scan_setting import NAMED, ScanSetting
from services.board.rolling_order import rolling_order
from services.board.scanning import Scanning
from services.board.source import in_parts
from services.describe import BaselineNews, FrameRate
from services.pipeline import Pipeline
from services.runtime.config import parse
from services.runtime.supervision import stub_arguments
from simulation.host import LATE_S, SimulatedHost

SIDE_M = 0.1
STUB = {"port": "stub", "bundle": "square16"}
STEP_NS = 4_500_000


def skin_of(**said):
    return parse({"skins": {"palm": STUB | said}}).skin("palm")


def raw(scan, z=(1.0,), step_ns=45_000_000, **fields):
    stamps = {"sample": 10**9 + scan * step_ns, "read": 10**9 + scan * step_ns + 1}
    z, more = np.asarray(z, np.complex64), {"source": "board", "valid": True} | fields
    return RawFrame(skin="palm", scan=scan, stamps=stamps, z=z, status=np.zeros(len(z), np.uint8), **more)


@pytest.mark.parametrize("snr_db", [120.0, 70.0])
def test_touches_of_another_solver_are_found_where_they_are(reference, snr_db):
    data = np.load(reference / "eidors_reference.npz")
    rng, sigma = np.random.default_rng(0), 10 ** (-snr_db / 20)
    untouched, pipeline, errors, scan = data["impedance_pairs"][0], Pipeline("square16"), [], 0

    def run(z, noisy=True):
        nonlocal scan
        scan += 1
        return pipeline.run(raw(scan, z * (1 + sigma * noisy * rng.standard_normal(120))))

    result = [run(untouched) for _ in range(72)][-1]
    assert result.contact.valid and not result.contact.contacts
    for z, name, shapes, drop in zip(*(data[k] for k in ("impedance_pairs", "scene", "shapes", "drop")), strict=True):
        result, touches = run(z), int(np.isfinite(shapes[:, 0]).sum())
        assert str(name).startswith("J") or result.delta.touched == bool(touches), name  # J: drift
        if touches == 1:
            iy, ix = np.nonzero(drop)
            centroid = SIDE_M / 2 * (-1 + 2 * (np.array([ix.mean(), iy.mean()]) + 0.5) / 96)
            seen = [c for c in result.contact.contacts if c.state != "end"]
            errors.append(np.hypot(*(np.array(seen[0].position[:2]) - centroid)))
        for _ in range(3):  # let touches end
            run(untouched, noisy=False)
    assert len(errors) >= 8 and np.median(errors) < 0.02 * SIDE_M and max(errors) < 0.06 * SIDE_M


def test_every_raw_frame_gives_one_frame_of_each_kind_and_the_same_frames_the_same_contacts(skin, board):
    frames, runs = [board.frame(board.disc(0.1, 0.1, 0.2, 0.3) if n > 75 else 0.0) for n in range(90)], []
    for always in (False, True):
        pipeline = Pipeline(skin, name="palm", always_reconstruct=always)
        results = [pipeline.run(frame) for frame in frames]
        assert all([f.scan for f in result[:3]] == [raw.scan] * 3 for result, raw in zip(results, frames, strict=True))
        assert list(results[-1].contact.stamps) == ["sample", "read", "preprocess", "infer", "publish"]
        assert results[71].image.image.size == always * 96 * 96 and not results[71].contact.contacts
        runs.append([[(c.position, c.force_n, c.id) for c in result.contact.contacts] for result in results])
    assert runs[0] == runs[1] and runs[0][-1][0][0][:2] == pytest.approx([0.005, 0.005], abs=0.002)


@pytest.mark.parametrize("name", [name for name in NAMED if name != "coherent"])  # the default, as everywhere
def test_a_press_is_found_with_every_setting(name):
    skin = skin_of(scan_setting=name)
    host, scan_s = SimulatedHost(snr_db=80.0, seed=5, skin=skin, late_s=LATE_S, keep=True), skin.setting.scan_s(120)
    host.until(76 * scan_s)
    host.press(x=0.02, y=-0.01, force=2.0)
    host.until(81 * scan_s)
    host.close()
    assert host.problem == "" and len(host.raws) > 0.8 * 810
    (found,) = host.contacts[-1][1].contacts
    assert host.contacts[-1][1].valid and np.hypot(found.position[0] - 0.02, found.position[1] + 0.01) < 1e-3
    assert found.force_n == pytest.approx(2.0, rel=0.25)


def test_a_slow_line_joins_parts_and_the_stub_is_told_its_rate(tmp_path, bundle):
    scanning = Scanning(bundle.pattern, ScanSetting(50_000, 32), 40_000.0)
    joined = in_parts(scanning, bundle, 921_600)
    assert 1 < joined.parts < 10 and 10 % joined.parts == 0
    assert joined.order is not None and (joined.order == rolling_order(bundle)).all()
    assert in_parts(scanning, bundle, 2_000_000).parts == 10 and in_parts(scanning, bundle, 115_200).parts == 1
    told = stub_arguments(parse({"skins": {"left": STUB | {"baud": 2_000_000}, "right": STUB}}, tmp_path / "skin.toml"))
    assert told[-2:] == ("--baud", "left=2000000") and told.count("--baud") == 1


def test_the_rate_is_that_of_whole_scans_and_of_parts_whatever_was_lost():
    rate, news = FrameRate(), BaselineNews()
    for scan in range(40):  # these do not follow each other
        rate(raw(scan, step_ns=STEP_NS, reasons=["separate"]))
        rate(raw(scan, step_ns=STEP_NS, kind="sentinel"))
    assert rate.found is None and news(None, 0) and not news(None, 1)
    rate = FrameRate()
    for scan in [*range(8), *range(8, 60, 3)]:  # two of three were overtaken
        assert scan > 8 or rate.found is None
        rate(raw(scan, parts=10, step_ns=STEP_NS))
    assert rate.found == {"least": pytest.approx(22.22, abs=0.01), "touched": pytest.approx(222.2, abs=0.1)}
    assert news(None, 2, rate.found) and not news(None, 3, dict(rate.found)), "info is sent again with another rate"
    for scan in range(20):  # the board began anew, and scans whole
        rate(raw(scan, step_ns=10 * STEP_NS))
    assert rate.found == dict.fromkeys(("least", "touched"), pytest.approx(22.22, abs=0.01))
