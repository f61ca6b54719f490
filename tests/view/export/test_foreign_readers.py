"""Exported files, opened by readers of other projects (tests/bench/foreign_readers.py): the numbers of the CSV file, missing points, many frames."""

from importlib.util import find_spec

import ezc3d
import numpy as np
import pandas as pd
import pytest
from bench.foreign_readers import c3d_points, differences, differences_by_opensim, opensim_in

from bayes_body.base.errors import InputError
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.export.c3d import write_c3d
from bayes_body.view.export.motion import Motion
from bayes_body.view.export.trc import write_trc

OPENSIM = pytest.mark.skipif(find_spec("opensim") is None, reason="opensim (70 MB) is not installed: `uv pip install opensim`")


@pytest.fixture
def run(make_run):
    """A person who bends every joint. The draws differ little, so that a mean of angles is the angle of a mean."""
    rng = np.random.default_rng(8)
    poses = rng.uniform(-0.5, 0.5, (9, 35))
    poses[:, 2] += 0.9
    return make_run(model="keypoints", frames=9, pose=poses + rng.normal(0, 5e-4, (2, 30, 9, 35)))


def largest(rows):
    """By format and reader: the largest differences in mm, degrees and seconds; 0 where a row has none."""
    figures = {}
    for row in rows:
        name = f"{row.format} by {row.reader}"
        figures[name] = np.maximum(figures.get(name, 0), np.nan_to_num(row[3:]))
    return figures


@pytest.mark.slow
def test_the_numbers_of_the_csv(run, tmp_path):
    figures = largest(differences(run, tmp_path))
    # The CSV has 0.001 mm, 1e-6 degrees and 1e-6 s; a C3D residual has steps of 0.01 or 0.02 mm here, and bvhio 32 bits.
    bars = {
        "npz by numpy": (6e-4, 6e-7),
        "trc by pandas": (1.1e-3, 0),
        "c3d by c3d": (0.011, 0),
        "c3d by ezc3d": (1.1e-3, 0),
        "bvh by bvhio": (3e-3, 3e-4),
    }
    assert figures.keys() == bars.keys()
    for name, (mm, degrees) in bars.items():
        assert (figures[name] <= (mm, degrees, 1.1e-6)).all(), f"{name}: {figures[name]}"


@OPENSIM
@pytest.mark.long
def test_the_numbers_of_the_csv_by_opensim(run, tmp_path):
    figures = largest(differences_by_opensim(run, tmp_path))
    trc = (1.1e-3, 0, 1.1e-6)
    # The orientation of the pelvis is a mean of other angles than those of the dofs.
    bars = {"trc by opensim, TimeSeriesTableVec3": trc, "trc by opensim, MarkerData": trc, "mot by opensim": (6e-4, 1e-3, 1.1e-6)}
    assert figures.keys() == bars.keys()
    for name, bar in bars.items():
        assert (figures[name] <= bar).all(), f"{name}: {figures[name]}"


def motion_of(frames, missing=()):
    """A motion of three markers; `missing`: (frame, marker, axis)."""
    rng = np.random.default_rng(2)
    mean, sd = rng.normal(size=(frames, 3, 3)), rng.uniform(0.002, 0.02, (frames, 3, 3))
    for place in missing:
        mean[place] = np.nan
    none = Moments(*np.zeros((4, frames, 0)))
    return Motion("walk", 59.94, "y", ("a", "b", "c"), Moments(mean, sd, mean - sd, mean + sd), (), (), none, np.zeros(frames, bool), None)


GAPS = ((1, 0, 0), (2, 2, 1), (3, 1, 2))


def test_missing_points_in_c3d(tmp_path):
    motion, path = motion_of(5, GAPS), tmp_path / "walk.c3d"
    write_c3d(motion, path, spread=True)
    expected = np.isnan(motion.markers.mean).any(axis=-1)
    _, points, _ = c3d_points(path)
    residuals, cameras = points[..., 3], points[..., 4]
    # A missing mean has no quantiles, but a standard deviation here. No camera is said to have seen the others.
    assert np.array_equal(residuals == -1, np.concatenate([expected, 0 * expected, expected, expected], axis=1)) and not cameras[residuals >= 0].any()
    assert np.array_equal(np.isnan(ezc3d.c3d(str(path))["data"]["points"][0, :3].T), expected)
    sd = 1000 * np.sqrt((motion.markers.sd**2).mean(axis=-1))
    assert np.abs(residuals[:, :3] - sd)[~expected].max() < 0.51 * (sd.max() / 126 + 0.01)
    assert np.abs(points[:, :3, :3] - 1000 * motion.markers.mean)[~expected].max() < 1e-3


def test_a_motion_without_any_point_is_written(tmp_path):
    motion, path = motion_of(5), tmp_path / "walk.c3d"
    motion.markers.mean[:], motion.markers.sd[:] = np.nan, np.nan
    write_c3d(motion, path)
    assert (c3d_points(path)[1][..., 3] == -1).all()


def test_missing_points_in_trc(tmp_path):
    """OpenSim's readers take `nan`. Empty cells they refuse at the end of a row."""
    motion, path = motion_of(5, GAPS), tmp_path / "walk.trc"
    write_trc(motion, path)
    rows = pd.read_csv(path, sep="\t", skiprows=4).iloc[:, 2:].to_numpy().reshape(5, 3, 3)
    assert np.array_equal(np.isnan(rows), np.isnan(motion.markers.mean))


@OPENSIM
@pytest.mark.long
def test_missing_points_in_trc_by_opensim(tmp_path):
    opensim = opensim_in(tmp_path)
    motion, path = motion_of(5, GAPS), tmp_path / "walk.trc"
    write_trc(motion, path)
    table, data = opensim.TimeSeriesTableVec3(str(path)), opensim.MarkerData(str(path))
    for f, m, a in np.ndindex(5, 3, 3):
        for value in (table.getRowAtIndex(f)[m][a], data.getFrame(f).getMarker(m)[a]):
            assert np.isnan(value) == np.isnan(motion.markers.mean[f, m, a]), (f, m, a)


@pytest.mark.slow
def test_more_frames_than_16_bits_with_a_sign(tmp_path):
    motion, path = motion_of(33_000), tmp_path / "walk.c3d"
    write_c3d(motion, path)
    _, points, rate = c3d_points(path)
    assert len(points) == 33_000 and np.isclose(rate, 59.94) and np.abs(points[..., :3] - 1000 * motion.markers.mean).max() < 1e-3


def test_more_frames_than_the_format_counts(tmp_path):
    with pytest.raises(InputError, match="--to c3d: 65536 frames; expected at most 65535, the format's limit; choose npz, csv or trc"):
        write_c3d(motion_of(65_536), tmp_path / "walk.c3d")
    assert not list(tmp_path.iterdir())
