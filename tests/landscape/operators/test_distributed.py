import pytest
import torch
import torch.distributed as dist

from landscape.eigen.eigen import EigenSettings, extreme_eigenpairs
from landscape.operators.distributed import DistributedOperator, Ranks, torchrun_ranks
from landscape.operators.operator import DenseOperator, SumOperator
from landscape.spectrum.density import spectral_density
from landscape.traces.trace import TraceSettings, estimate_traces
from tests.landscape.ranks import on_ranks
from tests.landscape.spectra import N, generator, operator

BLOCKS = {"a": slice(0, 50), "b": slice(50, N)}
TERMS = ("power law", "indefinite", "both tails")


def terms():
    return [DenseOperator(operator(name).matrix, BLOCKS) for name in TERMS]


def measured(H):
    """The numbers of every estimator, by a fixed seed."""
    traces = estimate_traces(H, generator(1), TraceSettings.fixed(8))
    ends = extreme_eigenpairs(H, generator(2), EigenSettings(2, 1, rtol=1e-9, basis=30))
    density = spectral_density(H, generator(3), matvecs=16, starts=2)
    return {
        "product": H.apply(torch.eye(N, 3, dtype=H.dtype)),
        "traces": torch.stack([trace.samples for trace in traces.values()]),
        "ends": torch.cat([ends.largest.values, ends.smallest.values]),
        "nodes": density.nodes,
    }


def complaint(action):
    try:
        action()
    except ValueError as error:
        return str(error)
    return ""


def work(ranks):
    mine = ranks.share(terms())
    H = DistributedOperator(SumOperator(mine), ranks)
    odd = torch.float64 if ranks.rank else torch.float32
    wrong = DenseOperator(torch.eye(3 + ranks.rank))
    return {
        **measured(H),
        "terms": float(len(mine)),
        "dim": complaint(lambda: DistributedOperator(wrong, ranks)),
        "dtype": complaint(lambda: DistributedOperator(DenseOperator(torch.eye(3, dtype=odd)), ranks)),
        "seeds": complaint(lambda: spectral_density(H, generator(ranks.rank))),
        "counts": complaint(lambda: H.apply(torch.zeros(N, 1 + ranks.rank, dtype=H.dtype))),
        "few": complaint(lambda: ranks.share([0])),
        "lost": "" if ranks.rank else told_of_a_loss(ranks.sum),  # the second rank leaves
    }


def told_of_a_loss(exchange):
    with pytest.raises(ConnectionError) as caught:
        exchange(torch.ones(3))
    return str(caught.value)


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    return on_ranks(2, tmp_path_factory.mktemp("ranks"), work)


def test_every_estimator_gives_the_numbers_of_one_process_to_round_off(found):
    alone = measured(SumOperator(terms()))
    # sums of three terms in another order; round-off of 1e-16 in H moves eigenvalues and nodes by as much, times the steps
    for name, value in alone.items():
        assert torch.allclose(found[0][name], value, rtol=0, atol=1e-12 * float(value.abs().max())), name


def test_all_ranks_have_the_same_bits(found):
    for name in ("product", "traces", "ends", "nodes"):
        assert torch.equal(found[0][name], found[1][name])


def test_the_ranks_share_all_terms_in_order(found):
    assert [rank["terms"] for rank in found] == [1, 2]
    parts = [Ranks(rank, 4).share(range(10)) for rank in range(4)]
    assert [item for part in parts for item in part] == list(range(10))


def test_ranks_that_disagree_all_say_so(found):
    for rank in found:
        assert "expected the same operator on every rank, got" in rank["dim"] and "rows" in rank["dim"]
        assert "expected the same operator on every rank, got 3 rows of torch.float" in rank["dtype"]
        assert "expected the same vectors on every rank" in rank["seeds"]
        assert "expected the same vectors on every rank" in rank["counts"]
        assert "at least one item for each of 2 ranks, got 1" in rank["few"]


def test_a_process_that_leaves_is_not_waited_for(found):
    assert "expected all processes to exchange numbers, lost one" in found[0]["lost"]


def test_without_a_group_the_error_says_how_to_make_one():
    with pytest.raises(ValueError, match="torchrun"):
        Ranks.joined()


def test_ranks_of_torchrun_use_nccl_between_gpus_and_gloo_otherwise(monkeypatch):
    said = []
    monkeypatch.setattr(dist, "is_torchelastic_launched", lambda: True)
    monkeypatch.setattr(dist, "init_process_group", lambda backend, device_id=None: said.append((backend, device_id)))
    monkeypatch.setattr(torch.cuda, "set_device", said.append)
    monkeypatch.setattr(dist, "destroy_process_group", lambda: said.append("left"))
    monkeypatch.setattr(Ranks, "joined", lambda: Ranks(0, 2))
    own = torch.device("cuda", 1)
    for device in (torch.device("cpu"), own):
        with torchrun_ranks(device) as ranks:
            assert ranks == Ranks(0, 2)
    assert said == [("gloo", None), "left", own, ("nccl", own), "left"]


def test_without_torchrun_there_are_no_ranks():
    with torchrun_ranks(torch.device("cpu")) as ranks:
        assert ranks is None
