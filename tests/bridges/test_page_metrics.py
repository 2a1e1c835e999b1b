"""/metrics of the page, scraped over HTTP and read by Prometheus' own parser."""

from __future__ import annotations

import asyncio
import time
from contextlib import AbstractAsyncContextManager
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
from prometheus_client import Metric
from prometheus_client.parser import text_string_to_metric_families

from bridges.page.server import PageServer
from bridges.page.settings import PageSettings
from bridges.process import BridgeError
from protocol.frames import Contact, ContactFrame, DeltaFrame, StatusFrame
from protocol.sockets import Publisher
from tests.bridges import page_server
from tests.bridges.page_server import SECRET

pytestmark = pytest.mark.live


def serving(**changes: Any) -> AbstractAsyncContextManager[PageServer]:
    return page_server.serving(**{"skins": ("palm",), "port": 18180, "metrics": True, **changes})


async def asked(server: PageServer, query: str = "", **headers: str) -> tuple[int, str, str]:
    async with aiohttp.ClientSession() as session:
        async with session.get(f"http://127.0.0.1:{server.door.port}/metrics{query}", headers=headers) as answer:
            return answer.status, answer.headers.get("Content-Type", ""), await answer.text()


Samples = dict[tuple[str, frozenset[tuple[str, str]]], float]


def samples(text: str) -> tuple[Samples, dict[str, Metric]]:
    families = {family.name: family for family in text_string_to_metric_families(text)}
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value for f in families.values() for sample in f.samples
    }, families


def at(found: Samples, name: str, **labels: str) -> float | None:
    return found.get((name, frozenset({"skin": "palm", **labels}.items())))


def contact(scan: int, *forces: float, valid: bool = True, age_s: float = 0.02) -> ContactFrame:
    now = time.monotonic_ns()
    touches = [
        Contact(id=k, position=[0.0, 0.0, 0.0], force_n=force, force_sigma_n=0.3) for k, force in enumerate(forces, 1)
    ]
    return ContactFrame(
        skin="palm",
        scan=scan,
        source="stub",
        valid=valid,
        valid_for_s=3600.0 if valid else 0.25,  # a busy machine does not make it old
        reasons=[] if valid else ["saturated", "gap"],
        contacts=touches,
        stamps={"sample": now - int(age_s * 1e9), "publish": now},
    )


async def scraped(server: PageServer, frames: int) -> Samples:
    """Once it has counted so many frames."""
    end = time.monotonic() + 20
    while True:
        status, kind, text = await asked(server)
        assert status == 200 and kind.startswith("text/plain; version=0.0.4")
        found, _ = samples(text)
        if at(found, "eitskin_frames_total") == frames:
            return found
        assert time.monotonic() < end, text
        await asyncio.sleep(0.05)


async def subscribed(publisher: Publisher, topic: str) -> None:
    end = time.monotonic() + 20
    while not publisher.wanted(topic, "palm"):
        publisher.poll()
        assert time.monotonic() < end
        await asyncio.sleep(0.01)


def test_contacts_are_counted_and_forces_shown_while_they_may_be_acted_on(runtime: Path) -> None:
    async def test() -> None:
        publisher = Publisher("publisher")
        async with serving() as server:
            await subscribed(publisher, "contact")
            sent = [contact(1), contact(2, 3.0), contact(3, 3.0, 4.0), contact(4, valid=False), contact(5, 1.5, 2.5)]
            for frame in sent:
                publisher.send(frame)
            found = await scraped(server, 5)
            assert at(found, "eitskin_frames_valid_total") == 4 and at(found, "eitskin_contacts_begun_total") == 2
            assert at(found, "eitskin_frames_reason_total", reason="gap") == 1
            assert at(found, "eitskin_frames_lost_total") == 0
            assert at(found, "eitskin_contacts_usable") == 1 and at(found, "eitskin_contacts") == 2
            assert at(found, "eitskin_force_newtons") == pytest.approx(4.0)
            assert at(found, "eitskin_force_sigma_newtons") == pytest.approx(0.3 * 2**0.5)
            assert at(found, "eitskin_latency_seconds_count") == 5
            assert at(found, "eitskin_latency_seconds_sum") == pytest.approx(0.1, rel=0.01)
            assert at(found, "eitskin_latency_seconds_bucket", le="0.01") == 0
            assert at(found, "eitskin_latency_seconds_bucket", le="+Inf") == 5
            publisher.send(contact(6, 9.0, valid=False))
            found = await scraped(server, 6)
            assert at(found, "eitskin_contacts_usable") == 0  # and what is not to be trusted is no gauge
            assert at(found, "eitskin_force_newtons") is None and at(found, "eitskin_contacts") is None
        publisher.close()

    asyncio.run(test())


def test_an_old_frame_is_no_gauge(runtime: Path) -> None:
    async def test() -> None:
        publisher = Publisher("publisher")
        async with serving() as server:
            await subscribed(publisher, "contact")
            old = contact(1, 3.0, age_s=30)
            old.valid_for_s = 0.25
            publisher.send(old)
            found = await scraped(server, 1)
            assert at(found, "eitskin_contacts_usable") == 0 and at(found, "eitskin_force_newtons") is None
            assert (at(found, "eitskin_age_seconds") or 0) >= 30
        publisher.close()

    asyncio.run(test())


def test_electrodes_noise_and_processes(runtime: Path) -> None:
    async def test() -> None:
        publisher = Publisher("preprocessing")
        async with serving() as server:
            await subscribed(publisher, "delta")
            await subscribed(publisher, "status")
            electrodes = np.zeros(16, "u1")
            electrodes[3] = 1
            now = {"sample": time.monotonic_ns()}
            sigma = np.array([1e-4, 2e-4, 3e-4, np.inf], "<f4")
            head = {"skin": "palm", "valid": True, "valid_for_s": 3600.0, "stamps": now}
            publisher.send(DeltaFrame(**head, electrodes=electrodes, sigma=sigma, difference=np.zeros(4, "<f4")))
            status = {"rates": {"delta": 22.0}, "drops": {"late": 2}, "counters": {"tares": 1}, "cpu": 0.25}
            latency = {"p50": 50.0, "p99": 70.0, "work_p50": 2.0}
            publisher.send(
                StatusFrame(
                    **{**head, "stamps": {"publish": time.monotonic_ns()}},  # type: ignore[arg-type]
                    process="preprocessing",
                    level="WARN",
                    latency=latency,
                    **status,  # type: ignore[arg-type]
                )
            )
            end = time.monotonic() + 20
            while True:
                found, families = samples((await asked(server))[2])
                if at(found, "eitskin_process_level", process="preprocessing") is not None:
                    if at(found, "eitskin_electrode_ok", electrode="3") is not None:
                        break
                assert time.monotonic() < end
                await asyncio.sleep(0.05)
            assert at(found, "eitskin_electrode_ok", electrode="3") == 0
            assert at(found, "eitskin_electrode_ok", electrode="4") == 1
            assert (
                at(found, "eitskin_electrodes", state="ok") == 15 and at(found, "eitskin_electrodes", state="open") == 1
            )
            assert at(found, "eitskin_noise_ratio") == pytest.approx(2e-4)
            of = {"process": "preprocessing"}
            assert (
                at(found, "eitskin_process_level", **of) == 1 and at(found, "eitskin_process_cpu_cores", **of) == 0.25
            )
            assert at(found, "eitskin_process_rate_hertz", topic="delta", **of) == 22
            assert at(found, "eitskin_process_dropped_total", cause="late", **of) == 2
            assert at(found, "eitskin_process_count", what="tares", **of) == 1
            assert at(found, "eitskin_process_latency_seconds", quantile="0.99", **of) == pytest.approx(0.07)
            assert at(found, "eitskin_process_work_seconds", quantile="0.5", **of) == pytest.approx(0.002)
            assert (
                families["eitskin_process_dropped"].type == "counter"
                and families["eitskin_latency_seconds"].documentation
            )
        publisher.close()

    asyncio.run(test())


def test_it_is_off_unless_asked_for(runtime: Path) -> None:
    async def test() -> None:
        async with serving(metrics=False) as server:
            assert (await asked(server))[0] == 404

    asyncio.run(test())


def test_who_may_not_look_may_not_read_it_either(runtime: Path) -> None:
    async def test() -> None:
        async with serving() as server:
            assert (await asked(server))[0] == 200
            assert (await asked(server, Host="elsewhere.example"))[0] == 421
            assert (await asked(server, Origin="http://elsewhere.example"))[0] == 403
        async with serving(host="0.0.0.0") as server:
            assert (await asked(server))[0] == 403
            assert (await asked(server, "?token=wrong"))[0] == 403
            assert (await asked(server, Authorization=f"Bearer {SECRET}"))[0] == 200
            assert (await asked(server, f"?token={SECRET}"))[0] == 200

    asyncio.run(test())


def test_without_its_package_it_says_what_to_do(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bridges.page.server.importlib.util.find_spec", lambda name: None)
    known = PageSettings(("palm",), "127.0.0.1", 18180, (), "", metrics=True)
    with pytest.raises(BridgeError, match="prometheus-client, which is not installed"):
        PageServer(known, SECRET, lambda skin, measured_ns: None)
