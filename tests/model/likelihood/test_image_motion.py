"""Image motion: where points were in the frame before, what is covered, closed forms of the likelihood, and mutants of what it compares."""

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry.camera import project
from bayes_body.base.registry import find
from bayes_body.density.factor import Variable
from bayes_body.model.body.solids import part_transforms, patches
from bayes_body.model.likelihood.surface_points import LEAST_COSINE, carried_points
from bayes_body.recording.evidence.image_motion import BACKGROUND
from bayes_body.recording.evidence.image_motion import BEFORE as BEFORE_PICTURE
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.session.session import CameraSpec

NOW, BEFORE = Variable("pose"), Variable("pose", -1)
SMOOTH_PX, ROLL_RAD = 2**0.5, 0.03

pytestmark = pytest.mark.usefixtures("x64")


def cameras_of(rig):
    return tuple(
        CameraSpec("", (1, 1), (1.0, 1.0), (0.0, 0.0), 0.0, (0.0,) * 5, np.asarray(R), np.asarray(t))
        for R, t in zip(rig.rotation, rig.translation, strict=True)
    )


def observe(images, before=None, rig=None, index=1, sizes=None, now_rig=None, **options):
    """The evidence of two frames; without `before`, of a first frame.

    `rig` saw the frame before, and this frame too, unless `now_rig` did. `sizes` are images of the cameras' sizes, if a camera missed a frame.
    """
    earlier = None if before is None else Frame(index - 1, tuple(before), None, cameras=cameras_of(rig))
    cameras = () if rig is None else cameras_of(rig if now_rig is None else now_rig)
    sizes = tuple(image.shape[::-1] for image in (images if sizes is None else sizes))
    term, frame = find("observation", "image_motion"), Frame(index, tuple(images), None, None, sizes, None, cameras, earlier)
    return jax.tree.map(jnp.asarray, term.build(options=term.options(**options))(frame))


def factor(scene, **options):
    term = find("likelihood", "image_motion")
    return term.build(name="motion", options=term.options(**options), body=scene.body, rig=scene.rig)


# One program for each form of the arguments: compilation is most of the time.
compiled = jax.jit(lambda built, values, data: built(values, data))
carried = jax.jit(carried_points, static_argnames="on_surface")
transforms_of, patches_of, projected = jax.jit(part_transforms), jax.jit(patches), jax.jit(project)
viewpoint_of = jax.jit(lambda camera: camera.viewpoint)


def camera_of(rig, c):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[c], rig)


def arrays_of(tree):
    return jax.tree.map(np.asarray, tree)


def value(built, now, before, data):
    return float(compiled(built, {NOW: now, BEFORE: before}, {built.name: data}))


def moved(scene):
    return jnp.asarray(np.asarray(scene.pose) + 0.03 * np.random.default_rng(5).normal(size=scene.pose.shape))


@pytest.mark.slow
@pytest.mark.parametrize("on_surface", [False, True])
def test_points_are_where_the_rigid_parts_carry_them(scene, on_surface):
    given = scene("poon_fleet_23")
    body = replace(given.body, sections=jnp.ones_like(given.body.sections))
    earlier = replace(given.rig, translation=given.rig.translation + jnp.array([0.01, -0.02, 0.03]))
    placed = transforms_of(body, moved(given)), transforms_of(body, given.pose)
    places = np.array([[0.2, -0.6], [0.7, 0.1], [0.9, 0.95]])
    points = arrays_of(carried(body, (given.rig, earlier), placed, places, on_surface=on_surface))
    now, then = arrays_of(placed)
    for c in range(2):
        one, before = (camera_of(rig, c) for rig in (given.rig, earlier))
        viewpoint = np.asarray(viewpoint_of(one))
        patch = arrays_of(patches_of(body, placed[0], viewpoint))
        is_sphere, axis = np.array(body.topology.is_sphere)[:, None], now.rotation[..., 2]
        to_camera = viewpoint - now.origin - np.asarray(body.lengths)[:, None] / 2 * axis
        for number, (t, s) in enumerate(places):
            across = patch.half_width + t * patch.taper
            radius = np.linalg.norm(across, axis=1, keepdims=True)
            # Of a cylinder: perpendicular to its axis and to the side of its contour, towards the camera.
            towards = np.where(is_sphere, to_camera / np.linalg.norm(to_camera, axis=1, keepdims=True), np.cross(axis, across / radius))
            towards *= np.sign(np.sum(towards * to_camera, axis=1, keepdims=True))
            chord = np.where(is_sphere, 2 * np.sqrt(t * (1 - t)), 1.0)
            world = patch.start + t * patch.axis + chord * (s * across + on_surface * np.sqrt(1 - s**2) * radius * towards)
            in_part = np.einsum("pij,pi->pj", now.rotation, world - now.origin)
            world_before = np.einsum("pij,pj->pi", then.rotation, in_part) + then.origin
            for camera, place, found in ((one, world, points.pixels), (before, world_before, points.previous_pixels)):
                expected = np.asarray(projected(camera, place)[0])
                got = np.stack([found.u[c, :, number], found.v[c, :, number]], axis=1)
                np.testing.assert_allclose(got, expected, atol=1e-6)
    assert any(body.topology.is_sphere) and not all(body.topology.is_sphere)


def test_a_point_is_covered_where_it_lies_in_the_outline_of_a_nearer_part(scene):
    given = scene("person_31")
    placed = transforms_of(given.body, given.pose)
    places = np.array([[t, s] for t in (0.1, 0.5, 0.9) for s in (-0.8, 0.0, 0.8)])
    points = arrays_of(carried(given.body, (given.rig, given.rig), (placed, placed), places, on_surface=False))
    assert not np.array(given.body.topology.is_sphere).any() and 0.05 < float(points.covered.mean()) < 0.95
    middle = np.asarray(placed.origin) + np.asarray(given.body.lengths)[:, None] / 2 * np.asarray(placed.rotation)[..., 2]
    for c in range(2):
        camera = camera_of(given.rig, c)
        patch = arrays_of(patches_of(given.body, placed, viewpoint_of(camera)))
        depth = (middle @ camera.rotation.T + camera.translation)[:, 2]
        corners = np.stack(
            [patch.start + t * patch.axis + s * (patch.half_width + t * patch.taper) for t, s in ((0, -1), (1, -1), (1, 1), (0, 1))], 1
        )
        outlines = np.asarray(projected(camera, corners)[0], np.float32)
        for part in range(len(depth)):
            for sample in range(len(places)):
                place = float(points.pixels.u[c, part, sample]), float(points.pixels.v[c, part, sample])
                inside = [cv2.pointPolygonTest(outline, place, measureDist=True) for outline in outlines]
                nearer = [each for each, other in zip(inside, depth, strict=True) if other < depth[part]]
                if min((abs(each) for each in nearer), default=1.0) > 1e-3:
                    assert bool(points.covered[c, part, sample]) == any(each > 0 for each in nearer)


@pytest.mark.parametrize("mapping", ["plane", pytest.param("cylinder", marks=pytest.mark.slow)])
def test_where_nothing_changes_the_value_is_known(scene, mapping):
    given = scene("arm_4")
    images = given.frame.images
    data = observe(images, images, given.rig)
    places = np.asarray(data.places)
    placed = transforms_of(given.body, given.pose)
    points = arrays_of(carried(given.body, (given.rig, given.rig), (placed, placed), places, on_surface=mapping == "cylinder"))
    shown = ~points.covered & points.pixels.visible
    for c, image in enumerate(images):
        u, v = points.pixels.u[c], points.pixels.v[c]
        shown[c] &= (u >= 0) & (v >= 0) & (u <= image.shape[1] - 1) & (v <= image.shape[0] - 1)
    q = np.where(shown, points.cosine, 0.0)
    assert ((points.cosine >= LEAST_COSINE) & (points.cosine <= 1)).all()
    expected, by_background = (
        np.log(q * (0.8 * np.asarray(cosine) / (5 * np.sqrt(2 * np.pi)) + 0.2 / 256) + (1 - q) / 256).sum() for cosine in (points.cosine, 1.0)
    )
    for background, known in ((False, expected), (True, expected - by_background)):
        built = factor(given, mapping=mapping, noise_grey=5.0, outlier_share=0.2, precision=0.5, background=background)
        np.testing.assert_allclose(value(built, given.pose, given.pose, data), 0.5 * known, rtol=1e-6)


@pytest.mark.slow
def test_the_printed_form_mixes_once_for_a_limb(scene):
    given = scene("arm_4")
    data = observe(given.frame.images, given.frame.images, given.rig, samples=(3, 2))
    placed = transforms_of(given.body, given.pose)
    points = arrays_of(carried(given.body, (given.rig, given.rig), (placed, placed), data.places, on_surface=False))
    # The arm is inside both images.
    q = np.where(points.covered, 0.0, points.cosine).mean(axis=-1)
    image = 0.1 / 256 + 0.9 * points.cosine.mean(axis=-1) / (8 * np.sqrt(2 * np.pi))
    expected = float(np.sum(np.log(q * image + (1 - q) / 256)))
    np.testing.assert_allclose(value(factor(given, mixture="limb", background=False), given.pose, given.pose, data), expected, rtol=1e-6)


def rolled(rig):
    """The rig of a frame before, in which each camera was turned about its optical axis, and the pictures of both frames."""
    c, s = np.cos(ROLL_RAD), np.sin(ROLL_RAD)
    turn = jnp.asarray([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    earlier = replace(rig, rotation=turn @ rig.rotation, translation=rig.translation @ turn.T)

    def pattern(x, y):
        waves = [np.sin(a * x + b * y + k) for k, (a, b) in enumerate(np.random.default_rng(3).normal(0, 0.25, (6, 2)))]
        return np.clip(128 + 35 * np.sum(waves, axis=0), 0, 255).round().astype(np.uint8)

    pictures = []
    for view in range(2):
        width, height = np.asarray(rig.size[view], int)
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        x, y = x - float(rig.centre[view, 0]), y - float(rig.centre[view, 1])
        pictures.append((pattern(x, y), pattern(c * x + s * y, -s * x + c * y)))
    return earlier, [now for now, _ in pictures], [before for _, before in pictures]


def squared(given):
    """The scene with cameras of square pixels without distortion: a turn of the camera is then a turn of the picture."""
    plain = {"distortion": 0 * given.rig.distortion, "skew": 0 * given.rig.skew, "radius_max": 0 * given.rig.radius_max + 1e3}
    return given._replace(rig=replace(given.rig, **plain, focal=jnp.broadcast_to(given.rig.focal[:, :1], (2, 2))))


def test_a_camera_that_turns_explains_the_motion_of_its_picture_and_mutants_do_not(scene):
    given = squared(scene("arm_4"))
    earlier, now, before = rolled(given.rig)
    built = factor(given, background=False)
    right = value(built, given.pose, given.pose, observe(now, before, earlier))
    still = value(built, given.pose, given.pose, observe(now, now, given.rig))
    assert abs(right - still) < 0.02 * abs(still)
    swapped = value(built, given.pose, given.pose, observe(before, now, earlier))
    standing = value(built, given.pose, given.pose, observe(now, before, given.rig))
    another = value(built, given.pose, moved(given), observe(now, before, earlier))
    assert max(swapped, standing, another) < right - 20


def test_what_moves_as_the_background_does_gains_nothing_and_what_moves_before_it_gains(scene):
    given = squared(scene("arm_4"))
    earlier, now, before = rolled(given.rig)
    built = factor(given)
    wall = observe(now, before, earlier, now_rig=given.rig)
    # The same pictures of a camera that stands still: the background did not turn, and only the body explains what did.
    standing = wall._replace(pictures=wall.pictures.at[:, BACKGROUND].set(wall.pictures[:, BEFORE_PICTURE]))
    alike, gained = (value(built, given.pose, given.pose, data) for data in (wall, standing))
    unmoved = value(built, given.pose, given.pose, observe(now, now, given.rig))
    assert abs(alike - unmoved) < 5 and unmoved <= 0 and gained > 20
    # Of a camera that stands still, nothing is carried.
    still = observe(now, before, given.rig)
    np.testing.assert_array_equal(still.pictures[:, BACKGROUND], still.pictures[:, BEFORE_PICTURE])


@pytest.mark.parametrize(
    "options",
    [pytest.param({"mapping": "plane"}, marks=pytest.mark.slow), pytest.param({"mapping": "cylinder", "mixture": "limb"}, marks=pytest.mark.long)],
)
def test_gradients_agree_with_central_differences(scene, options):
    given = scene("arm_4")
    earlier, now, before = rolled(given.rig)
    data, built = observe(now, before, earlier, samples=(3, 2)), factor(given, **options)
    both = np.concatenate([given.pose, moved(given)])
    target = jax.jit(jax.value_and_grad(lambda x: built({NOW: x[: len(x) // 2], BEFORE: x[len(x) // 2 :]}, {built.name: data})))
    direction, step = np.random.default_rng(7).normal(size=both.shape), 1e-6
    slope = float(np.asarray(target(both)[1]) @ direction)
    ahead, behind = (float(target(both + sign * step * direction)[0]) for sign in (1, -1))
    difference = (ahead - behind) / (2 * step)
    assert abs(slope) > 1 and abs(slope - difference) < 1e-5 * abs(slope)


def test_a_first_frame_and_cameras_that_missed_a_frame_say_nothing(scene):
    given = scene("arm_4")
    images, rig = given.frame.images, given.rig
    first = observe(images, index=0)
    assert not first.has_both_frames.any() and value(factor(given), given.pose, moved(given), first) == 0
    alone = [observe(images, [images[0], None], rig), observe([None, images[1]], images, rig, sizes=images)]
    both = value(factor(given), given.pose, given.pose, observe(images, images, rig))
    np.testing.assert_allclose(sum(value(factor(given), given.pose, given.pose, each) for each in alone), both, rtol=1e-9)
    assert [each.has_both_frames.tolist() for each in alone] == [[True, False], [False, True]]


def test_random_places_change_with_the_frame_and_not_with_the_particle(scene):
    given = scene("arm_4")
    drawn = [np.asarray(observe(given.frame.images, index=index, random=True).places) for index in (1, 1, 2)]
    assert (drawn[0] == drawn[1]).all() and (drawn[0] != drawn[2]).all() and drawn[0].shape == (32, 2)
    assert (np.abs(drawn[0] - (0.5, 0)) <= (0.5, 1)).all()
