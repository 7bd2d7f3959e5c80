"""Broken files of every kind are refused in a sentence, or read to what can be: never a traceback, a wait, or a bomb."""

import sys

import pytest

from tests.hostile import fuzz
from tests.hostile.fuzz import fuzzed
from tests.hostile.readers import READERS

CASES = 100  # of each; `python -m tests.hostile.fuzz --cases 10000` goes further


def test_without_the_developers_tools_one_sentence_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setattr(fuzz, "find_spec", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["fuzz"])
    with pytest.raises(SystemExit):
        fuzz.main()
    assert "found no pytest; pip install -e '.[dev]'" in capsys.readouterr().err


@pytest.mark.parametrize("name", READERS)
def test_a_broken_file_is_refused_in_a_sentence_or_read(name):
    found = fuzzed(name, CASES)
    assert not found.failures, "\n".join(found.failures[:20])
    if READERS[name].refuses:
        assert found.outcomes["clean"] > 0.2 * found.outcomes.total()  # most cases break something
