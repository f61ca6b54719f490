"""The line about the device that computes, and the note about a GPU that JAX cannot use."""

from types import SimpleNamespace

import jax
import pytest

from bayes_body.kernels.batching import assumed_accelerator
from bayes_body.runs import device
from bayes_body.runs.device import device_lines


@pytest.fixture
def machine(monkeypatch, tmp_path):
    """`machine(gpus, plugins, on_path)`: what the system says; none of the environment's choices."""
    for name in ("CUDA_VISIBLE_DEVICES", "JAX_PLATFORMS"):
        monkeypatch.delenv(name, raising=False)

    def arrange(gpus=0, plugins=(), on_path=False):
        for number in range(gpus):
            (tmp_path / "gpus" / f"0000:0{number}").mkdir(parents=True)
        (tmp_path / "cpuinfo").write_text("processor : 0\nmodel name\t: AMD EPYC 9\n")
        monkeypatch.setattr(device, "GPU_FOLDERS", tmp_path / "gpus")
        monkeypatch.setattr(device, "CPU_INFO", tmp_path / "cpuinfo")
        monkeypatch.setattr(device, "core_count", lambda: 2)
        monkeypatch.setattr(device, "find_spec", lambda name: True if name in plugins else None)
        monkeypatch.setattr(device.shutil, "which", lambda name: "/usr/bin/nvidia-smi" if on_path else None)

    return arrange


def test_cores_are_named_by_their_processor(machine):
    machine()
    assert list(device_lines()) == ["device     2 cores of AMD EPYC 9"]


@pytest.mark.parametrize("seen_by", [{"gpus": 1}, {"on_path": True}])
def test_a_gpu_without_a_plugin_is_a_note_with_the_remedy(machine, seen_by):
    machine(**seen_by)
    _, note = device_lines()
    assert note == "note: this machine has a GPU, but JAX has no plugin for it: pip install 'bayes-body[cuda]'"


def test_a_plugin_that_does_not_find_the_gpu_is_a_note(machine):
    machine(gpus=1, plugins=("jax_cuda12_plugin",))
    _, note = device_lines()
    assert "JAX cannot use it" in note and "nvidia-smi" in note


@pytest.mark.parametrize(("name", "value"), [("CUDA_VISIBLE_DEVICES", ""), ("CUDA_VISIBLE_DEVICES", "-1"), ("JAX_PLATFORMS", "cpu")])
def test_whoever_wants_no_gpu_hears_of_none(machine, monkeypatch, name, value):
    machine(gpus=1)
    monkeypatch.setenv(name, value)
    assert len(list(device_lines())) == 1


def test_gpus_are_named_with_their_memory_and_number(machine, monkeypatch):
    machine(gpus=2)
    devices = [SimpleNamespace(device_kind="NVIDIA H200", id=number) for number in range(2)]
    with assumed_accelerator(112e9):
        monkeypatch.setattr(jax, "local_devices", lambda: devices)
        assert list(device_lines()) == ["device     2 × NVIDIA H200, 112 GB for JAX on each (GPUs 0, 1 of 2)"]
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
        monkeypatch.setattr(jax, "local_devices", lambda: devices[:1])
        assert list(device_lines()) == ["device     NVIDIA H200, 112 GB for JAX (GPU 1 of 2)"]
