"""Broken files of every format are refused in a sentence, or read to what can be: never a traceback, a wait, or a bomb."""

import os

import pytest

from tests.hostile.formats import FORMATS
from tests.hostile.fuzz import fuzzed

CASES = int(os.environ.get("LANDSCAPE_FUZZ_CASES", 1000))  # of each format


@pytest.mark.parametrize("name", FORMATS)
def test_a_broken_file_is_refused_in_a_sentence_or_read(name):
    found = fuzzed(name, CASES)
    assert not found.failures, "\n".join(found.failures[:20])
    if FORMATS[name].refuses:
        assert found.outcomes["clean"] > 0.2 * found.outcomes.total()  # most cases break something
