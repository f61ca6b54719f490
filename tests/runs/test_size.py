"""The size of a run, before it begins: a bound that is never above what it takes, and the memory of the machine."""

from types import SimpleNamespace

import jax
import pytest

from bayes_body.base.errors import InputError
from bayes_body.kernels.batching import WORK_SHARE, assumed_accelerator, work_room
from bayes_body.model.body.solids import configuration_space
from bayes_body.model.build import build_model
from bayes_body.runs import size
from bayes_body.runs.size import check_size, least_bytes, memory_bytes


@pytest.fixture
def model(textured_session):
    return build_model("arm", textured_session)


def test_what_fits_exactly_is_accepted_and_a_particle_more_is_not(model, monkeypatch):
    there = least_bytes(configuration_space(model.body).dimension, 1000, 3)
    monkeypatch.setattr(size, "memory_bytes", lambda: there)
    check_size(model, {"particles": 1000, "layers": size.MOST, "waste_free": True, "step": 1e9}, 3)
    with pytest.raises(InputError, match=r"at least .* GB of memory for 1001 particles in each of 3 runs; expected at most the .* GB that there are"):
        check_size(model, {"particles": 1001}, 3)


def test_the_bound_is_not_above_the_arrays_that_a_frame_needs():
    """A frame's particles before and after it, on the device and on the host."""
    poses, weights, ancestors = 5000 * 31 * 4, 5000 * 4, 5000 * 4
    assert 2 * (poses + weights) < least_bytes(31, 5000, 1) - size.RUN_BYTES <= 4 * (poses + weights + ancestors)


def test_without_a_known_memory_only_counts_are_refused(model, monkeypatch):
    monkeypatch.setattr(size, "memory_bytes", lambda: None)
    check_size(model, {"particles": 10**12}, 1)
    with pytest.raises(InputError, match="--runs: 100001; expected at most 100000"):
        check_size(model, {"particles": 1}, 100_001)


def test_the_smallest_limit_is_the_memory(monkeypatch, tmp_path):
    (tmp_path / "memory.max").write_text("1000000\n")
    monkeypatch.setattr(jax, "local_devices", lambda: [SimpleNamespace(memory_stats=lambda: None)])
    whole = memory_bytes()
    monkeypatch.setattr(size, "CONTAINER_LIMIT", tmp_path / "memory.max")
    assert memory_bytes() == 1_000_000 < (whole or 1e15)
    (tmp_path / "memory.max").write_text("max\n")
    assert memory_bytes() != 1_000_000
    monkeypatch.setattr(jax, "local_devices", lambda: [SimpleNamespace(memory_stats=lambda: {"bytes_limit": 77})])
    assert memory_bytes() == 77


def test_on_an_accelerator_the_work_of_a_batch_needs_room_beside_the_particles(model, monkeypatch):
    there = least_bytes(configuration_space(model.body).dimension, 1000, 3)
    monkeypatch.setattr(size, "memory_bytes", lambda: there)
    with assumed_accelerator(float(there)):
        assert there - size.particle_memory() == int(work_room(float(there))) == int(WORK_SHARE * there)
        check_size(model, {"particles": 700}, 3)
        with pytest.raises(InputError, match="for 1000 particles in each of 3 runs"):
            check_size(model, {"particles": 1000}, 3)
