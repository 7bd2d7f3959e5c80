"""The choice of a device: one clear sentence where a GPU is asked for that cannot be used."""

import pytest
import torch

from landscape.errors import InputError
from splat.backend.device import device_named
from splat.render.backend import CPU, backend_of
from tests.refusals import refused


def test_the_cpu_is_the_cpu_and_has_kernels_of_its_own():
    assert device_named("cpu") == torch.device("cpu") and backend_of(torch.zeros(1)) is CPU


def test_a_device_without_kernels_is_refused_in_a_sentence():
    with pytest.raises(InputError, match=r"whose kernels are loaded \(cpu.*\), got one on meta; take the device from"):
        backend_of(torch.zeros(1, device="meta"))


@pytest.mark.parametrize(
    ("cuda", "available", "triton", "lack"),
    [
        (None, False, True, "got torch .*, which was built without CUDA; install"),
        ("13.0", False, True, "got none that torch can use; look whether nvidia-smi"),
        ("13.0", True, False, r"got no triton to compile its kernels; pip install -e '\.\[gpu\]'"),
    ],
)
def test_a_gpu_that_cannot_be_used_is_one_clear_sentence_or_the_cpu_where_that_is_left_open(
    cuda, available, triton, lack, monkeypatch
):
    monkeypatch.setattr(torch.version, "cuda", cuda)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: available)
    monkeypatch.setattr("splat.backend.device.find_spec", lambda name: object() if triton else None)
    refused(rf"^expected an NVIDIA GPU for the device cuda, {lack}.*, or use .* cpu$", device_named, "cuda")
    assert device_named("auto") == torch.device("cpu")


def test_a_gpu_that_can_be_used_is_used(monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("splat.backend.device.find_spec", lambda name: object())
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    loaded: list[str] = []
    monkeypatch.setattr("splat.backend.device.import_module", loaded.append)
    assert device_named("auto") == device_named("cuda") == torch.device("cuda", 0)
    assert loaded == ["splat.gpu"] * 2


def test_each_of_a_machines_processes_takes_a_gpu_of_its_own_and_too_few_are_one_clear_sentence(monkeypatch):
    monkeypatch.setattr("splat.backend.device._lack", lambda: None)
    monkeypatch.setattr("splat.backend.device.import_module", lambda _name: None)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    for processes, taken in ((1, [0]), (2, [0, 1])):
        monkeypatch.setenv("LOCAL_WORLD_SIZE", str(processes))
        for rank in range(processes):
            monkeypatch.setenv("LOCAL_RANK", str(rank))
            assert device_named("auto") == device_named("cuda") == torch.device("cuda", taken[rank])
            assert device_named("cpu") == torch.device("cpu")
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "3")
    for rank in range(3):  # also in those that would find one, lest the others wait for them
        monkeypatch.setenv("LOCAL_RANK", str(rank))
        refused(r"^expected .* cuda, got 2 for the 3 processes of this machine; start", device_named, "cuda")
        assert device_named("auto") == torch.device("cpu")


def test_an_unknown_device_is_refused():
    refused("expected the device 'auto', 'cpu' or 'cuda', got 'gpu'", device_named, "gpu")
