"""The renderer's person is no body of the models: at the true joint angles a model's silhouette is near the true one, and never it."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from workshop.simulation.walker import FPS, walker

from bayes_body.initial.fitting.outline import fit_outline
from bayes_body.initial.retarget import retarget
from bayes_body.model.body.build import build_body
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_body, load_definition
from bayes_body.recording.readers.images import read_mask
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import Subject
from bayes_body.results.metrics.fit import intersection_over_union, projected_masks
from bayes_body.workshop.simulation.options import Options
from bayes_body.workshop.simulation.person import build_person
from bayes_body.workshop.simulation.session import simulate
from bayes_body.workshop.simulation.staging import centred

from .test_session import RIGS

STEP, HEIGHT = 6, 1.78


@pytest.mark.long
@pytest.mark.parametrize(("model", "person"), [("silhouettes", 5), ("silhouettes", 3), ("deutscher_2005", 5)])
def test_a_model_at_the_true_angles_is_not_the_rendered_person(model, person, tmp_path):
    landmarks = {name: points[::STEP] for name, points in centred(walker(60), np.array((0, 0, 0.9))).items()}
    options = Options(seed=person, true_masks=True)
    session, _ = simulate(landmarks, read_rig(RIGS / "room_4.toml"), build_person(person, HEIGHT), options, tmp_path / "s", title="a walk")
    definition = load_definition(model)
    schema = load_body(definition.body_name)
    truth = retarget(build_body(definition.body_name, schema), landmarks, FPS / STEP, schema=schema)
    subject = Subject(body=definition.body_name, height_m=HEIGHT, lengths_m=truth.lengths_m)
    body = build_model(definition, replace(session, subject=subject, initial={}))
    poses = truth.angles.astype(np.float32)
    overlap = overlaps(body, poses, session)
    # At 1 the pictures would come from the model that is fitted to them.
    assert 0.75 <= np.median(overlap) <= 0.92
    assert overlap.max() < 0.95
    # As thick as somebody looks in the first frame, in the others: nearer, and never the same.
    outline = fit_outline(body.beginning_at(jnp.asarray(poses[0])), session)
    dressed = build_model(definition, replace(session, subject=replace(subject, outline_radii_m=outline.radii_m), initial={}))
    nearer = overlaps(dressed, poses[1:], session)
    # Picture by picture: some are seen worse than others, whatever somebody wears.
    assert np.median(nearer - overlap[1:]) > 0.003
    assert np.median(nearer) <= 0.92
    assert nearer.max() < 0.95


def overlaps(model, poses, session):
    """Of the posed body with the true silhouettes of the last frames: (frame, camera)."""
    first = session.frames - len(poses)
    return np.array(
        [
            [
                intersection_over_union(mask, read_mask(session.folder / "true_masks" / view.camera.name / f"{frame:06d}.png", view.camera.size_px))
                for view, mask in zip(session.views, projected_masks(model, pose, session), strict=True)
            ]
            for frame, pose in enumerate(poses, first)
        ]
    )
