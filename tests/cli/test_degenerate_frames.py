"""Frames that say little or nothing: the run names them, goes on from its prediction, and counts them."""

import json

import cv2
import numpy as np
import pytest
import xarray as xr
from resume.looped import link_looped

from bayes_body.cli.main import main

FRAMES, GAP, BLACK = 32, range(5, 25), 28


@pytest.fixture(scope="module")
def troubled(textured_session, tmp_path_factory):
    """Camera b is missing for twenty frames, and in one frame both images are black."""
    folder = link_looped(textured_session, tmp_path_factory.mktemp("troubled") / "session", FRAMES)
    for frame in GAP:
        (folder / "view1" / f"image{frame:06d}.png").unlink()
    for view in ("view0", "view1"):
        path = folder / view / f"image{BLACK:06d}.png"
        shape = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).shape
        path.unlink()
        cv2.imwrite(str(path), np.zeros(shape, np.uint8))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["sir", *(pytest.param(kernel, marks=pytest.mark.long) for kernel in ("annealed", "tempered"))])
def test_a_run_goes_on_over_what_it_cannot_see(troubled, tmp_path, capsys, kernel):
    with pytest.raises(SystemExit) as stopped:
        main(["track", str(troubled), "--model", "arm", "--kernel", kernel, "--particles", "100", "--out", str(tmp_path / "run")])
    said = capsys.readouterr()
    assert stopped.value.code == 0, said.err
    assert "camera 'b': 20 of 32 images are missing (frames 5-24)" in said.out
    assert "camera b in frames 5-24, 28" in said.out
    assert f"frame {BLACK}: lost" in said.out
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["frames"], summary["frames_lost"]) == (FRAMES, 1)
    tree = xr.open_datatree(tmp_path / "run" / "posterior.nc")
    pose, lost = tree["posterior"]["pose"], tree["filter"]["lost"].values[0]
    assert np.isfinite(pose).all()
    assert np.flatnonzero(lost).tolist() == [BLACK]
    assert tree["filter"]["seen"].sel(camera="b").values.sum() == FRAMES - len(GAP) - 1
    # On the black frame all particles count the same: nothing but the prediction speaks.
    weights = tree["sample_stats"]["log_weight"].isel(chain=0)
    assert np.ptp(weights.sel(frame=BLACK).values) < 1e-4
    assert np.ptp(weights.sel(frame=BLACK - 1).values) > 0.1
