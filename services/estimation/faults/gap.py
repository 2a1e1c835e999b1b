"""After lost time or a board's reset: nothing vouches for what touched before. The first scan is judged by itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from models.measurement.touch import TouchPrior
from services.estimation.asked.hypotheses import Hypotheses
from services.estimation.asked.question import Question, ScoredAnswer
from services.estimation.values import numbers as n


def judged_by_itself(
    hypotheses: Hypotheses, question: Question, standing: Sequence[TouchPrior], loose: Sequence[TouchPrior]
) -> ScoredAnswer:
    """The likeliest of: the touches that there were, which count as new ones; others, or none."""
    anew = hypotheses.ask(question.leaving(0.5), (), ())
    before = hypotheses.ask(question, standing, loose)
    kept = sum(place >= 0 for place in before.kept)
    vouched = replace(before, score=before.score + n.COST_TOUCH * kept)
    return max((anew, vouched), key=lambda answer: (answer.holds, answer.score))
