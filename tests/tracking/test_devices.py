"""Devices that share the runs draw the same, whatever their number: each computes a run alone, by the same program (docs/decisions/54_gpu.md)."""

import os
import subprocess
import sys

import pytest

from bayes_body.recording.session.read import save_session

PROGRAM = """
import hashlib, sys
import jax
from bayes_body.model.build import build_model
from bayes_body.recording.session.read import load_session
from bayes_body.tracking.track import track
session = load_session(sys.argv[1])
model = build_model("arm_markers", session)
kernel = model.kernel("laplace", particles=40, fallback="none")
draws = track(jax.random.key(5), session, model, kernel, 40, runs=3, frames=2)
print(len(jax.devices()), hashlib.sha256(draws.states["pose"].tobytes() + draws.log_weights.tobytes()).hexdigest())
"""


@pytest.mark.slow
def test_more_devices_draw_the_same(keypoint_session):
    save_session(keypoint_session)
    digests = {}
    for devices in (2, 8):
        # As a user's programs are compiled.
        flags = {"XLA_FLAGS": f"--xla_force_host_platform_device_count={devices}", "JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}
        command = [sys.executable, "-c", PROGRAM, str(keypoint_session.folder)]
        done = subprocess.run(command, env=os.environ | flags, capture_output=True, text=True, check=True)
        count, digests[devices] = done.stdout.split()
        assert int(count) == devices
    assert len(set(digests.values())) == 1, digests
