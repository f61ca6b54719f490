"""A hub with four jointed arms among many false detections, as in PAMPAS (Isard 2003): no detection says which limb it is, the joints do.

A limb is a segment of the plane: where it begins, and where it ends. That of the hub goes from its centre to the point at which the first arm begins.
Pictures are 100 units wide. Detections of the true limbs come with heavy tails, one limb has none, and arms are bent uniformly: not as in the model.
"""

import jax
import jax.numpy as jnp
import numpy as np
import numpyro.distributions as dist
import pytest

from bayes_body import edge_factor, graph, kernels, node_factor, proposal

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("optimised")]

NAMES = ("hub", *(f"{part}_{k}" for part in ("upper", "lower") for k in range(4)))
LENGTHS = np.array([6.0, *[14.0] * 4, *[11.0] * 4])
EDGES = [("hub", f"upper_{k}") for k in range(4)] + [(f"upper_{k}", f"lower_{k}") for k in range(4)]
# The angle by which an arm's place on the rim is turned from the first; a lower arm goes on from the end of the upper one.
TURNS = jnp.array([*(np.pi / 2 * np.arange(4)), *[0.0] * 4])
LENGTH_SD, JOINT_SD, BEND, SEEN_SD, TIGHT = 1.0, 0.7, 4.0, 0.8, 0.6
# Of each edge: the turn, and the lengths of its two limbs.
JOINTS = (TURNS, jnp.asarray([[LENGTHS[NAMES.index(name)] for name in edge] for edge in EDGES]))
MISSING, FALSE = "upper_2", 60


def turned(vector, angle):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]])


def direction(limb, turn=0.0):
    """A unit vector along a limb, turned."""
    along = turned(limb[2:] - limb[:2], turn)
    return along / jnp.sqrt(jnp.sum(along**2) + 1e-9)


def log_begin(turn, parent, child):
    """The child begins near where the parent ends, after a turn about where the parent begins: a normal distribution."""
    apart = child[:2] - (parent[:2] + turned(parent[2:] - parent[:2], turn))
    return -0.5 * jnp.sum((apart / JOINT_SD) ** 2) - jnp.log(2 * jnp.pi * JOINT_SD**2)


def log_joint(joint, parent, child):
    """It goes on in about the same direction, too."""
    return log_begin(joint[0], parent, child) + BEND * (jnp.sum(direction(parent, joint[0]) * direction(child)) - 1)


def draw_joint(key, joint, known, reverse):
    """Draw the other limb: begin and length are normal, and the bend is a Cauchy variable wrapped around the circle."""
    turn, lengths = joint
    noise, uniform = jax.random.normal(key, (3,)), jax.random.uniform(jax.random.fold_in(key, 1))
    bend = 2 * jnp.arctan((1 - TIGHT) / (1 + TIGHT) * jnp.tan(jnp.pi * (uniform - 0.5)))
    if reverse:
        along = (lengths[0] + LENGTH_SD * noise[2]) * turned(direction(known), bend)
        begin = known[:2] + JOINT_SD * noise[:2] - along
        return jnp.concatenate([begin, begin + turned(along, -turn)])
    begin = known[:2] + turned(known[2:] - known[:2], turn) + JOINT_SD * noise[:2]
    return jnp.concatenate([begin, begin + (lengths[1] + LENGTH_SD * noise[2]) * turned(direction(known, turn), bend)])


def log_drawn(joint, known, other, reverse):
    """The density of these draws: the limb's own angle and length stand for its end, which divides by the length."""
    turn, lengths = joint
    parent, child = (other, known) if reverse else (known, other)
    cosine, own = jnp.sum(direction(parent, turn) * direction(child)), lengths[0 if reverse else 1]
    length = jnp.sqrt(jnp.sum((other[2:] - other[:2]) ** 2) + 1e-9)
    bend = jnp.log((1 - TIGHT**2) / (2 * jnp.pi)) - jnp.log(1 + TIGHT**2 - 2 * TIGHT * cosine)
    stretch = -0.5 * ((length - own) / LENGTH_SD) ** 2 - jnp.log(LENGTH_SD * jnp.sqrt(2 * jnp.pi))
    return log_begin(turn, parent, child) + bend + stretch - jnp.log(length)


def log_length(length, limb):
    return -0.5 * ((jnp.sqrt(jnp.sum((limb[2:] - limb[:2]) ** 2) + 1e-9) - length) / LENGTH_SD) ** 2


def log_image(detections, limb):
    """A limb is seen by one of the detections, or by none: then it may be anywhere."""
    near = -0.5 * jnp.sum(((detections - limb) / SEEN_SD) ** 2, axis=1)
    return jnp.logaddexp(jax.nn.logsumexp(near), -9.0)


def picture(seed: int):
    """The true limbs, and detections of limbs in no order: those of the body but one, and false ones."""
    rng = np.random.default_rng(seed)
    heading, centre = rng.uniform(0, 2 * np.pi), rng.uniform(35, 65, size=2)

    def segment(begin, angle, length):
        return np.concatenate([begin, begin + length * np.array([np.cos(angle), np.sin(angle)])])

    limbs = {"hub": segment(centre, heading, LENGTHS[0])}
    for k in range(4):
        angle = heading + k * np.pi / 2
        bends = rng.uniform(-0.9, 0.9, size=2)
        limbs[f"upper_{k}"] = segment(segment(centre, angle, LENGTHS[0])[2:], angle + bends[0], LENGTHS[1] + rng.uniform(-1, 1))
        limbs[f"lower_{k}"] = segment(limbs[f"upper_{k}"][2:], angle + bends.sum(), LENGTHS[5] + rng.uniform(-1, 1))
    true = np.stack([limbs[name] for name in NAMES])
    seen = np.stack([limbs[name] + 0.4 * rng.standard_t(4, size=4) for name in NAMES if name != MISSING])
    begins, angles = rng.uniform(0, 100, size=(FALSE, 2)), rng.uniform(0, 2 * np.pi, FALSE)
    false = np.stack([segment(*one) for one in zip(begins, angles, rng.choice(LENGTHS, FALSE), strict=True)])
    return true, rng.permutation(np.concatenate([seen, false]))


def body_among(detections):
    each = jnp.broadcast_to(jnp.asarray(detections), (len(NAMES), *detections.shape))
    near = dist.MixtureSameFamily(dist.Categorical(probs=jnp.full(len(detections), 1 / len(detections))), dist.Normal(each[0], 1.2).to_event(1))
    return graph(
        dict.fromkeys(NAMES, (1, 4)),
        node_factor("length", log_length, parameters=jnp.asarray(LENGTHS)),
        node_factor("image", log_image, parameters=each),
        edge_factor("joint", log_joint, EDGES, JOINTS, draw_joint, log_drawn),
        proposal("detections", near),
    )


@pytest.fixture(scope="module")
def sampler():
    return jax.jit(kernels.particle_bp(samples=800, iterations=6, particles=300, shares=(0.3, 0.0, 0.4, 0.3)).on)


def test_limbs_are_found_by_their_joints(sampler):
    shares = []
    for seed in (0, 1, 3):
        true, detections = picture(seed)
        lengths = np.linalg.norm(detections[:, 2:] - detections[:, :2], axis=1)
        # By its length alone, an arm may be any of many.
        assert min(np.sum(np.abs(lengths - own) < 2) for own in LENGTHS[1:]) > 12
        joint = sampler(jax.random.key(seed), body_among(detections)).joint
        weights, values = np.asarray(jax.nn.softmax(joint.log_weights), float), np.asarray(joint.values, float)
        off = np.linalg.norm((values - true).reshape(len(values), -1, 2, 2), axis=-1).max(axis=2)
        shares.append(weights @ (off < 4))
    seen = [number for number, name in enumerate(NAMES) if not name.endswith("_2")]
    assert np.min(np.array(shares)[:, seen]) > 0.85 and np.mean(np.array(shares)[:, seen]) > 0.97
    # The third arm's upper limb has no detection: the true place of that arm keeps weight among the false ones that fit as well.
    hidden = np.array(shares)[:, NAMES.index(MISSING)]
    assert hidden.min() > 0.05 and hidden.mean() > 0.35
