"""The pictures of the reports: nothing runs out of a frame, no label lies on another; targets and units are said."""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import needs

needs.PLOTS.here()

from bench import REPORTS, plots  # noqa: E402

LETTER_PX, WIDEST_PX = 13, 1500  # at half the width of a page a letter is then still eight pixels high


@pytest.fixture
def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list]:
    """The figures that are made, still open."""
    figures: list = []
    monkeypatch.setattr(plots.plt, "close", figures.append)
    yield figures
    monkeypatch.undo()
    for figure in figures:
        plots.plt.close(figure)


def texts(figure) -> list:
    """What stands in its panels and on their axes, without legends."""
    found = []
    for axis in figure.axes:
        found += [axis.title, axis.xaxis.label, axis.yaxis.label, *axis.texts]
        for one in (axis.xaxis, axis.yaxis):
            low, high = sorted(one.get_view_interval())
            found += [tick.label1 for tick in one.get_major_ticks() if low <= tick.get_loc() <= high]
    return [text for text in found if text.get_text()]


def legends(figure) -> list:
    return [*figure.legends, *(axis.get_legend() for axis in figure.axes if axis.get_legend())]


@pytest.mark.parametrize("name", plots.DRAWN)
def test_labels_keep_out_of_each_others_way(name: str, drawn: list, tmp_path: Path) -> None:
    shutil.copy(REPORTS / f"{name}.json", tmp_path)
    assert plots.draw(tmp_path / f"{name}.json").stat().st_size > 10_000
    (figure,) = drawn
    found = texts(figure)
    assert len(found) > 10
    boxes = [(text.get_text(), text.get_window_extent()) for text in found]
    for text, box in boxes:
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, f"{text!r} runs out of the frame"
        assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1, f"{text!r} runs out of the frame"
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        assert not a.overlaps(b), f"{one!r} lies on {other!r}"
    for legend in legends(figure):
        assert not any(legend.get_window_extent().overlaps(box) for _, box in boxes), (
            f"a legend of {name} hides a label"
        )


@pytest.mark.parametrize("name", plots.DRAWN)
def test_it_can_be_read_at_half_its_width(name: str, drawn: list, tmp_path: Path) -> None:
    shutil.copy(REPORTS / f"{name}.json", tmp_path)
    plots.draw(tmp_path / f"{name}.json")
    (figure,) = drawn
    assert figure.bbox.width <= WIDEST_PX
    assert all(text.get_fontsize() * figure.dpi / 72 >= LETTER_PX for text in texts(figure))


@pytest.mark.parametrize("name", plots.DRAWN)
def test_units_and_targets_are_said(name: str, drawn: list, tmp_path: Path) -> None:
    shutil.copy(REPORTS / f"{name}.json", tmp_path)
    plots.draw(tmp_path / f"{name}.json")
    (figure,) = drawn
    entries = [text.get_text() for legend in legends(figure) for text in legend.get_texts()]
    assert all(axis.get_xlabel() for axis in figure.axes)
    assert all(axis.get_ylabel() for axis in figure.axes if name != "latency")  # whose rows have names
    assert name == "stability" or any("target" in entry for entry in entries)  # it has a promise, and no bound


def test_a_short_run_is_drawn_too(drawn: list, tmp_path: Path) -> None:
    """CI's reports have fewer rows, and not all targets."""
    report = json.loads((REPORTS / "scale.json").read_text())
    rows = [row for row in report["rows"] if row["skins"] < 16]
    (tmp_path / "scale.json").write_text(json.dumps({"targets": [], "rows": rows}))
    assert plots.draw(tmp_path / "scale.json").is_file()
    (tmp_path / "stability.json").write_text(json.dumps({"parts": {"matrices: stack": []}}))
    assert not plots.draw(tmp_path / "stability.json").exists(), "nothing of it was run"
    (tmp_path / "accuracy.json").write_text(json.dumps({"rows": [{"method": "x", "ms": 1.0, "level": "70"}]}))
    assert plots.draw(tmp_path / "accuracy.json").is_file()
