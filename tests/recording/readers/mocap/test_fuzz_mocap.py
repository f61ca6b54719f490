"""Damaged files of motion capture: whatever is done to a file, its reader gives a motion or says what is wrong, and does so soon."""

import numpy as np
import pytest
from recording.readers.mocap.conftest import AMC, ASF, BVH
from recording.readers.test_fuzz_readers import Reader, torture

from bayes_body.recording.readers.mocap import read_motion

QUICK, MANY = 200, 10_000


@pytest.fixture
def readers(c3d, trc, points):
    """By kind: a valid file, and how it is read."""
    few = {"names": points[0][:5], "positions": points[1][:6, :5]}

    def amc(path):
        path.with_suffix(".asf").write_text(ASF)
        return finite(read_motion(path))

    def asf(path):
        path.with_suffix(".amc").write_text(AMC)
        return finite(read_motion(path.with_suffix(".amc"), skeleton=path))

    return {
        "amc": Reader("a.amc", AMC.encode(), amc),
        "asf": Reader("a.asf", ASF.encode(), asf),
        "bvh": Reader("a.bvh", BVH.encode(), lambda path: finite(read_motion(path))),
        "c3d": Reader("a.c3d", c3d(**few).read_bytes(), read_motion),
        "trc": Reader("a.trc", trc(**few).read_bytes(), read_motion),
    }


def finite(motion):
    """Skeletons have no gaps, and their rotations are rotations."""
    assert np.isfinite(motion.positions_m).all()
    assert np.allclose(motion.rotations @ np.swapaxes(motion.rotations, -1, -2), np.eye(3), atol=1e-6)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["amc", "asf", "bvh", "c3d", "trc"])
def test_some_damaged_files(readers, kind, tmp_path):
    assert torture(readers[kind], tmp_path, QUICK, 1) > QUICK / 10


@pytest.mark.long
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", ["amc", "asf", "bvh", "c3d", "trc"])
def test_many_damaged_files(readers, kind, tmp_path):
    assert torture(readers[kind], tmp_path, MANY, 2) > MANY / 10
