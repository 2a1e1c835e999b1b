"""A bundle calibrated to one very skin: its matrices about the skin as it is mounted, in one packed piece (numpy only).

    packed = pack(matrices, skin, findings)  # models/fit_calibration.py does, after the fit
    mine = unpack(packed, bundle)            # a Bundle with those matrices, that geometry and a hash of its own

The hash covers the bundle's hash and every byte of the piece. The network files stay the bundle's.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle, matrices_of
from models.bundle_check import Wrong, check
from models.npz import npz
from models.prereconstruction import Matrices
from protocol.errors import EitskinError

SCHEMA = 1
MOST_BYTES = 32 * 1024 * 1024  # unpacked
KEY = "calibration"  # in the manifest: what the fit found, as `findings`
FIELDS = "fields"  # older calibrations have none


class CalibrationFileError(EitskinError):
    """A calibration that cannot be used; says what was found and what to do."""


def pack(
    matrices: Matrices, skin: Mapping[str, Any], findings: Mapping[str, Any], fields: NDArray[np.float32] | None = None
) -> bytes:
    """skin: the geometry as mounted (`SkinGeometry.to_dict`); findings: what the fit found, with `bundle_hash`;
    fields: as `Bundle.mounted_fields`.
    """
    arrays: dict[str, Any] = {f.name: np.asarray(getattr(matrices, f.name)) for f in dataclasses.fields(Matrices)}
    lower = np.tril_indices(len(matrices.gram))  # it is symmetric: a state with the whole would be too large to send
    arrays["gram"] = np.asarray(matrices.gram)[lower]
    text = json.dumps({"schema": SCHEMA, "skin": dict(skin), **findings}, allow_nan=False)
    if fields is not None:
        arrays[FIELDS] = fields.astype(np.float16)  # as response.npz has them
    out = io.BytesIO()
    np.savez_compressed(out, said=np.frombuffer(text.encode(), np.uint8), **arrays)
    return out.getvalue()


def unpack(packed: bytes, bundle: Bundle) -> Bundle:
    """The bundle (as it was loaded, not calibrated before) with this calibration. Raises CalibrationFileError."""
    try:
        arrays: dict[str, Any] = dict(npz(io.BytesIO(packed), "the calibration", MOST_BYTES))
        findings = json.loads(arrays.pop("said").tobytes())
        schema, made_for, skin = findings.pop("schema"), findings["bundle_hash"], dict(findings.pop("skin"))
        arrays["gram"] = _whole(arrays["gram"], len(arrays["z0"]))
        fields = _fields(arrays.pop(FIELDS), arrays["contact"].shape[1]) if FIELDS in arrays else None
        matrices = matrices_of(arrays)
    except (EitskinError, ValueError, KeyError, TypeError, OSError, AttributeError) as wrong:
        raise CalibrationFileError(f"no calibration ({str(wrong)[:120]}): run `skin tare` again") from None
    if schema != SCHEMA:
        raise CalibrationFileError(f"a calibration of schema {schema}, expected {SCHEMA}: run `skin tare` again")
    if made_for != bundle.hash:
        raise CalibrationFileError(
            f"a calibration of the bundle {str(made_for)[:12]}, this is {bundle.hash[:12]}: run `skin tare` again"
        )
    manifest = {**bundle.manifest, "skin": skin, KEY: findings}
    try:
        check(manifest, matrices)
    except Wrong as why:
        raise CalibrationFileError(f"the calibration: {why}: run `skin tare` again") from None
    digest = hashlib.sha256(bundle.hash.encode() + packed).hexdigest()
    return replace(bundle, manifest=manifest, matrices=matrices, hash=digest, mounted_fields=fields)


def _whole(lower: NDArray[np.float64], k: int) -> NDArray[np.float64]:
    """(k, k) of its lower triangle. Raises ValueError where that has another size."""
    made = np.zeros((k, k))
    made[np.tril_indices(k)] = lower
    return made + np.tril(made, -1).T


def _fields(values: NDArray[Any], electrodes: int) -> NDArray[np.float32]:
    """(2, F * F, E), F of any size. Raises ValueError where it is nothing like it."""
    side = round(values.shape[1] ** 0.5) if values.ndim == 3 else 0
    if values.dtype.kind != "f" or not side or values.shape != (2, side**2, electrodes):
        raise ValueError(f"fields: {values.dtype} {values.shape}, expected floats (2, F F, {electrodes})")
    if not np.isfinite(values).all():
        raise ValueError("fields: NaN or infinity, expected finite numbers")
    return values.astype(np.float32)


def found_by(bundle: Bundle) -> dict[str, Any] | None:
    """What the calibration of a calibrated bundle found; None for any other."""
    findings = bundle.manifest.get(KEY)
    return dict(findings) if isinstance(findings, dict) else None
