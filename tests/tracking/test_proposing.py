"""What detectors find in a frame reaches the kernel as proposals of the parts, in one form for all frames."""

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from initial.detection.people import mask, ring
from shared_fixtures import loose_limbed

from bayes_body.base.errors import InputError
from bayes_body.base.registry import forget, register
from bayes_body.density.kernel import FilterInfo, NamedKernel
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.recording.session.session import Segmentation, Session, Subject, View
from bayes_body.runs.track import track as track_session
from bayes_body.tracking.proposing import proposer_for
from bayes_body.tracking.track import track


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Two frames of a person of spheres by three cameras; the second has no images."""
    folder, views = tmp_path_factory.mktemp("spheres"), []
    for spec in ring(3):
        silhouette = 255 * mask(spec).astype(np.uint8)
        for kind, picture in (("image", silhouette), ("mask", silhouette)):
            cv2.imwrite(str(folder / f"{spec.name}_{kind}0.png"), picture)
        views.append(View(spec, images=f"{spec.name}_image%d.png", masks=f"{spec.name}_mask%d.png"))
    return Session(folder, "a person of spheres", "z", 60.0, 2, 0, tuple(views), Subject(height_m=1.75))


def to_first_proposal(key, particles, density):
    """A kernel that puts every part where its first proposal is, if it has any."""
    of_parts = density.proposals[0]
    parts = jnp.where(of_parts.exists[:, None], of_parts.components.mean[:, 0], particles.states["parts"])
    count, nothing = len(particles.log_weights), jnp.full(1, jnp.nan)
    info = FilterInfo(jnp.arange(count), jnp.asarray(1.0), nothing, nothing, jnp.nan, jnp.asarray(False), nothing, jnp.asarray(count))
    return particles._replace(states={**particles.states, "parts": parts}), info


@pytest.fixture
def named_kernel():
    register("kernel", "to_first_proposal", takes_proposals=True)(lambda options: to_first_proposal)
    yield NamedKernel("to_first_proposal", None, to_first_proposal)
    forget([("kernel", "to_first_proposal")])


@pytest.mark.filterwarnings("ignore::bayes_body.base.errors.RunWarning")
def test_a_detected_part_reaches_the_tracked_frame(session, named_kernel):
    definition = load_definition("loose_limbed_15")
    model = build_model(replace(definition, detectors=("silhouettes",)), session)
    draws = track(jax.random.key(0), session, model, named_kernel, particles=2)
    first, second = (np.asarray(frame.states["parts"], float)[0, 0] for frame in draws.frames)
    torso, start = model.body.placement.names.index("torso"), np.asarray(model.initial["parts"], float)
    # The session gives no pose, so the body begins with its pelvis at the origin, which lies between the feet of the person of spheres.
    assert np.linalg.norm(start[torso, :3] - first[torso, :3]) > 0.5
    assert np.linalg.norm(first[torso, :2]) < 0.1 and 0.8 < first[torso, 2] < 1.1
    # Nobody is seen in the second frame: its proposals have the same form, without weight.
    np.testing.assert_array_equal(first, second)
    # A frame that is read only when the one before is done has proposals, too.
    by_body = replace(session, segmentation=Segmentation(figures="near_body"))
    followed = track_session(jax.random.key(0), by_body, build_model(model.definition, by_body), named_kernel, particles=2)
    np.testing.assert_array_equal(np.asarray(followed.frames[1].states["parts"], float)[0, 0], second)


def test_only_kernels_that_take_proposals_wait_for_detectors(session, named_kernel):
    definition = load_definition("loose_limbed_15")
    model = build_model(replace(definition, detectors=("silhouettes",)), session)
    assert proposer_for(session, model, named_kernel) is not None
    assert proposer_for(session, model, model.kernel("tempered")) is None
    assert proposer_for(session, replace(model, definition=definition), named_kernel) is None


def test_a_body_without_hips_is_refused(session, named_kernel):
    arm = replace(parse_definition("loose", loose_limbed(load_definition("arm_markers").text), None), detectors=("limbs",))
    with pytest.raises(InputError, match=r"detectors.*no marker 'l_hip'"):
        proposer_for(session, build_model(arm, session), named_kernel)
