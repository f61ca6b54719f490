"""Dofs that widen parts: nothing moves, the radii do, in every view of the body and with every derivative."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.geometry.camera import Camera
from bayes_body.model.body.build import build_body
from bayes_body.model.body.kinematics import forward_kinematics, marker_positions
from bayes_body.model.body.schema import BodySchema
from bayes_body.model.body.solids import part_transforms, sphere_approximation, widened
from bayes_body.model.definition import load_definition
from bayes_body.model.likelihood.boundaries import contour
from bayes_body.model.likelihood.patch_pixels import rig_pixels, sample_slopes

DEFINITION = load_definition("poon_fleet_2002")
BODY = build_body("poon_fleet_23", DEFINITION.body)
WAIST = BODY.dof_names.index("waist")
PARTS = BODY.topology.names
RIG = Camera(
    size=jnp.array([[640.0, 480.0]]),
    focal=jnp.array([[600.0, 600.0]]),
    centre=jnp.array([[319.5, 239.5]]),
    skew=jnp.zeros(1),
    distortion=jnp.zeros((1, 5)),
    radius_max=jnp.full(1, 1e3),
    rotation=jnp.array([[[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]]),
    translation=jnp.array([[0.0, 1.0, 5.0]]),
)


def _pose(waist=0.0):
    rng = np.random.default_rng(0)
    pose = 0.2 * rng.normal(size=len(BODY.dof_names))
    pose[2], pose[WAIST] = 1.0, waist
    return jnp.asarray(pose)


def test_the_body_has_23_dofs_and_its_waist_is_the_last_of_the_torso():
    assert len(BODY.dof_names) == 23 and BODY.skeleton.topology.dof_units[WAIST] == "m"
    assert np.isclose(BODY.skeleton.low[WAIST], -0.05) and BODY.topology.widths == ((0, 1, WAIST), (1, 0, WAIST))


def test_a_width_moves_nothing():
    narrow, wide = _pose(-0.03), _pose(0.03)
    slopes = jax.jit(jax.jacrev(lambda pose: marker_positions(BODY.skeleton, BODY.markers, pose)))

    @jax.jit
    def places(pose):
        return forward_kinematics(BODY.skeleton, pose), marker_positions(BODY.skeleton, BODY.markers, pose)

    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(places(narrow)), jax.tree.leaves(places(wide)), strict=True))
    by_dof = np.asarray(slopes(narrow))
    assert not by_dof[..., WAIST].any() and by_dof[..., 0].any()


def test_the_radii_at_the_waist_are_added_to_and_no_others():
    wide = widened(BODY, _pose(0.02))
    difference = np.asarray(wide.outline_radii - BODY.outline_radii)
    expected = np.zeros_like(difference)
    expected[PARTS.index("abdomen"), 1] = expected[PARTS.index("chest"), 0] = 0.02
    assert np.allclose(difference, expected, atol=1e-7) and np.allclose(wide.radii - BODY.radii, expected, atol=1e-7)
    # The taper of the torso is not linear: it bends at the waist.
    radii = np.asarray(widened(BODY, _pose(-0.04)).outline_radii)
    assert radii[0, 1] < 0.8 * radii[0, 0] and radii[1, 0] < 0.8 * radii[1, 1]


@pytest.mark.slow
def test_pixels_change_with_it_as_their_slopes_say():
    samples = contour(BODY, 6).samples
    along_u, along_v = jax.jit(lambda pose: sample_slopes(BODY, RIG, samples, pose))(_pose())
    step, pixels = 1e-3, jax.jit(lambda pose: rig_pixels(BODY, RIG, samples, pose))
    ahead, behind = (pixels(_pose(waist)) for waist in (step, -step))
    assert np.allclose((ahead.u - behind.u) / (2 * step), along_u[WAIST], atol=0.5) and np.abs(along_u[WAIST]).max() > 50
    assert np.allclose((ahead.v - behind.v) / (2 * step), along_v[WAIST], atol=0.5)
    gradient = jax.jit(jax.grad(lambda pose: jnp.sum(pixels(pose).u ** 2) * 1e-4))(_pose())
    direct = 2e-4 * np.sum(np.asarray(pixels(_pose()).u) * np.asarray(along_u[WAIST]))
    assert np.isclose(gradient[WAIST], direct, rtol=1e-3, atol=1e-2)


def test_solids_that_must_not_meet_grow_with_it():
    @jax.jit
    def radii(body):
        return sphere_approximation(body, part_transforms(BODY, _pose())).radii

    grown = np.asarray(radii(widened(BODY, _pose(0.04)))) - radii(BODY)
    assert np.all(grown[:2] > 0) and not grown[2:].any()


def _document(**changes):
    dof = {"name": "waist", "axis": "width", "low_m": -0.02, "high_m": 0.02} | changes.get("dof", {})
    part = {"name": "stick", "joint": "a", "length": "stick", "radius_of_height": [0.02, 0.02], "widened": ["", "waist"]} | changes.get("part", {})
    dof = {key: value for key, value in dof.items() if value is not None}
    joint = {"name": "a", "parent": "world", "dofs": [dof, {"name": "turn", "axis": "x"}]}
    return {"title": "t", "source": "s", "lengths_of_height": {"stick": 0.3}, "joint": [joint], "part": [part]}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"dof": {"low_m": None, "high_m": None}}, "'waist' is a width without limits"),
        ({"dof": {"low_m": -0.04}}, "low_m = -0.04 of 'waist' removes the whole radius of 0.035 m"),
        ({"part": {"widened": ["", "wiast"]}}, "'wiast', which is not a dof of axis 'width'; did you mean 'waist'"),
        ({"part": {"widened": ["", "turn"]}}, "'turn', which is not a dof of axis 'width'"),
        ({"part": {"widened": ["", ""]}}, "'waist' widens no part"),
        ({"dof": {"low_m": None, "high_m": None, "low_deg": -1, "high_deg": 1}}, "give its limits as low_m and high_m"),
    ],
)
def test_a_width_that_cannot_be(changes, said):
    assert build_body("sound", BodySchema.model_validate(_document())).topology.widths == ((0, 1, 0),)
    with pytest.raises(ValueError, match=said.replace("(", r"\(")):
        BodySchema.model_validate(_document(**changes))
