"""The page's server, asked by programs: who may command, what a viewer is sent, what /metrics says."""

import asyncio
import re
import time
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
from prometheus_client.parser import text_string_to_metric_families

from bridges.door import Door
from bridges.page.commands import OwnRecorder
from bridges.page.replays import Replay, ReplayRefused, listed
from bridges.page.server import PageServer
from bridges.page.settings import PageSettings
from bridges.process import BridgeError, Handed
from protocol.advice import ADVICE
from protocol.frames import REASONS, Contact, ContactFrame, DeltaFrame, ImageFrame, StatusFrame
from protocol.sockets import ControlServer, Publisher
from protocol.transport import Transport
from tests.bridges.page_server import SECRET, looking, run, serving, until, wanted
from tests.waiting import WAIT_S

Said = Callable[..., Any]


def contact(scan: int, *forces: float, valid: bool = True, age_s: float = 0.02, source: str = "stub") -> ContactFrame:
    now = time.monotonic_ns()
    stamps = {"sample": now - int(age_s * 1e9), "publish": now}
    found = [Contact(id=k, position=[0.0] * 3, force_n=f, force_sigma_n=0.3) for k, f in enumerate(forces, 1)]
    head: dict[str, Any] = {"valid": valid, "reasons": [] if valid else ["saturated", "gap"], "source": source}
    head["valid_for_s"] = 3600.0 if valid and age_s < 1 else 0.25  # a busy machine does not make it old
    return ContactFrame(skin="palm", scan=scan, contacts=found, stamps=stamps, **head)


@pytest.fixture
def publisher(runtime: Path) -> Iterator[Publisher]:
    made = Publisher("publisher")
    yield made
    made.close()


@pytest.mark.live
def test_commands_need_the_token_and_presses_the_stub(publisher: Publisher) -> None:
    asked: list[dict[str, Any]] = []

    async def test() -> None:
        stub = ControlServer("stub", {"press": lambda args: asked.append(args) or {"presses": 1}})
        async with serving() as server, looking(server) as browser:
            answering = asyncio.create_task(asyncio.to_thread(stub.serve_once, WAIT_S))
            press = {"x": 0.01, "y": 0.0, "force": 2.0}

            for says, source, command, args in (
                ("token", "", "press", {"token": ""}),
                ("token", "", "press", {"token": "wrong"}),
                ("nobody just now", "", "press", {}),
                ("measured by board", "board", "press", {}),
                ("no argument to_heart", "stub", "press", {"to_heart": 1}),
                ("no command 'load'", "stub", "load", {}),
            ):
                if source:
                    await browser.watch(publisher, "contact")
                    publisher.send(contact(1, source=source))
                    await browser.frames()
                answer = await browser.command(command, **press, **args)
                assert not answer["ok"] and says in answer["error"] and not asked, answer
            answer = await browser.command("press", **press)
            assert answer["ok"] and answer["result"] == {"presses": 1} and asked == [{"skin": "palm", **press}]
            await answering
        stub.close()

    run(test)


@pytest.mark.live
def test_where_no_recorder_runs_the_page_has_one_while_it_runs(runtime, tmp_path) -> None:
    async def test() -> None:
        async with serving(recordings=str(tmp_path)) as server, looking(server) as browser:
            answer = await browser.command("record", on=True)
            assert answer["ok"] and answer["result"]["recording"], answer
            file = Path(answer["result"]["file"])
            assert file.parent == tmp_path and file.exists()
            assert (await browser.command("record", on=False))["result"]["file"] == str(file)
        assert not OwnRecorder._answers(0.1), "it ends with the page"

    run(test)


@pytest.mark.live
def test_nothing_is_subscribed_to_while_nobody_looks_and_a_frame_comes_with_when_it_was_measured(publisher) -> None:
    async def test() -> None:
        async with serving() as server:
            assert not wanted(publisher, "contact")
            async with looking(server) as browser, looking(server) as other:
                await browser.watch(publisher, "contact", "shape")
                await other.watch(publisher, "contact")
                await browser.socket.close()
                await until(lambda: not wanted(publisher, "shape"))
                assert wanted(publisher, "contact")
                old = contact(1, age_s=5.0)
                publisher.send(old)
                message = await other.hear("frames")
                assert message["frames"][0][0] == old.stamps["sample"]
                await other.say({"ping": 12.5})
                pong = await other.hear("pong")  # so that it can tell an age, whatever clock it has
                assert pong["ping"] == 12.5 and message["now"] <= pong["now"] <= time.monotonic_ns()
            await until(lambda: not wanted(publisher, "contact"))
            assert sum(server.looking.values()) == 0

    run(test)


@pytest.mark.live
def test_a_viewer_that_does_not_read_is_dropped_to_the_newest_and_holds_up_nobody(publisher: Publisher) -> None:
    async def test() -> None:
        async with serving() as server, looking(server) as quick, looking(server) as slow:
            for browser in (quick, slow):
                await browser.watch(publisher, "contact")
            seen: list[int] = []
            for scan in range(1, 41):
                publisher.send(contact(scan))
                while not seen or seen[-1] < scan:
                    seen += [frame.scan for frame in await quick.frames()]
            assert seen == list(range(1, 41))
            # two were on their way before it had read any; what waits for it is the newest alone
            got = [frame.scan for _ in range(3) for frame in await slow.frames()]
            assert got[-1] == 40 and len(got) == 3, got

    run(test)


@pytest.mark.live
def test_who_comes_late_is_sent_the_picture_that_is_held(runtime: Path) -> None:
    async def test() -> None:
        inference = Publisher("inference")
        async with serving() as server, looking(server) as first:
            await first.watch(inference, "image")
            for scan, drop in ((7, np.zeros((4, 4), "f4")), (8, np.zeros((0, 0), "f4"))):
                held: dict[str, Any] = {"held": scan == 8, "reconstructed": 7, "touched": True}
                inference.send(ImageFrame(skin="palm", scan=scan, source="stub", image=drop, **held))
                assert [got.scan for got in await first.frames()] == [scan]
            async with looking(server) as second:
                await second.watch(inference, "image")
                found = [(f.scan, f.image.size) for f in await second.frames() if isinstance(f, ImageFrame)]
                assert found == [(7, 16), (8, 0)]
        inference.close()

    run(test)


def test_only_recordings_of_the_folder_are_replayed(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    for name in ("out.mcap", "in/cut.mcap", "in/notes.txt"):
        (tmp_path / name).write_bytes(b"cut short")
    assert [(f["name"], f["bytes"], f["seconds"]) for f in listed(tmp_path / "in")] == [("cut.mcap", 9, None)]
    for name in ("../out.mcap", "notes.txt", "", "--help", str(tmp_path / "out.mcap")):
        with pytest.raises(ReplayRefused, match="there is no recording"):
            Replay(tmp_path / "in", name, 1.0, 0.0)
    for speed, start in ((0, 0.0), (1e9, 0.0), (1.0, -1.0), (float("nan"), 0.0), ("fast", 0.0), (1.0, None)):
        with pytest.raises(ReplayRefused, match="expected 0.05 to 50"):
            Replay(tmp_path / "in", "cut.mcap", speed, start)


def test_settings_in_skin_toml_reach_it_and_each_reason_has_its_advice() -> None:
    from services.bridge import settings as handed
    from services.runtime.config import ROOT, load, parse

    shipped = load(ROOT / "skin.toml")
    found = PageSettings.of(Handed.read(handed("page", shipped)))
    assert (found.skins, found.host, found.port) == (("palm",), "127.0.0.1", 8080) and Door(found.host, (), "").local
    inside = PageSettings.of(Handed.read(handed("page", shipped, "0.0.0.0", 9000)))
    assert (inside.host, inside.port) == ("0.0.0.0", 9000), "what a container's command says"
    with pytest.raises(BridgeError, match="found {'port': 8080}.*expected host, port"):
        PageSettings.of(Handed({}, Transport(), {"port": 8080}))
    for text in ("", "{", "[]", '{"skins": {}}'):
        with pytest.raises(BridgeError, match="skin bridge NAME"):
            Handed.read(text)
    (block,) = re.findall(r"```toml\n(.*?)```", (ROOT / "docs" / "page.md").read_text(), re.DOTALL)
    skins = {"palm": {"port": "stub", "bundle": "square16"}}
    page = parse(tomllib.loads(block) | {"skins": skins}).page
    assert (page.host, page.names, page.metrics) == ("0.0.0.0", ("robot.lan",), True)
    assert ADVICE.keys() == REASONS.keys() and all(text.endswith(".") for text in ADVICE.values())


async def asked(server: PageServer, **headers: str) -> tuple[int, str]:
    async with aiohttp.ClientSession() as session:
        async with session.get(f"http://127.0.0.1:{server.door.port}/metrics", headers=headers) as answer:
            return answer.status, await answer.text()


async def scraped(server: PageServer, there: Callable[[Said], bool]) -> Said:
    """What is said of palm, once it says what is waited for: by name without its prefix, None where it is not said."""
    while True:  # `run` ends it
        status, text = await asked(server)
        assert status == 200
        found = [sample for family in text_string_to_metric_families(text) for sample in family.samples]
        values = {(each.name, frozenset(each.labels.items())): each.value for each in found}

        def said(name: str, values: Any = values, **labels: str) -> Any:
            return values.get((f"eitskin_{name}", frozenset({"skin": "palm", **labels}.items())))

        if there(said):
            return said
        await asyncio.sleep(0.01)


@pytest.mark.live
def test_contacts_are_counted_and_forces_shown_while_they_may_be_acted_on() -> None:
    async def test() -> None:
        publisher = Publisher("publisher")
        async with serving(skins=("palm",), metrics=True) as server:
            await until(lambda: wanted(publisher, "contact"))
            for of in ((1,), (2, 3.0), (3, 3.0, 4.0), (4, False), (5, 1.5, 2.5)):
                publisher.send(contact(4, valid=False) if of[0] == 4 else contact(*of))
            said = await scraped(server, lambda said: said("frames_total") == 5)
            counted = {"frames_valid_total": 4, "contacts_begun_total": 2, "frames_lost_total": 0}
            counted |= {"contacts_usable": 1, "contacts": 2, "latency_seconds_count": 5}
            assert {name: said(name) for name in counted} == counted
            assert said("frames_reason_total", reason="gap") == 1
            assert said("force_newtons") == pytest.approx(4.0)
            assert said("force_sigma_newtons") == pytest.approx(0.3 * 2**0.5)
            assert said("latency_seconds_sum") == pytest.approx(0.1, rel=0.01)
            assert said("latency_seconds_bucket", le="0.01") == 0 and said("latency_seconds_bucket", le="+Inf") == 5
            for frame, age_s in ((contact(6, 9.0, valid=False), 0), (contact(7, 3.0, age_s=30.0), 30)):
                publisher.send(frame)
                said = await scraped(server, lambda said, frame=frame: said("frames_total") == frame.scan)
                assert said("contacts_usable") == 0 and said("age_seconds") >= age_s
                assert said("force_newtons") is None and said("contacts") is None, "not to be trusted is no gauge"
        publisher.close()

    run(test)


@pytest.mark.live
def test_electrodes_noise_and_processes() -> None:
    head: dict[str, Any] = {"skin": "palm", "valid": True, "valid_for_s": 3600.0}
    status: dict[str, Any] = {"rates": {"delta": 22.0}, "drops": {"late": 2}, "counters": {"tares": 1}, "cpu": 0.25}
    status["latency"] = {"p50": 50.0, "p99": 70.0, "work_p50": 2.0}
    rows: list[tuple[float, str, dict[str, str]]] = [
        (0, "electrode_ok", {"electrode": "3"}),
        (1, "electrode_ok", {"electrode": "4"}),
        (15, "electrodes", {"state": "ok"}),
        (1, "electrodes", {"state": "open"}),
        (2e-4, "noise_ratio", {}),
        (1, "process_level", of := {"process": "preprocessing"}),
        (0.25, "process_cpu_cores", of),
        (22, "process_rate_hertz", {"topic": "delta", **of}),
        (2, "process_dropped_total", {"cause": "late", **of}),
        (1, "process_count", {"what": "tares", **of}),
        (0.07, "process_latency_seconds", {"quantile": "0.99", **of}),
        (0.002, "process_work_seconds", {"quantile": "0.5", **of}),
    ]

    async def test() -> None:
        publisher = Publisher("preprocessing")
        async with serving(skins=("palm",), metrics=True) as server:
            await until(lambda: wanted(publisher, "delta") and wanted(publisher, "status"))
            head["stamps"] = dict.fromkeys(("sample", "publish"), time.monotonic_ns())
            sigma, electrodes = np.array([1e-4, 2e-4, 3e-4, np.inf], "<f4"), np.eye(16, dtype="u1")[3]
            publisher.send(DeltaFrame(**head, electrodes=electrodes, sigma=sigma, difference=np.zeros(4, "<f4")))
            publisher.send(StatusFrame(**head, **status, process="preprocessing", level="WARN"))
            said = await scraped(server, lambda s: None not in (s("process_level", **of), s("noise_ratio")))
            assert [said(name, **labels) for _, name, labels in rows] == pytest.approx([row[0] for row in rows])
        publisher.close()

    run(test)


@pytest.mark.live
def test_who_may_not_look_may_not_read_it_either_and_it_is_off_unless_asked_for() -> None:
    async def test() -> None:
        for changes, headers, status in (
            ({}, {}, 404),
            ({"metrics": True}, {}, 200),
            ({"metrics": True}, {"Origin": "http://elsewhere.example"}, 403),
            (beyond := {"metrics": True, "host": "0.0.0.0"}, {}, 403),
            (beyond, {"Authorization": f"Bearer {SECRET}"}, 200),
        ):
            async with serving(**changes) as server:
                assert (await asked(server, **headers))[0] == status, (changes, headers)

    run(test)
