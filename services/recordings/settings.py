"""The part of the configuration that a recording carries: what the stages need to give the same contacts again.

    {"skins": {"palm": {"bundle": "square16", "bundle_hash": ..., "frame_id": ..., "pose": ..., "network": ...,
     "reads": ..., "indenter": ..., "scan_setting": ..., "dft_points": ..., "scan": ..., "rtia_ohm": ..., "tare": ...,
     "touch": ..., "calibration": {...}}}, "skip": {...}}

It holds no address, key, port or path. A recording may come from anybody, so its settings are checked like a
configuration. Its bundle is looked for among the installed ones by its hash.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, field_validator

from models.bundle import BUNDLES, Bundle, BundleError
from models.files import read_text
from protocol.scan_setting import SettingName
from services.contacts.force import calibration_file as calibration
from services.recordings.recording import RecordingError
from services.runtime.config import (
    SKIN_NAME,
    ConfigError,
    ConfigFile,
    Indenter,
    Pose,
    Reads,
    ScanMode,
    Skin,
    TareConfig,
    TouchConfig,
)
from services.runtime.config_sections import Number, Section, Skip

KEY = "settings"
"""The key of a recording's metadata."""
MOST_BYTES = 1024 * 1024
CARRIED = (
    "frame_id",
    "pose",
    "network",
    "reads",
    "indenter",
    "scan_setting",
    "dft_points",
    "scan",
    "rtia_ohm",
    "tare",
    "touch",
)

Name = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f]{0,256}$")]


class RecordedPose(Pose):
    parent: Name = "base"


class RecordedSkin(Section):
    """One skin as it was when it was recorded."""

    bundle: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]  # its name, for the person who has to find it
    bundle_hash: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    frame_id: Name = ""
    pose: RecordedPose = RecordedPose()
    network: Literal["full", "fast", "int8", "none"] = "int8"
    reads: Reads | None = None
    indenter: Indenter | None = None
    scan_setting: SettingName = "paper"  # the only one that there was before recordings said it
    dft_points: Literal[128, 256, 512] = 128
    scan: ScanMode = "full"
    rtia_ohm: Annotated[Number, Field(gt=0)] = 40_000.0
    tare: TareConfig = TareConfig()
    touch: TouchConfig = TouchConfig()
    calibration: dict[str, Any] | None = None  # the content of its file, which calibration.load checks

    @field_validator("indenter", mode="before")
    @classmethod
    def indenter_of_then(cls, indenter: Any) -> Any:
        """Earlier versions knew a fit of what presses, whose radius they might not know."""
        if not isinstance(indenter, dict):
            return indenter
        radius_m = indenter.get("radius_m")
        return None if radius_m is None else {"radius_m": radius_m}

    @field_validator("scan", mode="before")
    @classmethod
    def scan_of_then(cls, scan: object) -> object:
        """Earlier versions knew an adaptive scan, of which the whole scans still count."""
        return "full" if scan == "adaptive" else scan


class Settings(Section):
    """What a recording says of its skins."""

    skins: Annotated[dict[str, RecordedSkin], Field(max_length=64)] = {}
    skip: Skip = Skip()

    @field_validator("skins")
    @classmethod
    def names(cls, skins: dict[str, RecordedSkin]) -> dict[str, RecordedSkin]:
        for name in skins:
            if not SKIN_NAME.fullmatch(name):
                raise ValueError(f"skin names of lower-case letters, digits, - and _ (found {name!r:.80})")
        return skins


def text_of(skins: Mapping[str, Skin], skip: Skip | None = None) -> str:
    """The settings of these skins as a recording holds them. Raises BundleError, ConfigError."""
    found = {name: _recorded(skin) for name, skin in skins.items()}
    settings = {"skins": found, "skip": (skip or Skip()).model_dump(mode="json")}
    return json.dumps(settings, allow_nan=False)


def _recorded(skin: Skin) -> dict[str, Any]:
    bundle = Bundle.load(skin.bundle)
    said = {key: value for key, value in skin.model_dump(mode="json").items() if key in CARRIED}
    law: dict[str, Any] | None = None
    if skin.calibration is not None:
        calibration.load(skin.calibration, skin, bundle)
        law = json.loads(read_text(skin.calibration, calibration.MOST_BYTES))
    return {**said, "bundle": bundle.name, "bundle_hash": bundle.hash, "calibration": law}


def read(text: str, source: Path) -> Settings:
    """The settings that a recording holds; none where it has none. Raises RecordingError, which names `source`."""
    if not text:
        return Settings()
    try:
        if len(text) > MOST_BYTES:
            raise ValueError(f"{len(text)} characters, expected at most {MOST_BYTES}")
        return Settings.model_validate(json.loads(text))
    except ValidationError as wrong:
        first = wrong.errors()[0]
        place, found = ".".join(map(str, first["loc"])), repr(first["input"])[:80]
        raise RecordingError(
            f"{source}: its settings cannot be used: {place}: found {found}; allowed: {first['msg']}"
        ) from None
    except (ValueError, RecursionError) as why:
        raise RecordingError(f"{source}: its settings cannot be used: {str(why)[:200]}") from None


@dataclass(frozen=True)
class Known:
    """Bundles to choose from, by hash: the installed ones, those that the user's configuration names, and `given`."""

    paths: Mapping[str, Path]
    given: Bundle | None = None

    @staticmethod
    def here(config: ConfigFile | None, given: Path | None = None) -> Known:
        """Raises BundleError where `given` cannot be used."""
        named: Iterable[str] = [skin.bundle for skin in config.skins.values()] if config is not None else ()
        paths: dict[str, Path] = {}
        installed = (str(path.parent) for path in sorted(BUNDLES.glob("*/manifest.json")))
        for place in (*installed, *named):
            try:
                bundle = Bundle.load(place)
            except BundleError:  # it may be another skin's; `skin doctor` reports it
                continue
            paths.setdefault(bundle.hash, bundle.path)
        return Known(paths, Bundle.load(given) if given is not None else None)

    def path(self, name: str, skin: RecordedSkin) -> Path:
        """The bundle of a recorded skin. Raises RecordingError."""
        if self.given is not None:
            return self.given.path
        if skin.bundle_hash not in self.paths:
            raise RecordingError(
                f"skin {name!r} was recorded with bundle {skin.bundle} {skin.bundle_hash[:12]}, which is not installed "
                f"(models/bundles and skin.toml have {len(self.paths)} others): name it with --bundle PATH"
            )
        return self.paths[skin.bundle_hash]

    def differs(self, name: str, skin: RecordedSkin) -> str:
        """A warning where the given bundle is not the recorded one; else ""."""
        if self.given is None or self.given.hash == skin.bundle_hash:
            return ""
        return (
            f"skin {name!r} was recorded with bundle {skin.bundle} {skin.bundle_hash[:12]}, --bundle is "
            f"{self.given.name} {self.given.hash[:12]}: contacts will differ from the recorded ones"
        )


def configuration(settings: Settings, known: Known, folder: Path) -> dict[str, Any]:
    """A configuration of these skins, as skin.toml would hold it, with the defaults for sockets and all else.

    Calibrations are written to `folder`. Raises RecordingError, BundleError.
    """
    skins: dict[str, Any] = {}
    for name, skin in settings.skins.items():
        bundle = Bundle.load(known.path(name, skin))
        said = {key: value for key, value in skin.model_dump(mode="json").items() if key in CARRIED}
        skins[name] = {"port": "stub", "bundle": str(bundle.path.resolve()), **said}
        if skin.calibration is not None and bundle.hash == skin.bundle_hash:
            file = folder / f"{name}-calibration.json"
            file.write_text(json.dumps(skin.calibration), encoding="utf-8")
            configured = Skin.model_validate(skins[name])
            try:
                calibration.load(file, configured, bundle)
            except ConfigError as why:
                raise RecordingError(f"the recording's calibration of skin {name!r} cannot be used: {why}") from None
            skins[name]["calibration"] = str(file)
    return {"skins": skins, "skip": settings.skip.model_dump(mode="json")}


def toml(content: Mapping[str, Any]) -> str:
    """A configuration as a TOML file: each skin and each section on a line of its own."""
    lines = [f"skins.{name} = {_value(skin)}" for name, skin in content["skins"].items()]
    return "\n".join([*lines, f"skip = {_value(content['skip'])}"]) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(v)}" for key, v in value.items() if v is not None) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value) if isinstance(value, float) else json.dumps(value, ensure_ascii=False)
