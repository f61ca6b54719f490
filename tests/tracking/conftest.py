"""An arm, and the program that tracks it with 40 particles: compiled once for all tests whose subject is another."""

import pytest

from bayes_body.kernels.smc.particle_filter import build_kernel
from bayes_body.model.build import build_model
from bayes_body.tracking.program import compiled_ahead


@pytest.fixture(scope="session")
def arm(textured_session):
    return build_model("arm", textured_session)


@pytest.fixture(scope="session")
def ahead(textured_session, arm):
    """For `track(..., arm, build_kernel(), key, particles=40, ahead=ahead)`."""
    with compiled_ahead(textured_session, arm, build_kernel(), 40) as program:
        return program
