"""A bundle fitted to one real skin: what presses at known places did in place of the bundle's own sensitivities.

The response map (response.py) replaces J, for the image. What it gets wrong for presses that it was not made of goes
into the reconstruction as model error beside the noise. Where touches are is found from the same map by its likelihood
(locating.py).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle, write
from models.locator_arrays import LocatorArrays
from models.prereconstruction import Matrices, PreReconstructor
from services.calibration.fields import pixels
from services.calibration.presses import Presses
from services.calibration.response import ResponseFit

Array = NDArray[np.float64]

MODEL_ERROR = 1.0  # lambda: the model error's share beside the mean eigenvalue of the whitened Gram matrix
TYPICAL_DROP = 0.3
"""S/m that a mean press is shown as: a skin that nobody calibrated in newtons has no scale of its own."""


def corrected(presses: Presses, found: ResponseFit, bundle: Bundle) -> Matrices:
    """The bundle's matrices with J from the response; images come out with a mean press at TYPICAL_DROP."""
    m = bundle.matrices
    inside = m.inside.ravel()
    response = found.at(found.similarity.to_machine(pixels(bundle))) * inside[:, None]  # (P, K)
    j = np.where(presses.measured, response, 0.0).T
    noise = np.where(presses.measured, presses.noise**2 + np.diag(found.error), 0.0)
    noise = np.where(presses.measured, noise, max(float(noise.max()), 1e-30))
    prior = np.sqrt((j**2 / noise[:, None]).sum(axis=0))  # NOSER, power 1/2, of the whitened J
    prior = np.where(inside, np.maximum(prior / prior[inside].mean(), 0.05), 1.0)
    back = np.where(inside[:, None], j.T / prior[:, None], 0.0)
    gram = j @ back
    mean = float((np.diag(gram) / noise).mean())
    gram = gram + np.diag(noise) * mean * MODEL_ERROR**2
    made = dataclasses.replace(
        m, gram=gram, back=back.astype(np.float32), jacobian=j.astype(np.float32), contact=np.zeros_like(m.contact)
    )
    gain = TYPICAL_DROP / _typical_peak(presses, made)
    return dataclasses.replace(
        made, back=(gain * made.back).astype(np.float32), jacobian=(made.jacobian / gain).astype(np.float32)
    )


def _typical_peak(presses: Presses, matrices: Matrices) -> float:
    operator = PreReconstructor(matrices).condition(presses.noise)
    peaks = [float(operator.one_step(d, len(matrices.inside)).max()) for d in presses.difference]
    return max(float(np.median(peaks)), 1e-12)


def write_corrected(
    folder: Path, presses: Presses, found: ResponseFit, locator: LocatorArrays | None, notes: dict[str, Any]
) -> Bundle:
    """A bundle folder of this very skin, in its true metres. `notes` goes into the manifest as `registration`."""
    bundle = found.bundle
    matrices = corrected(presses, found, bundle)
    manifest = {key: value for key, value in bundle.manifest.items() if key not in ("files", "schema")}
    metres = bundle.metres_per_unit * found.similarity.scale
    manifest["skin"] = {**manifest["skin"], "metres_per_unit": metres}
    manifest["image"] = {**manifest["image"], "metres_per_unit": metres}
    manifest |= {"network": None, "corrected_from": bundle.hash, "registration": notes}
    return write(folder, manifest, matrices, locator=locator)
