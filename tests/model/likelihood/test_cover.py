"""The term "cover" of `silhouette_edges`: against OpenCV's polygon test, its gradient, and what the two terms of the paper do not see."""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.registry import find
from bayes_body.density.factor import Variable
from bayes_body.model.body.solids import Samples
from bayes_body.model.likelihood.patch_pixels import rig_pixels
from bayes_body.recording.observation.frames import Frame
from bayes_body.recording.observation.silhouette_edges import spread_points

POSE = Variable("pose")
SOFT, POINTS = 2.0, 300


@jax.jit
def _value(factor, maps, pose):
    return factor({POSE: pose}, {"images": maps})


_slope = jax.jit(jax.grad(_value, argnums=2))
_pixels = jax.jit(rig_pixels)


class Cover(NamedTuple):
    """The term alone, and the points that it looks at."""

    factor: object
    maps: object

    def __call__(self, pose):
        return _value(self.factor, self.maps, pose)

    def slope(self, pose):
        """The gradient by the pose."""
        return np.asarray(_slope(self.factor, self.maps, pose))


def cover(scene, masks, terms=("cover",), **more) -> Cover:
    options = find("likelihood", "silhouette_edges").options(terms=terms, cover_points=POINTS, cover_soft_px=SOFT, **more)
    term = find("observation", "silhouette_edges")
    images = tuple(np.zeros(mask.shape, np.uint8) for mask in masks)
    maps = term.build(options=term.options(), likelihood=options)(Frame(0, images, tuple(masks)))
    return Cover(scene.factor(**options.model_dump()), jax.tree.map(jnp.asarray, maps))


def corners(scene, pose) -> np.ndarray:
    """Of each part's outline, pixels: (camera, part, 4, 2)."""
    t, s = (np.broadcast_to(row, (len(scene.body.topology.names), 4)) for row in ([0.0, 1, 1, 0], [-1.0, -1, 1, 1]))
    pixels = _pixels(scene.body, scene.rig, Samples(jnp.asarray(t), jnp.asarray(s)), pose)
    return np.stack([pixels.u, pixels.v], axis=-1)


def own_masks(scene, pose) -> list[np.ndarray]:
    masks = []
    for quadrilaterals, size in zip(corners(scene, pose), np.asarray(scene.rig.size, int), strict=True):
        mask = np.zeros(size[::-1], np.uint8)
        for each in quadrilaterals:
            cv2.fillConvexPoly(mask, cv2.convexHull(np.round(each * 16).astype(np.int32)), 1, shift=4)
        masks.append(mask > 0)
    return masks


@pytest.mark.parametrize("name", ["arm_4", "person_31"])
def test_it_is_the_distance_that_opencv_measures(scene, name):
    man = scene(name)
    masks = [np.asarray(mask) for mask in man.frame.masks]
    term = cover(man, masks)
    expected = 0.0
    for quadrilaterals, mask in zip(corners(man, man.pose), masks, strict=True):
        points = spread_points(mask, POINTS) + np.array(mask.shape[::-1]) / 2
        hulls = [cv2.convexHull(each.astype(np.float32)) for each in quadrilaterals]
        inside = np.array([[cv2.pointPolygonTest(hull, (float(u), float(v)), True) for hull in hulls] for u, v in points]).max(axis=1)
        # Beyond a corner the product of half-planes says less than the distance; there the error is 1 within what is compared.
        expected -= np.mean((1 - np.exp(-0.5 * (np.maximum(-inside, 0) / SOFT) ** 2)) ** 2)
    assert float(term(man.pose)) == pytest.approx(expected, abs=0.02)


@pytest.mark.slow
def test_its_gradient_is_that_of_differences(scene, x64):
    man = scene("person_31")
    term = cover(man, [np.asarray(mask) for mask in man.frame.masks])
    found, step = term.slope(man.pose), 1e-6
    differences = [(term(man.pose.at[k].add(step)) - term(man.pose.at[k].add(-step))) / (2 * step) for k in range(31)]
    np.testing.assert_allclose(found, differences, rtol=1e-4, atol=1e-6)


def test_limbs_that_fold_into_the_torso_are_found_out(scene):
    """The paper's silhouette term likes a body inside the silhouette, however small."""
    man = scene("person_31")
    names = man.body.dof_names
    masks = own_masks(man, man.pose)
    folded = man.pose
    for side in "lr":
        folded = folded.at[names.index(f"{side}_hip_y")].set(-2.0).at[names.index(f"{side}_knee")].set(-2.6)
    term = cover(man, masks)
    assert float(term(folded)) < 2 * float(term(man.pose))
    silhouette = cover(man, masks, ("silhouette",))
    assert float(silhouette(folded)) > 2 * float(silhouette(man.pose))


def test_what_is_not_asked_for_costs_nothing(scene):
    man = scene("arm_4")
    masks = [np.asarray(mask) for mask in man.frame.masks]
    plain = cover(man, masks, ("silhouette", "edges"))
    assert plain.maps.points.shape == (2, 0, 2)
    both = cover(man, masks, ("silhouette", "edges", "cover"))
    assert float(both(man.pose)) == pytest.approx(float(plain(man.pose)) + float(cover(man, masks)(man.pose)), rel=1e-5)


def test_the_weight_of_the_edges_multiplies_them_alone(scene):
    man = scene("arm_4")
    masks = [np.asarray(mask) for mask in man.frame.masks]
    wanted = ("silhouette",), ("edges",), ("silhouette", "edges")
    silhouette, edges, both = (float(cover(man, masks, terms, edge_weight=0.25)(man.pose)) for terms in wanted)
    assert edges == pytest.approx(0.25 * float(cover(man, masks, ("edges",))(man.pose)), rel=1e-6)
    assert both == pytest.approx(silhouette + edges, rel=1e-6)


def half_blind(man) -> Cover:
    """The term of a frame that only the first camera saw."""
    first, second = man.frame.masks
    options = find("likelihood", "silhouette_edges").options(terms=("cover",), cover_points=POINTS, cover_soft_px=SOFT)
    term = find("observation", "silhouette_edges")
    frame = Frame(0, (np.zeros(first.shape, np.uint8), None), (first, None), sizes_px=(first.shape[::-1], second.shape[::-1]))
    maps = jax.tree.map(jnp.asarray, term.build(options=term.options(), likelihood=options)(frame))
    return Cover(man.factor(**options.model_dump()), maps)


def test_a_camera_without_a_silhouette_says_nothing(scene):
    man = scene("arm_4")
    first, second = man.frame.masks
    empty = cover(man, [first, np.zeros(second.shape, bool)])
    assert float(half_blind(man)(man.pose)) == pytest.approx(float(empty(man.pose)), rel=1e-6)


@pytest.mark.slow
def test_a_camera_without_a_silhouette_leaves_a_slope(scene):
    man = scene("arm_4")
    assert np.abs(half_blind(man).slope(man.pose)).max() > 0
