"""Edges by phase: filters that answer waves and steps as they should, parts that hide each other, gradients."""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from bayes_body.base.errors import InputError
from bayes_body.base.geometry.camera import Pixels, project
from bayes_body.base.toml.read import validate
from bayes_body.model.body.solids import outline_samples, part_transforms
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_body, load_definition
from bayes_body.model.likelihood.boundaries import boundaries, contour
from bayes_body.model.likelihood.edge_phase import Options, build
from bayes_body.model.likelihood.patch_pixels import rig_patches, sample_slopes
from bayes_body.recording.evidence.edge_phase import PhaseMaps, look_up, pack, steer
from bayes_body.recording.observation.edge_phase import responses
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.session.session import CameraSpec, Session, View

SIZE = (320, 240)


@pytest.fixture(autouse=True)
def double_precision():
    with jax.enable_x64(True):
        yield


# -- filters ------------------------------------------------------------------------------------------------------------------------------


def _grid():
    return np.meshgrid(np.arange(SIZE[0], dtype=float), np.arange(SIZE[1], dtype=float))


@pytest.mark.parametrize("angle", [0.0, 0.4, math.pi / 2, 2.3])
def test_a_wave_comes_out_with_its_amplitude_and_phase(angle):
    columns, rows = _grid()
    c, s = math.cos(angle), math.sin(angle)
    phase = 2 * math.pi / 8 * (columns * c + rows * s)
    maps = responses(np.rint(128 + 50 * np.cos(phase)).astype(np.uint8), 8.0)
    found = steer(maps, c, s)
    middle = (slice(60, 180), slice(80, 240))
    assert np.allclose(np.hypot(found.even, found.odd)[middle], 50, rtol=0.05)
    off = np.angle(np.exp(1j * (np.arctan2(-found.odd, found.even) - phase)))[middle]
    assert np.abs(off).max() < 0.1
    across = steer(maps, -s, c)
    assert np.hypot(across.even, across.odd)[middle].max() < 5


@pytest.mark.parametrize("wavelength", [6.0, 8.0, 16.0])
@pytest.mark.parametrize("angle", [0.0, 0.7, 1.9])
def test_a_step_comes_out_odd_along_its_normal(angle, wavelength):
    columns, rows = _grid()
    c, s = math.cos(angle), math.sin(angle)
    across = (columns - 160) * c + (rows - 120) * s
    image = np.rint(60 + 120 / (1 + np.exp(-across / 0.4))).astype(np.uint8)
    maps = responses(image, wavelength)
    along = np.linspace(-40, 40, 9)
    places = np.array([120 + along * c, 160 - along * s])
    found = steer([map_coordinates(each, places, order=1) for each in maps], c, s)
    assert np.all(np.abs(np.arctan2(np.abs(found.odd), found.even) - math.pi / 2) < 0.1)
    # Turned around, the same boundary is the darker on the other side: a phase of the other sign, the same modulo π.
    turned = steer([map_coordinates(each, places, order=1) for each in maps], -c, -s)
    assert np.allclose(turned.odd, -found.odd) and np.allclose(turned.even, found.even)


def test_the_even_and_the_odd_filter_weigh_noise_alike():
    noise = np.random.default_rng(0).integers(0, 256, SIZE[::-1]).astype(np.uint8)
    found = steer(responses(noise, 8.0), math.cos(0.9), math.sin(0.9))
    assert np.isclose(found.even.std(), found.odd.std(), rtol=0.05)


def test_packed_maps_are_looked_up_as_they_are():
    rng = np.random.default_rng(1)
    image = cv2.GaussianBlur(rng.integers(0, 256, SIZE[::-1]).astype(np.uint8), (0, 0), 2)
    maps = responses(image, 8.0)
    words, level = pack(maps, (250, 330))
    assert words.shape == (250, 330, 4) and words.dtype == np.uint32
    u, v = rng.uniform(1, SIZE[0] - 2, 500), rng.uniform(1, SIZE[1] - 2, 500)
    angle = rng.uniform(0, 2 * math.pi, 500)
    exact = steer([map_coordinates(each, [v, u], order=1) for each in maps], np.cos(angle), np.sin(angle))
    shaped = [jnp.asarray(each).reshape(1, 1, -1) for each in (u, v, np.cos(angle), np.sin(angle))]
    found = jax.jit(look_up)(
        PhaseMaps(words[None, None], np.array([[level]]), np.ones(1)), _rig(), Pixels(shaped[0], shaped[1], jnp.ones((1, 1, 500), bool)), shaped[2:]
    )
    assert np.abs(np.asarray(found.even).ravel() - exact.even).max() < 2 * 7 * level
    assert np.abs(np.asarray(found.odd).ravel() - exact.odd).max() < 2 * 7 * level


# -- boundaries ---------------------------------------------------------------------------------------------------------------------------


def _camera(name="C1", distance=4.0, height=0.9):
    # In front of the person, who looks along x: at (distance, 0, height), looking back.
    rotation = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    return CameraSpec(
        name=name,
        size_px=SIZE,
        focal_px=(400.0, 400.0),
        centre_px=(160.0, 120.0),
        skew=0.0,
        distortion=(0.0,) * 5,
        rotation=rotation,
        translation_m=-rotation @ np.array([distance, 0.0, height]),
    )


def _session(cameras=1):
    views = tuple(View(_camera(f"C{k + 1}", 4.0 + 0.5 * k), images="none") for k in range(cameras))
    return Session(Path(), "drawn", "z", 60.0, 1, 0, views, initial={"root_z": 0.95})


def _model(visibility="soft", cameras=1):
    definition = load_definition("poon_fleet_2002_legs")
    (term,) = definition.likelihoods
    options = term.options.model_copy(update={"visibility": visibility})
    return build_model(replace(definition, likelihoods=(replace(term, options=options),)), _session(cameras))


def _rig():
    return build_model("poon_fleet_2002_legs", _session()).rig


STANDING = {"root_z": 0.95, "l_hip_y": 0.1, "r_hip_y": -0.1, "l_hip_x": 0.1, "r_hip_x": -0.1, "l_knee": -0.2, "r_knee": -0.3}


def _pose(model, **angles):
    names = model.body.dof_names
    return jnp.asarray([angles.get(name, 0.0) for name in names])


@partial(jax.jit, static_argnums=0)
def _boundaries(visibility, body, rig, outline, pose):
    return boundaries(body, rig, outline, rig_patches(body, rig, pose), visibility)


def _seen(model, samples, visibility):
    """Pose -> where its boundaries are seen."""
    return partial(_boundaries, visibility, model.body, model.rig, contour(model.body, samples))


@jax.jit
def _log_likelihood(density, pose):
    return density.log_likelihood({"pose": pose}, {})


def test_samples_stand_on_the_occluding_contour_of_the_paper():
    """e ± r (a × c) / |a × c| at both ends, projected; between them in equal steps of the axis."""
    model = _model()
    pose = _pose(model, **STANDING)
    found = _seen(model, 10, "soft")(pose)
    T = jax.jit(part_transforms)(model.body, pose)
    camera = jax.tree.map(lambda leaf: np.asarray(leaf)[0], model.rig)
    viewpoint = -camera.rotation.T @ camera.translation
    thigh = model.body.topology.names.index("l_thigh")
    axis, base = np.asarray(T.z[thigh]), np.asarray(T.origin[thigh])
    length, (r0, r1) = float(model.body.lengths[thigh]), np.asarray(model.body.outline_radii[thigh])
    side = np.cross(axis, base - viewpoint)
    side /= np.linalg.norm(side)
    t = (np.arange(10) + 0.5) / 10
    lines = [base + length * t[:, None] * axis + sign * (r0 + (r1 - r0) * t)[:, None] * side for sign in (1, -1)]
    project_line = jax.jit(project)
    pixels = [np.asarray(project_line(camera, line)[0]) for line in lines]
    own = np.stack([found.pixels.u[0, thigh], found.pixels.v[0, thigh]], axis=1)
    halves = own[:10], own[10:]
    assert any(np.allclose(halves[0], p, atol=1e-6) and np.allclose(halves[1], q, atol=1e-6) for p, q in (pixels, pixels[::-1]))
    # Normals stand across what the samples follow.
    along = np.diff(halves[0], axis=0)
    normal = np.stack([found.normals[0][0, thigh, :9], found.normals[1][0, thigh, :9]], axis=1)
    assert np.abs(np.sum(along * normal, axis=1)).max() < 1e-6 and np.allclose(np.linalg.norm(normal, axis=1), 1)


def test_normals_of_a_sphere_point_from_its_centre():
    definition = load_definition("poon_fleet_2002_legs")
    model = build_model(replace(definition, body_name="poon_fleet_22", body=load_body("poon_fleet_22"), dynamics=_everywhere(definition)), _session())
    pose = _pose(model, root_z=0.95)
    found = _seen(model, 10, "soft")(pose)
    head = model.body.topology.names.index("head")
    places = np.stack([found.pixels.u[0, head], found.pixels.v[0, head]], axis=1)
    outward = places - places.mean(axis=0)
    normal = np.stack([found.normals[0][0, head], found.normals[1][0, head]], axis=1)
    aligned = np.sum(outward * normal, axis=1) / np.linalg.norm(outward, axis=1)
    assert np.abs(aligned).min() > 0.99


def _everywhere(definition):
    options = definition.dynamics.options.model_copy(update={"sd_deg": {"*": 1.0}})
    return replace(definition.dynamics, options=options)


@pytest.mark.parametrize("visibility", ["hard", "soft"])
def test_a_leg_hides_the_one_behind_it(visibility):
    model = _model(visibility)
    # The left leg raised forward, towards the camera, over the right one.
    pose = _pose(model, root_z=0.95, root_yaw=0.0, l_hip_y=0.0, l_knee=0.0, r_hip_x=0.0)
    names, seen = model.body.topology.names, _seen(model, 10, visibility)

    def shown(**angles):
        found = seen(pose + _pose(model, **angles))
        return {name: np.asarray(found.visible)[0, k] for k, name in enumerate(names)}

    apart = shown(l_hip_x=0.15, r_hip_x=-0.15)
    assert min(apart["l_calf"].mean(), apart["r_calf"].mean()) > 0.85
    # Seen from the side, one leg stands before the other.
    aside = shown(root_yaw=math.pi / 2)
    first, second = sorted(("l_calf", "r_calf"), key=lambda name: -aside[name].mean())
    # The far leg's outline lies half a pixel inside the near one's: soft, it is half hidden.
    assert aside[first].mean() > 0.85 and aside[second].mean() < (0.15 if visibility == "hard" else 0.5)


def test_slopes_of_samples_are_those_of_differences():
    model = _model()
    pose, samples = _pose(model, **STANDING), outline_samples(model.body, 4)
    along_u, along_v = jax.jit(lambda pose: sample_slopes(model.body, model.rig, samples, pose))(pose)
    seen = _seen(model, 4, "soft")

    def places(pose):
        pixels = seen(pose).pixels
        return np.stack([pixels.u, pixels.v])

    for dof in range(14):
        step = 1e-6 * np.eye(14)[dof]
        difference = (places(pose + step) - places(pose - step)) / 2e-6
        assert np.allclose(along_u[dof], difference[0], atol=1e-4) and np.allclose(along_v[dof], difference[1], atol=1e-4)


# -- the likelihood -----------------------------------------------------------------------------------------------------------------------


def _image(seed=0):
    """Clutter, and a pair of dark legs in it."""
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.integers(0, 256, SIZE[::-1]).astype(np.float32), (0, 0), 6) * 3 - 200
    cv2.fillPoly(
        image, [np.array([[140, 110], [155, 110], [150, 200], [142, 200]]), np.array([[165, 110], [182, 110], [180, 205], [170, 205]])], 20.0
    )
    cv2.fillPoly(image, [np.array([[138, 40], [184, 40], [182, 112], [140, 112]])], 60.0)
    return np.clip(image, 0, 255).astype(np.uint8)


def _density_of(model, images):
    sizes = tuple(image.shape[::-1] if image is not None else SIZE for image in images)
    return model.density(model.observe(Frame(0, tuple(images), None, None, sizes)))


def _states(model, number, seed=0):
    """Poses around standing, some with straight limbs, some at their limits, some seen along a limb, some behind the camera."""
    rng = np.random.default_rng(seed)
    low, high = np.asarray(model.body.skeleton.low), np.asarray(model.body.skeleton.high)
    free = np.isinf(low)
    poses = np.where(free, rng.normal(0, 0.3, (number, 14)), rng.uniform(np.where(free, 0, low), np.where(free, 1, high), (number, 14)))
    poses[:, 2] += 0.95
    kind = rng.integers(0, 6, number)
    limited = ~free
    poses[kind == 1] = np.where(limited, 0.0, poses[kind == 1])
    poses[kind == 2] = np.where(limited & (rng.random((np.sum(kind == 2), 14)) < 0.5), low, poses[kind == 2])
    poses[kind == 3] = np.where(limited, high, poses[kind == 3])
    # The thigh along the line of sight; and everything behind the camera, or around it.
    poses[kind == 4, 6] = -math.pi / 2
    poses[kind == 5, 0] = rng.uniform(3.5, 8.0, np.sum(kind == 5))
    return jnp.asarray(np.clip(poses, np.where(free, -np.inf, low), np.where(free, np.inf, high)))


@pytest.mark.long
def test_the_gradient_of_the_whole_posterior_is_that_of_differences():
    model = _model("soft")
    density = _density_of(model, [_image()])
    view = density.unconstrained()
    rng = np.random.default_rng(3)
    first = density.previous.states["pose"][0]
    value_and_grad = jax.jit(jax.value_and_grad(lambda x: view({"pose": x})))
    # Smaller than the usual step: between pixels the look-up bends, and a difference over a bend is no derivative.
    step, worst = 1e-8, []
    for _ in range(100):
        pose = jnp.asarray(np.asarray(first) + rng.normal(0, 0.08, 14) * np.where(np.arange(14) < 3, 0.3, 1.0))
        pose = jnp.clip(pose, model.body.skeleton.low + 1e-3, model.body.skeleton.high - 1e-3)
        x = view.unconstrain({"pose": pose})["pose"]
        _, slope = value_and_grad(x)
        direction = jnp.asarray(rng.normal(size=14))
        ahead, behind = (value_and_grad(x + sign * step * direction)[0] for sign in (1, -1))
        difference, exact = (ahead - behind) / (2 * step), slope @ direction
        worst.append(abs(difference - exact) / (jnp.linalg.norm(slope) * jnp.linalg.norm(direction)))
    assert max(worst) < 1e-5


@pytest.mark.long
@pytest.mark.parametrize("visibility", ["soft", "hard"])
def test_no_state_has_a_value_or_gradient_that_is_no_number(visibility):
    model = _model(visibility)
    density = _density_of(model, [_image()])
    poses = _states(model, 10_000)
    with jax.enable_x64(False):
        model = _model(visibility)
        density = _density_of(model, [_image()])
        run = jax.jit(jax.vmap(jax.value_and_grad(lambda pose: density.log_likelihood({"pose": pose}, density.ancestor(0)))))
        values, slopes = run(jnp.asarray(np.asarray(poses), jnp.float32))
    assert bool(jnp.isfinite(values).all()) and bool(jnp.isfinite(slopes).all())


@pytest.mark.slow
def test_hard_and_soft_visibility_agree_where_nothing_is_hidden():
    values = []
    for visibility in ("hard", "soft"):
        model = _model(visibility)
        pose = _pose(model, root_z=0.95, l_hip_x=0.2, r_hip_x=-0.2)
        density = _density_of(model, [_image()])
        values.append(float(_log_likelihood(density, pose)))
    assert abs(values[0] - values[1]) < 2.0


@pytest.mark.slow
def test_a_camera_that_did_not_see_says_the_same_of_all_poses():
    model = _model("hard", cameras=2)
    density = _density_of(model, [_image(), None])
    alone = _model("hard")
    single = _density_of(alone, [_image()])
    poses = _states(model, 20, seed=5)
    of_both, of_one = (np.array([_log_likelihood(seen, pose) for pose in np.asarray(poses)]) for seen in (density, single))
    assert np.ptp(of_both - of_one) < 1e-9


def test_the_sum_of_samples_is_the_normalised_one_times_their_number():
    model = _model("hard")
    options = model.definition.likelihoods[0].options
    whole = build("edge_phase", options.model_copy(update={"normalise_by_samples": False}), model.body, model.rig)
    normalised = build("edge_phase", options, model.body, model.rig)
    maps = _density_of(model, [_image()]).data["edge_phase"]
    pose = {next(iter(normalised.scope)): _pose(model, **STANDING)}
    found = jax.jit(lambda pose: (whole.log_potential(pose, maps), normalised.log_potential(pose, maps)))(pose)
    assert np.isclose(found[0], 20 * found[1])


@pytest.mark.slow
def test_the_curvature_is_that_of_the_formula():
    """(22), from differences of the samples' places: the weight times (2π/λσ)² of every scale, times the products of shifts along the normal."""
    model = _model("hard")
    density = _density_of(model, [_image()])
    pose = _pose(model, **STANDING)
    found = jax.jit(lambda pose: density.curvature({"pose": pose, "pose_before": pose}, density.ancestor(0))["pose"])(pose)
    seen = _seen(model, 10, "hard")
    here = seen(pose)
    phase = sum((2 * math.pi / wavelength / (0.15 * math.pi)) ** 2 for wavelength in (8.0, 16.0)) / 20
    shifts = []
    for step in 1e-5 * np.eye(14):
        ahead, behind = seen(pose + step).pixels, seen(pose - step).pixels
        moved_u, moved_v = np.asarray(ahead.u) - behind.u, np.asarray(ahead.v) - behind.v
        shifts.append((moved_u * here.normals[0] + moved_v * here.normals[1]) / 2e-5)
    expected = phase * np.einsum("icps,jcps,cps->ij", shifts, shifts, here.visible)
    assert np.allclose(found, expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


# -- what cannot be -----------------------------------------------------------------------------------------------------------------------


def _table(**changes):
    scale = {"wavelength_px": 8.0, "epsilon": [0.5, 0.9], "amplitude": [3.0, 1.5], "log_amplitude": [0.0, 4.0], "log_occluded": -4.0} | changes
    return validate(Options, {"scale": [scale]}, "likelihood #1")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"amplitude": [0.9, 1.5]}, "amplitude"),
        ({"epsilon": [0.5, 1.1]}, "epsilon"),
        ({"log_amplitude": [4.0, 0.0]}, "give the smallest, then the largest"),
        ({"wavelength_px": 2.0}, "wavelength_px"),
    ],
)
def test_statistics_that_cannot_be_are_said(changes, words):
    with pytest.raises(InputError, match=words):
        _table(**changes)


def test_an_image_smaller_than_the_filters_is_said():
    model = _model()
    small = np.zeros((40, 60), np.uint8)
    with pytest.raises(InputError, match=r"images of 60 x 40 pixels under a filter of wavelength 16 px; expected at least 48 pixels"):
        _density_of(model, [small])
