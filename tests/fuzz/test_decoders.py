"""Every decoder, fed with the kept corpus: nothing raises but its own error. run.py searches for more."""

import logging

import pytest

from tests.fuzz import decoders


@pytest.mark.parametrize("name", decoders.TARGETS)
def test_the_kept_corpus(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """What once was too much, what reaches far into the decoder, and right inputs of which a piece is missing."""
    monkeypatch.setenv("EITSKIN_RUNTIME", "")
    inputs = seeds = decoders.seeds(name)
    inputs += [seed[: len(seed) * k // 5] + seed[len(seed) * k // 5 + 1 :] for seed in seeds[:4] for k in range(1, 5)]
    assert len(inputs) > 5
    for data in inputs:
        decoders.TARGETS[name](data)
    logging.disable(logging.NOTSET)
