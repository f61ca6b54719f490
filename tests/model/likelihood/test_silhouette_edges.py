"""The likelihood against (8) and (9) of Darby, Li & Costen (2008) written out point by point."""

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.density.factor import Variable
from bayes_body.model.body.solids import part_transforms
from bayes_body.model.likelihood.outlines import projected_area
from bayes_body.model.likelihood.patch_pixels import rig_pixels
from bayes_body.recording.observation.silhouette_edges import edge_proximity

POSE = Variable("pose")
SURFACE, OUTLINE, UNSEEN = (5, 3), 4, 0.5


@jax.jit
def evaluate(factor, pose, maps) -> jax.Array:
    return factor({POSE: pose}, {"images": maps})


slope_of = jax.jit(jax.grad(evaluate, argnums=1))
area_of = jax.jit(projected_area, static_argnums=3)
transforms_of = jax.jit(part_transforms)


def log_likelihood(scene, pose=None, maps=None, **options) -> jax.Array:
    factor = scene.factor(surface_samples=SURFACE, outline_samples=OUTLINE, **options)
    return evaluate(factor, scene.pose if pose is None else pose, scene.maps() if maps is None else maps)


def points(body, T, p, viewpoint, t, s) -> np.ndarray:
    """World points of part p at t along and s across the patch that faces the viewpoint; all as NumPy arrays."""
    (x, y, z), origin = T.rotation[p].T, T.origin[p]
    length, (r0, r1), (sx, sy) = body.lengths[p], body.radii[p], body.sections[p]
    if body.topology.is_sphere[p]:
        centre = origin + length / 2 * z
        view = (centre - viewpoint) / np.linalg.norm(centre - viewpoint)
        right = np.cross(z, view) / np.linalg.norm(np.cross(z, view))
        height = 2 * t - 1
        return centre + r0 * (height * np.cross(view, right) + np.sqrt(1 - height**2) * s * right)

    def side(end, radius):
        view = end - viewpoint
        normal = np.array([view @ y / sy, -view @ x / sx])
        cos, sin = normal / np.linalg.norm(normal)
        return radius * (sx * cos * x + sy * sin * y)

    tip = origin + length * z
    return (1 - t) * (origin + s * side(origin, r0)) + t * (tip + s * side(tip, r1))


def opencv_pixel(camera, point) -> np.ndarray:
    fx, fy, cx, cy = (*np.asarray(camera.focal), *np.asarray(camera.centre))
    rotation = cv2.Rodrigues(np.asarray(camera.rotation))[0]
    normalised = cv2.projectPoints(point[None], rotation, np.asarray(camera.translation), np.eye(3), np.asarray(camera.distortion))[0][0, 0]
    return np.array([fx * (normalised[0] + float(camera.skew) * normalised[1]) + cx, fy * normalised[1] + cy])


def slow(scene, term: str) -> float:
    """One term of (8), summed over cameras, at nearest pixels; errors are rounded to levels of 1/255 as the maps hold them."""
    along, across = SURFACE
    surface = [((i + 0.5) / along, (2 * j + 1) / across - 1) for i in range(along) for j in range(across)]
    outline = [((i + 0.5) / OUTLINE, s) for i in range(OUTLINE) for s in (-1, 1)]
    body, T = jax.tree.map(np.asarray, (scene.body, transforms_of(scene.body, scene.pose)))
    total = 0.0
    for c in range(2):
        camera = jax.tree.map(lambda leaf, c=c: np.asarray(leaf)[c], scene.rig)
        viewpoint = -camera.rotation.T @ camera.translation
        silhouette = cv2.GaussianBlur(scene.frame.masks[c].astype(np.float32), (0, 0), 2.0)
        V = silhouette if term == "silhouette" else edge_proximity(scene.frame.images[c], 20.0, 3.0)
        errors = []
        for p in range(len(scene.body.topology.names)):
            for t, s in surface if term == "silhouette" else outline:
                u, v = np.rint(opencv_pixel(camera, points(body, T, p, viewpoint, t, s))).astype(int)
                inside = 0 <= u < V.shape[1] and 0 <= v < V.shape[0]
                errors.append(np.floor(255 * (1 - V[v, u]) ** 2 + 0.5) / 255 if inside else round(255 * UNSEEN) / 255)
        total += np.mean(errors)
    return total


@pytest.mark.parametrize("name", ["arm_4", "deutscher_31"])
@pytest.mark.parametrize("term", ["silhouette", "edges"])
def test_equals_8_point_by_point(x64, scene, name, term):
    found = log_likelihood(scene(name), lookup="nearest", terms=(term,))
    assert found == pytest.approx(-slow(scene(name), term), rel=1e-5)


@pytest.mark.parametrize("lookup", ["nearest", "bilinear"])
def test_terms_add_up(x64, scene, lookup):
    man = scene("deutscher_31")
    both, silhouette, edges = (log_likelihood(man, lookup=lookup, terms=t) for t in (("silhouette", "edges"), ("silhouette",), ("edges",)))
    assert both == pytest.approx(float(silhouette + edges), rel=1e-12)
    assert min(-silhouette, -edges) > 0.1


def test_bilinear_and_nearest_are_of_the_same_maps(x64, scene):
    man = scene("deutscher_31")
    assert log_likelihood(man, lookup="nearest") == pytest.approx(float(log_likelihood(man, lookup="bilinear")), rel=0.1)


def test_precision_scales(x64, scene):
    man = scene("deutscher_31")
    assert log_likelihood(man, precision=7.0) == pytest.approx(7 * float(log_likelihood(man)), rel=1e-5)


def test_the_value_is_finite_everywhere_and_nan_for_nan(scene):
    man = scene("deutscher_31")
    for lookup in ("nearest", "bilinear"):
        for shift in (0.0, 3.0, -3.0, 1e4):
            assert np.isfinite(log_likelihood(man, man.pose.at[0].add(shift), lookup=lookup))
        for bad in (jnp.nan, jnp.inf):
            assert np.isnan(log_likelihood(man, man.pose.at[4].set(bad), lookup=lookup))


def test_out_of_sight_counts_what_the_observation_says(x64, scene):
    # A metre behind the cameras every sample is unseen: two cameras, two terms.
    man = scene("deutscher_31")
    maps = man.maps(unseen_error=0.2)
    assert log_likelihood(man, man.pose.at[0].set(50.0), maps) == pytest.approx(-4 * 0.2, rel=1e-5)


@pytest.mark.parametrize("gamma", [0.0, pytest.param(5.0, marks=pytest.mark.slow)])
def test_cameras_that_did_not_see_say_nothing(x64, scene, gamma):
    """One adds a constant, whatever the pose; two leave nothing but constants, and no slope."""
    man = scene("deutscher_31")
    poses = [man.pose, man.pose.at[7].add(0.4), man.pose.at[0].add(0.2)]

    def values(seen: tuple[bool, ...]) -> list[float]:
        frame = man.frame._replace(
            images=tuple(image if s else None for image, s in zip(man.frame.images, seen, strict=True)),
            sizes_px=tuple(image.shape[::-1] for image in man.frame.images),
        )
        maps = man._replace(frame=frame).maps()
        return [float(log_likelihood(man, pose, maps, gamma=gamma)) for pose in poses]

    np.testing.assert_allclose(values((False, False)), -4 * round(255 * UNSEEN) / 255, rtol=1e-9)
    both, first, second = values((True, True)), values((True, False)), values((False, True))
    np.testing.assert_allclose(np.add(first, second), np.subtract(both, 4 * round(255 * UNSEEN) / 255), rtol=1e-9)
    blind = man._replace(frame=man.frame._replace(images=(None, None), sizes_px=((160, 120), (128, 104)))).maps()
    slope = slope_of(man.factor(surface_samples=SURFACE, outline_samples=OUTLINE, gamma=gamma), man.pose, blind)
    np.testing.assert_allclose(slope, 0, atol=1e-9)


def test_at_equal_areas_w_is_one(x64, scene):
    man = scene("deutscher_31")
    equal = man.maps()._replace(foreground=area_of(man.body, man.rig, man.pose, (80, 60)))
    assert log_likelihood(man, maps=equal, gamma=5.0) == pytest.approx(float(log_likelihood(man)), rel=1e-12)


@pytest.mark.slow
def test_areas_agree_at_the_pose_to_which_they_are_matched(x64, scene):
    # The camera of a man of whose silhouette the body covers four fifths; the other camera did not see the frame.
    man = scene("deutscher_31")
    share = area_of(man.body, man.rig, man.pose, (80, 60))
    maps = man.maps()._replace(foreground=jnp.asarray([1.25 * share[0], -1.0]))
    factor = man.factor(surface_samples=SURFACE, outline_samples=OUTLINE, gamma=5.0)
    matched = factor.log_potential.matched_to(maps, man.pose)
    assert matched.body_share == pytest.approx(0.8, rel=1e-10)
    found = evaluate(replace(factor, log_potential=matched), man.pose, maps)
    assert found == pytest.approx(float(log_likelihood(man, maps=maps)), rel=1e-10)
    blind = maps._replace(foreground=jnp.asarray([-1.0, -1.0]))
    assert factor.log_potential.matched_to(blind, man.pose).body_share == 1.0


@pytest.mark.parametrize(("gamma", "least", "covered"), [(1.0, 0.0, 1.0), (5.0, 0.0, 1.0), (5.0, 0.07, 0.9)])
def test_w_is_9(x64, scene, gamma, least, covered):
    man = scene("deutscher_31")
    share = np.asarray(area_of(man.body, man.rig, man.pose, (80, 60)))
    maps = man.maps()._replace(foreground=jnp.asarray(share * [0.8, 1.3]))
    g_x, g_z = (s / (1 - s) for s in (share, covered * np.asarray(maps.foreground)))
    W = (1 - np.abs(g_z - g_x) / np.maximum(g_z, g_x)) ** gamma
    one = [silhouette_of(man, maps, c) - least for c in (0, 1)]
    expected = float(one[0] / W[0] + one[1] / W[1] + log_likelihood(man, maps=maps, terms=("edges",)))
    found = log_likelihood(man, maps=maps, gamma=gamma, least_error=least, body_share=covered)
    assert found == pytest.approx(expected, rel=1e-10)


@pytest.mark.slow
def test_covered_cells_count_in_neither_area(x64, scene):
    man, rows = scene("deutscher_31"), np.arange(60)
    whole = area_of(man.body, man.rig, man.pose, (80, 60))
    upper = np.broadcast_to((rows < 30)[:, None], (2, 60, 80)).astype(float)
    halves = [np.asarray(area_of(man.body, man.rig, man.pose, (80, 60), jnp.asarray(half))) for half in (upper, 1 - upper)]
    assert np.mean(halves, axis=0) == pytest.approx(np.asarray(whole), rel=1e-10)
    equal = man.maps()._replace(foreground=jnp.asarray(halves[0]), uncovered=jnp.asarray(upper))
    assert log_likelihood(man, maps=equal, gamma=5.0) == pytest.approx(float(log_likelihood(man)), rel=1e-12)


def silhouette_of(man, maps, c) -> jax.Array:
    """The silhouette term of one camera alone."""
    factor = man._replace(rig=jax.tree.map(lambda leaf: leaf[c : c + 1], man.rig)).factor(
        surface_samples=SURFACE, outline_samples=OUTLINE, terms=("silhouette",)
    )
    return evaluate(factor, man.pose, jax.tree.map(lambda leaf: leaf[c : c + 1], maps))


@pytest.mark.slow
def test_gamma_holds_a_body_to_its_size(x64, scene):
    # Twice as far from the one camera: with silhouettes alone a small body fits inside the big one just as well.
    man = scene("deutscher_31")
    one = man._replace(rig=jax.tree.map(lambda leaf: leaf[:1], man.rig))
    area = area_of(one.body, one.rig, one.pose, (80, 60))
    everything = jnp.zeros_like(man.maps().errors[:1])
    maps = man.maps()._replace(errors=everything + 0x40404040, foreground=area)
    viewpoint = jax.tree.map(lambda leaf: leaf[0], one.rig).viewpoint
    far = one.pose.at[:3].add(-viewpoint)
    assert area_of(one.body, one.rig, far, (80, 60))[0] < 0.5 * area[0]
    plain = [float(log_likelihood(one, pose, maps)) for pose in (one.pose, far)]
    held = [float(log_likelihood(one, pose, maps, gamma=5.0)) for pose in (one.pose, far)]
    assert plain[0] == pytest.approx(plain[1], rel=1e-9)
    assert held[0] == pytest.approx(plain[0], rel=1e-9)
    assert held[1] < 5 * held[0]
    # Where the silhouette leaves no error, W has nothing to divide but the least error.
    clear = maps._replace(errors=everything)
    vanished = [[float(log_likelihood(one, pose, clear, gamma=5.0, least_error=least)) for pose in (one.pose, far)] for least in (0.0, 0.05)]
    assert vanished[0] == pytest.approx([0.0, 0.0], abs=1e-9)
    assert vanished[1][1] < 5 * vanished[1][0] < 0


def test_gradient_away_from_cell_borders(x64, scene):
    arm, step = scene("arm_4", seed=1), 1e-6
    factor = arm.factor(surface_samples=(2, 2), outline_samples=2)
    data = {"images": arm.maps()}
    potential = factor.log_potential
    pixels = jax.jit(rig_pixels)(arm.body, arm.rig, potential.samples, arm.pose)
    # The precondition, held up: no sample reaches a pixel's line within the step (a radian moves none by more than 500 px).
    fraction = np.stack([pixels.u, pixels.v]) % 1
    assert min(fraction.min(), 1 - fraction.max()) > 500 * step
    steps = step * np.eye(arm.pose.size)
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(lambda pose: factor({POSE: pose}, data))))(
        np.asarray(arm.pose) + np.concatenate([steps, -steps, 0 * steps[:1]])
    )
    ahead, behind = np.split(np.asarray(values)[:-1], 2)
    found = np.asarray(gradients[-1])
    assert found == pytest.approx((ahead - behind) / (2 * step), rel=1e-6, abs=1e-8)
    assert np.abs(found).min() > 1e-3


@pytest.mark.parametrize("gamma", [0.0, pytest.param(5.0, marks=pytest.mark.slow)])
def test_gradient_is_zero_outside_the_scope(scene, gamma):
    arm = scene("arm_4")
    factor = arm.factor(gamma=gamma)
    values = {POSE: arm.pose, Variable("pose", -1): arm.pose + 0.1, Variable("other"): jnp.ones(3)}
    gradient = jax.jit(jax.grad(lambda v: factor(v, {"images": arm.maps()})))(values)
    assert factor.scope == (POSE,)
    assert not factor.reads_previous
    assert jnp.abs(gradient[POSE]).min() > 0
    assert not any(jnp.any(gradient[variable]) for variable in values if variable != POSE)


def test_images_of_a_new_frame_and_subject_compile_nothing(scene):
    man, traced = scene("deutscher_31"), []

    @jax.jit
    def evaluate(factor, pose, maps):
        traced.append(1)
        return factor({POSE: pose}, {"images": maps})

    factor, maps = man.factor(), man.maps()
    first = evaluate(factor, man.pose, maps)
    taller = replace(factor.log_potential, body=replace(man.body, lengths=man.body.lengths * 1.1))
    second = evaluate(replace(factor, log_potential=taller), man.pose, maps._replace(errors=maps.errors[:, ::-1]))
    assert len(traced) == 1
    assert first != second
