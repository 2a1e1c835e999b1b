"""What decides is counted from the syntax tree: numbers of the tables by what they say, and literals elsewhere."""

from bench import estimator_size as of


def test_literals_count_but_those_that_decide_nothing(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(of, "ROOT", tmp_path)
    file = tmp_path / "rules.py"
    file.write_text(
        'MOST = Number(7.0, "s", "a hold", "derived: two scans")\n'
        'LEAST = Number(3.0, "N", "a press", "measured: skin bench force")\n'
        "RADII = (0.09, 0.5)\n"
        "def far(x, k):\n    return x[k + 3] > 4 * MOST - 1 or x[0] < 2\n"
    )
    found = of.numbers([file])
    assert [(each.name, each.value, each.kind) for each in found] == [
        ("MOST", 7.0, "derived"),
        ("LEAST", 3.0, "measured"),
        ("RADII", 0.09, of.LITERAL),
        ("", 4.0, of.LITERAL),
    ]
    assert of.not_derived(found) == 3 and found[-1].where == "rules.py:5"
