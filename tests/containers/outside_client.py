"""A client outside the containers: contacts arrive at the board's rate, a press is seen, a killed container comes back.

Run beside `docker compose --profile demo up` with $EITSKIN_RUNTIME pointing at the folder of the sockets:

    python tests/containers/outside_client.py [page] [ros2] [foxglove]

which names the bridges whose profiles are up too: they are looked at and killed as well. Plain pyzmq, msgpack and
aiohttp, as a stranger would write it. Exit 0 when all was seen; needs the right to kill a container's process.
"""

import asyncio
import os
import shutil
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import aiohttp
import msgpack
import zmq

RUNTIME = os.environ["EITSKIN_RUNTIME"]
ENGINE = "docker" if subprocess.run(["docker", "info"], capture_output=True).returncode == 0 else "podman"
KILLED = ("acquisition", "preprocessing", "inference", "publisher")


def contacts() -> zmq.Socket:
    socket = zmq.Context.instance().socket(zmq.SUB)
    socket.setsockopt(zmq.CONFLATE, 1)
    socket.connect(f"ipc://{RUNTIME}/publisher.ipc")
    socket.subscribe(b"contact/palm\0")
    return socket


def receive(socket: zmq.Socket, timeout_s: float) -> dict | None:
    if not socket.poll(int(timeout_s * 1000)):
        return None
    message = socket.recv()
    return msgpack.unpackb(message[message.index(b"\0") + 1 :])


def collect(socket: zmq.Socket, seconds: float) -> list[dict]:
    end, frames = time.monotonic() + seconds, []
    while time.monotonic() < end:
        frame = receive(socket, max(0.01, end - time.monotonic()))
        if frame:
            frames.append(frame)
    return frames


def until_valid(socket: zmq.Socket, timeout_s: float) -> float:
    """Seconds until a valid frame came."""
    start = time.monotonic()
    while time.monotonic() - start < timeout_s:
        frame = receive(socket, 0.2)
        if frame and frame["valid"]:
            return time.monotonic() - start
    sys.exit(f"no valid contact frame within {timeout_s:.0f} s")


def press() -> None:
    """The stub's control socket takes {command, args} as msgpack."""
    request = zmq.Context.instance().socket(zmq.REQ)
    request.setsockopt(zmq.LINGER, 0)
    request.connect(f"ipc://{RUNTIME}/stub.ctl")
    request.send(msgpack.packb({"command": "press", "args": {"x": 0.02, "y": -0.01, "force": 3.0, "seconds": 10.0}}))
    if not request.poll(5000):
        sys.exit("the stub did not answer the press")
    reply = msgpack.unpackb(request.recv())
    if not reply["ok"]:
        sys.exit(f"the stub refused the press: {reply}")


def kill(name: str) -> None:
    """SIGKILL the process of a container from outside, as a crash would."""
    found = subprocess.run([ENGINE, "ps", "--format", "{{.Names}}"], capture_output=True, text=True, check=True)
    names = [n for n in found.stdout.split() if name in n]
    if len(names) != 1:
        sys.exit(f"expected one container of {name}, found {names}")
    pid = subprocess.run([ENGINE, "inspect", "-f", "{{.State.Pid}}", names[0]], capture_output=True, check=True).stdout
    os.kill(int(pid), signal.SIGKILL)


async def page_shows(base: str) -> bool:
    """Whether the page shows frames to who has its token, and to nobody else."""
    token = (Path(RUNTIME) / "page.token").read_text().strip()
    async with aiohttp.ClientSession(headers={"Origin": base}) as session:
        for query in ("", "?token=wrong"):
            async with session.get(f"{base}/live{query}") as refused:
                if refused.status != 403:
                    sys.exit(f"the page without its token: found HTTP {refused.status}, expected 403")
        async with session.ws_connect(f"{base}/live?token={token}") as socket:
            await socket.send_json({"skin": "palm", "want": ["contact"]})
            async with asyncio.timeout(5):
                while msgpack.unpackb(await socket.receive_bytes())["kind"] != "frames":
                    pass
    return True


def status_of(address: str) -> int:
    try:
        with urllib.request.urlopen(address, timeout=2) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as refused:
        return refused.code


def heartbeat(name: str) -> bool:
    """Whether a process answers the command `status`."""
    request = zmq.Context.instance().socket(zmq.REQ)
    request.setsockopt(zmq.LINGER, 0)
    request.connect(f"ipc://{RUNTIME}/{name}.ctl")
    request.send(msgpack.packb({"command": "status", "args": {"skin": "palm"}}))
    answered = bool(request.poll(1000)) and msgpack.unpackb(request.recv())["ok"]
    request.close()
    return answered


def works(bridge: str) -> bool:
    if bridge == "page":
        base = f"http://127.0.0.1:{os.environ.get('EITSKIN_PAGE_PORT', '8080')}"
        return status_of(base) == 200 and asyncio.run(page_shows(base))
    if bridge == "foxglove":
        return status_of("http://127.0.0.1:8765") == 403  # its door asks for a token
    return heartbeat(bridge)


def until_works(bridge: str) -> float:
    """Seconds until a bridge does what it is for."""
    start, why = time.monotonic(), ""
    while time.monotonic() - start < 30:
        try:
            if works(bridge):
                return time.monotonic() - start
        except (OSError, TimeoutError, TypeError, aiohttp.ClientError) as found:  # TypeError: it closes
            why = f": {type(found).__name__}: {found}"
        time.sleep(0.1)
    sys.exit(f"{bridge} does not work within 30 s{why}")


def main() -> None:
    if unknown := set(sys.argv[1:]) - {"page", "ros2", "foxglove"}:
        sys.exit(f"no bridge {', '.join(sorted(unknown))}: expected page, ros2, foxglove")
    if not shutil.which(ENGINE):
        sys.exit("neither docker nor podman found: run this beside a running compose project")
    socket = contacts()
    print(f"first valid frame after {until_valid(socket, 60):.1f} s")
    rate = len(collect(socket, 4)) / 4
    print(f"untouched: {rate:.1f} frames/s")
    press()
    seen = [c for frame in collect(socket, 3) for c in frame["contacts"]]
    if not seen:
        sys.exit("the press was not seen")
    x, y, _ = seen[-1]["position"]
    force = seen[-1]["force_n"]
    print(f"pressed at (20.0, -10.0) mm with 3 N, seen at ({x * 1e3:.1f}, {y * 1e3:.1f}) mm with {force:.2f} N")
    if rate < 15 or abs(x - 0.02) > 0.003 or abs(y + 0.01) > 0.003:
        sys.exit("rate below 15 frames/s or position off by more than 3 mm")
    for name in KILLED:
        session = collect(socket, 1)[-1]["session"]
        kill(name)
        time.sleep(0.3)
        collect(socket, 0.1)
        back = until_valid(socket, 20)
        again = receive(socket, 2)
        new = bool(again) and again["session"] != session
        print(f"{name} killed: valid frames again after {0.4 + back:.1f} s" + (", new session" if new else ""))
        if name == "publisher" and not new:
            sys.exit("the publisher came back with its old session")
    for name in sys.argv[1:]:
        until_works(name)
        kill(name)
        time.sleep(0.3)
        print(f"{name} works; killed: works again after {0.3 + until_works(name):.1f} s")


if __name__ == "__main__":
    main()
