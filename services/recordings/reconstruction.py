"""`skin reconstruct`: measurements of a file through the runtime stages, without sockets and without a clock."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle, BundleError
from models.calibration_file import found_by
from models.prereconstruction import PreReconstructor, noise_of_frames
from protocol.frames import RawFrame
from services.estimation.initialisation.baseline import (
    SEE,
    Baseline,
    NoBaseline,
    coarseness,
    identical,
    in_proportion,
    take,
    unlike,
)
from services.estimation.values import numbers
from services.estimation.values.estimate import Judgement, Verdict
from services.mounting import MountingFit, needs_fit
from services.pipeline import ALL, Pipeline, Result
from services.recordings.npz_file import TARE_ROWS, UNIT_UNKNOWN, Input, frames_of
from services.runtime.config import ConfigError, Skin, load
from services.runtime.stage import SEPARATE

Array = NDArray[np.float64]

IMAGE_SIZE = 96
MOST_CONTACTS = 8
ROW_NS = 45_000_000
"""Time between rows of a --sequence: the board's nominal scan."""
UNKNOWN_AGE_S = 300.0
"""Between the untouched rows of a file and its measurements, where nobody says: all the drift that is allowed for."""
FEWEST_FOR_TARE = 16
JOIN = " "  # of a row's reasons
MOST_REASONS = 120  # characters
AGE_OF_REFERENCE = "none: each row has its own `reference`"
IN_ORDER = "in the skin's own order"
UNSAID = {SEPARATE, "replay"}  # reasons of every row of a file


def find_skin(name: str) -> tuple[Skin, Bundle]:
    """A configured skin by its name, else a bundle by name or path. Raises ConfigError or BundleError."""
    unusable: ConfigError | None = None
    try:
        config = load()
        if name in config.skins:
            return config.skins[name], Bundle.load(config.skins[name].bundle)
    except ConfigError as why:
        unusable = why  # a bundle can be used with no configuration at all
    try:
        return Skin(port="stub", bundle=name, frame_id=name), Bundle.load(name)
    except BundleError as why:
        if unusable is None:
            raise
        raise BundleError(f"{why}\nnor a configured skin, for the configuration cannot be used: {unusable}") from None


def mounted_bundle(frames: Array, bundle: Bundle, warn: Callable[[str], None]) -> Bundle:
    """The bundle calibrated from untouched |Z| (M, K), or as it is where there is nothing to find or nothing found."""
    baseline = _mean_of(frames, bundle.prereconstructor(), lambda text: None)
    if not needs_fit(baseline, bundle):
        return bundle
    search = MountingFit(bundle)
    search.start(baseline)
    found = search.wait()
    if found is None:
        warn(search.problem)
        return bundle
    for remark in (found_by(found.bundle) or {}).get("remarks", []):
        warn(f"`untouched`: {remark}")
    return found.bundle


def baseline_of(frames: Array, pre: PreReconstructor, warn: Callable[[str], None], rows: NDArray[Any]) -> Baseline:
    """The tare of (M, K) untouched |Z|; where a board's tare would refuse, the mean all the same, in doubt.

    rows: (N, K) of the same file, which say in which steps it was measured.
    """
    found = _mean_of(frames, pre, warn)
    if off := unlike(found.z0, found.sigma / found.frames**0.5, pre):
        doubt = f"`untouched` is {off}: {SEE} (--skin, --pattern)"
    elif not (doubt := _too_coarse(frames, rows)):
        return found
    warn(doubt)
    return replace(found, doubt=doubt)


def _too_coarse(untouched: Array, rows: NDArray[Any]) -> str:
    steps = coarseness(np.vstack([untouched, np.abs(rows)]))
    return steps and f"|Z| is known {steps}: measure it with 10 bits or more"


def _mean_of(frames: Array, pre: PreReconstructor, warn: Callable[[str], None]) -> Baseline:
    doubt = ""
    if len(frames) > 1 and (frames == frames[0]).all():
        warn("the rows of `untouched` are all equal: only the first is used")  # computed, not measured
        frames = frames[:1]
    if len(frames) >= FEWEST_FOR_TARE:
        try:
            return _report_doubt(take(frames, pre, "file"), warn)
        except NoBaseline as why:
            doubt = f"`untouched`: {why}"
            warn(doubt + "; using their mean")
    frames = np.where(np.isfinite(frames), frames, np.nan)
    mean = np.nanmean(frames, axis=0)
    good = in_proportion(np.log(np.where(mean > 0, mean, np.nan))[None])  # false where there is none
    z0, sigma = np.zeros(len(mean)), np.full(len(mean), np.inf)
    z0[good], mean = mean[good], mean[good]
    if len(frames) >= 2:
        measured = frames[:, good]
        sigma[good] = noise_of_frames(np.where(np.isfinite(measured), measured, mean), mean)
    else:
        sigma[good] = numbers.TARE_ASSUMED * mean
        warn(f"`untouched` has one row: a noise of {numbers.TARE_ASSUMED:g} of each measurement is assumed")
    return Baseline(z0, sigma, len(frames), "file", 0, doubt)


def _report_doubt(found: Baseline, warn: Callable[[str], None]) -> Baseline:
    """Print why a tare is in doubt. Noise below the steps of a file is no doubt: in fewer rows it is none."""
    if found.doubt == identical(found.frames):
        warn(
            "most values of `untouched` are the same in every row: "
            f"a noise of {numbers.TARE_ASSUMED:g} of each measurement is assumed"
        )
        return replace(found, doubt="")
    if found.doubt:
        warn("`untouched`: " + found.doubt.removesuffix(", then run `skin tare`"))  # of a file there is none
    return found


def reconstruct(
    data: Input,
    skin: Skin,
    bundle: Bundle,
    sequence: bool = False,
    warn: Callable[[str], None] = lambda text: None,
    progress: Callable[[Iterable[int]], Iterable[int]] = lambda rows: rows,
    age_s: float | None = None,
    calibrate: bool = False,
) -> dict[str, NDArray[Any]]:
    """The arrays of OUT.npz: see `skin reconstruct --help`. Rows are independent unless `sequence`.

    age_s: of the untouched rows when the measurements, or the first of a sequence, were taken; None: UNKNOWN_AGE_S. A
    reference has none.
    calibrate: fit first how the skin is mounted, from the untouched rows, where the bundle does not predict them as it
    is (seconds).

    A row whose reference gives fewer than half the measurements stays empty: not valid, no image, no contacts.
    """
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of numpy, for measurements that are not finite
        return _reconstruct(data, skin, bundle, sequence, warn, progress, age_s, calibrate)


def _reconstruct(
    data: Input,
    skin: Skin,
    bundle: Bundle,
    sequence: bool,
    warn: Callable[[str], None],
    progress: Callable[[Iterable[int]], Iterable[int]],
    age_s: float | None,
    calibrate: bool,
) -> dict[str, NDArray[Any]]:
    if calibrate and data.untouched is not None:
        bundle = mounted_bundle(data.untouched, bundle, warn)
    name = skin.frame_id or "skin"
    pipeline = Pipeline(skin, name, bundle, always_reconstruct=True, each_alone=not sequence)
    out = _empty(len(data.measurements))
    rows = progress(range(len(data.measurements)))
    if data.untouched is None:
        _beside_references(data, pipeline, sequence, rows, out, warn)
        return _with_assumed(out, data, _noise_of_references(data, pipeline), AGE_OF_REFERENCE, "")
    baseline = baseline_of(data.untouched, pipeline.pre.pre, warn, data.measurements)
    age = f"{age_s:g} s, as told" if age_s is not None else f"not said: up to {UNKNOWN_AGE_S:g} s of drift allowed for"
    for row in rows:
        if not sequence:
            pipeline.reset()
        if not sequence or row == 0:
            fresh = Baseline(**{**baseline.to_dict(), "z0": baseline.z0.copy()})
            pipeline.pre.set_baseline(fresh, age_s=UNKNOWN_AGE_S if age_s is None else age_s)
        _store(out, row, pipeline.run(raw_frame(data.measurements[row], row if sequence else 0)))
    noise = _noise(baseline.sigma, baseline.z0, baseline.frames, "`untouched`")
    return _with_assumed(out, data, noise, age, _left_out(data.untouched, baseline))


def _with_assumed(
    out: dict[str, NDArray[Any]], data: Input, noise: str, age: str, left_out: str
) -> dict[str, NDArray[Any]]:
    """The arrays with what was assumed, as `assumed` (5, 2): of what, and what of it."""
    if data.unit == UNIT_UNKNOWN:
        out["force"][:], out["force_sigma"][:] = np.nan, np.nan
        for row in np.flatnonzero(out["count"]):
            said = [each for each in str(out["reasons"][row]).split() if each != "extrapolated"]  # a force of no unit
            out["reasons"][row] = JOIN.join(dict.fromkeys([*said, "uncalibrated_force"]))
    assumed = {"noise": noise, "age": age, "unit": data.unit, "columns": data.understood or IN_ORDER}
    return out | {"assumed": np.array([*(assumed | {"left out": left_out or "nothing"}).items()])}


def _noise(sigma: Array, z0: Array, rows: int, of: str) -> str:
    known = np.isfinite(sigma) & (z0 > 0)
    share = float(np.median(sigma[known] / z0[known])) if known.any() else np.nan
    if share == numbers.TARE_ASSUMED:
        return f"{share:.2g} of each measurement, assumed: {of} {'has one row' if rows == 1 else 'says nothing of it'}"
    return f"{share:.2g} of each measurement, from {rows} rows of {of}"


def _noise_of_references(data: Input, pipeline: Pipeline) -> str:
    found = pipeline.pre.references.now.noise
    if found is None or data.reference is None:
        return "not known: no `reference` could be used"
    return _noise(found, np.ones(len(found)), min(len(data.reference), TARE_ROWS), "`reference`")


def _left_out(untouched: Array, baseline: Baseline) -> str:
    """Rows and columns of `untouched` that do not count."""
    rows, columns = len(untouched) - baseline.frames, int((~np.isfinite(baseline.sigma)).sum())
    said = [f"{rows} of {len(untouched)} rows of `untouched`, which equal the first"] if rows else []
    said += [f"{columns} of {untouched.shape[1]} measurements, which `untouched` does not give"] if columns else []
    return "; ".join(said)


def _beside_references(
    data: Input,
    pipeline: Pipeline,
    sequence: bool,
    rows: Iterable[int],
    out: dict[str, NDArray[Any]],
    warn: Callable[[str], None],
) -> None:
    """Each row against the reference just before it: the very frames that an import or a port gives of such a file."""
    frames, lost, doubt = frames_of(data), 0, ""
    if data.reference is not None and data.unit == Input.unit:  # differences alone stand in steps of no |Z|
        pipeline.pre.references.doubt = _too_coarse(data.reference, data.measurements)
    for row in rows:
        for values, kind in frames:
            frame = raw_frame(values, row, kind, separate=not sequence)
            if kind == "full":
                break
            pipeline.pre.process(frame, ALL)
        frame.scan += 1
        _store(out, row, pipeline.run(frame))
        lost += pipeline.pre.baseline is None
        doubt = doubt or getattr(pipeline.pre.baseline, "doubt", "")
    if doubt:
        warn(f"{doubt} (--skin, --pattern)" if SEE in doubt else doubt)
    if lost:
        warn(f"{lost} of {len(out['valid'])} rows are not valid: their `reference` gives too few measurements")


def raw_frame(measurement: NDArray[Any], scan: int, kind: str = "full", separate: bool = False) -> RawFrame:
    return RawFrame(
        skin="file",
        scan=scan,
        kind=kind,
        reasons=[SEPARATE] if separate else [],
        z=measurement.astype(np.complex64),
        status=np.zeros(len(measurement), np.uint8),
        stamps={"sample": (scan + 1) * ROW_NS},
        source="replay",
        valid=True,
        board="file",
    )


def _empty(n: int) -> dict[str, NDArray[Any]]:
    return {
        "image": np.zeros((n, IMAGE_SIZE, IMAGE_SIZE), np.float32),
        "touched": np.zeros(n, bool),
        "valid": np.zeros(n, bool),
        "count": np.zeros(n, np.int64),
        "position": np.full((n, MOST_CONTACTS, 2), np.nan),
        "force": np.full((n, MOST_CONTACTS), np.nan),
        "force_sigma": np.full((n, MOST_CONTACTS), np.nan),
        "shape": np.full((n, MOST_CONTACTS), "", "<U12"),
        "reasons": np.full(n, "", f"<U{MOST_REASONS}"),
        "check": np.full(n, "", "<U16"),
        "statistic": np.full(n, np.nan),
        "limit": np.full(n, np.nan),
    }


def _store(out: dict[str, NDArray[Any]], row: int, result: Result) -> None:
    image = result.image.image
    if image.size:
        out["image"][row] = np.nan_to_num(resampled(image, IMAGE_SIZE), posinf=0.0, neginf=0.0)
    contacts = [c for c in result.contact.contacts if c.state != "end"]
    out["reasons"][row] = JOIN.join(reason for reason in result.contact.reasons if reason not in UNSAID)
    if (found := _decided(result)) is not None:
        out["check"][row], out["statistic"][row], out["limit"][row] = found.name, found.statistic, found.expected
    out["touched"][row] = result.delta.touched
    out["valid"][row] = result.contact.valid
    out["count"][row] = len(contacts)
    for place, contact in enumerate(contacts[:MOST_CONTACTS]):
        out["position"][row, place] = contact.on_sheet
        out["force"][row, place] = np.nan if contact.force_n is None else contact.force_n
        out["force_sigma"][row, place] = np.nan if contact.force_sigma_n is None else contact.force_sigma_n
        out["shape"][row, place] = contact.shape


def _decided(result: Result) -> Judgement | None:
    """What a row's verdict stands on: whether something touches, of a valid row and of one where that is not sure; else
    what is furthest beyond its limit; None where its image or its contacts, made after all judgements, made it invalid.
    """
    refused = [each for each in result.judgements if each.verdict is Verdict.REFUSE]
    if beyond := [each for each in refused if each.name != "changing"]:
        return max(beyond, key=lambda each: each.ratio)
    told = refused or result.contact.valid
    return next((each for each in result.judgements if told and each.name == "touch"), None)


def resampled(image: NDArray[np.float32], n: int) -> NDArray[np.float32]:
    """(h, w) -> (n, n), linear between pixel centres; unchanged where it is that size already."""
    if image.shape == (n, n):
        return image
    rows, columns = (_weights(n, size) for size in image.shape)
    return np.asarray(rows @ image @ columns.T, np.float32)


def _weights(n: int, m: int) -> NDArray[np.float32]:
    at = np.clip((np.arange(n) + 0.5) * m / n - 0.5, 0, m - 1)
    low = np.minimum(at.astype(int), max(m - 2, 0))
    weight = np.zeros((n, m), np.float32)
    weight[np.arange(n), low] = 1 - (at - low)
    weight[np.arange(n), np.minimum(low + 1, m - 1)] += at - low
    return weight
