"""A real walk in one camera: the hybrid Monte Carlo filter keeps both legs through a crossing, and the particle filter at equal time beside it.

The video is a woman who walks from right to left, in profile, on grass. The first pose and the joints of later frames were clicked once, on the
enlarged pictures; columns and rows.
"""

import cv2
import jax
import numpy as np
import pytest

import bayes_body as bb
from bayes_body.cli.main import main
from bayes_body.posterior.weighted import markers

FIRST, FRAMES = 60, 29
CLICKED = {
    "pelvis": (1418, 745), "thorax": (1420, 612), "l_hip": (1424, 747), "l_knee": (1452, 838), "l_ankle": (1487, 918),
    "r_hip": (1412, 743), "r_knee": (1346, 822), "r_ankle": (1318, 908),
}  # fmt: skip
# By number from the first: the legs have crossed between frame 8 and frame 14.
LATER = {
    16: {"l_knee": (1212, 802), "l_ankle": (1195, 898), "r_knee": (1280, 814), "r_ankle": (1307, 906)},
    24: {"l_knee": (1146, 806), "l_ankle": (1141, 910), "r_knee": (1210, 814), "r_ankle": (1288, 890)},
}


@pytest.fixture(scope="module")
def session(sports2d_walk, tmp_path_factory):
    """As a user makes it: imported, the clicked keypoints written into its file."""
    folder = tmp_path_factory.mktemp("walk")
    with pytest.raises(SystemExit, match="0"):
        main(["import", "pose2sim", str(sports2d_walk), str(folder), "--up", "z", "--height", "1.65", "--offset", f"demo={FIRST}"])
    path, clicked = folder / "session.toml", "\n".join(f"{name} = [{u}, {v}, 1]" for name, (u, v) in CLICKED.items())
    before, after = path.read_text(encoding="utf-8").split("[[camera]]")
    path.write_text(f"{before}[initial.keypoints_px.demo]\n{clicked}\n\n[[camera]]{after}", encoding="utf-8")
    return bb.load_session(folder)


@pytest.fixture(scope="module")
def model(session):
    return bb.with_first_pose(bb.load_model("hmc_walker", session), session)


def _off(session, model, draws, frame):
    """How far the mean pose's joints are from the clicked ones, by name, pixels."""
    camera, result = session.views[0].camera, draws.frames[frame]
    pose = _mean(result)
    matrix = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    turned, _ = cv2.Rodrigues(np.asarray(camera.rotation, float))
    pixels, _ = cv2.projectPoints(markers(model, pose)[:, None].astype(float), turned, np.asarray(camera.translation_m, float), matrix, None)
    at = dict(zip(model.body.markers.names, pixels[:, 0], strict=True))
    return {name: float(np.linalg.norm(at[name] - place)) for name, place in ({0: CLICKED} | LATER)[frame].items()}


KERNELS = {
    "hmc": (lambda model: bb.kernels.hmc(**model.definition.kernel.options.model_dump()), 400),
    "sir": (lambda _: bb.kernels.sir(), 40_000),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", KERNELS)
def test_both_legs_are_kept_through_a_crossing(session, model, name):
    make, particles = KERNELS[name]
    draws = bb.track(session, model, make(model), jax.random.key(0), particles=particles, frames=FRAMES)
    # A calf is 25 pixels thick, a thigh 35; what foreshortens a calf is the hardest to tell.
    for frame, most in ((0, 15), (16, 40), (24, 70)):
        off = _off(session, model, draws, frame)
        assert max(off.values()) < most, f"frame {frame}: {off}"
    knees = {side: np.degrees([_mean(f)[model.body.dof_names.index(f"{side}_knee")] for f in draws.frames]) for side in "lr"}
    # The left leg swings past the right one and is then stood on, while the right one begins to bend.
    assert knees["l"][9:15].min() < -50 and knees["l"][18] > -30 and knees["r"][9:15].min() > -35 and knees["r"][26] < -25


def _mean(result):
    return np.exp(result.log_weights[0]) @ result.states["pose"][0]
