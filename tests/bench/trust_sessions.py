"""Sessions of a world for tests: from the board's bytes to contact frames."""

from collections.abc import Iterator
from dataclasses import replace

from bench.trust.candidate import Today
from bench.trust.scene import TrustScene
from bench.trust.session import PlayedSession, SessionPlan
from firmware_stub import scene as scenes
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import PiecewiseLinear, Script, TouchPath
from firmware_stub.world import Touch
from firmware_stub.worlds import table
from models.bundle import Bundle
from protocol.frames import ContactFrame
from services.runtime.config import Skin


def press(begin: float, end: float, force: float, x: float, y: float, radius: float = 0.01) -> TouchPath:
    """A disc whose force rises and falls within 0.1 s."""
    touch = scenes.touch({"x": x, "y": y, "radius": radius, "force": force})
    none = replace(touch, drop=0.0)
    return TouchPath((begin, begin + 0.1, end - 0.1, end), (none, touch, touch, none))


def scene(
    seconds: float,
    *tracks: TouchPath,
    contact: tuple[tuple[int | None, PiecewiseLinear], ...] = (),
    tares: tuple[float, ...] = (),
) -> TrustScene:
    return TrustScene(seconds, Script("test", tracks=tracks, contact=contact), (), tares)


def played(
    what: TrustScene, scan: str, seed: int = 3, world: str = "plain", sheet: Sheet | None = None
) -> PlayedSession:
    skin = Skin.model_validate({"port": "stub", "bundle": "square16", "frame_id": "palm", "scan": scan})
    plan = SessionPlan(world, seed, what.seconds)
    return PlayedSession(plan, sheet or table.sheet(world, seed), skin, Bundle.load("square16"), what)


def today(session: PlayedSession) -> Today:
    return Today(session.skin, Bundle.load("square16"))


def frames(what: TrustScene, scan: str, seed: int = 3, world: str = "plain") -> Iterator[tuple[float, ContactFrame]]:
    """(sample [s], frame) of the service's own stages."""
    session = played(what, scan, seed, world)
    for _, frame in session.contacts({"today": today(session)}):
        yield frame.stamps["sample"] * 1e-9, frame
    session.rig.close()


def stronger(touch: Touch, share: float) -> Touch:
    return replace(touch, drop=touch.drop * (1 + share))
