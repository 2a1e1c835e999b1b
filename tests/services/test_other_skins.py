"""Skins of other outlines and electrodes, without a network: made, measured by the stub's board, pressed."""

from pathlib import Path

import numpy as np
import pytest

from firmware_stub.analog import Analog, BoardNoise
from firmware_stub.faults import Faults
from firmware_stub.sheet import Sheet
from firmware_stub.world import Touch, World
from models import bundle, geometry, manifest
from models.forward import ForwardModel
from models.linearise import linearise
from protocol.scan_setting import COHERENT
from services.pipeline import Pipeline, Result
from services.runtime.config import Skin
from tests.services.stub_skin import whole_scan

ELL = [[0, 0], [100, 0], [100, 50], [50, 50], [50, 100], [0, 100]]  # mm
SKINS = {
    "disc12": {"radius": 30, "electrodes": {"width": 5, "count": 12}},
    "ell16": {"outline": ELL, "electrodes": {"width": 7.5, "count": 16, "first": 12.5}},
}
PRESSES = {  # m, in the skin's frame, and how far off a contact may be: 3 % of the skin's side
    "disc12": ([(0.0, 0.0), (0.012, -0.008), (-0.005, 0.017)], 1.8e-3),
    "ell16": ([(-0.02, -0.02), (0.03, -0.028), (-0.026, 0.03)], 3e-3),
}


class Made:
    """A skin's bundle, and its stub: board and sheet on another mesh."""

    def __init__(self, name: str, folder: Path) -> None:
        data = {"name": name, "unit": "mm", "contact_impedance": 0.01, **SKINS[name]}
        skin = geometry.from_dict(data)
        matrices = linearise(ForwardModel(skin), "model")
        bundle.write(folder / name, manifest.describe(name, skin, matrices), matrices)
        self.sheet = Sheet(str(folder / name))
        self.analog = Analog(BoardNoise(1e-4), Faults(), np.random.default_rng(1))
        config = Skin(port="stub", bundle=str(folder / name), frame_id=name, network="none")
        self.pipeline, self.scan = Pipeline(config, name=name), 0

    def feel(self, world: World, scans: int) -> Result:
        t = self.sheet.transfer(world)
        for _ in range(scans):
            self.scan += 1
            z, status = self.analog.measure((t, t), self.sheet.skin.pattern, COHERENT, 40_000.0, 0.0)
            result = self.pipeline.run(whole_scan(z, self.scan, status))
        return result


@pytest.mark.parametrize("name", ["disc12", pytest.param("ell16", marks=pytest.mark.release)])
def test_presses_are_found_where_they_are(name: str, tmp_path: Path) -> None:
    made = Made(name, tmp_path)
    rest = made.feel(World(), 80)
    if rest.contact.reasons == ["stale_baseline"]:  # the L's mesh and the stub's differ too much to be sure: one tare
        made.pipeline.pre.command("tare", {})
        rest = made.feel(World(), 8)
    assert rest.contact.valid and not rest.contact.contacts, rest.contact.reasons
    places, most = PRESSES[name]
    for x, y in places:
        contact = made.feel(World(touches=(Touch("circle", x, y, 0.006, 0.3),)), 8).contact
        assert contact.valid and len(contact.contacts) == 1, (x, y, contact.reasons)
        found = contact.contacts[0].position
        assert np.hypot(found[0] - x, found[1] - y) < most, (x, y, found)
        assert not made.feel(World(), 12).contact.contacts
