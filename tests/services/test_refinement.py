"""What may be made of a held touch: a fit of its shape, and the mean of its image over the skin's symmetries."""

import numpy as np

from models.shapes import Shape
from services.refine_process import RefineHere
from services.runtime.config import Indenter, Skin, TouchConfig
from tests.services.stub_skin import StubSkin

UNIT = 0.05  # metres
CIRCLE, OTHER = Shape("circle", 0.2, -0.1, 0.22, 0.3), Shape("circle", -0.5, 0.5, 0.22, 0.3)
SKIN = Skin(port="stub", bundle="square16", frame_id="palm", indenter=Indenter(kind="circle"))


def test_a_round_touch_is_refined_and_its_uncertainties_hold():
    stub = StubSkin(85.0, skin=SKIN)
    stub.pipeline.inference.fit_by(RefineHere())
    found = [stub.feel((CIRCLE,)) for _ in range(3)][-1]
    (contact,) = found.contact.contacts
    assert found.contact.valid and contact.refined and contact.kind == "circle" and contact.kind_probability == 1.0
    off = np.hypot(*(np.array(contact.position[:2]) - UNIT * CIRCLE.centroid))
    assert off < 4 * contact.position_sigma[0] < 2e-3
    assert abs(contact.force_n - CIRCLE.force(UNIT)) < 4 * contact.force_sigma_n < 1.5
    assert abs(contact.area_m2 - CIRCLE.area * UNIT**2) < 4 * contact.area_sigma_m2
    held = stub.feel((CIRCLE,)).contact.contacts[0]
    assert held.refined and held.state == "hold"
    two = [stub.feel((CIRCLE, OTHER)) for _ in range(4)][-1].contact.contacts
    assert len(two) == 2 and not any(each.refined for each in two), "of two touches the image's answer stays"


def test_a_held_touch_gets_the_mean_without_any_frame_that_waits():
    """A round touch, which one touch's model explains scan after scan, so that it is held."""
    stub = StubSkin(85.0, skin=SKIN.model_copy(update={"touch": TouchConfig(symmetry=True)}))
    inference, seen = stub.pipeline.inference, []
    for _ in range(20):
        seen.append(stub.feel((Shape("circle", 0.3, -0.2, 0.25, 0.3),)))
        assert seen[-1].contact.valid and len({c.id for found in seen for c in found.contact.contacts}) == 1
        stub.pipeline.prepare()
    surer = [n for n, found in enumerate(seen) if found.delta.held and not found.image.held]
    assert surer and inference.health().counters["symmetric"] == len(surer)
    mean = seen[surer[-1]].image
    single = next(found for found in seen[surer[-1] :: -1] if not found.delta.held)
    assert mean.image.size and mean.reconstructed == single.delta.scan and (mean.image != single.image.image).any()
