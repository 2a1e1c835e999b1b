"""Sessions of a world for tests: from the board's bytes to contact frames."""

from collections.abc import Iterator
from dataclasses import replace

from bench.trust.runs import skin_of
from bench.trust.scene import TrustScene
from bench.trust.session import PlayedSession, SessionPlan
from bench.trust.stages import Today
from firmware_stub.sheet import Sheet
from firmware_stub.timeline import TouchPath
from firmware_stub.world import Touch
from firmware_stub.worlds import table
from protocol.frames import ContactFrame
from simulation.host import loaded
from simulation.scenes import ContactCurves, DiscPress, script


def press(begin: float, end: float, force: float, x: float, y: float, radius: float = 0.01) -> TouchPath:
    """A disc whose force rises and falls within 0.1 s."""
    return DiscPress(x, y, begin, end, force, 0.1, radius).path()


def scene(seconds: float, *tracks: TouchPath, contact: ContactCurves = (), tares: tuple[float, ...] = ()) -> TrustScene:
    return TrustScene(seconds, script(*tracks, contact=contact), (), tuple((t, "tare") for t in tares))


def played(what: TrustScene, scan: str, seed=3, world: str = "plain", sheet: Sheet | None = None) -> PlayedSession:
    plan, bundle = SessionPlan(world, seed, what.seconds), loaded("square16")
    return PlayedSession(plan, what, sheet or table.sheet(world, seed), skin_of(scan, "square16"), bundle)


def today(session: PlayedSession) -> Today:
    return Today(session.skin, loaded("square16"))


def frames(what: TrustScene, scan: str, seed: int = 3, world: str = "plain") -> Iterator[tuple[float, ContactFrame]]:
    """(sample [s], frame) of the service's own stages."""
    session = played(what, scan, seed, world)
    for _, frame in session.contacts({"": today(session)}):
        yield frame.stamps["sample"] * 1e-9, frame
    session.host.close()


def stronger(touch: Touch, share: float) -> Touch:
    return replace(touch, drop=touch.drop * (1 + share))
