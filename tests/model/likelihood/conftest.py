"""Scenes: a body, cameras around it and images of noise, in the precision of the moment; and the real recording as a model."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry.camera import Camera, stack, turning_radius
from bayes_body.base.registry import find
from bayes_body.density.factor import Factor
from bayes_body.model.body.build import build_body
from bayes_body.model.body.solids import Body
from bayes_body.model.definition import load_body
from bayes_body.recording.evidence.silhouette_edges import SilhouetteEdgeMaps
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.readers.parsec import import_parsec

DISTORTION, SKEW = (-0.2, 0.1, 0.004, -0.003, -0.02), 0.01


class Scene(NamedTuple):
    """A body seen by two cameras whose images differ in size."""

    body: Body
    rig: Camera
    frame: Frame
    pose: jax.Array

    def factor(self, **options) -> Factor:
        """The likelihood with those options."""
        term = find("likelihood", "silhouette_edges")
        return term.build(name="images", options=term.options(**options), body=self.body, rig=self.rig)

    def maps(self, **options) -> SilhouetteEdgeMaps:
        """What it looks at, prepared with those options."""
        term = find("observation", "silhouette_edges")
        return jax.tree.map(jnp.asarray, term.build(options=term.options(**options))(self.frame))


@pytest.fixture
def x64():
    """Double precision."""
    with jax.enable_x64(True):
        yield


@pytest.fixture
def scene() -> Callable[..., Scene]:
    """`scene("arm_4")`: the body in a pose of its own, about 2.5 m from each camera."""

    return lambda name, seed=0: _scene(name, seed, jax.config.read("jax_enable_x64"))


@cache
def _scene(name: str, seed: int, x64: bool) -> Scene:
    with jax.enable_x64(x64):
        body = build_body(name, load_body(name))
        angular = np.array(body.skeleton.topology.angular)
        pose = np.random.default_rng(seed).uniform(-0.5, 0.5, angular.size) * np.where(angular, 1, 0.2)
        height = 1.2 if name == "arm_4" else 0.0
        positions = (np.array([2.5, 0.3, height + 0.4]), np.array([-0.8, 2.4, height - 0.2]))
        sizes = ((160, 120), (128, 104))
        rig = stack([camera(position, np.array([0.0, 0.0, height]), size) for position, size in zip(positions, sizes, strict=True)])
        return Scene(body, rig, noise(sizes), jnp.asarray(pose))


def camera(position: np.ndarray, target: np.ndarray, size: tuple[int, int], distortion=DISTORTION) -> Camera:
    """A camera at `position` that looks at `target`, the world's z upwards."""
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0, 1])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    focal, centre = (1.1 * size[0], 1.2 * size[0]), (size[0] / 2 - 3, size[1] / 2 + 2)
    leaves = (R, -R @ position, focal, centre, SKEW, distortion, turning_radius(np.array(distortion)), size)
    return Camera(*(jnp.asarray(leaf, float) for leaf in leaves))


def noise(sizes) -> Frame:
    """Smooth noise: silhouettes of blobs, and edges everywhere."""
    rng = np.random.default_rng(11)
    images, masks = [], []
    for width, height in sizes:
        images.append(cv2.GaussianBlur(rng.integers(0, 256, (height, width)).astype(np.uint8), (0, 0), 1.5))
        images[-1] = cv2.normalize(images[-1], None, 0, 255, cv2.NORM_MINMAX)
        masks.append(cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), 6) > 0)
    return Frame(0, tuple(images), tuple(masks))


@pytest.fixture(scope="session")
def session(bodytrack, tmp_path_factory):
    """The real recording."""
    return import_parsec(bodytrack, tmp_path_factory.mktemp("bodytrack"))[0]
