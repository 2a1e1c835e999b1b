"""Runs of the reaction benchmark that are joined: nothing is lost on the way, and what does not belong is refused."""

import numpy as np
import pytest

from bench.speed import reaction_pieces
from bench.speed.reaction_events import KINDS, Reaction, StatedError, TouchEvent, events
from bench.speed.reaction_pieces import Piece, joined, keep, kept, piece_seed
from bench.speed.reaction_report import rows, stated


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(reaction_pieces, "FOLDER", tmp_path / "kept")


def piece(seed: int, never: bool) -> Piece:
    plan = events({kind.name: 2 for kind in KINDS}, 0.35, seed)
    seen = [
        (event, Reaction(0.008, 0.007, 0.009, errors_m=[1e-3], slip=[0.1], held_m=[2e-4], held_force=[0.1]))
        for event in plan
    ]
    seen[0][1].stated = [StatedError("held", 0.5, -1.0)]
    if never:
        seen[-1] = plan[-1], Reaction(np.nan, np.nan, np.nan, wrong=1)
    return Piece(seed, 2, {"full": seen, "rolling": seen}, {"full": 0, "rolling": 3}, [0.1, 0.4], "abc")


def test_kept_runs_are_joined_as_if_they_were_one() -> None:
    pieces = [piece(1, False), piece(piece_seed(1, 1), True)]
    keep(pieces, "reaction")
    again = kept("reaction", 1, ["full", "rolling"])
    found, late = joined(again)
    assert late == {"full": 0, "rolling": 6}
    before = joined(pieces)[0]
    for mode in ("full", "rolling"):
        assert len(found[mode]) == 2 * len(pieces[0].found[mode])
        assert [event for event, _ in found[mode]] == [event for event, _ in before[mode]]
        assert str(rows(mode, found[mode])) == str(rows(mode, before[mode]))
        assert stated(mode, found[mode]) == stated(mode, before[mode]) != []
    said = {"commit": "abc", "seed": 1001, "modes": ["full", "rolling"], "steps": 2}
    assert again[1].row() == {**said, "late_poses": late | {"rolling": 3}, "load": [0.1, 0.4]}


def test_touches_may_be_added_to_one_kind_of_scan_alone() -> None:
    keep([piece(1, False)], "reaction")
    alone = piece(piece_seed(1, 1), False)
    del alone.found["full"], alone.late["full"]
    found, late = joined([*kept("reaction", 1, ["rolling"]), alone])
    assert len(found["rolling"]) == 2 * len(found["full"]) and late == {"full": 0, "rolling": 6}


def test_touches_of_a_further_run_are_others() -> None:
    first, second = (events({KINDS[0].name: 5}, 0.35, piece_seed(1, k)) for k in (0, 1))
    assert not {event.x for event in first} & {event.x for event in second}
    assert isinstance(first[0], TouchEvent)


@pytest.mark.parametrize(("seed", "modes"), [(2, ["full", "rolling"]), (1, ["rolling", "other"])])
def test_another_series_is_refused(seed: int, modes: list[str]) -> None:
    with pytest.raises(ValueError, match="run without --more first"):
        kept("reaction", 1, ["rolling"])
    keep([piece(1, False)], "reaction")
    with pytest.raises(ValueError, match=f"this run is of .*{seed}"):
        kept("reaction", seed, modes)
