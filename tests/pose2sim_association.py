"""Association of people as Pose2Sim does it, restated for comparisons: the rules of version 0.9.4 (BSD-3), not its code.

Single person: in every frame, all combinations of one detection of each camera are tried. The tracked keypoint is triangulated; the first combination
with a mean reprojection error below 20 pixels ends the search. If there is none, all are tried with one camera less, and so on down to two, and at
last the best counts. Nothing is carried over from frame to frame. The tracked keypoint is the neck; here the mid of the shoulders.

Several people: the affinity of two detections of different cameras is 1 - d / 0.1 m, not below 0. d is the mean over the keypoints, weighted by the
geometric mean of both confidences, of the reciprocal product of both rays: their distance times the sine of their angle. A matrix of low rank near
the affinities is sought that has 0 between detections of one camera and 1 on the diagonal, with values between 0 and 1: the method of multipliers
with singular value thresholding, as in EasyMocap. Entries below 0.2 are dropped. Each detection proposes the detection with the largest entry in each
camera. Proposals that more detections make come first. What shares a detection with an earlier one is dropped, as is what two cameras do not see.

From frame to frame, the two bodies that are nearest (root of the sum of squares over keypoints) belong together, then the nearest of the remaining
ones. A person who is not seen stays in place. There are as many people as there are proposals in the fullest frame; who is seen in fewer than four
frames is none.
"""

from itertools import combinations, pairwise, product

import numpy as np
from weighted_dlt import triangulate_weighted

from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.keypoints.triangulate import reprojection_errors, triangulate_from_all, undistorted_rays

LARGEST_ERROR_PX, LEAST_CONFIDENCE, FEWEST_CAMERAS = 20.0, 0.3, 2
FARTHEST_M, LEAST_AFFINITY, FEWEST_FRAMES = 0.1, 0.2, 4
# Of the low-rank matrix: the weight of the rank, of sparsity, and of the constraints at first; when it is near enough, and the rounds at most.
RANK, SPARSITY, PENALTY, NEAR, ROUNDS = 50.0, 0.1, 64.0, 1e-4, 20
SHOULDERS = [MARKERS.index(f"{side}_shoulder") for side in "lr"]


def associate_single(cameras, people):
    """The subject's detection of each camera in each frame, (frame, camera); -1 for none."""
    return np.array([_best_combination(cameras, frame) for frame in people])


def _best_combination(cameras, groups):
    """The combination of a frame; cameras in which nobody is detected are left out of all."""
    tracked = [group[:, SHOULDERS].mean(axis=1) if len(group) else np.full((1, 3), np.nan) for group in groups]
    choices = np.array(list(product(*(range(len(points)) for points in tracked))))
    places = np.full(len(cameras), -1)
    for left_out in range(len(cameras) - FEWEST_CAMERAS + 1):
        for choice in choices:
            best, error = None, np.inf
            for out in combinations(range(len(cameras)), left_out):
                points = np.array([tracked[c][k] for c, k in enumerate(choice)])
                points[list(out)] = np.nan
                used = np.isfinite(points).all(axis=1) & (np.nan_to_num(points[:, 2]) >= LEAST_CONFIDENCE)
                if used.sum() < FEWEST_CAMERAS:
                    continue
                points = np.where(used[:, None], points, np.nan)[:, None]
                off = np.nanmean(reprojection_errors(cameras, triangulate_from_all(cameras, points), points))
                if off < error:
                    best, error = np.where(used, choice, -1), off
            if best is not None and error < LARGEST_ERROR_PX:
                return best
            places = places if best is None else best
    return places


def associate_several(cameras, people):
    """Everybody's detection of each camera in each frame, (person, frame, camera); -1 for none."""
    proposals = [_proposals(cameras, frame) for frame in people]
    count = max(map(len, proposals))
    persons, last = np.full((count, len(people), len(cameras)), -1), np.full((count, len(MARKERS), 3), np.nan)
    for frame, rows in enumerate(proposals):
        bodies = np.array([_body(cameras, people[frame], row) for row in rows]).reshape(-1, len(MARKERS), 3)
        for person, k in _nearest_pairs(last, bodies) if frame else ((k, k) for k in range(len(rows))):
            persons[person, frame] = rows[k]
            last[person] = np.where(np.isfinite(bodies[k]), bodies[k], last[person])
    return persons[(persons >= 0).any(axis=2).sum(axis=1) >= FEWEST_FRAMES]


def _body(cameras, groups, row):
    points = np.array([groups[c][k] if k >= 0 else np.full((len(MARKERS), 3), np.nan) for c, k in enumerate(row)])
    return triangulate_weighted(cameras, points)


def _nearest_pairs(before, bodies):
    """Pairs of a person and a body, the nearest first; those without a common keypoint are the farthest."""
    squares = ((before[:, None] - bodies[None]) ** 2).sum(axis=-1)
    distances = np.where(np.isfinite(squares).any(axis=-1), np.sqrt(np.nansum(squares, axis=-1)), np.inf)
    pairs, people, free = [], list(range(len(before))), list(range(len(bodies)))
    while people and free:
        i, j = np.unravel_index(np.argmin(distances[np.ix_(people, free)]), (len(people), len(free)))
        pairs.append((people.pop(int(i)), free.pop(int(j))))
    return pairs


def _proposals(cameras, groups):
    """Rows of detections of the cameras that belong together, -1 for none."""
    ends = np.cumsum([0, *map(len, groups)])
    parts = [slice(start, stop) for start, stop in pairwise(ends)]
    if ends[-1] == 0:
        return np.zeros((0, len(cameras)), int)
    allowed = np.ones((ends[-1], ends[-1]))
    for part in parts:
        allowed[part, part] = 0
    np.fill_diagonal(allowed, 1)
    near = _low_rank(_affinities(cameras, groups, parts) * allowed, allowed)
    near[near < LEAST_AFFINITY] = 0
    rows = [[int(row[part].argmax()) if row[part].max(initial=0.0) > 0 else -1 for part in parts] for row in near]
    unique, counts = np.unique(rows, axis=0, return_counts=True)
    ranked = unique[np.argsort(counts)[::-1]]
    new = [row for i, row in enumerate(ranked) if not any(((row == other) & (row >= 0)).any() for other in ranked[:i])]
    return np.array([row for row in new if (row >= 0).sum() >= FEWEST_CAMERAS], int).reshape(-1, len(cameras))


def _affinities(cameras, groups, parts):
    count = parts[-1].stop
    distances = np.full((count, count), 2 * FARTHEST_M)
    rays = [_rays(camera, group) for camera, group in zip(cameras, groups, strict=True)]
    for a, b in combinations(range(len(cameras)), 2):
        (along, moment, sure), (along_too, moment_too, sure_too) = rays[a], rays[b]
        reciprocal = (along[:, None] * moment_too[None]).sum(axis=-1) + (moment[:, None] * along_too[None]).sum(axis=-1)
        weight = np.sqrt(sure[:, None] * sure_too[None])
        mean = (np.abs(reciprocal) * weight).sum(axis=-1) / (1e-5 + weight.sum(axis=-1))
        distances[parts[a], parts[b]], distances[parts[b], parts[a]] = mean, mean.T
    return 1 - np.minimum(distances, FARTHEST_M) / FARTHEST_M


def _rays(camera, group):
    """Directions and moments of the keypoints' rays in the world, and confidences; all 0 for what is not seen."""
    xy = undistorted_rays(camera, group[..., :2].reshape(-1, 2).copy()).reshape(*group.shape[:2], 2)
    along = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=-1) @ camera.rotation
    along /= np.linalg.norm(along, axis=-1, keepdims=True)
    moment = np.cross(-camera.rotation.T @ camera.translation_m, along)
    seen = np.isfinite(xy).all(axis=-1)
    return np.where(seen[..., None], along, 0.0), np.where(seen[..., None], moment, 0.0), np.where(seen, group[..., 2], 0.0)


def _low_rank(affinities, allowed):
    count, penalty = len(affinities), PENALTY
    matrix = affinities * (1 - np.eye(count))
    multipliers, pull = np.zeros_like(matrix), SPARSITY - matrix
    for _ in range(ROUNDS):
        previous = matrix
        left, values, right = np.linalg.svd(matrix + multipliers / penalty)
        low = left * np.maximum(values - RANK / penalty, 0) @ right
        matrix = low - (pull + multipliers) / penalty
        np.fill_diagonal(matrix, 1)
        matrix = np.clip(matrix * allowed, 0, 1)
        matrix = (matrix + matrix.T) / 2
        multipliers = multipliers + penalty * (matrix - low)
        primal, dual = np.linalg.norm(matrix - low) / count, penalty * np.linalg.norm(matrix - previous) / count
        if primal < NEAR and dual < NEAR:
            break
        penalty *= 2.0 if primal > 10 * dual else 0.5 if dual > 10 * primal else 1.0
    return matrix
