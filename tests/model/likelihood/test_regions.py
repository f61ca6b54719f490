"""The likelihood of parts in regions of the image: sums over all pixels of a synthetic picture, and what a part that nobody sees is worth."""

from dataclasses import replace
from functools import partial

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.geometry.camera import project
from bayes_body.base.registry import find
from bayes_body.base.toml.read import validate
from bayes_body.density.factor import Factor, Variable
from bayes_body.model.body.placed_body import loosened
from bayes_body.model.body.solids import part_transforms, patches
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.observation.silhouette_edges import distance_to, edges

PARTS, LARGER = Variable("parts"), 3
OBSERVED = {"inside": 0.9, "band": 0.2, "elsewhere": 0.4, "edge_elsewhere": 2.0, "smooth_px": 2.0}
WHOLE = {"precision": 1.0, "edge_share": 0.3, "band": [0.1, 0.5]}


configured = jax.jit(lambda body, pose: body.placement.configuration(body.skeleton, pose))
transforms_of, patches_of = jax.jit(part_transforms), jax.jit(patches)
viewpoint_of = jax.jit(lambda camera: camera.viewpoint)
pixel_of = jax.jit(lambda camera, point: project(camera, point)[0])
total = jax.jit(lambda f, parts, data: f({PARTS: parts}, {"regions": data}))
slope_of = jax.jit(jax.grad(total, argnums=1))
by_part = jax.jit(lambda plate, parts, data: plate.log_potentials(parts, data))


def camera_of(scene, c):
    return jax.tree.map(lambda leaf: np.asarray(leaf)[c], scene.rig)


@pytest.fixture
def loose(scene):
    """`loose("arm_4")`: the body placed by parts before two cameras, blobs as silhouettes."""

    def make(name: str):
        given = scene(name)
        rig = jax.tree.map(np.asarray, given.rig)
        larger = {key: LARGER * getattr(rig, key) for key in ("focal", "centre", "size")}
        rig = replace(rig, distortion=0 * rig.distortion, radius_max=0 * rig.radius_max + 1e3, **larger)
        body = loosened(given.body)
        rig = jax.tree.map(jnp.asarray, rig)
        return given._replace(body=body, rig=rig, frame=blobs(rig.size), pose=configured(body, given.pose))

    return make


def blobs(sizes) -> Frame:
    rng, images, masks = np.random.default_rng(2), [], []
    for width, height in np.asarray(sizes, int):
        masks.append(cv2.GaussianBlur(rng.normal(size=(height, width)), (0, 0), 20) > 0)
        images.append(cv2.GaussianBlur((masks[-1] * 180 + 30).astype(np.uint8), (0, 0), 1.0))
    return Frame(0, tuple(images), tuple(masks))


def factor(scene, **options) -> Factor:
    term = find("likelihood", "regions")
    return term.build(name="regions", options=validate(term.options, WHOLE | options, "test"), body=scene.body, rig=scene.rig)


def maps(scene, **options):
    term = find("observation", "regions")
    return jax.tree.map(jnp.asarray, term.build(options=term.options(**(OBSERVED | options)))(scene.frame))


def value(scene, parts=None, data=None, **options) -> jax.Array:
    data = maps(scene) if data is None else data
    return total(factor(scene, **options), scene.pose if parts is None else parts, data)


def by_pixels(scene) -> np.ndarray:
    """The log-potential of every part: sums over all pixels whose centres are in its regions, and along its sides in small steps.

    A pixel counts as one of 640 x 480 pixels.
    """
    found, (near_share, far_share) = np.zeros(len(scene.body.placement.names)), WHOLE["band"]
    T = transforms_of(scene.body, scene.pose)
    solids = [scene.body.placement.owners[joint] for joint in scene.body.topology.joints]
    for c in range(2):
        v, u = np.mgrid[tuple(slice(extent) for extent in scene.frame.masks[c].shape)]
        counts = 640 * 480 / u.size
        one = camera_of(scene, c)
        facing = [np.asarray(vector) for vector in patches_of(scene.body, T, viewpoint_of(one))]
        S = cv2.GaussianBlur(scene.frame.masks[c].astype(np.float32), (0, 0), OBSERVED["smooth_px"])
        near = edges(scene.frame.images[c], 20.0) & (distance_to(scene.frame.masks[c]) <= 4.0)
        squares = (np.minimum(distance_to(near), 12.0) / 4.0) ** 2
        ratio = {p: S * np.log(p / 0.4) + (1 - S) * np.log((1 - p) / 0.6) for p in (0.9, 0.2)}
        for solid, part in enumerate(solids):
            start, along, across, taper = (vector[solid] for vector in facing)

            def pixel(t, s, one=one, start=start, along=along, across=across, taper=taper):
                return np.asarray(pixel_of(one, start + t * along + s * across + t * s * taper), float)

            p0, p1, p2, p3 = pixel(0, -1), pixel(1, -1), pixel(1, 1), pixel(0, 1)
            c0, c1, h0, h1 = (p0 + p3) / 2, (p1 + p2) / 2, (p3 - p0) / 2, (p2 - p1) / 2
            if scene.body.topology.is_sphere[solid]:
                middle, up, aside = (c0 + c1) / 2, (c1 - c0) / 2, (h0 + h1) / 2
                x, y = np.moveaxis(np.stack([u - middle[0], v - middle[1]], axis=-1) @ np.linalg.inv(np.stack([up, aside])), -1, 0)
                chord = np.sqrt(np.clip(1 - x * x, 0, None))
                inside = (np.abs(x) < 1) & (np.abs(y) < chord)
                # At each height on the diameter, the band begins at the chord.
                band = (np.abs(x) < 1) & (np.abs(y) > chord + 2 * near_share) & (np.abs(y) < chord + 2 * far_share)
                angle = np.linspace(0, 2 * np.pi, 2000)[:, None]
                sides = [middle + np.cos(angle) * up + np.sin(angle) * aside]
            else:
                inside = within(u, v, [c0 - h0, c1 - h1, c1 + h1, c0 + h0])
                nearer, farther = (
                    within(u, v, [c0 - wide * h0, c1 - wide * h1, c1 + wide * h1, c0 + wide * h0]) for wide in (1 + 2 * near_share, 1 + 2 * far_share)
                )
                band = farther & ~nearer
                t = np.linspace(0, 1, int(10 * np.linalg.norm(c1 - c0)))[:, None]
                sides = [c0 + sign * h0 + t * (c1 + sign * h1 - c0 - sign * h0) for sign in (-1, 1)]
            in_areas = ratio[0.9][inside].sum() + ratio[0.2][band].sum()
            on_sides = sum(looked_up(2.0 - squares, side).mean() * np.linalg.norm(np.diff(side, axis=0), axis=1).sum() for side in sides)
            found[part] += 0.7 * counts * in_areas + 0.3 * np.sqrt(counts) * on_sides
    return found


def within(u, v, corners) -> np.ndarray:
    """The pixels inside a convex polygon."""
    signs = []
    for (au, av), (bu, bv) in zip(corners, [*corners[1:], corners[0]], strict=True):
        signs.append((bu - au) * (v - av) - (bv - av) * (u - au))
    return np.all(np.array(signs) > 0, axis=0) | np.all(np.array(signs) < 0, axis=0)


def looked_up(image, points) -> np.ndarray:
    """Interpolated values of an image; 0 outside it."""
    return cv2.remap(image.astype(np.float32), points[:, 0].astype(np.float32), points[:, 1].astype(np.float32), cv2.INTER_LINEAR)[:, 0]


@pytest.mark.parametrize("name", ["arm_4", "person_31"])
@pytest.mark.parametrize(("samples", "share"), [((60, 30, 12), 0.01), ((8, 3, 1), 0.1)])
def test_it_is_the_sum_over_all_pixels(x64, loose, name, samples, share):
    scene = loose(name)
    expected = by_pixels(scene)
    plate = factor(scene, samples=samples).log_potential
    found = np.asarray(by_part(plate, scene.pose, maps(scene)))
    assert plate.rows == tuple((part,) for part in range(len(expected)))
    # Blobs may cancel within a part: the error is relative to the largest part.
    assert np.abs(expected).min() > 5
    assert np.abs(found - expected).max() < share * np.abs(expected).max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm_4", "person_31"])
def test_the_gradient_is_that_of_the_value(x64, loose, name):
    scene = loose(name)
    data = maps(scene)
    f, pose = factor(scene), np.asarray(scene.pose)
    found = np.asarray(slope_of(f, pose, data))
    # So short a step that no point reaches a pixel's line, where the slope jumps.
    step = 1e-9 * np.random.default_rng(0).normal(size=(5, *found.shape))
    for one in step:
        change = float(total(f, pose + one, data)) - float(total(f, pose - one, data))
        assert change == pytest.approx(2 * float(np.sum(found * one)), rel=1e-4)


@pytest.mark.slow
def test_a_part_is_read_on_its_own(loose):
    scene = loose("person_31")
    plate, data = factor(scene).log_potential, maps(scene)
    before, after = (np.asarray(by_part(plate, parts, data)) for parts in (scene.pose, scene.pose.at[3, :3].add(0.05)))
    assert np.flatnonzero(before != after).tolist() == [3]
    assert float(value(scene, data=data)) == pytest.approx(float(before.sum()), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("lookup", ["nearest", "bilinear"])
def test_what_nobody_sees_counts_nothing(loose, lookup):
    scene = loose("person_31")
    data = maps(scene)
    run, slope = (partial(function, factor(scene, lookup=lookup)) for function in (total, slope_of))

    def shifted(shift):
        return np.asarray(scene.pose) + np.float32([*shift, 0, 0, 0, 0])

    for shift in ([0, 0, 4.0], [0, 0, -9.0], [30.0, 0, 0], [0, 40.0, 0], [1e4, 0, 0]):
        away = shifted(shift)
        assert run(away, data) == 0
        assert not np.asarray(slope(away, data)).any()
    frame = scene.frame._replace(images=(None, None), sizes_px=tuple(image.shape[::-1] for image in scene.frame.images))
    blind = maps(scene._replace(frame=frame))
    assert blind.log_ratios.shape == data.log_ratios.shape
    assert run(scene.pose, blind) == 0 and not np.asarray(slope(scene.pose, blind)).any()
    for bad in (jnp.nan, jnp.inf):
        assert np.isnan(run(scene.pose.at[2, 1].set(bad), data))
    # A camera's centre inside the body: half of it is behind the lens.
    assert np.isfinite(run(shifted(np.asarray(viewpoint_of(camera_of(scene, 0)))), data))


def test_cameras_that_see_add_up(x64, loose):
    scene = loose("person_31")
    sizes = tuple(image.shape[::-1] for image in scene.frame.images)
    each = []
    for seen in (0, 1):
        images = tuple(image if c == seen else None for c, image in enumerate(scene.frame.images))
        each.append(float(value(scene, data=maps(scene._replace(frame=scene.frame._replace(images=images, sizes_px=sizes))))))
    assert sum(each) == pytest.approx(float(value(scene)), rel=1e-9)
    assert min(np.abs(each)) > 10


@pytest.mark.slow
def test_a_part_leaves_a_picture_without_a_jump(x64, loose):
    """The torso slides out of a picture in which everything is foreground: what is outside counts nothing, and no more than it did inside."""
    scene = loose("person_31")
    sizes = tuple(image.shape[::-1] for image in scene.frame.images)
    full = Frame(0, (scene.frame.images[0], None), (np.ones_like(scene.frame.masks[0]), None), sizes_px=sizes)
    data, plate = maps(scene._replace(frame=full)), factor(scene, edge_share=0.0, band=[0.0, 0.01]).log_potential
    aside = np.linspace(0, 3, 6000)[:, None] * np.asarray(scene.rig.rotation)[0, 0]
    slide = np.tile(scene.pose, (6000, 1, 1))
    slide[:, 0, :3] += aside
    torso = np.asarray(jax.jit(jax.vmap(lambda parts: plate.log_potentials(parts, data)[0]))(slide))
    assert torso[0] > 1000 and torso[-1] == 0
    # The last to leave is a narrow band, which would rather see background.
    assert torso.min() > -0.01 * torso[0] and np.abs(np.diff(torso)).max() < 0.015 * torso[0]


def test_options_act_as_they_say(x64, loose):
    scene = loose("arm_4")
    whole = float(value(scene))
    assert float(value(scene, precision=0.25)) == pytest.approx(0.25 * whole, rel=1e-9)
    regions, sides = (float(value(scene, edge_share=share)) for share in (0.0, 1.0))
    assert 0.7 * regions + 0.3 * sides == pytest.approx(whole, rel=1e-9)
    assert factor(scene).has_gradient and not factor(scene, lookup="nearest").has_gradient
    assert float(value(scene, lookup="nearest")) == pytest.approx(whole, rel=0.1)


def test_a_body_by_angles_is_refused(scene):
    with pytest.raises(InputError, match=r"likelihood 'regions': \[body\] placement = \"angles\"; expected placement = \"parts\""):
        factor(scene("arm_4"))


def test_too_few_points_for_the_solids_of_a_part(loose):
    with pytest.raises(InputError, match="regions: samples: 1 points along a part with 2 solids; expected at least one for each solid"):
        factor(loose("person_31"), samples=(1, 3, 1))


def test_a_band_that_ends_before_it_begins(loose):
    with pytest.raises(InputError, match=r"regions: band: from 0\.5 to 0\.1 of a part's width; expected a band that ends after it begins"):
        factor(loose("person_31"), band=[0.5, 0.1])
