"""A run on a recording of `unknown_recordings` against its truth: markers, joint angles and unknowns."""

from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np

from bayes_body.model.body.solids import Body
from bayes_body.model.unknowns.lengths import lengths_of
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.results.metrics.accuracy import LEVELS, inside_intervals
from bayes_body.results.metrics.angles import true_angles
from bayes_body.results.metrics.clouds import weights_of
from bayes_body.results.metrics.truth import draws_against_truth, true_markers
from bayes_body.results.posterior.weighted import frame_rhat, markers, rhat

AT_90 = LEVELS.index(0.9)
ANGLES = ("hip_flexion", "knee_flexion", "elbow_flexion", "pelvic_tilt")


def with_known_offsets(model, offsets_m):
    """The model that knows where keypoints lie (marker, 3), metres in the joints' frames."""

    def shifted(node):
        if not isinstance(node, Body):
            return node
        return replace(node, markers=replace(node.markers, offsets=node.markers.offsets + np.asarray(offsets_m, np.float32)))

    def with_offsets(factor):
        return jax.tree.map(shifted, factor, is_leaf=lambda node: isinstance(node, Body))

    return replace(model, factors=tuple(with_offsets(factor) if factor.side == "likelihood" else factor for factor in model.factors))


class Similarity(NamedTuple):
    """`scale * rotation @ x + shift`."""

    scale: float
    rotation: np.ndarray
    shift: np.ndarray

    def apply(self, points):
        """Return points (..., 3), moved."""
        return self.scale * points @ self.rotation.T + self.shift


def similarity(source, target):
    """The similarity that takes source points (point, 3) nearest to the target's (Umeyama 1991)."""
    middle, goal = source.mean(axis=0), target.mean(axis=0)
    U, stretches, V = np.linalg.svd((target - goal).T @ (source - middle))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ V))])
    rotation = U @ np.diag(signs) @ V
    scale = (stretches * signs).sum() / ((source - middle) ** 2).sum()
    return Similarity(scale, rotation, goal - scale * rotation @ middle)


def figures(recording, session, draws):
    """Figures of a run: millimetres, degrees and shares."""
    accuracy = draws_against_truth(session, draws)
    plain, truth, means = accuracy.plain, true_markers(session)[: len(draws.frames)], mean_markers(draws)
    names = [name for name in draws.model.body.markers.names if name in plain.names]
    errors = [points - truth for points in means]
    aligned = [similarity(points.reshape(-1, 3), truth.reshape(-1, 3)).apply(points) - truth for points in means]
    by_marker = plain.coverage_by_marker[AT_90]
    return {
        "mean_mm": 1e3 * float(np.mean(plain.error)),
        "rms_mm": _rms_mm(errors),
        "aligned_mean_mm": 1e3 * float(np.mean([np.linalg.norm(off, axis=-1) for off in aligned])),
        "aligned_rms_mm": _rms_mm(aligned),
        "coverage_90": float(plain.coverage[AT_90]),
        "coverage_50": float(plain.coverage[LEVELS.index(0.5)]),
        "by_marker": dict(zip(names, by_marker.tolist(), strict=True)),
        "crps_mm": 1e3 * float(np.mean(plain.scores.crps)),
        "spread_mm": 1e3 * float(np.mean(plain.scores.spread)),
        "log_evidence": float(np.mean(np.sum([frame.info.log_evidence for frame in draws.frames], axis=0))),
        "angles": _angles(accuracy.angles),
        "unknowns": {term.name: _unknown(recording.truth, draws, term) for term in draws.model.unknowns},
        **_agreement(draws),
    }


def mean_markers(draws):
    """Weighted means of the 15 markers in every run and frame (run, frame, 15, 3), metres."""
    by_frame = []
    for frame in draws.frames:
        changes = {name: frame.states[name] for name in draws.model.placing[1:]}
        places = markers(draws.model, frame.states[draws.model.body.variable], **changes)
        weights = np.stack([weights_of(log_weights) for log_weights in frame.log_weights])
        by_frame.append(np.einsum("rn,rnmk->rmk", weights, places))
    names = draws.model.body.markers.names
    return np.stack(by_frame, axis=1)[:, :, [names.index(name) for name in MARKERS]]


def dof_scores(session, draws, names):
    """Distance of the mean from the truth in standard deviations (frame, dof), of the first run's angles of these dofs."""
    columns = [draws.model.body.dof_names.index(name) for name in names]
    poses, scores = true_angles(session, draws.model).poses[:, columns], []
    for frame, true in zip(draws.frames, poses, strict=True):
        weights, values = weights_of(frame.log_weights[0]), np.asarray(frame.states["pose"], float)[0][:, columns]
        mean = weights @ values
        scores.append((mean - true) / np.sqrt(weights @ (values - mean) ** 2))
    return np.array(scores)


def _rms_mm(errors):
    return 1e3 * float(np.sqrt(np.mean(np.sum(np.square(errors), axis=-1))))


def _angles(accuracy):
    """By angle, left and right together: root mean square error, and share inside the 90 % intervals."""
    rows = {}
    for angle in ANGLES:
        columns = [place for place, name in enumerate(accuracy.names) if name.removesuffix("_l").removesuffix("_r") == angle]
        if columns:
            rms = np.sqrt(np.mean(accuracy.error_deg[..., columns] ** 2))
            rows[angle] = {"rms_deg": float(rms), "coverage_90": float(accuracy.coverage[AT_90, columns].mean())}
    return rows


def _agreement(draws):
    """R-hat over the runs: the median frame's largest of the pose, and the largest of an unknown in the last frame."""
    if draws.runs < 2:
        return dict.fromkeys(("rhat_pose", "rhat_pose_max", "rhat_unknowns"), float("nan"))
    last = len(draws.frames) - 1
    unknowns = [frame_rhat(draws.frames[last], last, term.name, term.space) for term in draws.model.unknowns]
    largest = max((float(np.nanmax(values)) for values in unknowns), default=float("nan"))
    by_frame = np.nanmax(rhat(draws), axis=1)
    return {"rhat_pose": float(np.median(by_frame)), "rhat_pose_max": float(by_frame.max()), "rhat_unknowns": largest}


# -- unknowns ---------------------------------------------------------------------------------------------------------------------------


def _unknown(truth, draws, term):
    """By entry, of the last frame, which knows all images: error, standard deviation, and share of the runs whose 90 % interval holds the truth."""
    frame = draws.frames[len(draws.frames) - 1]
    columns, names, true = true_entries(truth, draws.model, term)
    values = np.asarray(frame.states[term.name], float)
    values = (lengths_of(term, values) if term.name == "lengths" else values)[..., columns]
    weights = [weights_of(log_weights) for log_weights in frame.log_weights]
    inside = [inside_intervals(cloud[..., None], row, true[:, None])[AT_90, :, 0] for cloud, row in zip(values, weights, strict=True)]
    means = np.stack([row @ cloud for cloud, row in zip(values, weights, strict=True)])
    variances = [row @ (cloud - mean) ** 2 for cloud, row, mean in zip(values, weights, means, strict=True)]
    error, sd = (means - true).mean(axis=0), np.sqrt(np.mean(variances, axis=0))
    return {"entries": names, "error": error.tolist(), "sd": sd.tolist(), "inside": np.mean(inside, axis=0).tolist()}


def true_entries(truth, model, term):
    """Columns of an unknown (of lengths: of `lengths_of`) whose truth is known, their names, and their true values."""
    if term.name == "lengths":
        names = list(model.definition.body.lengths_of_height)
        # A length that the definition takes as exact is none of the unknowns.
        columns = [place for place, name in enumerate(names) if name.removeprefix("l_") in term.space.labels]
        return columns, [names[place] for place in columns], np.array([truth.lengths_m[names[place]] for place in columns])
    labels = list(term.space.labels)
    if term.name == "cameras":
        table = np.zeros((len(truth.motions), len(labels) // len(truth.motions)))
        table[:, : truth.motions.shape[1]] = truth.motions
        return list(range(len(labels))), labels, table.ravel()
    if term.name == "delays":
        return list(range(len(labels))), labels, truth.delays_s[1:] - truth.delays_s[0]
    if term.name == "keypoint_offsets":
        marker_names = model.body.markers.names
        true = [truth.offsets_m[marker_names.index(label[:-2]), "xyz".index(label[-1])] for label in labels]
        return list(range(len(labels))), labels, np.array(true)
    return [], [], np.zeros(0)
