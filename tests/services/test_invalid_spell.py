"""Frames that stay invalid are a problem of the skin, which status and doctor say."""

from __future__ import annotations

from services.contacts.invalid_spell import LASTS_S, InvalidSpell

S = 10**9


def test_a_spell_is_said_once_it_has_lasted_with_its_newest_reasons() -> None:
    spell = InvalidSpell()
    for t in range(1, 5):
        spell(False, ["stale_baseline"], t * S)
    assert not spell.problem
    spell(False, ["gap", "out_of_distribution"], round((1 + LASTS_S) * S))
    assert spell.problem.startswith("no frame has been valid for 5 s: gap (")
    assert "out_of_distribution" in spell.problem and "stale_baseline" not in spell.problem
    spell(True, [], 7 * S)
    assert not spell.problem


def test_a_clock_that_begins_anew_begins_the_spell_anew() -> None:
    spell = InvalidSpell()
    spell(False, ["gap"], 100 * S)
    spell(False, ["gap"], 200 * S)
    spell(False, ["gap"], 2 * S)
    assert not spell.problem
