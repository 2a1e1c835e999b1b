"""Frames that stay invalid are a problem of the skin, which status and doctor say."""

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
    for t in (100, 200, 2):  # a clock that begins anew begins the spell anew
        spell(False, ["gap"], t * S)
    assert not spell.problem
