"""The complete electrode model on a disc, without a mesh; the finite elements are checked against it.

On a disc of radius R the potential of a boundary current density is known mode by mode: current of angular frequency k
gives a potential R/(s k) times it, or with a concentric inclusion that times (1 + m)/(1 - m) with m = c (a/R)^(2k), c =
(s - s_in)/(s + s_in). The current density under each electrode is expanded in Legendre polynomials, and
u + z j = U is asked for in the mean against each of them. Fourier coefficients of Legendre polynomials over an arc are
spherical Bessel functions, so nothing is integrated numerically.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import spherical_jn

from models.geometry import GeometryError, SkinGeometry

Array = NDArray[np.float64]


def disc_impedances(
    skin: SkinGeometry,
    inclusion_radius: float = 0.0,
    inclusion_conductivity: float = 1.0,
    modes: int = 14,
    terms: int = 6000,
) -> Array:
    """(K,) ohm of the skin's pattern, on a disc of conductivity 1 S with a concentric inclusion [model units, S].

    modes: Legendre polynomials an electrode; terms: angular frequencies. 14 and 6000 are converged to 1e-5 for
    electrodes of a tenth of the radius. Raises GeometryError for a skin that is no disc.
    """
    if skin.outline is not None:
        raise GeometryError(f"skin '{skin.name}' is not a disc")
    radius, n = skin.radius, skin.n_electrodes
    k = np.arange(1, terms + 1)
    contrast = (1 - inclusion_conductivity) / (1 + inclusion_conductivity)
    image = contrast * (inclusion_radius / radius) ** (2.0 * k)
    gain = radius / k * (1 + image) / (1 - image)

    half = skin.widths / 2 / radius  # angle
    order = np.arange(modes)
    bessel = np.array([[spherical_jn(m, k * h) for m in order] for h in half])  # (n, modes, terms)
    phase = np.exp(-1j * np.outer(skin.electrodes / radius, k))
    basis = 2 * half[:, None, None] * radius * bessel * (1j**-order)[:, None] * phase[:, None]
    flat = basis.reshape(n * modes, terms)
    # twice the real part: frequencies k and -k
    potential = np.real((flat * gain) @ flat.conj().T) / (np.pi * radius)
    contact = (skin.contact_impedance * skin.widths)[:, None] / (2 * order + 1)
    system = potential + np.diag(contact.ravel())

    mean = np.arange(n) * modes  # the constant polynomial of each electrode carries its current
    higher = np.setdiff1d(np.arange(n * modes), mean)
    density = np.diag(1 / skin.widths)
    rest = np.linalg.solve(system[np.ix_(higher, higher)], -system[np.ix_(higher, mean)] @ density)
    electrode = (system[np.ix_(mean, mean)] @ density + system[np.ix_(mean, higher)] @ rest) / skin.widths[:, None]
    drive_plus, drive_minus, plus, minus = skin.pattern.T
    return np.asarray(
        electrode[plus, drive_plus]
        - electrode[plus, drive_minus]
        - electrode[minus, drive_plus]
        + electrode[minus, drive_minus]
    )
