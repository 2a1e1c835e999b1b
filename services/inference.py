"""Inference: from the difference to the image of the conductivity drop, by the bundle's network.

difference -> stack of pre-reconstructions (services/estimation/images.py), a topic too -> image
ONNX Runtime on one thread, warmed up before the stage is ready. A bundle without a network gives the one-step image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle
from models.locator import Located, Locator
from models.measurement.tables import tells_touches
from models.prereconstruction import Operator
from models.symmetries import symmetries
from protocol.frames import DeltaFrame, Frame, ImageFrame, LocatedTouch, StackFrame
from services.describe import ON, symmetry
from services.estimation.images import MEANS, Operators, Residual, sigma_of_mean
from services.linearisation import Linearisation
from services.networks import Network, OneStep, Pictures, Stack, network, nothing
from services.runtime.config import Skin
from services.runtime.stage import Health, Refused, Stage, inherited, invalidate
from services.symmetry import SymmetryMean

LEAST_ACCURACY = 0.6  # share of held-out touches whose class a registered skin's network gets right if it is stated
SETTLED = 5  # after so many untouched frames with the same noise, a touch is expected to have it too


class Inference(Stage):
    """delta -> image [S/m], on the bundle's grid; stack where asked."""

    reads = "delta"
    writes = ("image", "stack")
    stamp = "infer"

    def __init__(self, name: str, skin: Skin, bundle: Bundle) -> None:
        super().__init__(name)
        self.config, self.bundle = skin, bundle
        path = None if skin.network == "none" else bundle.network_path(skin.network) or bundle.network_path("full")
        self._network: Network | OneStep = network(str(path)) if path else OneStep(bundle)
        if isinstance(self._network, Network):
            self._network.check(bundle)
        # Only a network's image is in S/m: a one-step image shows where, not how much, as a registered skin's does.
        self._to_scale = isinstance(self._network, Network) and bundle.locator is None
        self._refuses = self._to_scale and not tells_touches(bundle)  # else the measurements have been explained
        self.linearisation = Linearisation(name, bundle)
        self._build()
        self._tells_shapes = tells_shapes(bundle)
        self._locator = None if bundle.locator is None else Locator(bundle.locator)
        self._symmetry: SymmetryMean | None = None
        if isinstance(self._network, Network) and symmetry(skin, bundle) == ON:
            turns = tuple(each.turn for each in symmetries(bundle.skin, bundle.pattern)[1:])
            self._symmetry = SymmetryMean(self._network, turns)
        self.reset()

    def reset(self) -> None:
        if self._symmetry is not None:
            self._symmetry.forget()
        self._surer: Pictures | None = None  # the mean over the symmetries of the image that is held
        self._last: ImageFrame | None = None  # of the touch that is being held
        self._again = True  # whether a subscriber may not have it: the next held frame brings it
        self._made_of: DeltaFrame | None = None  # frame of the image that is shown
        self._stack_sent = False  # whether who subscribes to stacks has that frame's
        self._unseen: DeltaFrame | None = None  # last reconstruction that nobody wanted
        self._ahead: tuple[DeltaFrame, Stack, Pictures] | None = None  # what `together` made
        self._tare_frames = 0  # of the baseline that untouched frames are held against
        self._quiet: NDArray[np.float32] | None = None  # standard deviation that untouched frames state
        self._stated = 0  # how many have stated it, one after the other
        names = ("networks_run", "held", "untouched", "unwanted", "missed", "uncalibrated", "symmetric")
        self._counters = dict.fromkeys(names, 0)  # uncalibrated: frames whose calibration could not be found

    def process(self, frame: Frame, wanted: frozenset[str]) -> list[Frame]:
        assert isinstance(frame, DeltaFrame)
        if "image" not in wanted:
            self._counters["unwanted"] += 1
            self._unseen = frame if frame.averaged else self._unseen
            return []
        out = ImageFrame(**inherited(frame), touched=frame.touched, after=frame.after, estimates=frame.estimates)
        followed = self.linearisation.follow(frame.calibration)
        if followed:
            self._build()
        elif followed is None:
            invalidate(out, "stale_baseline")
            self._counters["uncalibrated"] += 1
        out.metres_per_pixel, out.origin = self.bundle.metres_per_pixel, list(self.bundle.image_origin)
        if frame.averaged:
            self._run(frame, out)
        elif frame.held and self._unseen is not None and self._unseen.scan == frame.reconstructed:
            self._run(self._unseen, out)
        elif frame.held:
            self._hold(frame, out)
        else:
            self._counters["untouched"] += 1
            self._last = self._made_of = None
            if self._symmetry is not None:
                self._symmetry.forget()
            self._rest(frame)
        return [out]

    def _build(self) -> None:
        """What stands on the matrices in use."""
        bundle, tare = self.linearisation.bundle, self.config.tare
        if isinstance(self._network, OneStep):
            self._network = OneStep(bundle)
        self.residual = Residual(bundle, self._to_scale)
        self._operators = Operators(bundle.prereconstructor(), tare.scale_per_s, tare.contact_per_s)
        self._last, self._quiet, self._stated = None, None, 0

    def joined(self, topic: str) -> None:
        if topic == "stack":
            self._stack_sent = False
        else:
            self._again = True

    def beside(self, wanted: frozenset[str]) -> list[Frame]:
        frame = self._made_of
        if "stack" not in wanted or frame is None or self._stack_sent or (stack := self.stack(frame)) is None:
            return []
        self._stack_sent = True
        out = StackFrame(**inherited(frame), reconstructed=frame.scan)
        out.stack, out.context, out.scale = stack
        return [out]

    def _operator(self, frame: DeltaFrame) -> Operator | None:
        """What makes the stack of a frame that is to be reconstructed; None of others."""
        return self._operators(frame.sigma, frame.averaged, frame.tare_frames) if frame.averaged else None

    def stack(self, frame: DeltaFrame) -> Stack | None:
        """What a network reads of a frame that is to be reconstructed; None of others."""
        operator = self._operator(frame)
        return None if operator is None else Stack(*operator.stack(frame.difference))

    @classmethod
    def together(cls, work: Sequence[tuple[Stage, Frame]]) -> None:
        """Frames of several skins that wait at once: one run of the network for those that share it."""
        groups: dict[Network, list[tuple[Inference, DeltaFrame]]] = {}
        for stage, frame in work:
            if not (isinstance(stage, Inference) and isinstance(frame, DeltaFrame)):
                continue
            if isinstance(stage._network, Network) and stage._operator(frame) is not None:
                groups.setdefault(stage._network, []).append((stage, frame))
        for shared, members in groups.items():
            if len(members) < 2:
                continue
            stacks = [stack for stage, frame in members if (stack := stage.stack(frame)) is not None]
            made = shared.run_many(stacks)
            for (stage, frame), stack, pictures in zip(members, stacks, made, strict=True):
                stage._ahead = frame, stack, pictures

    def _rest(self, frame: DeltaFrame) -> None:
        """Learn the noise from an untouched frame. One that stands for no scan does not state it."""
        sigma, self._tare_frames = frame.sigma, frame.tare_frames
        if self._quiet is not None and np.array_equal(sigma, self._quiet):
            self._stated += 1
        elif np.isfinite(sigma).any():
            self._quiet, self._stated = sigma, 1

    def prepare(self) -> bool:
        """Make the matrices that a touch would need now; not while the noise changes from frame to frame."""
        if self._symmetry is not None and self._symmetry.busy:
            self._surer = self._symmetry.step()
            return True
        if self._quiet is None or self._stated < SETTLED:
            return False
        for n in () if isinstance(self._network, OneStep) else MEANS:
            if self._operators.prepare(sigma_of_mean(self._quiet, n), n, self._tare_frames):
                return True
        return self.residual.prepare(self._quiet)

    def _pictures(self, frame: DeltaFrame) -> tuple[Stack | None, Pictures]:
        """Of a frame that is to be reconstructed: what the network read, and what it made of it."""
        ahead, self._ahead = self._ahead, None
        if ahead and ahead[0] is frame:
            return ahead[1:]
        if isinstance(self._network, OneStep):
            return None, self._network.run(frame)
        stack = self.stack(frame)
        return stack, nothing(self.bundle.image_size) if stack is None else self._network.run(stack)

    def _run(self, frame: DeltaFrame, out: ImageFrame) -> None:
        stack, pictures = self._pictures(frame)
        out.image, out.sigma, out.classes = pictures
        if not self._tells_shapes:
            out.classes = ImageFrame(skin=self.skin).classes
        out.noise = _rms(frame.sigma)
        if self._locator is not None and frame.touched:
            quantity = self._locator.quantity
            out.touches = [_touch(each, quantity) for each in self._locator.locate(frame.difference, frame.sigma)]
        self._counters["networks_run"] += 1
        out.residual = self.residual(frame.difference, frame.sigma, out.image)
        if self._refuses and frame.touched and self.residual.refused:
            invalidate(out, "out_of_distribution")
        out.reconstructed = frame.scan
        self._last, self._unseen, self._surer = out, None, None
        self._made_of, self._stack_sent, self._again = frame, False, False
        if self._symmetry is None:
            return
        if frame.touched and stack is not None and np.isfinite(frame.sigma).all():
            self._symmetry.begin(stack, (out.image, out.sigma, out.classes))
        else:
            self._symmetry.forget()  # else the mean of the image before would come as this one's

    def _hold(self, frame: DeltaFrame, out: ImageFrame) -> None:
        """Hold the image of the frame last reconstructed, if this process has it. It is sent again only for new
        subscribers; a surer one of the same scan takes its place, and is a new one to readers.
        """
        last, surer = self._last, self._surer
        if last is None or last.reconstructed != frame.reconstructed:
            # skipped, or before we started: not valid until the next reconstruction, at most 16 frames on
            out.valid = False
            out.reasons.append("gap")
            self._counters["missed"] += 1
            return
        out.noise, out.residual, out.reconstructed = last.noise, last.residual, last.reconstructed
        out.held = surer is None
        self._counters["symmetric" if surer else "held"] += 1
        if surer or self._again:
            out.image, out.sigma, out.classes = surer or (last.image, last.sigma, last.classes)
            out.touches, self._again = last.touches, False
        if surer:
            self._last, self._surer = out, None

    def state(self) -> dict[str, Any]:
        last, rest = self._last, self.linearisation.state()
        if last is None:
            return {"last": None, **rest}
        kept = {name: getattr(last, name) for name in ("image", "sigma", "classes", "noise", "residual")}
        touches = [asdict(touch) for touch in last.touches]
        return {"last": {"scan": last.reconstructed, **kept, "touches": touches}, **rest}

    def load(self, state: dict[str, Any]) -> None:
        self.reset()
        if self.linearisation.load(state):
            self._build()
        last = state.get("last")
        if last is None:
            return
        try:
            image, sigma, classes = (np.asarray(last[name], np.float32) for name in ("image", "sigma", "classes"))
            self._last = ImageFrame(
                skin=self.skin,
                image=image,
                sigma=sigma,
                classes=classes,
                noise=last.get("noise"),
                residual=last.get("residual"),
                reconstructed=int(last["scan"]),
                touches=[LocatedTouch(**each) for each in last.get("touches", [])],
            )
        except (KeyError, TypeError, ValueError) as wrong:
            raise Refused(f"no image in the saved state ({wrong})") from None

    def health(self) -> Health:
        one_step = isinstance(self._network, OneStep)
        messages = [f"bundle {self.bundle.name} has no network: one-step images"] if one_step else []
        return Health("OK", messages, dict(self._counters))


def tells_shapes(bundle: Bundle) -> bool:
    """Whether shape classes are worth stating: what a registered skin's presses leave open may hide them."""
    if bundle.locator is None:
        return True
    full = (bundle.manifest.get("network") or {}).get("full") or {}
    return float(full.get("held_out", {}).get("noise-free", {}).get("class", 0.0)) >= LEAST_ACCURACY


def _touch(found: Located, quantity: str) -> LocatedTouch:
    value = {} if found.value is None else {quantity: found.value, "value_sigma": found.value_sigma}
    return LocatedTouch(position=[found.x, found.y], sigma=found.sigma, amplitude=found.amplitude, **value)


def _rms(sigma: NDArray[np.float32]) -> float | None:
    """Root mean square of the finite values; None without any."""
    finite = sigma[np.isfinite(sigma)].astype(float)
    return float(np.sqrt((finite**2).mean())) if finite.size else None


if __name__ == "__main__":
    import sys

    from services.process import main, stages

    sys.exit(main("inference", stages(Inference)))
