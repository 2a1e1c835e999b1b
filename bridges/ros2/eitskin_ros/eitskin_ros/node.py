"""The node of one skin: its parameters, topics and services."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable, Iterable
from typing import Any

from eitskin import views
from eitskin.control import ControlClient, ControlError
from eitskin.errors import EitskinError
from eitskin.feeds import ContactPace, Measured
from eitskin.frames import ContactFrame, ImageFrame, StatusFrame
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor, SetParametersResult
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from std_srvs.srv import Trigger

from . import messages
from .reference import AXES, Reference

TARE_S = 10.0
NO_SIMULATED_TIME = (
    "use_sim_time is true, expected false: the skin is measured in real time, and stamped by the system's clock. Start "
    "this node without it; a recorded skin is played by `ros2 bag play`, without this node"
)
PARAMETERS: dict[str, tuple[Any, str, tuple[float, float] | None]] = {
    "skin": ("palm", "name of the skin in eitskin's skin.toml", None),
    "replay": (False, "whether what eitskin replays from a recording is published too", None),
    "tare": (True, "whether the service ~/tare is offered: whoever is in the ROS domain may call it", None),
    "deadline": (0.25, "offered: longest time between two messages on ~/contacts [s]", (0.05, 10.0)),
    "marker_rate": (30.0, "messages on ~/markers at most, but where a touch begins or ends [Hz]", (1.0, 1000.0)),
    "reference_topic": ("", "WrenchStamped of a sensor, for `skin calibrate --live`; empty: none", None),
    "reference_axis": ("-z", f"of its force, above 0 where something presses the skin: {', '.join(AXES)}", None),
}
"""Name: default, description, range."""


class SkinNode(Node):
    """One skin's topics, below the node's name. Raises EitskinError for parameters that cannot be."""

    def __init__(self) -> None:
        super().__init__("skin")
        given = {name: self._declared(name, *about) for name, about in PARAMETERS.items()}
        self.skin, self.replay = str(given["skin"]), bool(given["replay"])
        if self.get_parameter("use_sim_time").value:
            raise EitskinError(NO_SIMULATED_TIME)
        self.add_on_set_parameters_callback(_refuse_simulated_time)
        self._ros = ros = messages.message_types(lambda of, name: getattr(importlib.import_module(f"{of}.msg"), name))
        on_time = {"deadline": Duration(seconds=given["deadline"])}
        best_effort = {"reliability": ReliabilityPolicy.BEST_EFFORT}
        self._contacts = self._publisher(ros.ContactArray, "~/contacts", **best_effort, **on_time)
        self._wrench = self._publisher(ros.WrenchStamped, "~/wrench", **on_time)  # what controls subscribes reliably
        self._markers = self._publisher(ros.MarkerArray, "~/markers")
        self._drop = self._publisher(ros.PointCloud2, "~/conductivity_drop", **best_effort)
        self._image = self._publisher(ros.Image, "~/image")  # as does the Image display of older RViz
        self._diagnostics = self.create_publisher(ros.DiagnosticArray, "/diagnostics", 10)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._tf = self.create_publisher(ros.TFMessage, "/tf_static", latched)
        self._frame_id = self.skin  # of contacts, which may be given in the parent's frame; until a frame says
        self._marker_pace = ContactPace(given["marker_rate"])
        self._state: tuple[bool, list[str]] | None = None  # valid and reasons of what was published last
        self._info: dict[str, Any] = {}
        if given["tare"]:
            self.create_service(Trigger, "~/tare", self._on_tare)
        if given["reference_topic"]:
            self.reference = Reference(self, self.skin, given["reference_topic"], given["reference_axis"])

    def _declared(self, name: str, default: Any, text: str, limits: tuple[float, float] | None) -> Any:
        """The value of a parameter, which is not changed while the node runs."""
        span = [FloatingPointRange(from_value=limits[0], to_value=limits[1])] if limits else []
        about = ParameterDescriptor(description=text, read_only=True, floating_point_range=span)
        return self.declare_parameter(name, default, about).value

    def _publisher(self, kind: Any, name: str, **policies: Any) -> Any:
        """Its depth and reliability may be overridden by parameters, as ROS names them (qos_overrides)."""
        options = QoSOverridingOptions.with_default_policies()
        return self.create_publisher(kind, name, QoSProfile(depth=5, **policies), qos_overriding_options=options)

    @property
    def wants_image(self) -> bool:
        return _wanted(self._drop) or _wanted(self._image)

    @property
    def wants_diagnostics(self) -> bool:
        return _wanted(self._diagnostics)

    def hand_on(self, frame: ContactFrame, measured_ns: int) -> None:
        """Publish contacts that may be acted on. `measured_ns`: by the monotonic clock of this host."""
        self._note(True, frame.reasons, "valid")
        self._frame_id = frame.frame_id or self.skin
        head = self._header(measured_ns, self._frame_id)
        _publish(self._contacts, lambda: messages.contacts(self._ros, head, frame))
        if views.has_forces(frame):
            _publish(self._wrench, lambda: messages.wrench(self._ros, head, frame))
        if self._marker_pace.passes(Measured(frame, measured_ns)):
            _publish(self._markers, lambda: messages.markers(self._ros, head, frame))

    def refuse(self, why: str, reasons: list[str], measured_ns: int | None = None) -> None:
        """Say that nothing may be acted on: of a measurement, or that none has come. `why`: for the log."""
        self._note(False, reasons, why)
        head = self._header(measured_ns or time.monotonic_ns(), self._frame_id)
        _publish(self._contacts, lambda: messages.not_valid(self._ros, head, reasons))
        _publish(self._markers, lambda: messages.markers(self._ros, head, None))
        self._marker_pace.refused()

    def show(self, frame: ImageFrame, measured_ns: int) -> None:
        """Publish an image that may be shown as the present one."""
        head = self._header(measured_ns, self._info.get("frame_id") or self.skin)
        surface = self._info.get("surface")
        _publish(self._drop, lambda: messages.conductivity_drop(self._ros, head, frame, surface))
        _publish(self._image, lambda: messages.image(self._ros, head, frame))

    def place(self, info: dict[str, Any]) -> None:
        """Publish where the skin is; again only where it is elsewhere."""
        known, self._info = self._info, info
        same = all(known.get(key) == info.get(key) for key in ("pose", "parent_frame_id", "frame_id"))
        if not same and (moved := messages.transform(self._ros, time.time_ns(), info)) is not None:
            self._tf.publish(moved)

    def diagnose(self, processes: Iterable[tuple[StatusFrame, float]], electrodes: list[str]) -> None:
        """Publish what each process said last, and how many seconds ago; the electrodes; whether contacts are valid."""
        ros, (valid, reasons) = self._ros, self._state or (False, [messages.SILENT])
        said = ", ".join(reasons)
        found = [messages.of_process(ros, frame, age_s) for frame, age_s in processes]
        found.append(messages.of_electrodes(ros, self.skin, electrodes))
        level = ("WARN" if reasons else "OK") if valid else "ERROR"
        text = ("valid, but " + said if reasons else "valid") if valid else f"not valid: {said}"
        found.append(messages.diagnostic(ros, self.skin, "contacts", level, text, {}))
        self._diagnostics.publish(ros.DiagnosticArray(header=messages.header(ros, time.time_ns(), ""), status=found))

    def _header(self, measured_ns: int, frame_id: str) -> Any:
        ahead_ns = time.time_ns() - time.monotonic_ns()  # each time: the system's time is set now and then
        return messages.header(self._ros, measured_ns + ahead_ns, frame_id)

    def _note(self, valid: bool, reasons: list[str], said: str) -> None:
        """For diagnostics, and for the log where it is news."""
        before, self._state = self._state, (valid, reasons)
        if before is None or valid != before[0]:
            self.get_logger().info(said) if valid else self.get_logger().warning(said)

    def _on_tare(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            taken = ControlClient("preprocessing", TARE_S).call("tare", skin=self.skin)
        except ControlError as why:
            response.success, response.message = False, str(why)
        else:
            response.success, response.message = True, f"new baseline from {taken.get('frames', 'some')} frames"
        return response


def _wanted(publisher: Any) -> bool:
    return bool(publisher.get_subscription_count())


def _publish(publisher: Any, make: Callable[[], Any]) -> None:
    """Make and publish a message where somebody subscribes."""
    if _wanted(publisher):
        publisher.publish(make())


def _refuse_simulated_time(parameters: list[Any]) -> SetParametersResult:
    simulated = any(each.name == "use_sim_time" and each.value for each in parameters)
    return SetParametersResult(successful=not simulated, reason=NO_SIMULATED_TIME if simulated else "")
