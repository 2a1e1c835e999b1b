"""The linearised physics a bundle ships: B, A and the sensitivities of `prereconstruction.Matrices`, from a
forward model.
"""

from __future__ import annotations

import numpy as np

from models.forward import ForwardModel
from models.prereconstruction import MODEL_ERROR, Array, Matrices

GRID = 24
LADDER = 10.0 ** -np.arange(0.0, 9.0)  # lambda^2, relative to the mean eigenvalue
SCALE_INDEX = 3  # lambda^2 = 1e-3: sharp enough to scale with the drop, and steady at 50 dB
NOSER_POWER = 0.5  # EIDORS's default; the paper says "a power"


def linearise(
    model: ForwardModel,
    normalisation: str = "model",
    grid: int = GRID,
    model_error: float = MODEL_ERROR,
    conductivity: Array | None = None,
) -> Matrices:
    """Matrices of the untouched skin, even or of a conductivity (n_elements, 3) as xx, xy, yy. A drop is the share that
    a touch takes of whatever conducts there.

    The NOSER prior is a density, so the mesh's element sizes do not enter the image.

    With j_k(r) the sensitivity of d_k to a drop at r, R weighs x(r)^2 by r(r) = (sum_k j_k(r)^2)^NOSER_POWER; the
    continuous R^-1 J^T is then j_k(r) / r(r), and A its integral against j_l. r is scaled to mean 1, so lambda keeps
    one meaning over skins.
    """
    even = np.tile([1.0, 0.0, 1.0], (model.n_elements, 1))
    tensors = even if conductivity is None else conductivity
    solution = model.solve(tensors)
    signed = solution.impedances()
    z0 = np.abs(signed)
    per_area = zip(solution.products(), (tensors / model.areas[:, None]).T, strict=True)
    # of d = |Z|/|Z0| - 1 to a drop, per area
    density: Array = np.sum([part * share for part, share in per_area], axis=0) / signed[:, None]
    prior = (density**2).sum(axis=0) ** NOSER_POWER
    prior /= (prior * model.areas).sum() / model.areas.sum()
    # The singular points at electrode ends would make one element rule the image: nothing is asked to be stiffer than
    # this.
    prior = np.minimum(prior, 100.0)
    elements = density / prior
    gram = (elements * model.areas) @ density.T
    pixels = model.pixel_map(grid)
    inside = np.asarray(pixels.sum(axis=1)).reshape(grid, grid) > 0
    jacobian = np.asarray((density * model.areas) @ model.element_map(grid))
    contact = solution.jacobian_contact() * model.contact_impedance / signed[:, None]
    return Matrices(
        pattern=model.pattern.astype(np.int16),
        z0=z0,
        gram=gram,
        back=np.asarray(pixels @ elements.T).astype(np.float32),
        jacobian=jacobian.astype(np.float32),
        contact=contact,
        inside=inside,
        ladder=LADDER,
        level=np.ones(len(LADDER)),
        scale_index=SCALE_INDEX,
        normalisation=normalisation,
        model_error=model_error,
    )
