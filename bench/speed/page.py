"""The live page: what its process costs without, with one and with ten viewers, and whether the pipeline notices.

    skin bench page [--seconds 60] [--rounds 5]

Real processes and the stub, a touch that slides, viewers that take all that a browser takes. Rounds without a viewer
and with ten alternate in one run, so that the machine's load is the same for both. Prints a table.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import time
from pathlib import Path

import aiohttp
from rich.console import Console
from rich.table import Table

from bench import REPORTS
from bench import goals as _goals
from bench.goals import Goal
from bench.json_file import write_json
from bench.machine import provenance
from bench.speed.bridges import quantiles
from bench.speed.service import BEGIN, Service, end_on_sigterm, running_square
from bridges.page.feed import NEWEST
from models.command import real, whole
from protocol.frames import ContactFrame
from protocol.sockets import AllReader

SETTLE_S = 3.0
MANY = 10
RATIO, GATE = 1.1, 1.6
"""The target, and what a short run on a shared machine may have."""


async def view(address: str, stop: asyncio.Event) -> int:
    """What a browser takes, each message told to be read at once; how many bytes that was."""
    taken = 0
    async with aiohttp.ClientSession() as session:
        async with session.ws_connect(f"{address}/live", headers={"Origin": address}, max_msg_size=1 << 23) as socket:
            await socket.send_json({"skin": "palm", "want": NEWEST})
            while not stop.is_set():
                try:
                    message = await asyncio.wait_for(socket.receive_bytes(), 0.5)
                except TimeoutError:
                    continue
                taken += len(message)
                if b"frames" in message[:32]:
                    await socket.send_str('{"ack":1}')
    return taken


def pipeline_ms(seconds: float) -> list[float]:
    """From acquisition's read to the contacts being published, of each frame."""
    reader, found = AllReader(["contact"], "palm"), []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        frame = reader.recv(0.2)
        if isinstance(frame, ContactFrame):
            found.append((frame.stamps["publish"] - frame.stamps["read"]) * 1e-6)
    reader.close()
    return found


def cpu_s(pid: int) -> float:
    """Of one core, used by a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def with_viewers(count: int, address: str, pid: int, seconds: float) -> tuple[float, list[float]]:
    """Cores that the page's process used, and the pipeline's times."""
    stop = asyncio.Event()
    viewers = [asyncio.create_task(view(address, stop)) for _ in range(count)]
    await asyncio.sleep(SETTLE_S)
    before, began = cpu_s(pid), time.monotonic()
    times = await asyncio.to_thread(pipeline_ms, seconds)
    cores = (cpu_s(pid) - before) / (time.monotonic() - began)
    stop.set()
    await asyncio.gather(*viewers)
    return cores, times


def page_of(service: Service) -> tuple[str, int]:
    """Address and process of the page that `skin up` has started."""
    end = time.monotonic() + 60
    while not (found := re.search(r"(http://\S+)/#", (service.folder / "log.txt").read_text())):
        if time.monotonic() > end:
            raise RuntimeError('the service started no page: skin.toml has no `bridges = ["page"]`, perhaps')
        time.sleep(0.2)
    return found[1], int((service.folder / "page.lock").read_text())


async def run(service: Service, seconds: float, rounds: int) -> tuple[dict[int, list[float]], dict[int, list[float]]]:
    """By number of viewers: cores in each round, the pipeline's times."""
    cores: dict[int, list[float]] = {0: [], 1: [], MANY: []}
    times: dict[int, list[float]] = {0: [], 1: [], MANY: []}
    for _ in range(rounds):
        for count in cores:
            used, found = await with_viewers(count, *page_of(service), seconds / rounds)
            cores[count].append(used)
            times[count] += found
    return cores, times


def share(values: list[float], q: float) -> float:
    return sorted(values)[int(q * (len(values) - 1))]


def goals(cores: dict[int, list[float]], times: dict[int, list[float]]) -> list[Goal]:
    """Ratios have gates. What nobody costs while nobody looks is the heartbeat."""
    many, none = (quantiles(times[count]) for count in (MANY, 0))
    middle = {count: share(used, 0.5) for count, used in cores.items()}
    return [
        Goal(f"pipeline's p99 with {MANY} viewers, over none", many["p99"] / none["p99"], at_most=RATIO),
        Goal(f"pipeline's p50 with {MANY} viewers, over none", many["p50"] / none["p50"], at_most=RATIO, gate=GATE),
        Goal("page's process without a viewer (cores)", middle[0], at_most=0.005),
        Goal("page's process with one viewer (cores)", middle[1], at_most=0.05),
        Goal(f"page's process with {MANY} viewers, over one", middle[MANY] / max(middle[1], 1e-3)),
    ]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="skin bench page", description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--seconds", type=real(), default=60.0, help="of each number of viewers, all rounds together")
    parser.add_argument("--rounds", type=whole(), default=5)
    parser.add_argument("--out", type=Path, default=REPORTS)
    args = parser.parse_args(argv)
    end_on_sigterm()
    with running_square("full", bridge="page") as service:
        BEGIN["moving"](service)
        cores, times = asyncio.run(run(service, args.seconds, args.rounds))
    table = Table("viewers", "page's process [cores]", "pipeline p50 [ms]", "p99 [ms]", "frames")
    for count, used in cores.items():
        told = (f"{share(times[count], q):.2f}" for q in (0.5, 0.99))
        table.add_row(str(count), f"{share(used, 0.5):.4f}", *told, str(len(times[count])))
    console, wanted = Console(width=150), goals(cores, times)
    console.print(table)
    console.print(_goals.table(wanted))
    rows = {f"{count} viewers": {"cores": cores[count], **quantiles(times[count])} for count in cores}
    report = {**provenance("page", argv), "targets": [goal.to_dict() for goal in wanted], "rows": rows}
    write_json(args.out / "page.json", report)
    print(f"wrote {args.out / 'page.json'}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
