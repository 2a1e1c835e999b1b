"""skin.toml: which skins there are, where their boards are, who may listen. Validated before anything starts.

An error names the file, the key, what was found and what is allowed; see `ConfigError`.
"""

from __future__ import annotations

import itertools
import os
import re
import tomllib
import unicodedata
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator

from models.files import FileError, read_text
from protocol.ad5940 import LEAST_RTIA_OHM, MOST_RTIA_OHM
from protocol.errors import EitskinError
from protocol.part_size import BAUD, FASTEST_BAUD, SLOWEST_BAUD
from protocol.scan_setting import NAMED, WITH_POINTS, ScanSetting, SettingName
from protocol.topics import BRIDGES
from protocol.transport import Transport
from services.runtime import port_url
from services.runtime.config_sections import (
    Count,
    FoxgloveSection,
    Logging,
    Number,
    PageSection,
    RealTime,
    RecorderSection,
    Section,
    Security,
    Skip,
    Sockets,
    Switch,
)

ROOT = Path(__file__).resolve().parents[2]
BUNDLES, MANIFEST = ROOT / "models" / "bundles", "manifest.json"
SKIN_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")

Vector3 = tuple[Number, Number, Number]
Quaternion = tuple[Number, Number, Number, Number]


NO_ROS2 = (
    "the bridge to ROS 2 is a node of ROS now, with parameters of its own: take `ros2` out of skin.toml, and start it "
    "by `ros2 launch eitskin_ros skin.launch.py` (docs/ros.md)"
)


NO_FIT = (
    "`radius_m` alone: no fit of their shape refines touches, as the measurements tell place, size and force without "
    "one. Take {} out, and `indenter` too where no radius is known"
)


class ConfigError(EitskinError):
    """The configuration cannot be used. The text is for the person who must mend the file."""


class Pose(Section):
    """Where the skin's frame (origin at its centre, x right, y up, z out) sits in its parent frame."""

    parent: str = "base"
    position_m: Vector3 = (0.0, 0.0, 0.0)
    quaternion_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)

    @field_validator("quaternion_xyzw")
    @classmethod
    def unit_length(cls, q: Quaternion) -> Quaternion:
        if abs(sum(v * v for v in q) - 1) > 1e-3:
            raise ValueError("a quaternion of length 1")
        return q


class Surface(Section):
    """What the sheet is wrapped round; without it the skin lies flat. See services/contacts/surface.py."""

    kind: Literal["cylinder"]
    radius_m: Annotated[Number, Field(gt=0, le=10)]  # of the sheet on it, not of the limb below its foam
    axis_degrees: Annotated[Number, Field(ge=-360, le=360)] = 90.0  # of the cylinder's axis to the sheet's x


def _without(given: Any, key: str) -> Any:
    return {name: value for name, value in given.items() if name != key} if isinstance(given, dict) else given


class TareConfig(Section):
    """How the untouched baseline is taken and kept."""

    frames: Annotated[Count, Field(ge=8, le=4096)] = 64
    max_age_s: Annotated[Number, Field(gt=0)] = 3600.0  # an older persisted baseline is not loaded
    calibrate: Switch = True  # after `skin tare`: fit how the skin is mounted, and use matrices that fit it
    # How fast an untouched skin may change, relative. A foam that dries by 6 %, electrodes whose contacts change by a
    # quarter, within five minutes.
    scale_per_s: Annotated[Number, Field(gt=0, le=1e-2)] = 2e-4  # the sheet's conductivity
    contact_per_s: Annotated[Number, Field(gt=0, le=1e-1)] = 8e-4  # each electrode's contact impedance

    @model_validator(mode="before")
    @classmethod
    def older(cls, given: Any) -> Any:
        """Files and recordings of before give a time constant of drift, which is followed by its own statistics now."""
        return _without(given, "tracking_s")


class TouchConfig(Section):
    """What a scene does not need."""

    hold: Switch = True  # switch of the rule "nothing changed: do not reconstruct again"
    skip_untouched: Switch = True  # switch of the rule "nothing touches: do not reconstruct"
    symmetry: Switch = False  # a held touch's image becomes the mean over the skin's symmetries: services/symmetry.py

    @model_validator(mode="before")
    @classmethod
    def older(cls, given: Any) -> Any:
        """Files and recordings of before give a rate of false alarms, which is fixed now (values/numbers.py)."""
        return _without(given, "false_alarms")


class Indenter(Section):
    """What presses this skin: always one tip, flat and round. Its radius fixes the area of a force
    (services/contacts/force/of_disc.py).
    """

    radius_m: Annotated[Number, Field(gt=0, le=1)]

    @model_validator(mode="before")
    @classmethod
    def no_fit(cls, given: Any) -> Any:
        if isinstance(given, dict) and (gone := [key for key in ("kind", "refine") if key in given]):
            raise ValueError(NO_FIT.format(" and ".join(f"`{key}`" for key in gone)))
        return given


LEAST_POINTS = 128
NetworkFile = Literal["full", "fast", "int8", "none"]
ScanMode = Literal["full", "rolling"]
Reads = Literal["pressure", "peak"]


class Skin(Section):
    """One skin: one board on one port, one bundle."""

    port: str  # "stub", a device path, a pyserial URL, or a file (*.mcap, *.npz)
    bundle: str  # the name of a folder of models/bundles, else a path
    frame_id: str = ""  # default: the skin's name
    pose: Pose = Pose()
    surface: Surface | None = None  # what the sheet is wrapped round
    contacts_in: Literal["skin", "parent"] = "skin"  # "parent": contacts come in the frame that `pose` names
    mismatch: str = "none"  # how the stub's sheet differs from the bundle: a name of models/mismatch.py
    world: str = ""  # what the stub's skin does beside, as real ones do: a name of firmware_stub/worlds/table.py
    calibration: Path | None = None  # this very skin's force law: services/contacts/force/calibration_file.py
    reads: Reads | None = None  # what forces are read from; None: as the bundle says, else "pressure"
    indenter: Indenter | None = None
    network: NetworkFile = "int8"
    scan_setting: SettingName = "coherent"  # how each pair is measured: protocol/scan_setting.py
    dft_points: Literal[128, 256, 512] = 128  # of a setting with a DFT of 128
    baud: Annotated[int, Field(ge=SLOWEST_BAUD, le=FASTEST_BAUD, strict=True)] = BAUD  # of the serial line
    scan: ScanMode = "rolling"  # in parts, where board and bundle can and the load allows it; full: whole
    rtia_ohm: Annotated[Number, Field(ge=LEAST_RTIA_OHM, le=MOST_RTIA_OHM)] = (
        40_000.0  # gain resistor of the board's current measurement
    )
    tare: TareConfig = TareConfig()
    touch: TouchConfig = TouchConfig()

    @field_validator("port")
    @classmethod
    def some_port(cls, port: str) -> str:
        if "://" in port:
            port_url.check(port)
            return port
        if port == "stub" or port.startswith("/") or Path(port).suffix in RECORDINGS:
            return port
        raise ValueError(
            '"stub", a device path (/dev/ttyACM0), a pyserial URL (socket://host:4000), a recording (*.mcap) or a file '
            "of measurements (*.npz)"
        )

    @property
    def setting(self) -> ScanSetting:
        """How the board measures each pair."""
        named = NAMED[self.scan_setting]
        return replace(named, points=self.dft_points) if self.scan_setting in WITH_POINTS else named

    @model_validator(mode="after")
    def points_of_a_dft(self) -> Skin:
        if self.dft_points != LEAST_POINTS and self.scan_setting not in WITH_POINTS:
            raise ValueError(
                f"`dft_points` with scan_setting = {' or '.join(map(repr, WITH_POINTS))}: the others have points of "
                f"their own (found {self.dft_points} with {self.scan_setting!r})"
            )
        return self

    @field_validator("scan", mode="before")
    @classmethod
    def scan_of_today(cls, scan: object) -> object:
        if scan == "adaptive":
            raise ValueError('"full" or "rolling": the adaptive scan is no more, write "rolling", which is quicker')
        return scan

    @model_validator(mode="after")
    def one_law(self) -> Skin:
        if self.reads is not None and self.calibration is not None:
            raise ValueError(
                "`reads` or `calibration`: a calibration's file says itself what its law reads; leave one of them out "
                f"(found {self.reads!r} and {str(self.calibration)!r})"
            )
        return self

    @model_validator(mode="after")
    def mismatch_of_a_stub(self) -> Skin:
        if self.mismatch != "none" and self.port != "stub":
            raise ValueError(f'`mismatch` with port = "stub" alone: a real skin has its own (found {self.port!r})')
        if self.world and self.port != "stub":
            raise ValueError(f'`world` with port = "stub" alone: a real skin is in its own (found {self.port!r})')
        if self.world and self.mismatch != "none":
            raise ValueError("`world` and `mismatch`: a world has a sheet of its own; leave one of them out")
        return self


RECORDINGS = (".mcap", ".npz")
MOST_SKINS = 64  # of one service


def _one_board(port: str, other: str) -> bool:
    """Whether two ports are the same board: a device may have several names."""
    if port == "stub" or Path(port).suffix in RECORDINGS:  # a stub is started for each skin, a file read by each
        return False
    return port == other or (port.startswith("/") and os.path.realpath(port) == os.path.realpath(other))


class ConfigFile(Section):
    """The whole file. `path` is where it was read from; relative paths in it are relative to its folder."""

    skins: Annotated[dict[str, Skin], Field(min_length=1)]
    sockets: Sockets = Sockets()
    security: Security = Security()
    realtime: RealTime = RealTime()
    skip: Skip = Skip()
    bridges: tuple[Literal["page", "foxglove"], ...] = ()  # that `skin up` starts too
    page: PageSection = PageSection()
    foxglove: FoxgloveSection = FoxgloveSection()
    recorder: RecorderSection | None = None  # without it, `skin up` starts no recorder
    logging: Logging = Logging()
    path: Annotated[Path, Field(exclude=True)] = Path("skin.toml")

    @field_validator("skins")
    @classmethod
    def names(cls, skins: dict[str, Skin]) -> dict[str, Skin]:
        if len(skins) > MOST_SKINS:
            raise ValueError(
                f"at most {MOST_SKINS} skins (found {len(skins)}): run the others in a service of their own, with "
                "another skin.toml and another EITSKIN_RUNTIME"
            )
        for name in skins:
            if not SKIN_NAME.fullmatch(name):
                raise ValueError(f"skin names of lower-case letters, digits, - and _ (found {name!r})")
        for (name, skin), (other, same) in itertools.combinations(skins.items(), 2):
            if _one_board(skin.port, same.port):
                raise ValueError(
                    f"a port of its own for each skin ({name} has {skin.port!r}, {other} has {same.port!r}: "
                    "one board measures one skin)"
                )
        return {name: s if s.frame_id else s.model_copy(update={"frame_id": name}) for name, s in skins.items()}

    @field_validator("bridges")
    @classmethod
    def each_once(cls, bridges: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(bridges)) < len(bridges):
            raise ValueError(f"each of {', '.join(BRIDGES)} at most once")
        return bridges

    def transport(self) -> Transport:
        """For `protocol.transport.configure`."""
        return self.security.transport(self.sockets.addresses, self.path.parent)

    def relative(self, path: Path | None) -> Path | None:
        """A path of the file: relative ones are relative to its folder."""
        return None if path is None else self.path.parent / path

    def _resolved(self, skin: Skin) -> Skin:
        """The skin with its paths relative to our folder made whole. A bundle's name stays a name."""
        paths: dict[str, Any] = {"calibration": self.relative(skin.calibration)}
        if Path(skin.port).suffix in RECORDINGS and "://" not in skin.port:
            paths["port"] = str(self.relative(Path(skin.port)))
        beside = self.path.parent / skin.bundle
        shipped = (BUNDLES / skin.bundle / MANIFEST).is_file()
        if "/" in skin.bundle or ((beside / MANIFEST).is_file() and not shipped):
            paths["bundle"] = str(beside)
        return skin.model_copy(update=paths)

    def skin(self, name: str) -> Skin:
        """The skin called `name`; ConfigError names those there are."""
        if name not in self.skins:
            raise ConfigError(f"{self.path}: no skin called {name!r}; configured: {', '.join(self.skins)}")
        return self.skins[name]


def config_path(path: str | Path | None = None) -> Path:
    """The file in force: the argument, else $EITSKIN_CONFIG, else skin.toml of the checkout."""
    return Path(path or os.environ.get("EITSKIN_CONFIG") or ROOT / "skin.toml")


def load(path: str | Path | None = None) -> ConfigFile:
    """Read and check the configuration. Raises ConfigError, one line for each thing that is wrong."""
    file = config_path(path)
    try:
        raw = tomllib.loads(read_text(file))
    except FileError as why:
        raise ConfigError(str(why)) from None
    except (ValueError, RecursionError) as why:  # TOMLDecodeError; a number of ten thousand digits
        raise ConfigError(f"{file}: is not TOML: {why}") from None
    return parse(raw, file)


def parse(raw: dict[str, Any], file: Path = Path("skin.toml")) -> ConfigFile:
    """Check a configuration that is already a dict; `file` is named in errors."""
    if wrong_text := _control_characters(raw):
        raise ConfigError("\n".join(f"{file}: {line}" for line in wrong_text))
    if "ros2" in raw or (isinstance(raw.get("bridges"), list) and "ros2" in raw["bridges"]):
        raise ConfigError(f"{file}: {NO_ROS2}")
    try:
        config = ConfigFile.model_validate(raw | {"path": file})
        return config.model_copy(update={"skins": {n: config._resolved(s) for n, s in config.skins.items()}})
    except ValidationError as wrong:
        raise ConfigError("\n".join(_explain(file, e) for e in wrong.errors())) from None


def _control_characters(raw: dict[str, Any]) -> list[str]:
    """A line for each text, or name of a key, that no terminal or file name should get."""
    found, waiting = [], [("", raw)]
    while waiting:
        key, value = waiting.pop()
        if isinstance(value, str) and _controls(value):
            found.append(f"{key}: found {_shown(value)}; allowed: text without control characters")
        if not isinstance(value, dict | list):
            continue
        for name, inner in value.items() if isinstance(value, dict) else enumerate(value):
            if _controls(str(name)):
                found.append(f"{key or '(top level)'}: found the name {_shown(name)}; allowed: printable characters")
            else:
                waiting.append((f"{key}.{name}".lstrip("."), inner))
    return sorted(found)


def _controls(text: str) -> bool:
    return any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in text)


def _explain(file: Path, error: Any) -> str:
    key = ".".join(str(part) for part in error["loc"]) or "(top level)"
    if error["type"] == "missing":
        return f"{file}: {key}: is missing; add it"
    if error["type"] == "extra_forbidden":
        return f"{file}: {key}: unknown key; allowed here: {', '.join(_allowed(error['loc'][:-1]))}"
    found = _shown(error["input"])
    allowed = error["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    return f"{file}: {key}: found {found}; allowed: {allowed}"


def _shown(value: Any) -> str:
    try:
        found = repr(value)
    except (ValueError, RecursionError):  # a number of ten thousand digits, a list a thousand deep
        return f"a {type(value).__name__} too long to show"
    return found if len(found) < 80 else found[:77] + "..."


def _allowed(location: tuple[int | str, ...]) -> list[str]:
    """Keys that the section at `location` knows."""
    model: Any = ConfigFile
    for part in location:
        if model is ConfigFile and part == "skins":
            continue
        if location[0] == "skins" and part == location[1] and model is ConfigFile:
            model = Skin
            continue
        model = _section(model.model_fields[str(part)].annotation)
    return [name for name, field in model.model_fields.items() if not field.exclude]


def _section(annotation: Any) -> type[BaseModel]:
    options = getattr(annotation, "__args__", (annotation,))
    return next(o for o in options if isinstance(o, type) and issubclass(o, BaseModel))
