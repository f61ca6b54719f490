"""Bodies that stand in themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.registry import find
from bayes_body.density.factor import Factor, Variable
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.solids import part_transforms, penetration_depths
from bayes_body.model.definition import load_body
from bayes_body.recording.readers.parsec import import_parsec

POSE = Variable("pose")


@pytest.fixture
def x64():
    """Double precision."""
    with jax.enable_x64(True):
        yield


def man(name="deutscher_31"):
    return build_body(name, load_body(name))


def intersection(body, **options) -> Factor:
    term = find("potential", "intersection")
    return term.build(name="intersection", options=term.options(**options), body=body)


@jax.jit
def evaluate(factor, pose):
    return factor({POSE: pose}, {})


slope = jax.jit(jax.grad(evaluate, argnums=1))
depths_at = jax.jit(lambda body, pose: penetration_depths(body, part_transforms(body, pose)))
origins_at = jax.jit(lambda body, pose: part_transforms(body, pose).origin)


def value(factor, pose) -> float:
    return float(evaluate(factor, jnp.asarray(pose)))


def legs(body, angle) -> np.ndarray:
    """Both legs straight, turned inwards by an angle each, one a little before the other."""
    pose = np.zeros(len(body.dof_names))
    for side, sign in (("l", 1), ("r", -1)):
        pose[body.dof_names.index(f"{side}_hip_x")] = sign * angle
        pose[body.dof_names.index(f"{side}_hip_y")] = sign * 0.02
    return pose


def inwards(body) -> float:
    """+1 or -1: the sense of the hips' turn that brings the ankles together."""

    def gap(angle):
        origins = np.asarray(origins_at(body, jnp.asarray(legs(body, angle), jnp.zeros(0).dtype)))
        p, q = (body.topology.names.index(name) for name in ("l_calf", "r_calf"))
        return float(np.linalg.norm(origins[p] - origins[q]))

    return 1.0 if gap(0.2) < gap(-0.2) else -1.0


def test_legs_that_cross_are_excluded():
    body = man()
    hard = intersection(body)
    assert value(hard, legs(body, inwards(body) * 0.25)) == -np.inf
    assert value(hard, legs(body, -inwards(body) * 0.25)) == 0
    assert value(hard, legs(body, 0.0)) == 0
    assert hard.side == "constraint"


def test_what_flesh_yields_is_allowed():
    body = man()
    pose = legs(body, inwards(body) * 0.25)
    worst = float(depths_at(body, jnp.asarray(pose, jnp.float32)).max())
    assert worst > 0.05
    assert value(intersection(body, yield_m=worst - 1e-3), pose) == -np.inf
    assert value(intersection(body, yield_m=worst + 1e-3), pose) == 0


def test_the_first_pose_of_the_recording_is_allowed(bodytrack, tmp_path):
    session, _ = import_parsec(bodytrack, tmp_path)
    subject = session.subject
    body = build_body("deutscher_31", load_body("deutscher_31"), Shape(None, subject.lengths_m, subject.radii_m, subject.sections))
    pose = np.array([session.initial[name] for name in body.dof_names])
    assert value(intersection(body), pose) == 0
    assert value(intersection(body, mode="soft"), pose) == 0


def test_soft_is_the_formula(x64):
    body = man()
    pose = legs(body, inwards(body) * 0.2)
    depths = np.asarray(depths_at(body, jnp.asarray(pose)))
    assert np.sum(depths > 0.03) >= 2
    expected = -0.5 * np.sum((np.maximum(depths - 0.03, 0) / 0.01) ** 2)
    assert value(intersection(body, mode="soft", yield_m=0.03, soft_sd_m=0.01), pose) == pytest.approx(expected, rel=1e-12)


def test_soft_falls_with_the_overlap():
    body = man()
    soft, hard = intersection(body, mode="soft"), intersection(body)
    angles = inwards(body) * np.linspace(0.0, 0.15, 16)
    values = np.array([value(soft, legs(body, angle)) for angle in angles])
    assert values[0] == 0
    assert values[-1] < -1
    assert np.all(np.diff(values) <= 0)
    assert np.all(np.diff(values[values < 0]) < 0)
    # Zero together with the hard form.
    assert [v == 0 for v in values] == [value(hard, legs(body, angle)) == 0 for angle in angles]


def test_soft_pushes_apart(x64):
    body = man()
    soft = intersection(body, mode="soft")
    sense = inwards(body)
    pose = jnp.asarray(legs(body, sense * 0.12))
    gradient = slope(soft, pose)
    assert jnp.isfinite(gradient).all()
    left, right = (gradient[body.dof_names.index(f"{side}_hip_x")] for side in ("l", "r"))
    # legs() turns the left hip by +angle and the right one by -angle: both are pushed outwards.
    assert sense * left < 0 < sense * right
    step = 1e-3 * gradient / jnp.linalg.norm(gradient)
    assert value(soft, pose + step) > value(soft, pose)
    ahead, behind = (value(soft, pose + sign * 1e-3 * step) for sign in (1, -1))
    assert (ahead - behind) / 2e-6 == pytest.approx(float(jnp.linalg.norm(gradient)), rel=1e-4)


def test_the_root_does_not_matter(x64):
    # The constraint is on the relative pose: no gradient along the root's dofs.
    body = man()
    soft = intersection(body, mode="soft")
    gradient = slope(soft, jnp.asarray(legs(body, inwards(body) * 0.12)))
    np.testing.assert_allclose(gradient[:6], 0, atol=1e-9 * float(jnp.abs(gradient).max()))


@pytest.mark.parametrize("mode", ["hard", "soft"])
def test_no_pairs_no_constraint(mode):
    arm = man("arm_4")
    assert arm.topology.penetration == ()
    factor = intersection(arm, mode=mode)
    pose = jnp.array([0.3, 0.2, 0.1, -2.6])
    assert value(factor, pose) == 0
    assert not slope(factor, pose).any()
