"""Replications: the same whatever stops them and however many processes there are; what is on disk is read back as it was."""

import json
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
import pytest

from bayes_body.workshop.calibration.replications import BLOCK, Experiments, ReplicationLog, run_replications, settings_of


class Drawn(NamedTuple):
    value: jax.Array
    number: jax.Array
    flag: jax.Array


def _one(key):
    value = jax.random.normal(key, (2,))
    return Drawn(value * jax.numpy.array([1.0, jax.numpy.inf]), jax.random.randint(key, (), 0, 99), value[0] > 0)


def _other(key):
    return Drawn(jax.random.uniform(key, (2,)), jax.random.randint(key, (), 0, 99), jax.numpy.array(True))


def _make(seed):
    return Experiments(seed, {"one": _one, "other": _other})


COUNTS = {"one": 25, "other": 12}
MAKE = partial(_make, 3)
SETTINGS = {"model": "arm", "options": {"particles": 7}, "plugins": ()}


def same(a, b):
    return all((a[name][field] == b[name][field]).all() and a[name][field].dtype == b[name][field].dtype for name in a for field in a[name])


def test_a_replication_depends_on_its_number_alone():
    many, few = run_replications(MAKE, COUNTS), run_replications(MAKE, {"one": 11})
    assert many["one"]["value"].shape == (25, 2) and many["other"]["number"].shape == (12,)
    assert (many["one"]["value"][:11] == few["one"]["value"]).all()
    assert len(np.unique(many["one"]["value"][:, 0])) == 25
    assert not same(many, run_replications(partial(_make, 4), COUNTS))


class _StoppedError(Exception):
    pass


def test_an_interrupted_check_goes_on_to_the_same_end(tmp_path):
    path, whole = tmp_path / "kept", run_replications(MAKE, COUNTS)

    def stop(blocks):
        yield from range(2)
        raise _StoppedError

    with pytest.raises(_StoppedError):
        run_replications(MAKE, COUNTS, log=ReplicationLog(path, SETTINGS), watch=stop)
    before = ReplicationLog(path, SETTINGS)
    assert len(before) == 2
    # The computer stopped in the middle of a line.
    with path.open("ab") as file:
        file.write(b'{"experiment": "one", "blo')
    kept = ReplicationLog(path, SETTINGS)
    assert len(kept) == 2
    asked = []
    assert same(whole, run_replications(MAKE, COUNTS, log=kept, watch=lambda blocks: asked.extend(blocks) or blocks))
    assert len(asked) == -(-25 // BLOCK) + -(-12 // BLOCK) - 2
    assert same(whole, run_replications(MAKE, COUNTS, log=ReplicationLog(path, SETTINGS)))
    assert settings_of(path) == json.loads(json.dumps(SETTINGS))
    kept.remove()
    assert not path.exists()


def test_replications_of_something_else_are_refused(tmp_path):
    path = tmp_path / "kept"
    ReplicationLog(path, SETTINGS)
    with pytest.raises(ValueError, match=r"kept: replications with model = 'arm'; expected model = 'leg'; use its settings, remove it"):
        ReplicationLog(path, {**SETTINGS, "model": "leg"})
    path.write_text("something\n")
    with pytest.raises(ValueError, match="its first line is not that of a check"):
        ReplicationLog(path, SETTINGS)


def test_a_file_that_cannot_be_written_is_said(tmp_path):
    with pytest.raises(ValueError, match="cannot be"):
        ReplicationLog(tmp_path / "missing" / "kept", SETTINGS)


@pytest.mark.slow
def test_processes_change_nothing(tmp_path):
    assert same(run_replications(MAKE, COUNTS), run_replications(MAKE, COUNTS, jobs=2, log=ReplicationLog(tmp_path / "kept", SETTINGS)))
