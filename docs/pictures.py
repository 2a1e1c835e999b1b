"""Pictures of the real page for docs/, made beside a service that runs: python docs/pictures.py ADDRESS

page.png, page-narrow.png, and page.webp: ten seconds of a press, a slide, two fingers, and a board that is unplugged.

The service must keep up while they are made: a machine with other work shows frames that are late, and grey.
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

DOCS = Path(__file__).resolve().parent
WEBGL = ["--use-angle=swiftshader-webgl", "--enable-unsafe-swiftshader"]  # drawn by software
ARGUMENTS = ["--no-sandbox", "--disable-gpu-compositing", *WEBGL]
SECONDS = 11.0
PRESS_S, SLIDE_S, TWO_S, UNPLUG_S, LIFT_S = 0.3, 1.5, 3.7, 5.7, 7.2  # what happens when in the film
LEAST_S = 0.045  # pictures that come sooner after one are left out
TRIES, TAKES = 40, 12
WIDE, NARROW, FILM = (1360, 1130), (390, 844), (1320, 620)
PLACE = "([x, y]) => { const p = new DOMPoint(x, -y).matrixTransform(overlay.getScreenCTM()); return [p.x, p.y]; }"


class Hand:
    """Fingers on the map, in millimetres of the skin."""

    def __init__(self, page: Any) -> None:
        self._page, self._session = page, page.context.new_cdp_session(page)
        self._down = 0

    def at(self, *places: tuple[float, float]) -> None:
        points = [dict(zip("xy", self._page.evaluate(PLACE, list(p)), strict=True), id=n) for n, p in enumerate(places)]
        if not points and not self._down:
            return
        kind = "touchStart" if len(points) > self._down else "touchMove" if points else "touchEnd"
        self._session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        self._down = len(points)


def opened(browser: Any, address: str, size: tuple[int, int], **options: Any) -> Any:
    context = browser.new_context(viewport=dict(zip(("width", "height"), size, strict=True)), has_touch=True, **options)
    page = context.new_page()
    page.goto(address)
    page.wait_for_selector("#overlay .outline", state="attached")
    page.wait_for_selector("body[data-trust=yes]")
    # Nothing fades: a surface that is drawn by software is not there meanwhile, and a picture is of one moment.
    page.evaluate("document.styleSheets[0].insertRule('* { transition: none !important; }')")
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


def story(seconds: float) -> list[tuple[float, float]]:
    """Where fingers are: one presses, slides, is joined by a second; both are lifted while the board is unplugged."""
    if seconds < PRESS_S or seconds > LIFT_S:
        return []
    along = min(max(seconds - SLIDE_S, 0.0) / (TWO_S - SLIDE_S), 1.0)
    first = (-28 + 56 * along, -16 + 10 * math.sin(math.pi * along))
    return [first, (-20.0, 24.0)] if seconds > TWO_S else [first]


Painted = list[tuple[float, bytes]]  # when [s], JPEG


def take(page: Any) -> tuple[int, Painted]:
    """One film, and how often it was seen before the unplugging that frames are late: of this machine, not the page."""
    painted: Painted = []
    late = 0
    session, hand = page.context.new_cdp_session(page), Hand(page)

    def keep(event: dict[str, Any]) -> None:
        if not painted or event["metadata"]["timestamp"] - painted[-1][0] > LEAST_S:
            painted.append((event["metadata"]["timestamp"], base64.b64decode(event["data"])))
        session.send("Page.screencastFrameAck", {"sessionId": event["sessionId"]})

    session.on("Page.screencastFrame", keep)
    session.send("Page.startScreencast", {"format": "jpeg", "quality": 92})
    began, unplugged = time.monotonic(), False
    while (now := time.monotonic() - began) < SECONDS:
        hand.at(*story(now))
        late += now < UNPLUG_S and page.evaluate("document.body.dataset.trust") != "yes"
        if now > UNPLUG_S and not unplugged:
            unplugged = True
            page.evaluate("document.querySelector('[data-fault=unplug]').click()")
        page.wait_for_timeout(50)
    session.send("Page.stopScreencast")
    page.wait_for_timeout(500)  # what was on its way has come
    hand.at()
    session.detach()
    return late, painted


def film(page: Any, file: str) -> str:
    """The first take in which the machine kept up, or the best one; each picture is shown as long as it was there."""
    takes: list[tuple[int, Painted]] = []
    while len(takes) < TAKES and not any(late == 0 for late, _ in takes):
        page.wait_for_timeout(4000)
        takes.append(take(page))
    late, painted = min(takes, key=lambda each: each[0])
    times = [at for at, _ in painted]
    lasts = [round(1e3 * (b - a)) for a, b in zip(times, times[1:], strict=False)] + [500]
    size = (FILM[0] * 3 // 4, FILM[1] * 3 // 4)
    first, *others = [Image.open(io.BytesIO(drawn)).convert("RGB").resize(size) for _, drawn in painted]
    first.save(DOCS / file, save_all=True, append_images=others, duration=lasts, loop=0, quality=70, method=4)
    return f"{len(painted)} pictures in {sum(lasts) / 1e3:.1f} s, late ones {late}, take {len(takes)}"


def main(address: str) -> None:
    with sync_playwright() as found, found.chromium.launch(executable_path="/usr/bin/chromium", args=ARGUMENTS) as one:
        picture(opened(one, address, WIDE), "page.png", (20.0, -10.0), (-22.0, 22.0))
        narrow = {"is_mobile": True, "color_scheme": "dark", "device_scale_factor": 1.5}
        picture(opened(one, address, NARROW, **narrow), "page-narrow.png", (15.0, 10.0))
        print("page.webp:", film(opened(one, address, FILM), "page.webp"))


if __name__ == "__main__":
    main(sys.argv[1])
