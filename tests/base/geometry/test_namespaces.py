"""Numbers of the host come to the device in the wanted precision, and nothing is compiled for that."""

import jax
import numpy as np
import pytest

from bayes_body.base.geometry.namespaces import device_array


@pytest.fixture
def compilations():
    """The events of XLA's compiler, while it is watched."""
    events = []

    def listen(event, duration, **_):
        if "backend_compile" in event:
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield events
    jax.monitoring.unregister_event_duration_listener(listen)


@pytest.mark.parametrize(
    "values", [np.linspace(0, 1, 23), [[1.0, 2.0]] * 29, np.arange(31), np.float64(3.5)], ids=["array", "lists", "whole", "scalar"]
)
@pytest.mark.parametrize("dtype", [float, int, bool, np.float32])
def test_nothing_is_compiled(compilations, values, dtype):
    array = device_array(values, dtype)
    assert compilations == []
    assert isinstance(array, jax.Array) and array.dtype == jax.dtypes.canonicalize_dtype(dtype)
    np.testing.assert_array_equal(array, np.asarray(values, array.dtype))


def test_in_double_precision_too(compilations):
    with jax.enable_x64(True):
        assert device_array([0.1] * 37).dtype == np.float64
    assert compilations == []


def test_the_listener_hears_what_is_compiled(compilations):
    jax.jit(lambda x: x + 1)(np.zeros(41, np.float32))
    assert compilations
