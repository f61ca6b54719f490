"""The prior of a loose-limbed body: one density for both directions of a joint, its draws, its coordinates, and the ladder that samplers need."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from bayes_body.base.errors import InputError
from bayes_body.base.geometry import rigid, rotations
from bayes_body.base.toml.read import validate
from bayes_body.density.factor import Variable
from bayes_body.kernels.hmc.hamiltonian import Schedule, run_chain
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.placed_body import loosened, placed_markers
from bayes_body.model.definition import load_body
from bayes_body.model.dynamics import rigid_walk
from bayes_body.model.potentials import intersection, kinematic, penetration
from bayes_body.model.potentials.joint_mixture import JointMixtures, save_joint_mixtures

PARTS = Variable("parts")
WIDE = {"component": [{"sd_m": {"*": [0.02, 0.03, 0.05]}, "sd_deg": {"*": [20.0, 55.0, 35.0]}, "mean_deg": {"l_knee": -40.0}}]}
TWO = {"component": [WIDE["component"][0], {"weight": 3.0, "sd_m": {"*": 0.04}, "sd_deg": {"*": 25.0}, "mean_deg": {"l_elbow": -90.0}}]}


@pytest.fixture(scope="module")
def body():
    return loosened(build_body("person_31", load_body("person_31")))


@pytest.fixture(scope="module")
def joints(body):
    """Two components for each joint with full blocks: axes at random, means far apart. A tenth of each Gaussian is beyond a half turn."""
    placement, rng = body.placement, np.random.default_rng(11)
    count = len(placement.names) - 1
    axes = Rotation.random(count * 4, rng=rng).as_matrix().reshape(count, 2, 2, 3, 3)
    sd = np.array([[0.02, 0.03, 0.05], np.radians([25.0, 100.0, 50.0])])
    turns = Rotation.from_rotvec(rng.normal(size=(count * 2, 3))).as_quat(canonical=True, scalar_first=True)
    mean = np.concatenate([0.01 * rng.normal(size=(count, 2, 3)), turns.reshape(count, 2, 4)], axis=-1)
    covariance = np.einsum("jmbik,bk,jmblk->jmbil", axes, sd**2, axes)
    parents = tuple(placement.names[parent] for parent in placement.parents[1:])
    return JointMixtures(body.name, placement.names[1:], parents, mean, covariance, np.tile([0.3, 0.7], (count, 1)))


@pytest.fixture
def learned(tmp_path):
    """`learned(joints)`: the options of the potential with this file."""

    def call(joints):
        save_joint_mixtures(joints, tmp_path / "joints.npz")
        return {"learned": str(tmp_path / "joints.npz")}

    return call


def _kinematic(body, options):
    return kinematic.build("kinematic", validate(kinematic.Options, options, "test"), body)


def _pose(body, seed=0):
    """A pose of the parts' joints; the joints that the parts hold stay at 0."""
    values = np.random.default_rng(seed).normal(size=len(body.dof_names)) * 0.4
    held = [name.startswith("thorax") or "clavicle" in name for name in body.dof_names]
    return jnp.asarray(np.where(held, 0.0, values), jnp.float32)


def _edge(factor, row):
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[row]), factor.log_potential.parameters)


def _random_rigid(rng, count, shift_m):
    quaternions = Rotation.random(count, rng=rng).as_quat(scalar_first=True)
    return np.concatenate([rng.normal(size=(count, 3)) * shift_m, quaternions], axis=1).astype(np.float32)


# One program of each for all tests.
_parts_of = jax.jit(lambda body, pose: body.placement.configuration(body.skeleton, pose))
_value = jax.jit(lambda factor, parts: factor({PARTS: parts}, {}))
_log_of_parents = jax.jit(jax.vmap(kinematic.log_density, (None, 0, None)))
_log_of_children = jax.jit(jax.vmap(kinematic.log_density, (None, None, 0)))


@pytest.fixture(scope="module")
def turns_and_shifts():
    """A fixed pose, and many uniform rotations and standard normal shifts."""
    rng, count = np.random.default_rng(1), 2**20
    return _random_rigid(rng, 1, 1.0)[0], _random_rigid(rng, count, 0.0)[:, 3:], rng.normal(size=(count, 3))


def test_parts_place_a_body_as_the_angles_do(body):
    pose = _pose(body)
    parts = _parts_of(body, pose)
    assert parts.shape == (10, 7)
    markers, expected = jax.jit(lambda body, parts, pose: (placed_markers(body, parts), placed_markers(body.by_angles, pose)))(body, parts, pose)
    np.testing.assert_allclose(markers, expected, atol=2e-6)


EDGES = [
    pytest.param(given, options, id=f"{given}-{name}", marks=() if (given, name) == ("parent", "two") else pytest.mark.slow)
    for given in ("parent", "child")
    for name, options in (("one component", WIDE), ("two", TWO), ("full blocks", None))
]


@pytest.mark.parametrize(("given", "options"), EDGES)
def test_an_edge_is_normalised_in_both_directions(body, options, given, joints, learned, turns_and_shifts):
    """The other part's rotation is uniform over all rotations, and its position normal where the joint is, given the rotation."""
    options = options or learned(joints)
    edge, sd, (fixed, turns, shifts) = _edge(_kinematic(body, options), 3), 0.05, turns_and_shifts
    off = (shifts * sd).astype(np.float32)
    joint = np.asarray(edge["mean"])[0, :3] + off
    places = rigid.apply(fixed, joint) if given == "parent" else fixed[:3] - rotations.rotate(turns, joint)
    other = rigid.rigid(places, turns)
    values = _log_of_children(edge, fixed, other) if given == "parent" else _log_of_parents(edge, other, fixed)
    log_proposal = norm.logpdf(np.asarray(off, float), scale=sd).sum(axis=1) - np.log(8 * np.pi**2)
    weights = np.exp(np.asarray(values, float) - log_proposal)
    error = weights.std() / np.sqrt(len(weights))
    assert abs(np.log(weights.mean())) < 4 * error
    assert error < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("blocks", [pytest.param("diagonal", marks=pytest.mark.long), "full"])
def test_ancestral_draws_have_the_density(body, blocks, joints, learned):
    """E[p/q] under draws of one prior is 1 only if draws and both densities agree: the other prior is narrower within its support."""
    if blocks == "full":
        wide, narrow = (_kinematic(body, learned(replace(joints, covariance=share * joints.covariance))) for share in (1.0, 0.85))
    else:
        wide = _kinematic(body, WIDE)
        narrow = _kinematic(body, {"component": [WIDE["component"][0] | {"sd_deg": {"*": [18.0, 50.0, 32.0]}, "sd_m": {"*": [0.018, 0.027, 0.045]}}]})
    root = jnp.asarray(_random_rigid(np.random.default_rng(2), 1, 1.0)[0])
    draws = jax.jit(jax.vmap(lambda key: kinematic.draw_tree(key, wide, root)))(jax.random.split(jax.random.key(0), 40_000))
    ratio = jax.jit(jax.vmap(lambda x: narrow({PARTS: x}, {}) - wide({PARTS: x}, {})))(draws)
    weights = np.exp(np.asarray(ratio, float))
    log_normaliser = np.log(weights.mean())
    assert abs(log_normaliser) < 4 * weights.std() / weights.mean() / np.sqrt(len(weights))
    assert weights.std() / weights.mean() / np.sqrt(len(weights)) < 0.01


@pytest.mark.parametrize("reverse", [pytest.param(False, id="child"), pytest.param(True, id="parent", marks=pytest.mark.slow)])
def test_weighted_draws_are_draws_of_the_density(body, joints, learned, reverse):
    """Their mean weight is 1, and by weight they have the moments of draws by rejection, though a tenth of the rotations go beyond a half turn."""
    edge, count = _edge(_kinematic(body, learned(joints)), 3), 2**15
    known = jnp.asarray(_random_rigid(np.random.default_rng(5), 1, 1.0)[0])

    @jax.jit
    def draw(noise_key, draw_key):
        noise, keys = jax.random.normal(noise_key, (count, 7)), jax.random.split(draw_key, count)
        weighted, log_weights = jax.vmap(lambda own: kinematic.weighted_draw(own, edge, known, reverse))(noise)
        plain = jax.vmap(lambda key: kinematic.draw(key, edge, known, reverse))(keys)
        return figures(weighted), figures(plain), log_weights

    def figures(poses):
        relative = rigid.relative(poses, known) if reverse else rigid.relative(known, poses)
        w = rotations.logarithm(relative[:, 3:])
        return jnp.concatenate([relative[:, :3], w, w**2], axis=1)

    weighted, plain, log_weights = (np.asarray(values, float) for values in draw(jax.random.key(6), jax.random.key(7)))
    weights = np.exp(log_weights)
    assert abs(weights.mean() - 1) < 4 * weights.std() / count**0.5 and (weights == 0).mean() > 0.05
    away = (weights[:, None] * weighted).mean(axis=0) - plain.mean(axis=0)
    error = np.sqrt(((weights[:, None] * weighted).var(axis=0) + plain.var(axis=0)) / count)
    assert np.all(np.abs(away) < 4 * error)


def test_the_prior_moves_with_the_world_and_does_not_see_a_quaternions_sign(body):
    factor = _kinematic(body, TWO)
    parts = np.asarray(_parts_of(body, _pose(body, 3)))
    moved = rigid.compose(_random_rigid(np.random.default_rng(4), 1, 2.0), parts)
    flipped = parts.copy()
    flipped[2, 3:] *= -1
    value = float(_value(factor, parts))
    assert float(_value(factor, moved)) == pytest.approx(value, abs=2e-2)
    assert float(_value(factor, flipped)) == pytest.approx(value, abs=1e-4)


@pytest.mark.slow
def test_the_coordinates_are_those_of_the_tree_and_their_volume_is_right(body):
    with jax.enable_x64(True):
        loose = loosened(build_body("person_31", load_body("person_31")))
        walk = rigid_walk.build(rigid_walk.Options(sd_deg={"*": 20.0}), loose, 60.0)
        before = {"parts": loose.placement.configuration(loose.skeleton, jnp.asarray(_pose(body, 5), float))}
        state = walk.sample(jax.random.key(0), before)
        chart = walk.chart(before)
        position = chart.unconstrain(state)
        np.testing.assert_allclose(chart.constrain(position)["parts"], state["parts"], atol=1e-12)

        def tangent(x):
            """The state near `state`, in its own tangent spaces: the Haar measure there is Lebesgue's."""
            steps = rigid.relative(state["parts"], chart.constrain({"parts": x})["parts"])
            return jnp.concatenate([steps[:, :3], rotations.logarithm(steps[:, 3:])], axis=1).ravel()

        volume = np.linalg.slogdet(jax.jacfwd(tangent)(position["parts"]))[1]
        assert float(chart.log_determinant(position)) == pytest.approx(volume, abs=1e-9)


@pytest.mark.slow
def test_the_walk_is_normalised(body):
    """Its log-density under its own draws has the mean of a normal's, minus the mean log-Jacobian of the exponential map."""
    walk = rigid_walk.build(rigid_walk.Options(sd_deg={"*": 28.0}), body, 60.0)
    before = {"parts": _parts_of(body, _pose(body))}
    broad = rigid_walk.build(rigid_walk.Options(sd_deg={"*": 29.0}, sd_m={"*": 0.031}), body, 60.0)

    @jax.jit
    @jax.vmap
    def log_ratio(key):
        draw = broad.sample(key, before)
        return walk.log_density(draw, before) - broad.log_density(draw, before)

    weights = np.exp(np.asarray(log_ratio(jax.random.split(jax.random.key(1), 50_000)), float))
    assert abs(weights.mean() - 1) < 4 * weights.std() / np.sqrt(len(weights))


def test_a_rotation_on_its_own_keeps_a_known_distribution():
    """Uniform rotations, as HMC sees them in the tangent space: the angle's density is (1 - cos)/π."""

    def target(position):
        w = position["w"]
        inside = jnp.sum(w * w) < np.pi**2
        return jnp.where(inside, rotations.log_jacobian(w), -jnp.inf)

    schedule = Schedule(draws=4000, burn_in=50, thinning=2, leapfrog_steps=6, jitter=0.5, sampler="hmc", target_acceptance=0.0)
    chain = jax.jit(lambda key: run_chain(key, {"w": jnp.full(3, 0.5)}, target, jnp.asarray(0.35), jnp.ones(3), schedule))(jax.random.key(0))
    angles = np.linalg.norm(np.asarray(chain.positions["w"], float), axis=1)
    # E[angle] = π/2 + 2/π, Var = π²/12 + 2 - 4/π² ... compared in standard errors of autocorrelated draws, from means of batches.
    batches = angles.reshape(40, -1).mean(axis=1)
    assert abs(angles.mean() - (np.pi / 2 + 2 / np.pi)) < 4 * batches.std() / np.sqrt(40)


@pytest.mark.parametrize(
    ("term", "options", "said"),
    [
        (kinematic, {"component": [{"sd_deg": {"l_thihg": 3.0, "*": 4.0}}]}, r"sd_deg\.l_thihg: matches no part of the body; did you mean 'l_thigh'"),
        (kinematic, {"component": [{"mean_deg": {"l_kne": 3.0}}]}, r"mean_deg\.l_kne: no dof .*did you mean 'l_knee'"),
        (
            kinematic,
            {"component": [{"relative": {"l_thigh": [0.0, 0.1, 0.0, 1.0, 1.0, 0.0, 0.0]}}]},
            r"a quaternion of length 1\.414; expected length 1",
        ),
        (kinematic, {"component": [{"relative": {"l_hoof": [0.0, 0.1, 0.0, 1.0, 0.0, 0.0, 0.0]}}]}, r"relative\.l_hoof: no part"),
        (penetration, {"pairs": [["l_calf", "r_clf"]]}, r"'r_clf' is no part of the body 'person_31'; did you mean 'r_calf'"),
    ],
)
def test_a_potential_on_what_the_body_lacks(body, term, options, said):
    with pytest.raises(InputError, match=said):
        term.build("term", validate(term.Options, options, "test"), body)


def test_a_learned_joint_is_where_the_body_has_it(body, joints, learned):
    """A taller person's joints are further apart, by the proportions of the body, and the displacements are the same."""
    still = replace(joints, mean=joints.mean * np.array([0, 0, 0, 1, 1, 1, 1]))
    tall = loosened(build_body("person_31", load_body("person_31"), Shape(2.0)))
    row = joints.parts.index("l_calf")
    found = [np.asarray(_kinematic(each, learned(still)).log_potential.parameters["mean"][row]) for each in (body, tall)]
    np.testing.assert_allclose(found[1][:, :3], found[0][:, :3] * 2.0 / 1.75, atol=1e-6)
    np.testing.assert_allclose(found[0][:, 3:], joints.mean[row, :, 3:], atol=1e-6)
    moved = np.asarray(_kinematic(tall, learned(joints)).log_potential.parameters["mean"][row])
    np.testing.assert_allclose(moved[:, :3] - found[1][:, :3], joints.mean[row, :, :3], atol=1e-6)


def test_learned_and_given_components_are_mixed_by_their_shares(body, joints, learned):
    """The density at draws of the given components, which are far wider than the learned ones."""
    file, wide = learned(joints), WIDE["component"]
    options = file, {"component": wide}, file | {"component": wide, "component_share": 0.2}
    edges = [_edge(_kinematic(body, each), 3) for each in options]
    still = np.asarray(rigid.identity(), np.float32)
    children = jax.jit(jax.vmap(kinematic.draw, (0, None, None)))(jax.random.split(jax.random.key(5), 50), edges[1], still)
    of_learned, of_given, of_both = (np.asarray(_log_of_children(edge, still, children)) for edge in edges)
    np.testing.assert_allclose(of_both, np.logaddexp(np.log(0.8) + of_learned, np.log(0.2) + of_given), rtol=1e-4)


def _renamed(joints, old, new):
    parts, parents = (tuple(new if name == old else name for name in names) for names in (joints.parts, joints.parents))
    return replace(joints, parts=parts, parents=parents)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda j: _renamed(j, "head", "hoof"),
            r"learned on the body 'person_31', and the body 'person_31' has no joint of 'hoof' with 'torso'; exp",
        ),
        (lambda j: _renamed(j, "l_thigh", "l_leg"), r"has no joint of 'l_calf' with 'l_leg'; expected the joints of the body 'person_31'; learn one"),
        (
            lambda j: replace(j, parts=j.parts[:-1], parents=j.parents[:-1], **_without_last(j)),
            r"and the file has no joint of 'r_forearm' with 'r_upp",
        ),
        (lambda j: replace(j, mean=1.5 * j.mean), r"\w+, component 1: a quaternion of length 1\.5; expected length 1, or it is no rotation"),
        (lambda j: replace(j, covariance=-j.covariance), r"\w+, component 1: a matrix that is no covariance; expected symmetric and positive"),
        (lambda j: replace(j, weight=-j.weight), r"\w+, component 1: the weight -0\.3; expected a finite number above 0"),
        (
            lambda j: replace(j, weight=j.weight[:3]),
            r"other arrays \(\w+\); expected a file of kinematic potentials; make one with `bayes-body learn",
        ),
    ],
)
def test_a_learned_file_that_does_not_fit(body, joints, learned, change, said):
    with pytest.raises(InputError, match=said):
        _kinematic(body, learned(change(joints)))


def _without_last(joints):
    return {name: getattr(joints, name)[:-1] for name in ("mean", "covariance", "weight")}


def test_a_learned_file_that_is_none(body, tmp_path):
    (tmp_path / "joints.npz").write_bytes(b"no archive")
    with pytest.raises(InputError, match=r"not such an archive, or damaged .*; expected a file of kinematic potentials"):
        _kinematic(body, {"learned": str(tmp_path / "joints.npz")})
    with pytest.raises(InputError, match=r"knimeatic_10: no such file; expected a file of kinematic potentials; check the path"):
        _kinematic(body, {"learned": "knimeatic_10"})
    with pytest.raises(InputError, match="both `learned` and `component`; expected one of the two, or both with `component_share`"):
        _kinematic(body, {"learned": "kinematic_10", "component": [{}]})
    with pytest.raises(InputError, match="`component_share` without both"):
        _kinematic(body, {"learned": "kinematic_10", "component_share": 0.1})


def test_potentials_of_parts_need_parts(body):
    with pytest.raises(InputError, match=r'potential \'kinematic\': \[body\] placement = "angles"; expected placement = "parts"'):
        kinematic.build("kinematic", kinematic.Options(), body.by_angles)


def test_penetration_is_that_of_the_whole_body(body):
    """Crossed legs: the deepest pairs agree with the constraint on the body by angles."""
    crossed = {"l_hip_x": -0.25, "r_hip_x": 0.25}
    parts = _parts_of(body, jnp.asarray([crossed.get(name, 0.0) for name in body.dof_names]))
    pairs = tuple(pair for pair in body.topology.penetration)
    names = body.topology.names
    legs = [[names[a], names[b]] for a, b in pairs if {names[a][2:], names[b][2:]} <= {"thigh", "calf"}]
    soft = penetration.build("penetration", validate(penetration.Options, {"pairs": legs}, "test"), body)
    whole = intersection.build("intersection", intersection.Options(mode="soft"), body)
    hard = penetration.build("penetration", validate(penetration.Options, {"pairs": legs, "mode": "hard"}, "test"), body)
    assert float(_value(whole, parts)) < -1
    # The calf of the plate has the foot with it, so it may go deeper, but never less deep.
    assert float(_value(soft, parts)) <= float(_value(whole, parts)) + 1e-3
    assert float(_value(hard, parts)) == -np.inf
