"""The markers' likelihood: its formula written out, its integral, and that what is drawn from it has its density."""

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from bayes_body.base.errors import InputError
from bayes_body.base.registry import find
from bayes_body.density.factor import Factor, Variable
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.body.placed_body import loosened, placed_markers
from bayes_body.recording.evidence.markers import FEET, KEYPOINTS, MARKERS, MarkerEvidence

POSE = Variable("pose")
NOISES = {
    "gaussian": {"noise": "gaussian"},
    "student": {"noise": "student", "degrees_of_freedom": 3.0},
    "outliers": {"noise": "student", "outliers": 0.2},
    "gaussian with outliers": {"outliers": 0.3},
}
# Where a likelihood does the same whatever the noise: one of each kind, and the others in the slow tier.
SOME_NOISES = ["gaussian", "outliers", *(pytest.param(noise, marks=pytest.mark.slow) for noise in ("student", "gaussian with outliers"))]


def factor(scene, **options) -> Factor:
    term = find("likelihood", "markers_gaussian")
    return term.build(name="markers", options=term.options(**options), body=scene.body, rig=scene.rig)


@jax.jit
def log_density(f: Factor, pose, seen: MarkerEvidence) -> jax.Array:
    return f({POSE: pose}, {"markers": seen})


@jax.jit
def value_and_slope(f: Factor, configuration, seen: MarkerEvidence) -> tuple[jax.Array, jax.Array]:
    """The log-density, and its gradient by the one variable of the factor."""
    return jax.value_and_grad(lambda x: f({f.scope[0]: x}, {"markers": seen}))(configuration)


positions = jax.jit(marker_positions)
configured = jax.jit(lambda body, pose: body.placement.configuration(body.skeleton, pose))


def camera_of(scene, c):
    return jax.tree.map(lambda leaf: np.asarray(leaf, float)[c], scene.rig)


def opencv_pixels(scene) -> np.ndarray:
    """The body's markers in each camera, by OpenCV, (camera, marker, 2)."""
    points, rows = np.asarray(positions(scene.body.skeleton, scene.body.markers, scene.pose), float), []
    for c in range(2):
        camera = camera_of(scene, c)
        xy = cv2.projectPoints(points, cv2.Rodrigues(camera.rotation)[0], camera.translation, np.eye(3), camera.distortion)[0][:, 0]
        x = xy[:, 0] + camera.skew * xy[:, 1]
        rows.append(np.stack([camera.focal[0] * x + camera.centre[0], camera.focal[1] * xy[:, 1] + camera.centre[1]], axis=1))
    return np.array(rows)


def seen_near(scene, seed=3, spread=6.0) -> MarkerEvidence:
    """Markers some pixels from where they should be; one in three of low confidence, one in three not found."""
    rng = np.random.default_rng(seed)
    pixels, confidence = np.zeros((2, len(MARKERS), 2)), np.zeros((2, len(MARKERS)))
    places = [MARKERS.index(name) for name in scene.body.markers.names]
    pixels[:, places] = opencv_pixels(scene) + rng.normal(0, spread, (2, len(places), 2))
    confidence[:, places] = rng.choice([0.0, 0.2, 0.9], (2, len(places)))
    confidence[:, places[:2]] = [[0.5, 0.9], [1.0, 0.2]]
    return MarkerEvidence(jnp.asarray(pixels), jnp.asarray(confidence))


@pytest.mark.parametrize(
    ("body", "power"),
    [
        ("arm_4", 0.0),
        ("deutscher_31", 0.5),
        pytest.param("arm_4", 0.5, marks=pytest.mark.slow),
        pytest.param("deutscher_31", 0.0, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("noise", NOISES)
def test_equals_the_formula_marker_by_marker(x64, scene, body, noise, power):
    options = {"sd_px": 5.0, "at_diagonal_px": 100.0, "least_confidence": 0.2, "by_confidence": power, **NOISES[noise]}
    scene, share = scene(body), options.get("outliers", 0.0)
    seen, expected, total, counted = seen_near(scene), opencv_pixels(scene), 0.0, 0
    for c in range(2):
        width, height = camera_of(scene, c).size
        for m, name in enumerate(scene.body.markers.names):
            (u, v), q = np.asarray(seen.pixels)[c, MARKERS.index(name)], float(np.asarray(seen.confidence)[c, MARKERS.index(name)])
            if q <= 0.2:
                continue
            counted += 1
            sd = 5.0 * np.hypot(width, height) / 100 / q**power
            r2, nu = np.sum((np.array([u, v]) - expected[c, m]) ** 2) / sd**2, options.get("degrees_of_freedom", 4.0)
            f = (np.exp(-r2 / 2) if options.get("noise", "gaussian") == "gaussian" else (1 + r2 / nu) ** (-(nu + 2) / 2)) / (2 * np.pi * sd**2)
            inside = -0.5 <= u <= width - 0.5 and -0.5 <= v <= height - 0.5
            total += np.log((1 - share) * f + share * inside / (width * height))
    assert 2 <= counted < 2 * len(scene.body.markers.names)
    assert log_density(factor(scene, **options), scene.pose, seen) == pytest.approx(total, rel=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("noise", NOISES)
def test_it_integrates_to_one_over_the_pixels_of_a_marker(x64, scene, noise):
    scene = scene("arm_4")
    f, elbow = factor(scene, sd_px=2.5, **NOISES[noise]), MARKERS.index("l_elbow")
    width, height = camera_of(scene, 0).size
    centre = opencv_pixels(scene)[0, list(scene.body.markers.names).index("l_elbow")]
    assert 30 < centre[0] < width - 30 and 30 < centre[1] < height - 30
    confidence = np.zeros((2, 15))
    confidence[0, elbow] = 0.9

    @jax.jit
    @jax.vmap
    def density(pixel):
        pixels = jnp.zeros((2, 15, 2)).at[0, elbow].set(pixel)
        return jnp.exp(log_density(f, scene.pose, MarkerEvidence(pixels, jnp.asarray(confidence))))

    # A fine grid over ten images, so that an image's border falls between its points; what a Student has beyond is known.
    u, v = (np.arange(-0.5 - 2 * side, 3 * side, 0.5) + 0.25 for side in (width, height))
    mass = 0.25 * np.asarray(density(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))).sum()
    nu, share = NOISES[noise].get("degrees_of_freedom", 4.0), NOISES[noise].get("outliers", 0.0)
    tail = (1 + (2 * height / 2.5) ** 2 / nu) ** (-nu / 2) if NOISES[noise].get("noise") == "student" else 0.0
    assert mass == pytest.approx(1, abs=2 * (1 - share) * tail + 1e-4)


@jax.jit
def draws(f: Factor, pose) -> MarkerEvidence:
    return jax.vmap(lambda key: f.simulate(key, {POSE: pose}))(jax.random.split(jax.random.key(5), 4000))


@jax.jit
def log_ratios(f: Factor, other, pose, seen: MarkerEvidence) -> jax.Array:
    """log p(z | other) - log p(z | pose) of many frames."""
    return jax.vmap(lambda z: log_density(f, other, z) - log_density(f, pose, z))(seen)


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["gaussian", "student"])
def test_what_is_drawn_has_the_distances_of_the_distribution(scene, noise):
    scene, nu, sd = scene("arm_4"), 3.0, 4.0
    seen = draws(factor(scene, sd_px=sd, **NOISES[noise]), scene.pose)
    places = [MARKERS.index(name) for name in scene.body.markers.names]
    assert seen.pixels.shape == (4000, 2, 15, 2)
    assert (np.delete(np.asarray(seen.confidence), places, axis=2) == 0).all() and (np.asarray(seen.confidence)[:, :, places] == 1).all()
    off = (np.asarray(seen.pixels)[:, :, places] - opencv_pixels(scene)) / sd
    r2 = np.sum(off**2, axis=-1).ravel()
    below = 1 - np.exp(-r2 / 2) if noise == "gaussian" else 1 - (1 + r2 / nu) ** (-nu / 2)
    assert kstest(below, "uniform").pvalue > 1e-3
    assert kstest((np.arctan2(off[..., 1], off[..., 0]).ravel() / (2 * np.pi)) % 1, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("noise", NOISES)
def test_what_is_drawn_has_the_density(scene, noise):
    """The mean of p(z | s') / p(z | s) over z drawn from p(z | s) is 1, for any s'."""
    scene = scene("arm_4")
    f = factor(scene, sd_px=6.0, missing=0.25, **NOISES[noise])
    other = np.asarray(scene.pose) + np.array([0.02, -0.03, 0.02, 0.04], np.float32)
    seen = draws(f, scene.pose)
    ratio = np.exp(log_ratios(f, other, scene.pose, seen))
    assert ratio.std() > 0.1
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(ratio.size)


def test_markers_are_missing_at_their_rate(scene):
    scene = scene("arm_4")
    seen = draws(factor(scene, missing=0.25), scene.pose)
    places = [MARKERS.index(name) for name in scene.body.markers.names]
    there = np.asarray(seen.confidence)[:, :, places]
    assert abs(there.mean() - 0.75) < 4 * np.sqrt(0.25 * 0.75 / there.size)
    assert (np.asarray(seen.pixels)[:, :, places][there == 0] == 0).all()


def test_nothing_seen_says_nothing(scene):
    scene = scene("deutscher_31")
    nothing = MarkerEvidence(jnp.full((2, 15, 2), jnp.nan), jnp.zeros((2, 15)))
    value, gradient = value_and_slope(factor(scene), scene.pose, nothing)
    assert value == 0
    assert (np.asarray(gradient) == 0).all()


@pytest.mark.parametrize("noise", SOME_NOISES)
def test_behind_the_camera_it_is_finite_and_does_not_depend_on_the_pose(scene, noise):
    scene = scene("arm_4")
    turn = np.diag(np.array([-1.0, 1.0, -1.0], np.float32))
    rotation, translation = (jnp.asarray(array) for array in (turn @ np.asarray(scene.rig.rotation), np.asarray(scene.rig.translation) @ turn))
    f, seen = factor(scene._replace(rig=replace(scene.rig, rotation=rotation, translation=translation)), **NOISES[noise]), seen_near(scene)
    value, gradient = value_and_slope(f, scene.pose, seen)
    assert np.isfinite(value) and value < value_and_slope(factor(scene, **NOISES[noise]), scene.pose, seen)[0]
    assert (np.asarray(gradient) == 0).all()
    assert np.isnan(value_and_slope(f, scene.pose.at[0].set(jnp.nan), seen)[0])


def test_the_gradient_is_the_densitys(x64, scene):
    scene = scene("deutscher_31")
    f, seen = factor(scene, **NOISES["outliers"]), seen_near(scene)
    pose, step = np.asarray(scene.pose), 1e-6 * np.random.default_rng(0).normal(size=scene.pose.shape)
    value, gradient = value_and_slope(f, pose, seen)
    ahead, behind = (float(value_and_slope(f, moved, seen)[0]) for moved in (pose + step, pose - step))
    assert ahead - behind == pytest.approx(2 * float(np.asarray(gradient) @ step), rel=1e-5)
    assert np.isfinite(value)


def test_a_wrong_detection_moves_a_gaussian_and_not_a_student(x64, scene):
    scene = scene("arm_4")
    wrist, near = MARKERS.index("l_wrist"), seen_near(scene, spread=0.5)
    away = 60.0 * (np.arange(len(MARKERS)) == wrist)[:, None]
    far = MarkerEvidence(jnp.asarray(near.pixels + away), jnp.asarray(np.ones(near.confidence.shape)))
    pulls = {}
    for noise in ("gaussian", "student"):
        f = factor(scene, sd_px=3.0, noise=noise)
        pulls[noise] = np.linalg.norm(value_and_slope(f, scene.pose, far)[1])
    assert pulls["student"] < 0.05 * pulls["gaussian"]


def test_a_body_without_such_markers(scene):
    scene = scene("arm_4")
    body = replace(scene.body, markers=replace(scene.body.markers, names=("a", "b", "c")))
    with pytest.raises(
        InputError, match=r"markers: the body 'arm_4' has the markers a, b, c; expected some of pelvis, .*; use these names in the body's"
    ):
        factor(scene._replace(body=body))


@jax.jit
def whole(f: Factor, body, parts, seen: MarkerEvidence) -> tuple[jax.Array, jax.Array]:
    """The text of the whole body, at the markers of the placed parts, and its gradient."""
    detections, places = f.log_potential.log_potential.args[0], np.array([MARKERS.index(name) for name in body.markers.names], np.int32)
    pixels, confidence = (array[:, places] for array in seen)
    return jax.value_and_grad(lambda x: detections.log_density(placed_markers(body, x), pixels, confidence))(parts)


rows_of = jax.jit(lambda plate, parts, seen: plate.log_potentials(parts, seen))


@pytest.mark.slow
@pytest.mark.parametrize("body", ["arm_4", "person_31"])
@pytest.mark.parametrize("noise", SOME_NOISES)
def test_a_body_placed_by_parts_is_a_plate_of_the_same_density(x64, scene, body, noise):
    scene = scene(body)
    loose = loosened(scene.body)
    parts, seen = np.asarray(configured(loose, scene.pose)), seen_near(scene)
    parts = jnp.asarray(parts + 0.01 * np.random.default_rng(0).normal(size=parts.shape))
    f = factor(scene._replace(body=loose), by_confidence=0.5, least_confidence=0.2, **NOISES[noise])
    plate = f.log_potential
    owners = [loose.placement.owners[joint] for joint in loose.markers.joints]
    assert plate.rows == tuple((part,) for part in sorted(set(owners)))

    (one, slope), (other, other_slope) = value_and_slope(f, parts, seen), whole(f, loose, parts, seen)
    assert float(one) == pytest.approx(float(other), rel=1e-9) and np.isfinite(one)
    np.testing.assert_allclose(slope, other_slope, rtol=1e-6, atol=1e-9 * np.abs(other_slope).max())
    rows = np.asarray(rows_of(plate, parts, seen))
    moved = np.asarray(rows_of(plate, parts.at[plate.rows[1][0], 1].add(0.05), seen))
    assert np.flatnonzero(rows != moved).tolist() == [1]
    assert np.isnan(value_and_slope(f, parts.at[0, 4].set(jnp.nan), seen)[0])


@pytest.fixture
def feet(x64, scene):
    """The likelihood of a body with ankles, and evidence of all its keypoints, some pixels from where they should be."""
    scene = scene("person_35")
    assert set(scene.body.markers.names) == set(KEYPOINTS)
    pixels = opencv_pixels(scene)[:, [scene.body.markers.names.index(name) for name in KEYPOINTS]]
    pixels += np.random.default_rng(3).normal(0, 6.0, pixels.shape)
    return scene, factor(scene), MarkerEvidence(jnp.asarray(pixels), jnp.full(pixels.shape[:2], 0.9))


def test_heels_and_toes_move_the_ankles(feet):
    scene, f, seen = feet
    moved = value_and_slope(f, scene.pose, seen)[1]
    # Below the confidence that counts.
    without = value_and_slope(f, scene.pose, seen._replace(confidence=seen.confidence.at[:, len(MARKERS) :].set(0.3)))[1]
    for name in ("l_ankle_y", "l_subtalar", "r_ankle_y", "r_subtalar"):
        place = scene.body.dof_names.index(name)
        assert abs(moved[place]) > 0.1 and abs(without[place]) < 1e-9
        # Without noise the slope points back to where the keypoints came from.
        step = jnp.zeros_like(scene.pose).at[place].set(0.1)
        exact = seen._replace(pixels=jnp.asarray(opencv_pixels(scene)[:, [scene.body.markers.names.index(name) for name in KEYPOINTS]]))
        assert value_and_slope(f, scene.pose + step, exact)[1][place] < 0 < value_and_slope(f, scene.pose - step, exact)[1][place]


def test_markers_may_have_another_deviation(feet):
    """With twice the deviation, a marker alone has the density of the likelihood whose deviation is twice as large."""
    scene, _, seen = feet
    toes = np.array(["toe" in name for name in KEYPOINTS])
    only = {name: seen._replace(confidence=jnp.where(chosen, seen.confidence, 0.0)) for name, chosen in (("toes", toes), ("others", ~toes))}
    plain, wide, mixed = (factor(scene, sd_px=sd, **more) for sd, more in ((6.0, {}), (12.0, {}), (6.0, {"sd_factors": {"*_toe": 2.0}})))
    wanted = log_density(wide, scene.pose, only["toes"]) + log_density(plain, scene.pose, only["others"])
    assert float(log_density(mixed, scene.pose, seen)) == pytest.approx(float(wanted), rel=1e-9)
    with pytest.raises(InputError, match=r"sd_factors\.toes: matches no marker of the body"):
        factor(scene, sd_factors={"toes": 2.0})


def test_what_is_drawn_of_a_body_with_feet_has_its_heels_and_toes(feet):
    scene, f, seen = feet
    drawn = jax.jit(lambda key, pose: f.simulate(key, {POSE: pose}))(jax.random.key(0), scene.pose)
    assert drawn.pixels.shape == seen.pixels.shape == (2, len(MARKERS) + len(FEET), 2) and (np.asarray(drawn.confidence) == 1).all()


@pytest.mark.slow
def test_both_placements_draw_the_same_frames(scene):
    scene = scene("arm_4")
    loose = loosened(scene.body)
    key, parts = jax.random.key(2), configured(loose, scene.pose)
    drawn = jax.jit(lambda f, x: f.simulate(key, {f.scope[0]: x}))
    by_angles = drawn(factor(scene, missing=0.2), scene.pose)
    by_parts = drawn(factor(scene._replace(body=loose), missing=0.2), parts)
    np.testing.assert_allclose(by_angles.pixels, by_parts.pixels, atol=1e-3)
    np.testing.assert_array_equal(by_angles.confidence, by_parts.confidence)
