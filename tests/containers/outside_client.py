"""A client outside the containers: contacts arrive at the board's rate, a press is seen, a killed container comes back.

Run beside `docker compose --profile demo up` with $EITSKIN_RUNTIME pointing at the folder of the sockets, and the names
of the bridges whose profiles are up too: [page] [ros2] [foxglove]. Plain pyzmq, msgpack and aiohttp,
as a stranger would write it. Exit 0 when all was seen; needs the right to kill a container's process.
"""

import asyncio
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

import aiohttp
import msgpack
import zmq

RUNTIME = os.environ["EITSKIN_RUNTIME"]
ENGINE = "docker" if subprocess.run(["docker", "info"], capture_output=True).returncode == 0 else "podman"
ROS_LISTENER = """
import rclpy
from eitskin_msgs.msg import ContactArray
rclpy.init()
node, valid = rclpy.create_node("stranger"), rclpy.Future()
hear = lambda m: valid.done() or m.valid and valid.set_result(m)
node.create_subscription(ContactArray, "/palm/contacts", hear, rclpy.qos.qos_profile_sensor_data)
rclpy.spin_until_future_complete(node, valid, timeout_sec=10)
raise SystemExit(not valid.done())
"""
KILLED = ("acquisition", "preprocessing", "inference", "publisher")


def receive(socket: zmq.Socket, timeout_s: float) -> dict | None:
    if not socket.poll(int(timeout_s * 1000)):
        return None
    message = socket.recv()
    return msgpack.unpackb(message[message.index(b"\0") + 1 :])


def collect(socket: zmq.Socket, seconds: float) -> list[dict]:
    end, frames = time.monotonic() + seconds, []
    while (left := end - time.monotonic()) > 0:
        frames.append(receive(socket, left))
    return [frame for frame in frames if frame]


def until(what: Callable[[], object], seconds: float, missing: str) -> float:
    """Seconds until it was so."""
    start, why = time.monotonic(), ""
    while time.monotonic() - start < seconds:
        try:
            if what():
                return time.monotonic() - start
        except (OSError, TimeoutError, TypeError, aiohttp.ClientError) as found:  # TypeError: a socket that closes
            why = f": {found!r}"
        time.sleep(0.02)
    sys.exit(f"{missing} within {seconds:g} s{why}")


def ask(process: str, command: str, timeout_ms: int, **args: object) -> bool:
    """Whether a process carried out a command: its control socket takes {command, args} as msgpack."""
    request = zmq.Context.instance().socket(zmq.REQ)
    request.setsockopt(zmq.LINGER, 0)
    request.connect(f"ipc://{RUNTIME}/{process}.ctl")
    request.send(msgpack.packb({"command": command, "args": args}))
    reply = msgpack.unpackb(request.recv()) if request.poll(timeout_ms) else {"ok": False}
    request.close()
    return bool(reply["ok"])


def kill(name: str) -> None:
    """SIGKILL the process of a container from outside, as a crash would."""
    found = subprocess.run([ENGINE, "ps", "--format", "{{.Names}}"], capture_output=True, text=True, check=True)
    (of,) = (n for n in found.stdout.split() if name in n)
    pid = subprocess.run([ENGINE, "inspect", "-f", "{{.State.Pid}}", of], capture_output=True, check=True).stdout
    os.kill(int(pid), signal.SIGKILL)


async def page_shows(base: str) -> bool:
    """Whether the page shows frames to who has its token, and to nobody else."""
    token = (Path(RUNTIME) / "page.token").read_text().strip()
    async with aiohttp.ClientSession(headers={"Origin": base}) as session:
        async with session.get(f"{base}/live?token=wrong") as refused:
            if refused.status != 403:
                sys.exit(f"the page without its token: found HTTP {refused.status}, expected 403")
        async with session.ws_connect(f"{base}/live?token={token}") as socket:
            await socket.send_json({"skin": "palm", "want": ["contact"]})
            async with asyncio.timeout(5):
                while msgpack.unpackb(await socket.receive_bytes())["kind"] != "frames":
                    pass
    return True


def works(bridge: str) -> bool:
    if bridge == "page":
        return asyncio.run(page_shows(f"http://127.0.0.1:{os.environ.get('EITSKIN_PAGE_PORT', '8080')}"))
    if bridge == "foxglove":
        try:
            urllib.request.urlopen("http://127.0.0.1:8765", timeout=2).close()
        except urllib.error.HTTPError as refused:
            return refused.code == 403  # its door asks for a token
    found = subprocess.run([ENGINE, "ps", "--format", "{{.Names}}"], capture_output=True, text=True, check=True)
    name = next((name for name in found.stdout.split() if "ros2" in name), "")
    hears = [ENGINE, "exec", name, "/opt/eitskin/.venv-ros/bin/python", "-c", ROS_LISTENER]
    return bool(name) and subprocess.run(hears, capture_output=True).returncode == 0


def main() -> None:
    if unknown := set(sys.argv[1:]) - {"page", "ros2", "foxglove"}:
        sys.exit(f"no bridge {', '.join(sorted(unknown))}: expected page, ros2 or foxglove")
    socket = zmq.Context.instance().socket(zmq.SUB)
    socket.setsockopt(zmq.CONFLATE, 1)
    socket.connect(f"ipc://{RUNTIME}/publisher.ipc")
    socket.subscribe(b"contact/palm\0")

    def until_valid(seconds: float) -> float:
        return until(lambda: (receive(socket, 0.2) or {}).get("valid"), seconds, "no valid contact frame")

    print(f"first valid frame after {until_valid(60):.1f} s")
    rate = len(collect(socket, 4)) / 4
    pressed = ask("stub", "press", 5000, x=0.02, y=-0.01, force=3.0, seconds=10.0)
    seen = [c for frame in collect(socket, 3) for c in frame["contacts"]]
    if not pressed or not seen:
        sys.exit("the press was not taken by the stub, or not seen")
    x, y, _ = seen[-1]["position"]
    print(f"{rate:.1f} frames/s; pressed at (20.0, -10.0) mm, seen at ({x * 1e3:.1f}, {y * 1e3:.1f}) mm")
    if rate < 15 or abs(x - 0.02) > 0.003 or abs(y + 0.01) > 0.003:
        sys.exit("rate below 15 frames/s or position off by more than 3 mm")
    for name in KILLED:
        session = collect(socket, 1)[-1]["session"]
        kill(name)
        collect(socket, 0.4)  # what was on its way
        print(f"{name} killed: valid frames again after {0.4 + until_valid(20):.1f} s")
        if name == "publisher" and (receive(socket, 2) or {"session": session})["session"] == session:
            sys.exit("the publisher came back with its old session")
    for name in sys.argv[1:]:
        until(lambda name=name: works(name), 30, f"{name} does not work")
        kill(name)
        time.sleep(0.3)
        again = until(lambda name=name: works(name), 30, f"{name} does not work again")
        print(f"{name} works; killed: works again after {0.3 + again:.1f} s")


if __name__ == "__main__":
    main()
