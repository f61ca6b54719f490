"""Unknowns: variables with a stationary prior that change bodies, cameras and clocks in the factors, against independent computations."""

import dataclasses

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.density.factor import Composed, Variable
from bayes_body.density.gaussian_view import joined, split
from bayes_body.density.jacobian import rows_and_jacobians
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.placed_body import placed_markers
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.recording.evidence.markers import KEYPOINTS, MarkerEvidence
from bayes_body.recording.session.session import CameraUncertainty, Subject
from bayes_body.results.posterior.weighted import markers

KINDS = ("lengths", "widths", "cameras", "delays", "keypoint_offsets", "noise")
LIKELIHOOD, WALLS = "markers_gaussian", "intersection"


def without_unknowns(name):
    """The text of a model without its own unknowns."""
    definition = load_definition(name)
    begin, end = definition.text.find("[[unknown]]"), definition.text.find("[kernel]")
    return (definition.text if begin < 0 else definition.text[:begin] + definition.text[end:]), definition.body_text


def with_unknowns(name, *kinds, extra=""):
    text, body_text = without_unknowns(name)
    tables = "".join(f'\n[[unknown]]\nkind = "{kind}"\n{extra}' for kind in kinds)
    return parse_definition(name, text + tables, body_text)


@pytest.fixture(scope="module")
def model(keypoint_session):
    return build_model(with_unknowns("keypoints", *KINDS), keypoint_session)


@pytest.fixture(scope="module")
def known(keypoint_session):
    return build_model(with_unknowns("keypoints"), keypoint_session)


@pytest.fixture(scope="module")
def data(model):
    """A frame of keypoints near the body in its first pose."""
    rng = np.random.default_rng(5)
    factor = next(factor for factor in model.factors if factor.name == LIKELIHOOD)
    pixels = np.asarray(factor.log_potential.inner(values(model)))[..., :2]
    evidence = MarkerEvidence(np.zeros((len(pixels), len(KEYPOINTS), 2), np.float32), np.zeros((len(pixels), len(KEYPOINTS)), np.float32))
    places = [KEYPOINTS.index(name) for name in model.body.markers.names]
    evidence.pixels[:, places] = pixels + rng.normal(size=pixels.shape) * 5
    evidence.confidence[:, places] = 1.0
    return {LIKELIHOOD: evidence}


def values(model, **changes):
    rng = np.random.default_rng(3)
    state = dict(model.initial)
    state["velocity"] = jnp.asarray(rng.normal(size=state["velocity"].shape), jnp.float32)
    return {Variable(name): jnp.asarray(value, jnp.float32) for name, value in {**state, **changes}.items()}


def term(model, name):
    return next(term for term in model.unknowns if term.name == name)


def log_likelihood(model, data, **changes):
    state = {variable.name: value for variable, value in values(model, **changes).items()}
    return float(model.density(data).log_likelihood(state, state))


def expected(model, **changes):
    factor = next(factor for factor in model.factors if factor.name == LIKELIHOOD)
    return np.asarray(factor.log_potential.inner(values(model, **changes)), float)


def draw(model, name, seed=1):
    unknown = term(model, name)
    return np.asarray(unknown.prior().sample(jax.random.key(seed)), float)


def test_at_their_mean_nothing_changes(model, known, data):
    state = {name: value for name, value in model.initial.items() if name in known.initial}
    np.testing.assert_allclose(expected(model)[..., :2], expected(known), atol=2e-4)
    assert log_likelihood(model, data) == pytest.approx(log_likelihood(known, data), abs=1e-3)
    assert set(state) == set(known.initial) == {"pose", "velocity"}


def test_with_one_camera_the_session_is_taken_as_exact(keypoint_session):
    single = dataclasses.replace(keypoint_session, views=keypoint_session.views[:1])
    assert build_model("keypoints", single).unknowns == ()
    assert [term.name for term in build_model("keypoints", keypoint_session).unknowns] == ["lengths", "cameras", "keypoint_offsets"]
    text, body_text = without_unknowns("keypoints")
    definition = parse_definition("keypoints", f'{text}\n[[unknown]]\nkind = "lengths"\nleast_cameras = 1\n', body_text)
    assert [term.name for term in build_model(definition, single).unknowns] == ["lengths"]


def test_without_unknowns_factors_are_as_they_were(known):
    assert known.unknowns == ()
    assert known.settled(known.initial) is known
    assert all(variable.name == "pose" for factor in known.factors for variable in factor.scope)


def test_lengths_are_those_of_a_body_that_is_built_with_them(model, keypoint_session):
    change = draw(model, "lengths")
    named, labels = term(model, "lengths").named(change), term(model, "lengths").space.labels
    schema = model.definition.body
    stems = {name: name[2:] if name.startswith(("l_", "r_")) else name for name in schema.lengths_of_height}
    height = keypoint_session.subject.height_m or schema.height_m
    lengths = {name: share * height * np.exp(named[0] + named[labels.index(stems[name])]) for name, share in schema.lengths_of_height.items()}
    subject = Subject(body=model.definition.body_name, lengths_m=lengths)
    other = build_model(with_unknowns("keypoints"), dataclasses.replace(keypoint_session, subject=subject))
    np.testing.assert_allclose(expected(model, lengths=change)[..., :2], expected(other), atol=2e-3)
    body = build_body(model.body.name, schema, Shape(None, lengths))
    state = values(model, lengths=change)
    by_name = {variable.name: value for variable, value in state.items()}
    pose = by_name["pose"]
    np.testing.assert_allclose(placed_markers(model.body_in(by_name), pose), placed_markers(body, pose), atol=1e-6)
    np.testing.assert_allclose(
        markers(model, np.asarray(pose)[None], lengths=change[None].astype(np.float32))[0], placed_markers(body, pose), atol=1e-6
    )


def test_bones_have_the_deviations_and_correlations_that_were_learned(model, keypoint_session):
    """The covariance of the bones is that of the definition, and their mean is the one expected, by name, whatever the entries are."""
    definition = with_unknowns("keypoints", "lengths", extra="bone_sd = { thigh = 0.02 }\nbone_mean = { calf = 0.1 }\n")
    told = dataclasses.replace(keypoint_session, subject=dataclasses.replace(keypoint_session.subject, height_m=None, lengths_m={}))
    unknown = term(build_model(definition, told), "lengths")
    labels, mixing = unknown.space.labels, np.asarray(unknown.mixing, float)
    covariance = mixing * np.asarray(unknown.sd, float) ** 2 @ mixing.T
    sd = dict(zip(labels, np.sqrt(np.diagonal(covariance)), strict=True))
    np.testing.assert_allclose(unknown.named_sd(), list(sd.values()), rtol=1e-6)
    assert (sd["overall"], sd["thigh"], sd["calf"]) == pytest.approx((0.055, 0.02, 0.0518), abs=1e-4)
    torso, thigh, calf = (labels.index(name) for name in ("torso", "thigh", "calf"))
    assert covariance[thigh, torso] / (sd["thigh"] * sd["torso"]) == pytest.approx(-0.45, abs=1e-5)
    np.testing.assert_allclose(covariance[0, 1:], 0, atol=1e-9)
    np.testing.assert_allclose(unknown.named(np.asarray(unknown.mean, float)), np.where(np.arange(len(labels)) == calf, 0.1, 0), atol=1e-6)
    free = term(build_model(with_unknowns("keypoints", "lengths", extra='sides = "free"\n'), keypoint_session), "lengths")
    np.testing.assert_allclose(free.named_sd(), free.sd, rtol=1e-6)
    assert {"l_thigh", "r_thigh"} < set(free.space.labels)


def test_walls_have_the_lengths_too(model):
    walls = next(factor for factor in model.factors if factor.name == WALLS)
    change = np.zeros(len(term(model, "lengths").space.labels))
    change[0] = np.log(0.5)
    depths = jax.jit(walls.log_potential.inner)
    assert not np.allclose(depths(values(model)), depths(values(model, lengths=change)))


def test_cameras_turn_about_their_centre_and_move_along_their_axes(model):
    motion = draw(model, "cameras").reshape(-1, 6)
    rig, points = model.rig, np.asarray(placed_markers(model.body, model.first_pose), float)
    pixels = []
    for c, (turn, move) in enumerate(zip(motion[:, :3], motion[:, 3:], strict=True)):
        in_camera = points @ np.asarray(rig.rotation[c], float).T + np.asarray(rig.translation[c], float)
        moved = Rotation.from_rotvec(turn).apply(in_camera) + move
        (fx, fy), (cx, cy) = np.asarray(rig.focal[c], float), np.asarray(rig.centre[c], float)
        intrinsics = np.array([[fx, float(rig.skew[c]) * fx, cx], [0, fy, cy], [0, 0, 1]])
        pixels.append(cv2.projectPoints(moved, np.zeros(3), np.zeros(3), intrinsics, np.asarray(rig.distortion[c], float))[0][:, 0])
    np.testing.assert_allclose(expected(model, cameras=motion.ravel())[..., :2], pixels, atol=2e-2)


def test_focal_length_and_principal_point(keypoint_session):
    model = build_model(with_unknowns("keypoints", "cameras", extra="focal_sd = 0.01\ncentre_sd_px = 5.0\n"), keypoint_session)
    table = np.zeros((len(keypoint_session.views), 9))
    table[:, 6], table[:, 7:] = 0.02, (3.0, -4.0)
    at_rest, centre = expected(model), np.asarray(model.rig.centre)[:, None]
    np.testing.assert_allclose(expected(model, cameras=table.ravel()), centre + np.exp(0.02) * (at_rest - centre) + [3.0, -4.0], atol=2e-3)


def test_a_late_camera_sees_a_later_pose(model):
    delays = np.array([0.02, -0.01, 0.015])[: len(term(model, "delays").sd)]
    late = expected(model, delays=delays)
    state = values(model)
    pose, velocity = state[Variable("pose")], state[Variable("velocity")]
    for camera, delay in enumerate([0.0, *delays]):
        np.testing.assert_allclose(late[camera], expected(model, pose=pose + delay * velocity)[camera], atol=1e-3)


def test_keypoints_lie_beside_joints_that_stay(model):
    labels = term(model, "keypoint_offsets").space.labels
    change = np.zeros(len(labels))
    change[labels.index("l_hip_x")] = 0.03
    moved = np.linalg.norm(expected(model, keypoint_offsets=change) - expected(model), axis=-1)
    hip = model.body.markers.names.index("l_hip")
    assert (moved[:, hip] > 0.1).all()
    assert not np.delete(moved, hip, axis=1).any()
    assert "keypoint_offsets" not in model.placing
    # Along the bone, an offset is a length.
    assert "l_wrist_z" not in labels
    assert {"l_wrist_x", "l_wrist_y", "l_elbow_z"} <= set(labels)


def test_noise_is_that_of_a_likelihood_with_another_deviation(model, known, data):
    scale = np.log(np.array([1.5, 0.7, 1.0, 2.0])[: len(np.asarray(model.rig.focal))])
    likelihood = next(factor for factor in known.factors if factor.name == LIKELIHOOD).log_potential.outer.args[0].detections
    scaled = dataclasses.replace(likelihood, sd_px=likelihood.sd_px * jnp.exp(jnp.asarray(scale, jnp.float32)))
    points = placed_markers(known.body, known.first_pose)
    evidence = data[LIKELIHOOD]
    places = [KEYPOINTS.index(name) for name in known.body.markers.names]
    wanted = scaled.log_density(points, jnp.asarray(evidence.pixels[:, places]), jnp.asarray(evidence.confidence[:, places]))
    assert log_likelihood(model, data, noise=scale) == pytest.approx(float(wanted), abs=1e-3)


def test_widths_scale_radii(model):
    labels = term(model, "widths").space.labels
    change = np.zeros(len(labels), np.float32)
    change[labels.index("thigh")] = np.log(1.2)
    body = model.body_in({"widths": jnp.asarray(change), "lengths": jnp.zeros(len(term(model, "lengths").sd))})
    grown = np.asarray(body.radii) / np.asarray(model.body.radii)
    is_thigh = np.array([name.endswith("thigh") for name in model.body.topology.names])
    np.testing.assert_allclose(grown[is_thigh], 1.2, rtol=1e-6)
    np.testing.assert_allclose(grown[~is_thigh], 1.0, rtol=1e-6)


def test_the_session_says_how_well_it_knows_what_it_says(model, known, keypoint_session):
    camera = CameraUncertainty((0.001, 0.002, 0.003), (0.004, 0.005, 0.006), delay_s=0.007, delay_sd_s=0.008)
    views = (*keypoint_session.views[:-1], dataclasses.replace(keypoint_session.views[-1], uncertainty=camera))
    subject = dataclasses.replace(
        keypoint_session.subject,
        lengths_sd={"l_thigh": 0.04, "torso": 0.05, "overall": 0.03},
        keypoint_offsets_m={"l_hip": (0.01, 0.02, 0.03)},
        keypoint_offsets_sd_m={"l_hip": (0.004, 0.0, 0.006)},
    )
    session = dataclasses.replace(keypoint_session, views=views, subject=subject)
    usual, model = model, build_model(with_unknowns("keypoints", *KINDS), session)
    size = len(term(model, "cameras").sd) // len(views)
    np.testing.assert_allclose(term(model, "cameras").sd[-size:], [*camera.turn_sd, *camera.move_sd_m], rtol=1e-6)
    np.testing.assert_array_equal(term(model, "cameras").sd[:-size], term(usual, "cameras").sd[:-size])
    assert (float(term(model, "delays").mean[-1]), float(term(model, "delays").sd[-1])) == pytest.approx((0.007, 0.008))
    lengths = dict(zip(term(model, "lengths").space.labels, np.asarray(term(model, "lengths").sd, float), strict=True))
    assert lengths["overall"] == pytest.approx(0.03)
    assert np.hypot(lengths["overall"], lengths["thigh"]) == pytest.approx(0.04)
    assert lengths["calf"] == pytest.approx(float(term(usual, "lengths").sd[term(usual, "lengths").space.labels.index("calf")]))
    offsets, before = term(model, "keypoint_offsets"), term(usual, "keypoint_offsets")
    # A heel that is further below than behind still has no offset along the body file's longer side.
    high = dataclasses.replace(session, subject=dataclasses.replace(subject, lengths_m={"heel_below": 0.2}))
    assert term(build_model(with_unknowns("keypoints", *KINDS), high), "keypoint_offsets").space.labels == before.space.labels
    first = offsets.space.labels.index("l_hip_x")
    np.testing.assert_allclose(offsets.mean[first : first + 3], [0.01, 0.02, 0.03], rtol=1e-6)
    np.testing.assert_allclose(offsets.sd[first : first + 3], [0.004, before.sd[first + 1], 0.006], rtol=1e-6)
    assert not np.delete(np.asarray(offsets.mean), range(first, first + 3)).any()
    for key, table in {"lengths_sd": {"l_thigg": 0.04}, "keypoint_offsets_m": {"l_hipp": (0.0, 0.0, 0.0)}}.items():
        wrong = dataclasses.replace(session, subject=dataclasses.replace(subject, **{key: table}))
        with pytest.raises(InputError, match=r"no such .*did you mean"):
            build_model(with_unknowns("keypoints", *KINDS), wrong)
    # A smaller body lacks some of the names.
    smaller = dataclasses.replace(session, subject=dataclasses.replace(subject, body="deutscher_31"))
    legs = term(build_model(with_unknowns("poon_fleet_2002_legs", "lengths"), smaller), "lengths")
    assert np.hypot(legs.sd[0], legs.sd[legs.space.labels.index("thigh")]) == pytest.approx(0.04)
    # A definition without unknowns takes the session's word.
    np.testing.assert_array_equal(expected(build_model(with_unknowns("keypoints"), session)), expected(known))


@pytest.mark.parametrize("name", KINDS)
def test_the_walk_is_stationary(model, name):
    """A walk without this variance would make every unknown certain, or uncertain without end."""
    unknown = term(model, name)
    unknown = dataclasses.replace(unknown, mean=unknown.mean + 0.1, retention=jnp.full_like(unknown.retention, 0.8))
    at = unknown.onward(unknown.mean + unknown.sd)
    np.testing.assert_allclose(at.base_dist.loc, unknown.mean + 0.8 * unknown.sd, rtol=1e-5)
    variance = 0.8**2 * np.asarray(unknown.sd) ** 2 + np.asarray(at.base_dist.scale) ** 2
    np.testing.assert_allclose(variance, np.asarray(unknown.sd) ** 2, rtol=1e-5)


def test_the_first_particles_have_the_prior_exactly(model):
    start = model.start(512, jax.random.key(4))
    for unknown in model.unknowns:
        drawn = np.asarray(start.states[unknown.name], float) / np.asarray(unknown.sd, float)
        np.testing.assert_allclose(drawn.mean(axis=0), 0, atol=1e-3)
        np.testing.assert_allclose(np.cov(drawn.T, bias=True), np.eye(drawn.shape[1]), atol=5e-3)
        pose = np.asarray(start.states["pose"], float)
        both = np.concatenate([pose[:, pose.std(axis=0) > 0], drawn], axis=1)
        between = np.corrcoef(both.T)[: -drawn.shape[1], -drawn.shape[1] :]
        # An angle that its limits cut off is a bent function of its normal number. Independent draws would differ by 0.04.
        np.testing.assert_allclose(between, 0, atol=2e-2)


def test_a_settled_model_has_the_values_of_a_state(model, data):
    changes = {name: draw(model, name) for name in KINDS}
    state = {variable.name: value for variable, value in values(model, **changes).items()}
    settled = model.settled(state)
    pose = {"pose": state["pose"]}
    density = settled.density(data)
    assert settled.unknowns == ()
    assert float(density.log_likelihood(pose, pose)) == pytest.approx(log_likelihood(model, data, **changes), abs=1e-2)


@pytest.mark.slow
def test_the_jacobian_of_entries_that_share_a_push_is_that_of_all_directions(model):
    composed = [factor for factor in model.factors if isinstance(factor.log_potential, Composed)]
    state = {variable.name: value for variable, value in values(model, **{name: draw(model, name) for name in KINDS}).items()}
    root = np.random.default_rng(6).normal(size=(joined(state).size,) * 2).astype(np.float32) / 30

    def jacobians(is_local):
        factors = []
        for factor in composed:
            local = tuple(entry for entry in factor.log_potential.local if is_local(entry[0].name))
            factors.append(dataclasses.replace(factor, log_potential=dataclasses.replace(factor.log_potential, local=local)))
        whitened = jnp.zeros(len(root))
        return jax.jit(lambda z: rows_and_jacobians(factors, lambda z: split(joined(state) + root @ z, state), z))(whitened)

    in_all_directions = jax.tree.leaves(jacobians(lambda _: False))
    for left_out in (None, "cameras"):
        for quick, slow in zip(jax.tree.leaves(jacobians(lambda name: name != left_out)), in_all_directions, strict=True):  # noqa: B023
            np.testing.assert_allclose(quick, slow, atol=1e-5 * np.abs(slow).max())


REFUSED = {
    "no velocity": ("silhouettes", 'kind = "delays"', "unknown 'delays': no term of the model reads it"),
    "nothing reads noise": ("silhouettes", 'kind = "noise"', "take the table out"),
    "a random walk": ("arm_markers", 'kind = "delays"', "the motion prior has no variable 'velocity'"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_an_unknown_that_cannot_be_known_is_refused(case, keypoint_session):
    name, table, sentence = REFUSED[case]
    definition = load_definition(name)
    changed = parse_definition(name, f"{definition.text}\n[[unknown]]\n{table}\n", definition.body_text)
    with pytest.raises(InputError, match=sentence):
        build_model(changed, keypoint_session)


def test_a_key_that_matches_nothing_is_named(keypoint_session):
    definition = with_unknowns("keypoints", "lengths", extra="bone_sd = { thig = 0.1 }\n")
    with pytest.raises(InputError, match=r"unknown 'lengths': bone_sd.thig: matches no bone of the body; did you mean 'thigh'"):
        build_model(definition, keypoint_session)


def test_a_bone_without_deviation_changes_only_with_the_body(keypoint_session):
    table = 'bone_sd = { "*" = 0.0, thigh = 0.1 }\n'
    built = build_model(with_unknowns("keypoints", "lengths", extra=table), keypoint_session)
    assert term(built, "lengths").space.labels == ("overall", "thigh")
    lengths = np.asarray(built.body_in({**built.initial, "lengths": jnp.array([0.1, 0.0])}).lengths / built.body.lengths)
    np.testing.assert_allclose(lengths, np.exp(0.1), rtol=1e-5)
    longer = with_unknowns("keypoints", "lengths", extra=f"{table}bone_mean = {{ calf = 0.1 }}\n")
    with pytest.raises(InputError, match=r"unknown 'lengths': bone_mean.calf: 0.1, and calf has the standard deviation 0"):
        build_model(longer, keypoint_session)


FAULTY = {
    "twice": ('[[unknown]]\nkind = "lengths"\n[[unknown]]\nkind = "lengths"\n', "two tables of the kind 'lengths'"),
    "no width": ('[[unknown]]\nkind = "cameras"\nmove_sd_m = 0.0\n', "unknown #1.*move_sd_m"),
    "no such kind": ('[[unknown]]\nkind = "length"\n', "unknown 'length' does not exist"),
}


@pytest.mark.parametrize("case", FAULTY)
def test_a_faulty_table_is_named(case):
    text, sentence = FAULTY[case]
    known_text, body_text = without_unknowns("keypoints")
    with pytest.raises(FaultyFileError, match=sentence):
        parse_definition("keypoints", f"{known_text}\n{text}", body_text)
