"""Stages that are kept between two runs of a command."""

from dataclasses import dataclass, field
from math import inf

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from analysis.console.kept import Kept, kept_stages
from analysis.console.stages import Stages


@dataclass(frozen=True, eq=False)
class Found:
    vector: Float[Tensor, " n"]
    error: float = inf
    parts: tuple[Float[Tensor, "_ _"], ...] = ()
    inner: "Found | None" = None
    names: dict[str, float] = field(default_factory=dict)


class Work:
    """Counts how often it was done."""

    def __init__(self):
        self.count = 0

    def __call__(self, generator, report, notes) -> Found:
        self.count += 1
        report(1, 2, "half")
        notes.append("a note")
        vector = torch.randn(5, generator=generator, dtype=torch.float64)
        return Found(vector, parts=(torch.ones(2, 3),), inner=Found(vector.float()), names={"a": 0.1})


def kept(folder, identity="this", work=None):
    count = (lambda: work.count) if work else (lambda: 0)
    return Kept(Stages(), torch.Generator().manual_seed(0), ["first", "second"], count, folder, identity)


def test_a_stage_that_was_kept_is_read_and_not_done_again(tmp_path):
    work, again = Work(), Work()
    one = kept(tmp_path / "kept", work=work)
    first = one.run("first", Found, work)
    two = kept(tmp_path / "kept", work=again)
    read = two.run("first", Found, again)
    assert (work.count, again.count) == (1, 0) and read.inner is not None
    assert torch.equal(first.vector, read.vector) and read.error == inf and read.names == {"a": 0.1}
    assert read.inner.vector.dtype == torch.float32 and read.parts[0].shape == (2, 3)
    assert two.notes == one.notes == ["a note"] and two.count == one.count == 1
    assert kept_stages(tmp_path / "kept") == ["first"]
    second = two.run("second", Found, again)  # as if nothing had been kept
    assert torch.equal(second.vector, _alone("second").vector)


def _alone(name) -> Found:
    return kept(None).run(name, Found, Work())


@pytest.mark.parametrize("harm", ["another command", "cut", "one bit", "another type"])
def test_what_is_not_this_command_s_is_measured_again(tmp_path, harm):
    kept(tmp_path).run("first", Found, Work())
    file = tmp_path / "first.msgpack"
    if harm in ("cut", "one bit"):
        content = bytearray(file.read_bytes())
        content[-9] ^= 1
        file.write_bytes(file.read_bytes()[:-3] if harm == "cut" else bytes(content))
    work = Work()
    if harm == "another type":
        kept(tmp_path).run("first", dict[str, int], lambda *_: {"a": 1})
        assert kept(tmp_path).run("first", dict[str, str], lambda *_: {"a": "b"}) == {"a": "b"}
        return
    kept(tmp_path, identity="that" if harm == "another command" else "this").run("first", Found, work)
    assert work.count == 1
