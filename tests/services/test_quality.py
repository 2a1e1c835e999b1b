"""The forward residual: touches are explained, anything else is not, and makes no valid contact."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from models.bundle import Bundle
from models.shapes import Shape, drop_image
from services.estimation.images.quality import Residual
from tests.services.stub_skin import StubSkin, present, transfer

TOUCHES = [
    (Shape("circle", 0.2, -0.3, 0.2, 0.15),),
    (Shape("circle", -0.4, 0.1, 0.3, 0.85),),
    (Shape("square", -0.6, 0.6, 0.3, 0.5),),
    (Shape("circle", 0.5, 0.5, 0.2, 0.5), Shape("L", -0.5, 0.4, 0.3, 0.4), Shape("triangle", 0.0, -0.6, 0.25, 0.3)),
]


def clean(bundle: Bundle, shapes: tuple[Shape, ...]) -> NDArray[np.float64]:
    """(K,) |Z| of the stub's sheet."""
    t, (i, j) = transfer(shapes), np.asarray(bundle.pattern)[:, :2].T
    return np.asarray(t[i, i] + t[j, j] - 2 * t[i, j])


@pytest.mark.parametrize("shapes", TOUCHES)
@pytest.mark.parametrize("dead", [False, True])
def test_the_true_image_explains_another_meshs_frame(bundle: Bundle, shapes: tuple[Shape, ...], dead: bool) -> None:
    residual = Residual(bundle, to_scale=True)
    d = (clean(bundle, shapes) / clean(bundle, ()) - 1).astype(np.float32)
    sigma = np.full(len(d), 1e-4, np.float32)
    if dead:
        sigma[(np.asarray(bundle.pattern) == 3).any(axis=1)] = np.inf
        d[~np.isfinite(sigma)] = 0
    image = drop_image(list(shapes), 96).astype(np.float32)
    right = residual(d, sigma, image)
    assert right is not None and right < 0.05
    elsewhere = residual(d, sigma, image[::-1])
    assert elsewhere is not None and elsewhere > 5 * right + 0.1
    nothing = residual(d, sigma, np.zeros_like(image))
    assert nothing == pytest.approx(1, abs=0.1)


def test_what_it_cannot_tell_is_none(bundle: Bundle) -> None:
    residual, image = Residual(bundle, to_scale=True), np.zeros((96, 96), np.float32)
    d, sigma = np.zeros(120, np.float32), np.full(120, 1e-4, np.float32)
    for wrong in ((d, np.full_like(d, np.inf), image), (d[:64], sigma[:64], image), (d, sigma, image[:95])):
        assert residual(*wrong) is None
    assert residual(d, sigma, image) == 0


def test_touches_have_quality_and_random_frames_make_no_valid_contact(bundle: Bundle) -> None:
    """Noise of any size, channels and electrodes exchanged, other skins, one value, clipped, falling."""
    skin = StubSkin()
    for shapes in TOUCHES:
        for contact in (result.contact for result in skin.felt(2, shapes)):
            assert contact.valid and contact.quality is not None and contact.quality > 0.8
        assert skin.rest(4).contact.quality is None
    rng, z0, seen = np.random.default_rng(1), clean(bundle, ()), 0
    place = {frozenset(row[:2]): k for k, row in enumerate(bundle.pattern.tolist())}
    for _ in range(3):
        z = clean(bundle, TOUCHES[rng.integers(len(TOUCHES))])
        d, size, order = z / z0 - 1, 10 ** rng.uniform(-3.0, -0.3), rng.permutation(16)
        electrodes = [place[frozenset(order[row[:2]].tolist())] for row in bundle.pattern]
        for frame in (
            z0 * (1 + size * rng.standard_normal(120)),
            z0 * (1 + rng.permutation(d)),
            z0 * (1 + d[electrodes]),
            z0 * np.exp(0.3 * rng.standard_normal(120)),
            np.full(120, 10 ** rng.uniform(-2, 4)),
            np.minimum(z, np.quantile(z0, rng.uniform(0, 0.6))),
            z0 * (1 - d),
        ):
            noisy = frame * (1 + 1e-4 * rng.standard_normal(120))
            result = skin.run(noisy.astype(np.complex64))
            assert not (result.contact.valid and present(result))
            seen += result.image.residual is not None and result.image.residual > 0.5
            skin.rest(4)
    assert seen > 4  # it is the residual that refuses many of them
    assert skin.rest(3).contact.valid


def test_a_published_reference_is_explained(bundle: Bundle, reference: Path) -> None:
    """EIDORS' frames with the drops that they were made of."""
    data = np.load(reference / "eidors_reference.npz")
    z = np.abs(data["impedance_pairs"])
    order = {tuple(sorted(p)): k for k, p in enumerate((data["pairs"] - 1).tolist())}
    rows = [order[tuple(sorted(row[:2]))] for row in bundle.pattern.tolist()]
    residual, sigma = Residual(bundle, to_scale=True), np.full(120, 1e-4, np.float32)
    shares = []
    for k in range(1, len(z)):
        if (data["conductivity"][k] == 1) and data["drop"][k].max() > 0.05:
            d = (z[k] / z[0] - 1)[rows].astype(np.float32)
            shares.append(residual(d, sigma, data["drop"][k].astype(np.float32)))
    assert len(shares) > 10 and max(s for s in shares if s is not None) < 0.1
