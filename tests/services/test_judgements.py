"""Why a frame says what it says, as the topic `judgements`: raw frames in, frames out."""

import numpy as np
import pytest

from models.bundle import Bundle
from protocol.frames import STATUS_OPEN, DeltaFrame, JudgementsFrame, PartFrame, RawFrame, pack, unpack
from services.estimation.values.judgement import ROWS, judge
from services.inference import Inference
from services.judged import judged
from services.preprocessing import Preprocessing
from services.publisher import Publishing
from services.runtime.config import Skin
from simulation.host import SimulatedHost
from tests.services.conftest import Board, Fed

ASKED = frozenset({"delta", "part", "judgements"})
UNASKED = ASKED - {"judgements"}


def run(stage: Preprocessing, frame: RawFrame) -> tuple[DeltaFrame, JudgementsFrame]:
    """What is made of a whole scan, the judgements as a subscriber has them."""
    delta, made = stage.everything(frame, ASKED)
    said = unpack(pack(made))
    assert isinstance(delta, DeltaFrame) and isinstance(said, JudgementsFrame)
    header = ("skin", "scan", "part", "stamps", "source", "valid", "reasons", "valid_for_s")
    assert [getattr(said, key) for key in header] == [getattr(delta, key) for key in header]
    return delta, said


def verdicts(said: JudgementsFrame) -> dict[str, str]:
    return dict(zip(said.names, said.verdicts, strict=True))


def without(bundle: Bundle, board: Board, *electrodes: int) -> RawFrame:
    """A frame of a skin on which these electrodes have come off."""
    frame = board.frame()
    uses = np.isin(bundle.pattern, electrodes).any(axis=1)
    frame.z[uses], frame.status[uses] = np.nan, STATUS_OPEN
    return frame


def test_nothing_is_wrong_with_an_untouched_or_a_pressed_skin(fed: Fed, board: Board) -> None:
    assert verdicts(run(fed.stage, board.frame())[1])["baseline"] == "refuse"
    _, said = run(fed.tared().stage, board.frame())
    assert said.valid and not said.reasons
    assert {"believed", "touch", "explained"} <= set(said.names) <= set(ROWS)
    assert set(said.verdicts) <= {"pass", "cannot", "not asked"}
    assert all(ratio < 1 for ratio in said.ratios)
    for _ in range(4):
        delta, said = run(fed.stage, board.frame(board.disc(0.3, 0.0, 0.2, 0.3)))
    assert delta.touched and said.valid and verdicts(said)["touch"] == "note", "a press refuses nothing"


def test_an_electrode_that_comes_off_turns_open_and_the_contact_frame_says_so(tared, skin, bundle, board) -> None:
    inference, publishing = Inference("palm", skin, bundle), Publishing("palm", skin, bundle)
    delta, said = run(tared.stage, without(bundle, board, 5))
    (image,) = inference.process(delta, frozenset({"image"}))
    (contact,) = publishing.process(image, frozenset({"contact"}))
    assert verdicts(said)["open"] == "note" and said.where[said.names.index("open")] == 5
    assert said.valid and contact.valid
    assert said.reasons == ["electrode_open"] and "electrode_open" in contact.reasons
    _, said = run(tared.stage, without(bundle, board, 1, 6, 11))
    assert not said.valid and verdicts(said)["too_many"] == "refuse"


def test_nothing_is_made_that_nobody_asked_for_or_that_cannot_be_judged(fed, bundle, board) -> None:
    for frame in (*(board.frame() for _ in range(72)), without(bundle, board, 5)):
        (made,) = fed.stage.everything(frame, UNASKED)
        assert isinstance(made, DeltaFrame)
    frame = board.frame()
    frame.z, frame.status = frame.z[:-1], frame.status[:-1]
    (made,) = fed.stage.everything(frame, ASKED)
    assert isinstance(made, DeltaFrame) and made.reasons == ["out_of_distribution"]


def test_every_part_of_a_scan_is_explained_also_where_nothing_touches(skin: Skin, bundle: Bundle) -> None:
    """And what other topics say is the same whether somebody asks or not."""
    host = SimulatedHost("rolling", 80.0, 3)
    raws = [raw for _ in iter(lambda: host.now < 5.0, False) for raw, _ in host.acquired()]
    host.close()
    asked, unasked = (Preprocessing("palm", skin, bundle) for _ in range(2))
    whole = parts = 0
    for raw in raws:
        *made, said = asked.everything(raw, ASKED)
        others = unasked.everything(raw, UNASKED)
        assert isinstance(said, JudgementsFrame) and (said.scan, said.part) == (raw.scan, raw.part)
        assert [pack(each) for each in made] == [pack(each) for each in others]
        whole, parts = whole + any(isinstance(each, DeltaFrame) for each in made), parts + (not made)
        assert not any(isinstance(each, PartFrame) for each in made)
    assert whole > 50 and parts > 5 * whole


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_makes_no_frame_invalid(number: float) -> None:
    back = unpack(pack(judged(DeltaFrame(skin="palm", valid=True), [judge("explained", number, 1.0)])))
    assert isinstance(back, JudgementsFrame) and back.valid and not back.reasons
    assert np.isfinite(back.ratios).all() and (back.ratios[0] >= 1) == (back.verdicts == ["refuse"])
