"""The annotations' shapes hold while tests run: a wrong one is an error where it enters."""

import bayes_body_shape_checks
import jax
import jax.numpy as jnp
import jaxtyping
import pytest
from jaxtyping import Array, Float

from bayes_body.base.geometry import camera


def _camera() -> camera.Camera:
    return camera.Camera(jnp.eye(3), jnp.zeros(3), jnp.ones(2), jnp.zeros(2), jnp.zeros(()), jnp.zeros(5), jnp.ones(()), jnp.ones(2))


def test_a_wrong_shape_is_refused():
    with pytest.raises(jaxtyping.TypeCheckError, match="points"):
        camera.project(_camera(), jnp.zeros(4))


def test_a_nested_function_is_checked_and_is_itself_at_every_definition():
    def defined(count):
        @jaxtyping.jaxtyped(typechecker=bayes_body_shape_checks.check)
        def first(values: Float[Array, "3"]) -> Float[Array, " count"]:
            return values[:count]

        return first

    for count in (1, 2):
        assert defined(count)(jnp.zeros(3)).shape == (count,)
        with pytest.raises(jaxtyping.TypeCheckError, match="values"):
            defined(count)(jnp.zeros(4))


def test_a_batch_passes_through_vmap():
    rig = camera.stack([_camera(), _camera()])
    pixels, _ = jax.vmap(camera.project, (0, None))(rig, jnp.ones((4, 3)))
    assert pixels.shape == (2, 4, 2)


def test_two_host_devices():
    assert len(jax.devices("cpu")) == 2
