"""The page in a real browser beside the whole service: Debian's chromium, without a screen, driven by playwright.

EITSKIN_CHROMIUM names another one.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from protocol.control import ControlClient
from protocol.frames import unpack
from services.recordings.recording import RecordingReader
from tests import needs

pytestmark = [pytest.mark.live, pytest.mark.release]

ROOT = Path(__file__).resolve().parents[2]
VECTORS = ROOT / "protocol" / "vectors"
WAIT_MS = 30_000
# No sandbox: CI is root in a container. Without WebGL, but where a test wants it: software draws it then.
FLAT = ["--no-sandbox", "--disable-gpu", "--disable-3d-apis"]
SOLID = ["--no-sandbox", "--disable-gpu-compositing", "--use-angle=swiftshader-webgl", "--enable-unsafe-swiftshader"]
TRUST_CHANGES = """() => {
  window.changes = [];
  const { body } = document;
  const seen = () => changes.push([body.dataset.trust, performance.now()]);
  new MutationObserver(seen).observe(body, { attributeFilter: ["data-trust"] });
}"""


@pytest.fixture(scope="module")
def chromium() -> str:
    needs.CHROMIUM.here()
    return str(shutil.which(needs.CHROMIUM.programs[0]))


@pytest.fixture(scope="module")
def address(shared_service: Path) -> str:
    """Of the page that `skin up` has started, as it printed it."""
    end = time.monotonic() + 60
    while not (found := re.search(r"http://\S+/#\S+", (shared_service / "log.txt").read_text())):
        assert time.monotonic() < end, (shared_service / "log.txt").read_text()
        time.sleep(0.1)
    return found[0]


Open = Callable[..., Any]


@pytest.fixture(scope="module")
def launch(chromium: str) -> Iterator[Callable[..., Any]]:
    """Starts a browser with these arguments."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as found:
        yield lambda args: found.chromium.launch(executable_path=chromium, args=args)


@pytest.fixture(scope="module")
def browser(launch: Callable[..., Any]) -> Iterator[Any]:
    with launch(FLAT) as one:
        yield one


@pytest.fixture(scope="module")
def solid_browser(launch: Callable[..., Any]) -> Iterator[Any]:
    with launch(SOLID) as one:
        yield one


@pytest.fixture
def page(browser: Any, address: str) -> Iterator[Open]:
    """Opens the page, with the flat map alone."""
    with opening(browser, address) as opened:
        yield opened


@pytest.fixture
def solid(solid_browser: Any, address: str) -> Iterator[Open]:
    """Opens the page, with the surface."""
    with opening(solid_browser, address) as opened:
        yield opened


@contextmanager
def opening(browser: Any, address: str) -> Iterator[Open]:
    """Opens pages; a test fails where the browser complains, or asks anybody else for anything."""
    wrong: list[str] = []
    contexts = []
    own = address.split("/#")[0]

    def opened(width: int = 1280, height: int = 900, to: str = address, **options: Any) -> Any:
        context = browser.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        found = context.new_page()
        found.set_default_timeout(WAIT_MS)
        found.on("console", lambda said: said.type == "error" and wrong.append(said.text))
        found.on("pageerror", lambda error: wrong.append(str(error)))
        found.on("request", lambda request: request.url.startswith((own, "data:")) or wrong.append(request.url))
        sockets = own.replace("http", "ws")
        found.on("websocket", lambda socket: socket.url.startswith(sockets) or wrong.append(socket.url))
        found.goto(to)
        found.wait_for_selector("#overlay .outline", state="attached")
        found.wait_for_selector("body[data-trust=yes]")
        return found

    yield opened
    for context in contexts:
        context.close()
    assert not wrong, wrong


def place(page: Any, x_mm: float, y_mm: float) -> tuple[float, float]:
    """Where a place of the skin is on the screen."""
    ask = "([x, y]) => { const p = new DOMPoint(x, -y).matrixTransform(overlay.getScreenCTM()); return [p.x, p.y]; }"
    x, y = page.evaluate(ask, [x_mm, y_mm])
    return x, y


def marks(page: Any, selector: str) -> list[dict[str, float]]:
    """x, y [mm] and force [N] of what is drawn on the map."""
    ask = "found => found.map(g => ({x: +g.dataset.x, y: +g.dataset.y, force: +g.dataset.force}))"
    return page.locator(selector).evaluate_all(ask)  # type: ignore[no-any-return]


def until(true: Callable[[], Any], seconds: float = WAIT_MS / 1e3) -> Any:
    end = time.monotonic() + seconds
    while not (found := true()):
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.1)
    return found


def apart_mm(page: Any) -> float | None:
    """From the one contact on the page to the one true touch on it; None while there is no such pair."""
    found, true = marks(page, "#overlay .contact"), marks(page, "#overlay .truth g")
    if len(found) != 1 or len(true) != 1:
        return None
    return float(((found[0]["x"] - true[0]["x"]) ** 2 + (found[0]["y"] - true[0]["y"]) ** 2) ** 0.5)


def true_at(page: Any, x: float, y: float) -> bool:
    """Whether the one true touch is there, within half a millimetre."""
    true = marks(page, "#overlay .truth g")
    return len(true) == 1 and abs(true[0]["x"] - x) < 0.5 and abs(true[0]["y"] - y) < 0.5


def nothing_touches(page: Any) -> bool:
    return not marks(page, "#overlay .contact") and not marks(page, "#overlay .truth g")


@pytest.mark.parametrize(("x", "y"), [(20, -10), (-25, 25)])
def test_a_press_is_seen_where_it_is(page: Open, x: float, y: float) -> None:
    found = page()
    found.mouse.move(*place(found, x, y))
    found.mouse.down()
    until(lambda: (apart := apart_mm(found)) is not None and apart < 3)
    until(lambda: true_at(found, x, y))
    until(
        lambda: [true["force"] for true in marks(found, "#overlay .truth g")] == pytest.approx([3])
    )  # it grew while it was held
    until(lambda: re.search(r"[23]\.\d\d N ± 0\.\d\d", found.inner_text("#contacts")))
    found.mouse.move(*place(found, x + 10, y))
    until(lambda: true_at(found, x + 10, y))
    found.mouse.up()
    until(lambda: nothing_touches(found))


@pytest.mark.parametrize("screen", [(1280, 900), (390, 844)])
def test_the_map_stays_under_the_finger_however_much_the_banner_says(page: Open, screen: tuple[int, int]) -> None:
    ask = """() => {
      const at = () => JSON.stringify(map.getBoundingClientRect()), before = at();
      const said = document.getElementById("trust-reasons");
      said.textContent = "what is the matter at length ".repeat(20);
      return [before, at(), said.getBoundingClientRect().height];
    }"""
    before, after, height = page(*screen).evaluate(ask)
    assert before == after
    assert height > 60  # all of it is there to be read


def test_several_fingers_press_at_once_on_a_narrow_screen(page: Open) -> None:
    found = page(390, 844, has_touch=True, is_mobile=True)
    assert found.evaluate("document.documentElement.scrollWidth") <= 390
    found.locator("#map").scroll_into_view_if_needed()
    hand = found.context.new_cdp_session(found)
    fingers = [dict(zip("xy", place(found, x, 0), strict=True), id=n) for n, x in enumerate((-25, 25))]
    hand.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": fingers})
    until(lambda: len(marks(found, "#overlay .contact")) == 2)
    hand.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(lambda: nothing_touches(found))


def test_by_keyboard_alone(page: Open) -> None:
    found = page()
    found.keyboard.press("Tab")
    found.keyboard.press("Enter")  # to the skin
    for _ in range(30):
        if found.evaluate("document.activeElement.id") == "map":
            break
        found.keyboard.press("Tab")
    else:
        raise AssertionError("Tab does not reach the map")
    for _ in range(5):
        found.keyboard.press("ArrowLeft")
    found.keyboard.press("+")
    assert found.inner_text("#force-out") == "3.5 N"
    found.keyboard.down(" ")
    until(lambda: (apart := apart_mm(found)) is not None and apart < 3)
    until(lambda: true_at(found, -10, 0))
    until(lambda: "contact" in found.inner_text("#summary"))  # what a screen reader says
    found.keyboard.up(" ")
    until(lambda: nothing_touches(found))


def test_a_fault_is_named_with_what_to_do(page: Open) -> None:
    found = page()
    found.click("text=Dead electrode")
    found.wait_for_selector("#overlay .electrodes g[data-name=open]")
    until(lambda: "electrode open" in found.inner_text("#banner"))
    assert "Look at the wire" in found.inner_text("#banner")
    assert found.text_content("#overlay .electrodes g[data-name=open] .sign") == "×"
    found.click("text=All well again")
    until(lambda: "electrode" not in found.inner_text("#banner"))
    found.click("text=Unplug")
    found.wait_for_selector("body[data-trust=no]")
    until(lambda: found.evaluate("getComputedStyle(map).filter") == "grayscale(1)")
    until(lambda: "s old" in found.inner_text("#banner"))
    found.wait_for_selector("body[data-trust=yes]")


def test_the_cause_stands_first_while_the_board_is_unplugged_under_a_finger(page: Open) -> None:
    """The last frame before it was of a touch that moved: that it was changing is no cause."""
    found = page()
    found.mouse.move(*place(found, -20, 0))
    found.mouse.down()
    until(lambda: true_at(found, -20, 0))
    found.evaluate("document.querySelector('[data-fault=unplug]').click()")
    found.mouse.move(*place(found, 20, 0), steps=10)
    until(lambda: found.inner_text("#trust-title") == "No board")
    assert "the cable is out" in found.inner_text("#trust-reasons")
    banner = found.inner_text("#banner")
    assert not {*"{}[]_"} & {*banner}, banner  # as a program prints its values
    assert "changing" not in banner
    assert "not known" in found.inner_text("#contacts-panel") or marks(found, "#overlay .contact")
    until(lambda: "no board, after" in found.inner_text("#fault-said"))
    found.mouse.up()
    found.wait_for_selector("body[data-trust=yes]")
    until(lambda: re.search(r"that is over.* for [1-9]\d*\.\d s", found.inner_text("#fault-said")))


CABLE = "/dev/ttyACM0 is not there: plug the board in, or correct `port` in skin.toml"


@pytest.mark.parametrize(
    ("age_s", "reasons", "acquisition", "title", "said"),
    [
        (2.0, ["changing"], CABLE, "No board", f"acquisition: {CABLE}."),
        (2.0, ["changing"], "", "The newest contacts are 2.0 s old", ""),
        (0.0, ["changing", "electrode_open"], "", "Electrode open: not to be acted on", ""),
        (0.0, ["changing"], "", "Changing: not to be acted on", ""),
    ],
)
def test_the_banner_names_the_cause_before_what_follows_from_it(
    page: Open, age_s: float, reasons: list[str], acquisition: str, title: str, said: str
) -> None:
    ask = """async ([ageS, reasons, acquisition]) => {
      const { judge } = await import("/trust.js");
      const status = (process, level, messages) =>
        [process, { frame: { process, level, messages, host: "x", valid_for_s: 3 }, heard: performance.now() }];
      const statuses = new Map([status("publisher", "STALE", ["no image/palm for 1 s"]),
        status("acquisition", acquisition ? "ERROR" : "OK", acquisition ? [acquisition] : [])]);
      if (!acquisition) statuses.delete("publisher");
      const frame = { reasons, valid: false, valid_for_s: 0.25 };
      return judge({ connected: true, clock: { known: true, now: () => 9000 }, statuses, recent: [], drawMs: 30,
        contact: { frame, measured: (9000 - 1e3 * ageS) * 1e6 }, hello: { host: "y", reasons: {}, advice: {} } });
    }"""
    verdict = page().evaluate(ask, [age_s, reasons, acquisition])
    assert (verdict["ok"], verdict["title"], verdict["said"]) == (False, title, said)
    named = [reason["name"] for reason in verdict["reasons"]]
    assert named == ([] if age_s else reasons[::-1])  # those of an old frame are no cause


def test_what_a_fault_did_is_said_at_its_button_and_over_the_surface(page: Open) -> None:
    found = page()
    found.click("text=Dead electrode")
    until(lambda: found.text_content("#trouble") == "electrode 5: open")
    until(lambda: "electrode 5: open, after" in found.inner_text("#fault-said"))
    assert found.get_attribute("[data-fault=electrode_open]", "data-on") is not None
    found.click("text=All well again")
    until(lambda: found.text_content("#trouble") == "")
    found.click("text=Gain step")
    until(lambda: "gain, after" in found.inner_text("#fault-said"))
    until(lambda: "gain step" in (found.text_content("#trouble") or ""))
    time.sleep(1)  # the one frame that said so is long gone
    assert "the board's gain stepped" in found.inner_text("#banner")
    found.click("text=All well again")


def test_a_fault_that_somebody_else_asked_for_is_said_there_too(page: Open, shared_service: Path) -> None:
    found = page()
    ControlClient("stub").call("fault", skin="palm", name="electrodes_swapped", args={"electrodes": [2, 3]}, seconds=3)
    until(lambda: "the wires of electrodes 2 and 3 are exchanged" in found.inner_text("#fault-said"))
    until(lambda: found.inner_text("#fault-said") == "")


def test_two_methods_say_that_nothing_touches(page: Open) -> None:
    found = page()
    drawn = """id => { const c = document.getElementById(id);
        return c.getContext("2d").getImageData(0, 0, c.width, c.height).data.some(v => v > 0); }"""
    sides = ("one-step", "network")
    found.mouse.move(*place(found, 10, 10))
    found.mouse.down()
    until(lambda: all(found.evaluate(drawn, side) and not found.inner_text(f"#{side}-none") for side in sides))
    assert "scan" in found.inner_text("#network-note")
    found.mouse.up()
    until(lambda: all(found.inner_text(f"#{side}-none") == "Nothing touches." for side in sides))
    assert not any(found.evaluate(drawn, side) for side in sides)
    assert not found.inner_text("#network-note")


def test_contacts_and_force_stand_on_a_phones_first_screen(page: Open) -> None:
    found = page(390, 844, has_touch=True, is_mobile=True)
    hand = found.context.new_cdp_session(found)
    finger = dict(zip("xy", place(found, 15, 10), strict=True), id=0)
    hand.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [finger]})
    until(lambda: "N ±" in found.inner_text("#contacts"))
    for panel in ("#map", "#contacts-panel", "#timeline"):
        box = found.locator(panel).bounding_box()
        assert box["y"] >= 0 and box["y"] + box["height"] <= 844, (panel, box)
    hand.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(lambda: nothing_touches(found))


def test_it_greys_within_half_a_second_of_a_killed_publisher(page: Open, shared_service: Path) -> None:
    found = page()
    found.evaluate(TRUST_CHANGES)
    took: list[float] = []
    while not took or (min(took) > 0.5 and len(took) < 4):  # what the machine's other work adds is not the page's
        publisher = int((shared_service / "publisher.lock").read_text())
        well = "document.body.dataset.trust === 'yes' && (changes.length = 0, performance.now())"
        began = until(lambda well=well: found.evaluate(well))  # a loaded machine's frames may be late just now
        os.kill(publisher, signal.SIGKILL)
        grey = until(lambda: found.evaluate("changes.find(([trust]) => trust === 'no')"))
        took.append((grey[1] - began) / 1e3)
        found.wait_for_selector("body[data-trust=yes]")
        until(lambda: found.evaluate("getComputedStyle(map).filter") == "none")
    assert min(took) <= 0.5, took


def test_without_the_token_it_only_looks(page: Open, address: str) -> None:
    found = page(to=address.split("#")[0])
    assert "token" in found.inner_text("#press-why")
    assert found.is_disabled("#tare") and found.is_disabled("text=Unplug")
    found.mouse.move(*place(found, 0, 0))
    found.mouse.down()
    time.sleep(0.5)
    assert nothing_touches(found)


def test_dark_and_light_and_without_motion(page: Open) -> None:
    dark = page(color_scheme="dark", reduced_motion="reduce")
    light = page(color_scheme="light")
    paper = "getComputedStyle(document.body).backgroundColor"
    assert dark.evaluate(paper) != light.evaluate(paper)
    assert dark.evaluate("getComputedStyle(map).transitionDuration") == "0s"
    assert light.evaluate("getComputedStyle(map).transitionDuration") != "0s"


def test_the_course_of_the_force_is_drawn_whole_when_its_panel_grows(page: Open) -> None:
    """The panel takes the height that its neighbours leave, and they change after the first drawing."""
    found = page()
    for height in (400, 230):
        found.evaluate("h => { timeline.style.flex = 'none'; timeline.style.height = `${h}px`; }", height)
        until(lambda height=height: found.evaluate("timeline.height / devicePixelRatio") == height)


def test_it_reads_the_wire_as_the_vectors_say(page: Open) -> None:
    """The page's own msgpack reader, on messages made by a program that shares no code with ours."""
    found = page()
    read = """async ([hex]) => {
      const { frameOf } = await import("/msgpack.js");
      const plain = v => {
        if (ArrayBuffer.isView(v) && v.shape) return { shape: v.shape, values: Array.from(v, Number) };
        if (Array.isArray(v)) return v.map(plain);
        if (!v || typeof v !== "object") return v;
        return Object.fromEntries(Object.entries(v).map(([k, x]) => [k, plain(x)]));
      };
      const { topic, skin, frame } = frameOf(Uint8Array.from(hex.match(/../g), h => parseInt(h, 16)));
      const sayable = (k, v) => typeof v === "number" && !Number.isFinite(v) ? String(v) : v;
      return JSON.stringify({ topic, skin, fields: plain(frame) }, sayable);
    }"""
    files = sorted((VECTORS / "frames").glob("*.bin"))
    assert len(files) >= 9
    for file in files:
        expected = json.loads(file.with_suffix(".json").read_text())
        got = json.loads(found.evaluate(read, [file.read_bytes().hex()]))
        assert (got["topic"], got["skin"]) == (expected["topic"], expected["skin"]), file.name
        for name, value in expected["fields"].items():
            same(got["fields"][name], value, f"{file.name}: {name}")


NUMBERS = {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}


def same(got: Any, expected: Any, where: str) -> None:
    if isinstance(expected, dict) and "dtype" in expected:
        flat = []
        stack = [expected["values"]]
        while stack:
            value = stack.pop(0)
            stack = [*value, *stack] if isinstance(value, list) else stack
            flat += [] if isinstance(value, list) else [value]
        assert got["shape"] == expected["shape"], where
        for a, b in zip(got["values"], flat, strict=True):
            same(a, NUMBERS.get(b, b) if isinstance(b, str) else b, where)
    elif isinstance(expected, float) or (isinstance(expected, int) and abs(expected) > 2**53):
        assert got == pytest.approx(expected, rel=1e-6), where
    elif isinstance(expected, dict):
        for key, value in expected.items():
            same(got[key], value, f"{where}.{key}")
    elif isinstance(expected, list):
        assert len(got) == len(expected), where
        for a, b in zip(got, expected, strict=True):
            same(a, b, where)
    else:
        assert got == expected, where


def test_what_is_no_message_is_refused(page: Open) -> None:
    found = page()
    refuses = """async bytes => {
      const { frameOf } = await import("/msgpack.js");
      try { frameOf(Uint8Array.from(bytes)); return "took it"; } catch (why) { return why.name; }
    }"""
    head = b"contact/palm\0"
    endless = [b"\xdf\xff\xff\xff\xff", b"\xdd\xff\xff\xff\xff", 100 * b"\x91"]
    for bad in (b"", head, head + b"\xc1", head + b"\x81\xa1\xff\x01", *(head + more for more in endless)):
        assert found.evaluate(refuses, list(bad)) != "took it", bad


def ask_surface(page: Any, function: str, *arguments: object) -> Any:
    """What a function of the page's surface, and of these, returns."""
    ask = f"async rest => ({function})((await import('/main.js')).surface, ...rest)"
    return page.evaluate(ask, arguments)


def shade(page: Any, x_mm: float, y_mm: float, above_mm: float | None = None) -> list[int]:
    """Red, green, blue and alpha that are drawn at a place of the skin: of its face, or above where it is flat."""
    function = """(s, x, y, above) => {
      s.draw(performance.now());
      if (!s.view) return [0, 0, 0, 0];
      const at = [x / 1e3 / s.half, y / 1e3 / s.half], z = above === null ? s.height(at) : above / 1e3 / s.half;
      const scale = s.canvas.width / s.root.clientWidth, [across, down] = s.project([...at, z]);
      const found = new Uint8Array(4);
      s.gl.readPixels(scale * across, s.canvas.height - scale * down, 1, 1, s.gl.RGBA, s.gl.UNSIGNED_BYTE, found);
      return Array.from(found);
    }"""
    return ask_surface(page, function, x_mm, y_mm, above_mm)  # type: ignore[no-any-return]


def is_bare(colour: list[int]) -> bool:
    return colour[3] == 255 and max(colour[:3]) - min(colour[:3]) < 60


def is_hot(colour: list[int]) -> bool:
    """As the map has it in the middle of a press."""
    return colour[3] == 255 and colour[0] > 150 and colour[0] - colour[2] > 80


def is_well(colour: list[int]) -> bool:
    return colour[1] > colour[0] + 30


def electrode(page: Any, number: int) -> tuple[float, float]:
    """Where it is, in millimetres."""
    x, y = ask_surface(page, "(s, k) => s.pins[k].map(v => 1e3 * v * s.half)", number)
    return x, y


def drawn_ms(page: Any) -> float:
    """When the surface was drawn last."""
    return float(ask_surface(page, "s => s.drawn"))


def test_the_surface_is_hot_where_it_is_pressed(solid: Open) -> None:
    found = solid()
    until(lambda: is_bare(shade(found, 16, -15)) and is_bare(shade(found, -16, 15)))
    assert shade(found, 0, 300)[3] == 0  # nothing is drawn beside the skin
    found.mouse.move(*place(found, 20, -10))
    found.mouse.down()
    until(lambda: is_hot(shade(found, 16, -15)))  # in front of the arrow
    assert ask_surface(found, "s => s.height([0.02 / s.half, -0.01 / s.half])") < -0.05
    assert is_bare(shade(found, -16, 15))
    until(lambda: re.search(r"\d N", found.inner_text("#surface .force")))
    found.mouse.up()
    until(lambda: is_bare(shade(found, 16, -15)))


def test_a_dead_electrode_is_seen_on_the_surface(solid: Open) -> None:
    found = solid()
    at = electrode(found, 5)
    until(lambda: is_well(shade(found, *at, 1)))
    found.click("text=Dead electrode")
    until(lambda: found.locator("#surface .fault").all_inner_texts() == ["5 ×"])
    until(lambda: (colour := shade(found, *at, 2))[0] > colour[1] + 60)
    found.click("text=All well again")
    until(lambda: is_well(shade(found, *at, 1)))
    assert found.locator("#surface .fault").count() == 0


def test_the_surface_is_turned_by_hand_and_drawn_only_when_it_changes(solid: Open) -> None:
    found = solid(390, 500)
    until(lambda: nothing_touches(found))
    found.locator("#surface").scroll_into_view_if_needed()
    first = found.locator("#surface .number").first

    def is_still() -> bool:
        before = drawn_ms(found)
        time.sleep(0.5)
        return before > 0 and drawn_ms(found) == before

    until(is_still)
    before = first.bounding_box()
    found.locator("#surface").press("ArrowLeft")
    until(lambda: first.bounding_box() != before)
    found.locator("#surface").press("Home")
    until(lambda: first.bounding_box() == before)
    box = found.locator("#surface").bounding_box()
    found.mouse.move(box["x"] + 100, box["y"] + 100)
    found.mouse.down()
    found.mouse.move(box["x"] + 160, box["y"] + 110)
    found.mouse.up()
    until(lambda: first.bounding_box() != before)
    found.evaluate("scrollTo(0, document.body.scrollHeight)")
    until(lambda: not ask_surface(found, "s => s.seen"))
    unseen = drawn_ms(found)
    found.locator("#surface").dispatch_event("keydown", {"key": "ArrowLeft"})
    time.sleep(0.5)
    assert drawn_ms(found) == unseen
    found.locator("#surface").scroll_into_view_if_needed()
    until(lambda: drawn_ms(found) > unseen)


def test_no_force_stands_at_the_arrow_of_another_contact(solid: Open) -> None:
    """Contacts change their order, and the arrows are drawn with the display's next picture."""
    found = solid()
    until(lambda: shade(found, *electrode(found, 0), 1)[3] == 255)
    function = """s => {
      const [left, right] = [-0.02, 0.02].map((x, k) =>
        ({ id: k, position: [x, x, 0], normal: [0, 0, 1], force_n: 3 }));
      s.contacts([left, right]);
      s.draw(performance.now());
      s.contacts([right, left]);
      const tags = [...document.querySelectorAll("#surface .force:not([hidden])")];
      return tags.map((tag) => [tag.textContent[0], tag.getBoundingClientRect().x]).sort(([, a], [, b]) => a - b);
    }"""
    assert [name for name, _ in ask_surface(found, function)] == ["0", "1"]


def test_another_skin_is_flat_until_its_image_comes(solid: Open) -> None:
    found = solid()
    found.mouse.move(*place(found, 20, -10))
    found.mouse.down()
    until(lambda: is_hot(shade(found, 16, -15)))
    function = """s => {
      const corners = [[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]];
      s.geometry(corners, corners.flat());
      s.draw(performance.now());
      return [s.height([0.2, -0.1]), document.querySelectorAll("#surface .tag:not([hidden])").length];
    }"""
    assert [abs(each) for each in ask_surface(found, function)] == [0, 4]


def test_a_browser_that_refuses_the_shaders_says_so_and_keeps_the_map(solid_browser: Any, address: str) -> None:
    with solid_browser.new_context() as context:
        page = context.new_page()
        page.set_default_timeout(WAIT_MS)
        shaders = (ROOT / "bridges" / "page" / "web" / "shaders.js").read_text()
        broken = shaders.replace("seen = lit(", "seen = unlit(")
        page.route("**/shaders.js", lambda route: route.fulfill(body=broken, content_type="text/javascript"))
        page.goto(address)
        until(lambda: "refuses" in page.inner_text("#surface-why"))
        assert page.is_hidden("#surface-panel") and page.is_visible("#map")


def test_a_lost_surface_is_said_and_comes_back(solid: Open) -> None:
    found = solid()
    at = electrode(found, 0)
    until(lambda: shade(found, *at, 1)[3] == 255)
    ask_surface(found, "s => { window.taken = s.gl.getExtension('WEBGL_lose_context'); taken.loseContext(); }")
    until(lambda: found.is_hidden("#surface-panel"))
    assert "map shows the same" in found.inner_text("#surface-why")
    found.evaluate("taken.restoreContext()")
    until(lambda: found.is_visible("#surface-panel") and found.is_hidden("#surface-why"))
    until(lambda: is_well(shade(found, *at, 1)))


def test_without_webgl_the_page_says_that_the_map_is_alone(page: Open) -> None:
    found = page()
    assert found.is_hidden("#surface-panel") and "WebGL 2" in found.inner_text("#surface-why")


def test_a_snapshot_has_the_press_before_it(page: Open) -> None:
    found = page()
    until(lambda: re.search(r"the last \d+ s are kept", found.inner_text("#recorder")))
    found.mouse.move(*place(found, -15, 15))
    found.mouse.down()
    until(lambda: true_at(found, -15, 15))
    found.mouse.up()
    until(lambda: nothing_touches(found))
    found.click("#snapshot")
    made = Path(until(lambda: found.inner_text("#said").partition("Snapshot: ")[2]))
    try:
        until(lambda: "being written" in found.inner_text("#recorder"))
        until(lambda: "are kept" in found.inner_text("#recorder"))
        frames = [unpack(message.wire) for message in RecordingReader(made).messages({"contact"})]
        touched = [c.position[:2] for frame in frames for c in frame.contacts]  # type: ignore[attr-defined]
        assert any(math.dist(at, (-0.015, 0.015)) < 0.003 for at in touched)
    finally:
        made.unlink()


def test_a_recording_goes_on_when_the_recorder_was_killed(page: Open, shared_service: Path) -> None:
    found = page()
    found.click("#record")
    until(lambda: "Recording to" in found.inner_text("#recorder"))
    before = found.inner_text("#recorder")
    time.sleep(1)
    os.kill(int((shared_service / "recorder.lock").read_text()), signal.SIGKILL)
    until(lambda: (said := found.inner_text("#recorder")).startswith("Recording to") and said[:40] != before[:40])
    found.click("#record")
    until(lambda: found.inner_text("#said").startswith("Recorded "))
    last = Path(found.inner_text("#said").removeprefix("Recorded "))
    until(lambda: "Not recording" in found.inner_text("#recorder"))
    first = last.parent / re.search(r"\S+\.mcap", before)[0]  # type: ignore[index]
    for path in (first, last):
        assert sum(1 for _ in RecordingReader(path).messages({"contact"})) > 0
        path.unlink()


TITLES = """() => {
  window.titles = [];
  const title = document.getElementById("trust-title");
  const seen = () => titles.push(title.textContent);
  new MutationObserver(seen).observe(title, { childList: true, subtree: true });
}"""
COURSE = """async () => { const { timeline } = await import("/main.js");
    return JSON.stringify([...timeline.courses.get("palm").lines].map(([id, points]) => [id, points.length])); }"""


def record_a_press(found: Any, seconds: float) -> None:
    found.click("#record")
    found.wait_for_selector("#record[aria-pressed=true]")
    found.mouse.move(*place(found, 15, 15))
    found.mouse.down()
    until(lambda: true_at(found, 15, 15))
    time.sleep(seconds)
    found.mouse.up()
    found.click("#record")


def test_a_replay_says_where_it_is_and_when_it_is_over(page: Open) -> None:
    found = page()
    record_a_press(found, 1.5)
    until(lambda: found.inner_text("#said").startswith("Recorded "))
    until(lambda: nothing_touches(found))
    made = Path(found.inner_text("#said").removeprefix("Recorded "))
    long = made.with_name(f"the-left-hand_{'of-the-second-robot-' * 6}.mcap")
    made.rename(long)
    try:
        found.click("#recordings summary")
        until(lambda: found.input_value("#file"))
        found.select_option("#file", long.name)
        seconds = float(found.inner_text("#scrub-out").split(" of ")[1].split()[0])
        before = found.evaluate(COURSE)
        found.evaluate(TITLES)
        found.click("#play")
        until(lambda: found.is_disabled("#tare") and found.is_disabled("#record"))  # of a skin, not of it
        places: list[float] = []

        def over() -> bool:
            places.append(float(found.inner_text("#scrub-out").split(" of ")[0]))
            return bool(found.inner_text("#trust-title") == "The recording is over")

        until(over, 60)
        assert max(places) <= seconds and any(0 < place < seconds for place in places), (places, seconds)
        assert found.inner_text("#scrub-out") == f"{seconds:.1f} of {seconds:.1f} s"
        assert found.get_attribute("body", "data-tone") == "calm"
        assert found.evaluate(COURSE) == before  # what the recording shows is not drawn into the skin's course
        until(lambda: found.inner_text("#trust-title").startswith("Live"))
        assert "played to its end" in found.inner_text("#said")
        titles = found.evaluate("titles")  # before the replay begins they are the skin's, on a busy machine late ones
        during = titles[titles.index("The replay begins") : titles.index("The recording is over")]
        assert not [title for title in during if "old" in title], titles
        assert found.evaluate("document.documentElement.scrollWidth") <= 1280
        beyond = """() => [...document.querySelectorAll(".side .panel")].flatMap(panel => {
            const right = e => e.getBoundingClientRect().right;
            return [...panel.querySelectorAll("*")].filter(e => right(e) > right(panel)).map(e => e.id);
        })"""
        assert not found.evaluate(beyond)
    finally:
        long.unlink()


def test_a_recording_that_cannot_be_played_is_said(page: Open, shared_service: Path) -> None:
    found = page()
    broken = ROOT / "recordings" / "broken.mcap"
    broken.parent.mkdir(exist_ok=True)
    broken.write_bytes(b"no recording")
    try:
        found.click("#recordings summary")
        until(lambda: found.input_value("#file"))
        found.select_option("#file", broken.name)
        found.click("#play")
        until(lambda: "broken.mcap could not be replayed" in found.inner_text("#said"), 60)
        until(lambda: found.inner_text("#trust-title").startswith("Live"))
    finally:
        broken.unlink()


def test_a_recording_is_made_and_replayed(page: Open) -> None:
    found = page()
    record_a_press(found, 2)
    found.wait_for_selector("#record[aria-pressed=false]")
    until(lambda: nothing_touches(found))
    found.click("#recordings summary")
    made = until(lambda: found.input_value("#file"))
    try:
        found.click("#play")
        until(lambda: found.inner_text("#trust-title").startswith("Replay"))
        until(lambda: len(seen := marks(found, "#overlay .contact")) == 1 and abs(seen[0]["x"] - 15) < 3)
        assert not marks(found, "#overlay .truth g")  # nobody knows it now
        until(lambda: float(found.input_value("#scrub")) > 0.5)
        found.click("#play")
        until(lambda: found.inner_text("#trust-title").startswith("Live"))
    finally:
        (ROOT / "recordings" / str(made)).unlink()
