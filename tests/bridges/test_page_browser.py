"""The page in a real browser beside the whole service: Debian's chromium, without a screen, driven by playwright."""

import math
import re
import shutil
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from protocol.control import ControlClient
from protocol.frames import unpack
from services.recordings.recording import RecordingReader
from tests import needs
from tests.waiting import WAIT_S, until

pytestmark = [pytest.mark.live, pytest.mark.release]

FLAT = ["--no-sandbox", "--disable-gpu", "--disable-3d-apis"]
SOLID = ["--no-sandbox", "--disable-gpu-compositing", "--use-angle=swiftshader-webgl", "--enable-unsafe-swiftshader"]
Open = Callable[..., Any]


@pytest.fixture(scope="module")
def browsers() -> Iterator[dict[bool, Any]]:
    """Without the surface, and with it."""
    needs.CHROMIUM.here()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as found:
        launch = partial(found.chromium.launch, executable_path=shutil.which(needs.BROWSER))
        with launch(args=FLAT) as flat, launch(args=SOLID) as solid:
            yield {False: flat, True: solid}


@pytest.fixture
def page(browsers: dict[bool, Any], shared_service: Path) -> Iterator[Open]:
    """Opens pages; a test fails where the browser complains, or asks anybody else for anything."""
    ControlClient("stub", WAIT_S).call("release")
    ControlClient("stub", WAIT_S).call("faults", clear=True)
    address = until(lambda: re.search(r"http://\S+/#\S+", (shared_service / "log.txt").read_text()))[0]
    own, wrong, opened_pages = address.split("/#")[0], list[str](), []

    def opened(solid: bool = False) -> Any:
        found = browsers[solid].new_page(viewport={"width": 1280, "height": 900})
        opened_pages.append(found)
        found.set_default_timeout(1e3 * WAIT_S)
        found.on("console", lambda said: said.type == "error" and wrong.append(said.text))
        found.on("pageerror", lambda error: wrong.append(str(error)))
        found.on("request", lambda request: request.url.startswith((own, "data:")) or wrong.append(request.url))
        found.on("websocket", lambda to: to.url.startswith(own.replace("http", "ws")) or wrong.append(to.url))
        found.goto(address)
        found.wait_for_selector("#overlay .outline", state="attached")
        found.wait_for_selector("body[data-trust=yes]")
        return found

    yield opened
    for each in opened_pages:
        each.context.close()
    assert not wrong, wrong


def place(page: Any, x_mm: float, y_mm: float) -> Any:
    """Where a place of the skin is on the screen."""
    ask = "([x, y]) => { const p = new DOMPoint(x, -y).matrixTransform(overlay.getScreenCTM()); return [p.x, p.y]; }"
    return page.evaluate(ask, [x_mm, y_mm])


def marks(page: Any, selector: str) -> list[list[float]]:
    """x, y [mm] of what is drawn on the map."""
    return page.locator(f"#overlay {selector}").evaluate_all("found => found.map(g => [+g.dataset.x, +g.dataset.y])")


def press(page: Any, x_mm: float, y_mm: float) -> None:
    """Press by mouse, until the contact is on the map, within 3 mm of the one true touch, which is there."""
    page.mouse.move(*place(page, x_mm, y_mm))
    page.mouse.down()

    def near(selector: str, most: float) -> bool:
        return [math.dist(at, (x_mm, y_mm)) < most for at in marks(page, selector)] == [True]

    until(lambda: near(".contact", 3) and near(".truth g", 1))


def nothing_touches(page: Any) -> bool:
    return not marks(page, ".contact") and not marks(page, ".truth g")


def says(page: Any, selector: str, pattern: str) -> Any:
    """Waits until an element's text has this in it."""
    return until(lambda: re.search(pattern, page.inner_text(selector)))


def test_a_press_by_mouse_is_seen_where_it_is_and_by_both_methods(page: Open) -> None:
    found = page()
    drawn = """id => { const c = document.getElementById(id);
        return c.getContext("2d").getImageData(0, 0, c.width, c.height).data.some(v => v > 0); }"""
    press(found, 20, -10)
    says(found, "#contacts", r"[23]\.\d\d N ± 0\.\d\d")
    until(lambda: all(found.evaluate(drawn, side) for side in ("one-step", "network")))
    found.mouse.up()
    until(lambda: nothing_touches(found))
    until(lambda: not any(found.evaluate(drawn, side) for side in ("one-step", "network")))


def test_unplugged_under_a_finger_it_greys_and_the_cause_stands_first(page: Open) -> None:
    """The last frame before it was of a touch that moved: that it was changing is no cause."""
    found = page()
    press(found, -20, 0)
    found.evaluate("document.querySelector('[data-fault=unplug]').click()")
    found.mouse.move(*place(found, 20, 0), steps=10)
    until(lambda: found.inner_text("#trust-title") == "No board")
    until(lambda: found.evaluate("getComputedStyle(map).filter") == "grayscale(1)")
    assert "the cable is out" in found.inner_text("#trust-reasons")
    assert "changing" not in found.inner_text("#banner")
    found.mouse.up()
    found.wait_for_selector("body[data-trust=yes]")
    until(lambda: found.evaluate("getComputedStyle(map).filter") == "none")


def test_the_surface_is_pressed_in_and_a_dead_electrode_is_named_with_what_to_do(page: Open) -> None:
    without, found = page(), page(solid=True)
    assert without.is_hidden("#surface-panel") and "WebGL 2" in without.inner_text("#surface-why")

    def surface(function: str) -> Any:
        return found.evaluate(f"async () => ({function})((await import('/main.js')).surface)")

    press(found, 20, -10)
    heights = "s => [s.height([0.02 / s.half, -0.01 / s.half]), s.height([-0.02 / s.half, 0.02 / s.half])]"
    until(lambda: (at := surface(heights))[0] < -0.05 and at[0] < 3 * at[1])
    says(found, "#surface .force", r"\d N")
    found.mouse.up()
    found.click("text=Dead electrode")
    until(lambda: found.locator("#surface .fault").all_inner_texts() == ["5 ×"])
    found.wait_for_selector("#overlay .electrodes g[data-name=open]")
    says(found, "#banner", "electrode open")
    assert "Look at the wire" in found.inner_text("#banner")
    says(found, "#fault-said", "electrode 5: open, after")
    found.click("text=All well again")
    until(lambda: "electrode" not in found.inner_text("#banner") and found.locator("#surface .fault").count() == 0)


def test_a_snapshot_a_recording_and_its_replay(page: Open) -> None:
    found = page()
    says(found, "#recorder", r"the last \d+ s are kept")
    found.click("#record")
    press(found, 15, 15)
    time.sleep(1.5)  # of it are recorded
    found.mouse.up()
    found.click("#record")
    last = Path(says(found, "#said", r"Recorded (\S+\.mcap)")[1])
    until(lambda: nothing_touches(found))
    found.click("#snapshot")
    made = Path(until(lambda: found.inner_text("#said").partition("Snapshot: ")[2]))
    says(found, "#recorder", "are kept")
    try:
        for path in (last, made):
            frames = [unpack(message.wire) for message in RecordingReader(path).messages({"contact"})]
            touched = [c.position[:2] for frame in frames for c in frame.contacts]
            assert any(math.dist(at, (0.015, 0.015)) < 0.003 for at in touched), path
        found.click("#recordings summary")
        until(lambda: found.input_value("#file"))
        found.select_option("#file", last.name)
        found.click("#play")
        until(lambda: found.is_disabled("#tare") and found.is_disabled("#record"))  # of a skin, not of it
        until(lambda: any(abs(x - 15) < 3 for x, _ in marks(found, ".contact")))
        assert not marks(found, ".truth g")  # nobody knows it now
        says(found, "#trust-title", "The recording is over")
        says(found, "#trust-title", "^Live")
    finally:
        last.unlink()
        made.unlink()
