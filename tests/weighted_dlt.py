"""Weighted triangulation as Pose2Sim does it, restated for comparisons: Pagnon, Domalain & Reveret 2021 and 2022; the original is under BSD-3.

A camera at projection matrix P that sees a point at (u, v) with confidence w gives the rows w (P_1 - u P_3) and w (P_2 - v P_3), which times (X, 1)
are 0. X is the right singular vector of the smallest singular value. If the mean reprojection error is above a threshold, all subsets with one camera
less are tried, then with two less, as long as enough cameras remain, and the one with the smallest error counts. If that is too large, there is no
point. Gaps are interpolated over time, a Hampel filter replaces what is far from its neighbours by their median, and a Butterworth filter runs
forwards and backwards. Settings are the defaults of Pose2Sim's demonstration, but lenses are undistorted. Sides are not swapped.
"""

from itertools import combinations

import numpy as np
from scipy.signal import butter, filtfilt

from bayes_body.recording.readers.keypoints.triangulate import reprojection_errors, undistorted_rays

LARGEST_ERROR_PX, LEAST_CONFIDENCE, FEWEST_CAMERAS = 15.0, 0.3, 2
# Longer gaps are left to the last point before them.
LONGEST_GAP, ORDER, CUT_OFF_HZ = 20, 4, 6.0
# Of the Hampel filter: frames, and how many standard deviations from the median is far, with 0.6745 of one in a median absolute deviation.
WINDOW, FAR, DEVIATION = 7, 2.0, 0.6745


def triangulate_weighted(cameras, keypoints):
    """Points (point, 3), metres, from column, row and confidence (camera, point, 3); NaN where no cameras agree."""
    present = np.isfinite(keypoints).all(axis=-1) & (keypoints[..., 2] >= LEAST_CONFIDENCE)
    rows = np.stack([_rows(camera, points) for camera, points in zip(cameras, keypoints, strict=True)])
    count = keypoints.shape[1]
    points, least = np.full((count, 3), np.nan), np.full(count, np.inf)
    for left_out in range(len(cameras) - FEWEST_CAMERAS + 1):
        open_ = least > LARGEST_ERROR_PX
        candidates, errors = points.copy(), np.full(count, np.inf)
        for subset in combinations(range(len(cameras)), len(cameras) - left_out):
            used = np.isin(np.arange(len(cameras)), subset)[:, None] & present
            # A camera that does not see the point was left out already.
            possible = open_ & (used.sum(axis=0) >= FEWEST_CAMERAS)
            solved = _solved(rows, np.where(used, keypoints[..., 2], 0.0))
            off = np.where(used, reprojection_errors(cameras, solved, keypoints), 0.0).sum(axis=0) / np.maximum(used.sum(axis=0), 1)
            better = possible & (off < errors)
            candidates[better], errors[better] = solved[better], off[better]
        better = errors < np.inf
        points[better], least[better] = candidates[better], errors[better]
    return np.where((least <= LARGEST_ERROR_PX)[:, None], points, np.nan)


def _rows(camera, keypoints):
    """P_1 - u P_3 and P_2 - v P_3 of each point, in pixels."""
    rays = np.nan_to_num(undistorted_rays(camera, keypoints[:, :2].copy()))
    P = np.column_stack([camera.rotation, camera.translation_m])
    return (P[None, :2] - rays[..., None] * P[None, 2:]) * np.array(camera.focal_px)[None, :, None]


def _solved(rows, weights):
    A = (weights[..., None, None] * rows).transpose(1, 0, 2, 3).reshape(rows.shape[1], -1, 4)
    X = np.linalg.svd(A)[2][:, -1]
    return X[:, :3] / np.where(np.abs(X[:, 3:]) < 1e-12, 1e-12, X[:, 3:])


def filter_points(points, fps):
    """Points over time (frame, ...), gaps interpolated and filtered without lag; NaN where a point was never seen."""
    b, a = butter(ORDER / 2, CUT_OFF_HZ / (fps / 2))
    columns = [_without_gaps(column) for column in points.reshape(len(points), -1).T]
    return filtfilt(b, a, _without_outliers(np.stack(columns, axis=1)), axis=0).reshape(points.shape)


def _without_gaps(column):
    known = np.flatnonzero(np.isfinite(column))
    if not len(known):
        return column
    frames = np.arange(len(column))
    before = known[np.maximum(np.searchsorted(known, frames, side="right") - 1, 0)]
    after = known[np.minimum(np.searchsorted(known, frames), len(known) - 1)]
    return np.where(after - before > LONGEST_GAP, column[before], np.interp(frames, known, column[known]))


def _without_outliers(columns):
    windows, half = np.lib.stride_tricks.sliding_window_view(columns, WINDOW, axis=0), WINDOW // 2
    median = np.median(windows, axis=-1)
    spread = np.median(np.abs(windows - median[..., None]), axis=-1)
    inner = columns[half:-half]
    far = DEVIATION * np.abs(inner - median) > FAR * spread
    return np.concatenate([columns[:half], np.where(far & (spread > 0), median, inner), columns[-half:]])
