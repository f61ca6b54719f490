"""Quadrature against closed forms; kernels against quadrature on an image that no model made."""

from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_forms.targets import CENTRE, conjugate, point_mass, skewed

from bayes_body import kernels
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.session.session import CameraSpec, Session, View
from bayes_body.workshop.calibration.reference import LIMIT, compare, integrate


@pytest.mark.parametrize("make", [conjugate, skewed])
def test_it_finds_mean_and_evidence(make):
    target = make(1)
    found = integrate(target.density, "x")
    assert (found.error < 0.005 * found.sd).all()
    assert np.allclose(found.mean, target.mean, atol=0.01 * found.sd.min())
    if make is conjugate:
        assert abs(found.log_evidence - target.log_evidence) < 0.01


def test_a_posterior_of_several_ancestors_is_their_mixture():
    target = conjugate(1)
    both = point_mass(CENTRE, 2)._replace(states={"x": jnp.stack([jnp.asarray(CENTRE), jnp.asarray(CENTRE) + 1.0])})
    parts = [integrate(target.density.with_previous(point_mass(state, 1)), "x") for state in np.asarray(both.states["x"])]
    shares = np.exp([part.log_evidence for part in parts])
    shares /= shares.sum()
    mixture = integrate(target.density.with_previous(both), "x")
    assert np.allclose(mixture.mean, shares @ [part.mean for part in parts], atol=0.02)


def test_too_many_dofs_are_refused(textured_session):
    model = build_model("deutscher_2005", textured_session)
    with pytest.raises(ValueError, match="31 dofs; expected at most 4"):
        integrate(model.density(jax.tree.map(jnp.asarray, {})))


# -- the arm on a drawn image -----------------------------------------------------------------------------------------------------------------

SHOULDER, ELBOW, WRIST, HAND = np.array([[0.0, 0, 1.43], [-0.22, -0.07, 1.2], [-0.42, -0.03, 1.345], [-0.5, -0.01, 1.4]])
RADII = ((SHOULDER, ELBOW, 0.05), (ELBOW, WRIST, 0.038), (WRIST, HAND, 0.04))
SIZE = (160, 120)


def _look(position, target=np.array([-0.25, 0.0, 1.3])):
    z = (target - position) / np.linalg.norm(target - position)
    x = np.cross(z, [0.0, 0, 1])
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return CameraSpec(f"at{position[0]:.0f}", SIZE, (190.0, 190.0), (79.5, 59.5), 0.0, (0.0,) * 5, R, -R @ position)


def _drawn(camera):
    """Capsules of fixed width, drawn by OpenCV: image and mask."""
    image = np.full(SIZE[::-1], 70, np.uint8)
    mask = np.zeros(SIZE[::-1], np.uint8)
    for base, tip, radius in RADII:
        ends = [camera.rotation @ point + camera.translation_m for point in (base, tip)]
        pixels = [tuple(np.round(camera.focal_px[0] * end[:2] / end[2] + camera.centre_px).astype(int).tolist()) for end in ends]
        width = max(round(2 * radius * camera.focal_px[0] / np.mean([end[2] for end in ends])), 1)
        cv2.line(image, *pixels, 170, width)
        cv2.line(mask, *pixels, 255, width)
    return cv2.GaussianBlur(image, (0, 0), 1.0), mask > 0


def _on_the_drawing(name):
    """A model and its density on the drawn frame."""
    cameras = [_look(np.array(place)) for place in ((1.6, -1.2, 1.5), (-1.0, -1.9, 1.2))]
    views = tuple(View(camera, images=f"unused{k}_%04d.png") for k, camera in enumerate(cameras))
    initial = {"shoulder_x": np.radians(-20), "shoulder_y": np.radians(-40), "shoulder_z": 0.0, "elbow": np.radians(-85)}
    session = Session(Path(), "drawn", "z", 60.0, 1, 0, views, initial=initial)
    model = build_model(load_definition(name), session)
    images, masks = zip(*(_drawn(camera) for camera in cameras), strict=True)
    return model, model.density(jax.tree.map(jnp.asarray, model.observe(Frame(0, images, masks))))


@pytest.fixture(scope="module", params=["arm", pytest.param("arm_edges", marks=pytest.mark.long)])
def drawn(request):
    """A model, its density on the drawn frame, and the quadrature of it."""
    model, density = _on_the_drawing(request.param)
    return model, density, integrate(density)


HMC = {"chains": 8, "burn_in": 30, "leapfrog_steps": 8, "step": 0.4}
KERNELS = {"sir": (kernels.sir(), 4000), "tempered": (kernels.tempered(), 500), "hmc": (kernels.hmc(**HMC), 800)}


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("name", ["sir", "hmc", pytest.param("tempered", marks=pytest.mark.long)])
def test_means_and_variances_of_the_kernels_are_those_of_the_grid(drawn, name):
    model, density, exact = drawn
    kernel, particles = KERNELS[name]
    found = compare(density, kernel, model.start(particles), jax.random.key(0), exact=exact)
    prior = np.radians([3, 3, 3, 4])
    # The image says something, and not what the prior said already.
    assert (found.exact.sd < 0.8 * prior).all(), found.exact.sd / prior
    assert (np.abs(found.exact.mean - np.asarray(model.initial["pose"])) / found.exact.sd).max() > 1
    assert (found.exact.error < 0.01 * found.exact.sd).all()
    assert (found.off < LIMIT).all(), found.off
    assert (found.variance_off < LIMIT).all(), found.variance_off


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("drawn", ["arm"], indirect=True)
def test_draws_that_are_too_narrow_are_found_out(drawn):
    model, density, exact = drawn
    honest = kernels.hmc(**HMC)

    def narrow(key, particles, density):
        after, info = honest(key, particles, density)
        mean = after.states["pose"].mean(axis=0)
        return after._replace(states={**after.states, "pose": mean + 0.9 * (after.states["pose"] - mean)}), info

    found = compare(density, narrow, model.start(800), jax.random.key(0), exact=exact)
    assert (found.off < LIMIT).all() and found.variance_off.max() > LIMIT


@pytest.mark.long
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("drawn", ["arm"], indirect=True)
def test_a_mode_seeker_is_found_out(drawn):
    model, density, exact = drawn
    found = compare(density, kernels.annealed(), model.start(1000), jax.random.key(0), exact=exact)
    assert found.off.max() > LIMIT
