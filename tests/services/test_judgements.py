"""Why a frame says what it says, as the topic `judgements`: raw frames in, frames out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from models.bundle import Bundle
from protocol.frames import STATUS_OPEN, DeltaFrame, JudgementsFrame, PartFrame, RawFrame, pack, unpack
from services.cli.judged import lines
from services.cli.watch import line
from services.estimation.values import judgement
from services.estimation.values.judgement import ROWS, judge
from services.inference import Inference
from services.judged import judged
from services.preprocessing import Preprocessing
from services.publisher import Publishing
from services.runtime.config import Skin
from tests.services.conftest import Board
from tests.services.rolling_host import rolling_host

ASKED = frozenset({"delta", "part", "judgements"})
UNASKED = ASKED - {"judgements"}


@pytest.fixture
def stage(skin: Skin, bundle: Bundle) -> Preprocessing:
    return Preprocessing("palm", skin, bundle)


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


def tared(stage: Preprocessing, board: Board) -> JudgementsFrame:
    for _ in range(72):
        _, said = run(stage, board.frame())
    return said


def without(bundle: Bundle, board: Board, *electrodes: int) -> RawFrame:
    """A frame of a skin on which these electrodes have come off."""
    frame = board.frame()
    uses = np.isin(bundle.pattern, electrodes).any(axis=1)
    frame.z[uses], frame.status[uses] = np.nan, STATUS_OPEN
    return frame


def test_nothing_is_wrong_with_an_untouched_skin(stage: Preprocessing, board: Board) -> None:
    assert verdicts(run(stage, board.frame())[1])["baseline"] == "refuse"
    said = tared(stage, board)
    assert said.valid and not said.reasons
    assert {"believed", "touch", "explained"} <= set(said.names) <= set(ROWS)
    assert set(said.verdicts) <= {"pass", "cannot", "not asked"}
    assert all(ratio < 1 for ratio in said.ratios)


def test_an_electrode_that_comes_off_turns_open_and_the_contact_frame_says_so(
    stage: Preprocessing, skin: Skin, bundle: Bundle, board: Board
) -> None:
    inference, publishing = Inference("palm", skin, bundle), Publishing("palm", skin, bundle)
    tared(stage, board)
    delta, said = run(stage, without(bundle, board, 5))
    (image,) = inference.process(delta, frozenset({"image"}))
    (contact,) = publishing.process(image, frozenset({"contact"}))
    assert verdicts(said)["open"] == "note" and said.where[said.names.index("open")] == 5
    assert said.valid and contact.valid
    assert said.reasons == ["electrode_open"] and "electrode_open" in contact.reasons
    first = line("judgements", said).splitlines()[1]
    assert first.split() == ["note", "open", "1,", "limit", "1,", "ratio", "1,", "electrode", "5"]


def test_what_refuses_a_frame_is_printed_first(stage: Preprocessing, bundle: Bundle, board: Board) -> None:
    tared(stage, board)
    _, said = run(stage, without(bundle, board, 1, 6, 11))
    assert not said.valid and verdicts(said)["too_many"] == "refuse"
    words = [each.split()[0] for each in lines(said)]
    assert len(words) == len(said.names)
    assert words == sorted(words, key=["refuse", "note", "pass", "cannot"].index)


def test_a_press_is_noted_and_refuses_nothing(stage: Preprocessing, board: Board) -> None:
    tared(stage, board)
    for _ in range(4):
        delta, said = run(stage, board.frame(board.disc(0.3, 0.0, 0.2, 0.3)))
    assert delta.touched and said.valid and verdicts(said)["touch"] == "note"


def test_nothing_is_made_that_nobody_asked_for(stage: Preprocessing, bundle: Bundle, board: Board) -> None:
    for frame in (*(board.frame() for _ in range(72)), without(bundle, board, 5)):
        (made,) = stage.everything(frame, UNASKED)
        assert isinstance(made, DeltaFrame)


def test_a_scan_that_cannot_be_judged_has_no_judgements(stage: Preprocessing, board: Board) -> None:
    frame = board.frame()
    frame.z, frame.status = frame.z[:-1], frame.status[:-1]
    (made,) = stage.everything(frame, ASKED)
    assert isinstance(made, DeltaFrame) and made.reasons == ["out_of_distribution"]


def test_every_part_of_a_scan_is_explained_also_where_nothing_touches(skin: Skin, bundle: Bundle) -> None:
    """And what other topics say is the same whether somebody asks or not."""
    with rolling_host(3) as host:
        raws = host.raws
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


def test_each_row_names_the_file_that_judges_it() -> None:
    folder = Path(judgement.__file__).parents[1]
    for name, row in ROWS.items():
        assert f'"{name}"' in (folder / f"{row.room}.py").read_text(encoding="utf-8"), f"{row.room}.py: no {name}"
