"""`skin up` and every command that talks to it, as a user would: real processes, the stub board."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = [pytest.mark.live, pytest.mark.release]
ROOT = Path(__file__).resolve().parents[2]


def skin(*arguments: object, timeout: float = 60) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(ROOT / "skin"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout)


@pytest.fixture
def recorder(service: subprocess.Popen[bytes], tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, str(ROOT / "skin"), "record", str(tmp_path / "demo.mcap"), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    yield process
    process.kill()
    process.wait(10)


def test_the_demo(
    service: subprocess.Popen[bytes], recorder: subprocess.Popen[bytes], runtime: Path, tmp_path: Path
) -> None:
    second = skin("up")
    assert second.returncode == 1 and "is in use by process" in second.stderr and second.stdout == ""

    began = time.monotonic()
    pressed = skin("press", "--x", 0.02, "--y", -0.01, "--force", 3, "--seconds", 120, "--json")
    assert pressed.returncode == 0 and time.monotonic() - began < 10
    compared = skin("compare", "--seconds", 3, "--json")
    rows = [json.loads(line) for line in compared.stdout.splitlines()]
    summary = rows[-1]["summary"]
    assert summary["seen"] >= 0.8 * summary["touches"] > 0
    assert summary["position_error_mm"]["median"] < 3 and rows[0]["force_n"] == pytest.approx(3)

    top = json.loads(skin("top", "--once", "--json", "--seconds", 3).stdout)
    assert set(top["processes"]) >= {"acquisition", "preprocessing", "inference", "publisher", "stub"}
    assert top["topics"]["contact"]["rate_hz"] > 10
    assert top["contacts"][0]["position"][0] == pytest.approx(0.02, abs=3e-3)
    assert top["topics"]["raw"]["latency_ms"]["p50"] > 0

    refused = skin("press", "--x", 5, "--y", 0, "--force", 3)
    assert refused.returncode == 1 and "metres" in refused.stderr
    refused = skin("fault", "toothache")
    assert refused.returncode == 1 and "electrode_open" in refused.stderr
    doctor = skin("doctor")
    assert "in order: the baseline is" in doctor.stdout, doctor.stdout

    recorder.send_signal(signal.SIGINT)
    report = json.loads(recorder.communicate(timeout=10)[0])
    assert report["gaps"] == 0 and report["messages"]["raw/palm"] > 40
    assert report["messages"]["contact/palm"] > 40 and report["messages"]["state/palm"] == 1
    refused = skin("replay", tmp_path / "demo.mcap")
    assert refused.returncode == 1 and "a board feeds the service" in refused.stderr
    assert skin("fault", "unplug", "--seconds", 60).stdout.startswith("unplug: the device vanishes")
    doctor = skin("doctor")
    says = "the stub board: on request, the cable is out; `skin fault --clear` ends it"
    assert doctor.returncode == 1 and re.search(f"FAIL +palm: port +{re.escape(says)}", doctor.stdout), doctor.stdout
    os.kill(service.pid, 0)
