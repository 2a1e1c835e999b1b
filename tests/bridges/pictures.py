"""Pictures of the real page for docs/, made beside a service that runs: python -m tests.bridges.pictures ADDRESS

page.png, page-narrow.png, and page.webp: ten seconds of a finger, two fingers, and a dead electrode.
"""

from __future__ import annotations

import base64
import io
import math
import sys
import time
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import sync_playwright

DOCS = Path(__file__).resolve().parents[2] / "docs"
WEBGL = ["--use-angle=swiftshader-webgl", "--enable-unsafe-swiftshader"]  # drawn by software
ARGUMENTS = ["--no-sandbox", "--disable-gpu-compositing", *WEBGL]
SECONDS = 10.0
TWO_S, FAULT_S = 3.5, 6.5  # when the second finger comes, when the electrode dies
TRIES = 40
WIDE, NARROW, FILM = (1360, 1060), (390, 844), (1000, 640)
PLACE = "([x, y]) => { const p = new DOMPoint(x, -y).matrixTransform(overlay.getScreenCTM()); return [p.x, p.y]; }"


class Hand:
    """Fingers on the map, in millimetres of the skin."""

    def __init__(self, page: Any) -> None:
        self._page, self._session = page, page.context.new_cdp_session(page)
        self._down = 0

    def at(self, *places: tuple[float, float]) -> None:
        points = [dict(zip("xy", self._page.evaluate(PLACE, list(p)), strict=True), id=n) for n, p in enumerate(places)]
        kind = "touchMove" if len(points) == self._down else "touchStart" if len(points) > self._down else "touchEnd"
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        self._down = len(points)


def opened(browser: Any, address: str, size: tuple[int, int], **options: Any) -> Any:
    context = browser.new_context(viewport=dict(zip(("width", "height"), size, strict=True)), has_touch=True, **options)
    page = context.new_page()
    page.goto(address)
    page.wait_for_selector("#overlay .outline", state="attached")
    page.wait_for_selector("body[data-trust=yes]")
    page.wait_for_timeout(1500)
    return page


def picture(page: Any, file: str, *fingers: tuple[float, float]) -> None:
    """Taken once the fingers are seen and the data to be trusted: taking it holds up a page drawn by software."""
    hand = Hand(page)
    hand.at(*fingers)
    page.wait_for_timeout(4000)
    ratio = page.evaluate("devicePixelRatio")
    box = page.locator("#banner").bounding_box()
    for _ in range(TRIES):
        image = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        red, green, _ = image.getpixel((int((box["x"] + box["width"] - 20) * ratio), int((box["y"] + 8) * ratio)))  # type: ignore[misc]
        if green > red:
            break
        page.wait_for_timeout(300)
    hand.at()
    image.save(DOCS / file, optimize=True)


def film(page: Any, file: str) -> int:
    """How many frames it got."""
    frames: list[tuple[float, Image.Image]] = []
    session, hand = page.context.new_cdp_session(page), Hand(page)

    def frame(event: dict[str, Any]) -> None:
        frames.append((event["metadata"]["timestamp"], Image.open(io.BytesIO(base64.b64decode(event["data"])))))
        session.send("Page.screencastFrameAck", {"sessionId": event["sessionId"]})

    session.on("Page.screencastFrame", frame)
    session.send("Page.startScreencast", {"format": "jpeg", "quality": 90})
    began, faulted = time.monotonic(), False
    while (now := time.monotonic() - began) < SECONDS:
        first = (26 * math.cos(0.8 * now), 20 * math.sin(0.8 * now))
        hand.at(first, (-25.0, 25.0)) if TWO_S < now < FAULT_S else hand.at(first)
        if now > FAULT_S and not faulted:
            faulted = True
            page.evaluate("document.querySelector('[data-fault=electrode_open]').click()")
        page.wait_for_timeout(60)
    session.send("Page.stopScreencast")
    hand.at()
    page.evaluate("document.querySelector('[data-fault=clear]').click()")
    lasts = [max(20, int(1e3 * (b[0] - a[0]))) for a, b in zip(frames, frames[1:], strict=False)] + [500]
    first, *others = [image.convert("RGB") for _, image in frames]
    first.save(DOCS / file, save_all=True, append_images=others, duration=lasts, loop=0, quality=60, method=4)
    return len(frames)


def main(address: str) -> None:
    with sync_playwright() as found, found.chromium.launch(executable_path="/usr/bin/chromium", args=ARGUMENTS) as one:
        picture(opened(one, address, WIDE), "page.png", (20.0, -10.0), (-22.0, 22.0))
        narrow = {"is_mobile": True, "color_scheme": "dark", "device_scale_factor": 1.5}
        picture(opened(one, address, NARROW, **narrow), "page-narrow.png", (15.0, 10.0))
        print(film(opened(one, address, FILM), "page.webp"), "frames in the film")


if __name__ == "__main__":
    main(sys.argv[1])
