"""A real walk in one camera: the hybrid Monte Carlo filter keeps both legs through six crossings, and the particle filter beside it.

The video is a woman who walks from right to left, in profile, on grass and past a wall. The first pose and the joints of later frames were clicked
once, on the enlarged pictures; columns and rows.
"""

import cv2
import jax
import numpy as np
import pytest

import bayes_body as bb
from bayes_body.cli.main import main
from bayes_body.results.posterior.weighted import markers

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("optimised")]

FIRST, FRAMES = 60, 121
CLICKED = {
    "pelvis": (1418, 745), "thorax": (1420, 612), "l_hip": (1424, 747), "l_knee": (1452, 838), "l_ankle": (1487, 918),
    "r_hip": (1412, 743), "r_knee": (1346, 822), "r_ankle": (1318, 908),
}  # fmt: skip
# By number from the first, between one crossing of the legs and the next; they cross near frames 10, 30, 48, 66, 84, 102 and 120.
LATER = {
    16: {"l_knee": (1212, 802), "l_ankle": (1195, 898), "r_knee": (1280, 814), "r_ankle": (1307, 906)},
    24: {"l_knee": (1146, 806), "l_ankle": (1141, 910), "r_knee": (1210, 814), "r_ankle": (1288, 890)},
    39: {"l_knee": (1071, 820), "l_ankle": (1133, 903), "r_knee": (981, 820), "r_ankle": (962, 904)},
    57: {"l_knee": (797, 820), "l_ankle": (774, 906), "r_knee": (909, 817), "r_ankle": (956, 900)},
    75: {"l_knee": (704, 814), "l_ankle": (767, 900), "r_knee": (616, 820), "r_ankle": (594, 906)},
    93: {"l_knee": (433, 822), "l_ankle": (412, 909), "r_knee": (530, 821), "r_ankle": (578, 902)},
    111: {"l_knee": (333, 825), "l_ankle": (391, 912), "r_knee": (259, 819), "r_ankle": (216, 912)},
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
    return bb.load_model("walker_from_the_side", session)


def _off(session, model, draws, frame):
    """How far the mean pose's joints are from the clicked ones, by name, pixels."""
    camera, result = session.views[0].camera, draws.frames[frame]
    pose = _mean(result)
    matrix = np.array([[camera.focal_px[0], 0, camera.centre_px[0]], [0, camera.focal_px[1], camera.centre_px[1]], [0, 0, 1]])
    turned, _ = cv2.Rodrigues(np.asarray(camera.rotation, float))
    pixels, _ = cv2.projectPoints(markers(model, pose)[:, None].astype(float), turned, np.asarray(camera.translation_m, float), matrix, None)
    at = dict(zip(model.body.markers.names, pixels[:, 0], strict=True))
    return {name: float(np.linalg.norm(at[name] - place)) for name, place in ({0: CLICKED} | LATER)[frame].items()}


@pytest.fixture(scope="module")
def by_hmc(session, model):
    return bb.track(jax.random.key(0), session, model, particles=400, frames=FRAMES)


def test_both_legs_are_kept_through_all_crossings(session, model, by_hmc):
    # A calf is 25 pixels thick, a thigh 35; a leg that is taken for the other one is 100 and more away.
    for frame in (0, *LATER):
        off = _off(session, model, by_hmc, frame)
        assert max(off.values()) < 45, f"frame {frame}: {off}"


def test_the_knees_bend_as_those_of_a_walker(model, by_hmc):
    poses = np.degrees([_mean(frame) for frame in by_hmc.frames])
    for side in "lr":
        knee = poses[:, model.body.dof_names.index(f"{side}_knee")]
        period, share = _periodic(knee)
        # A stride takes 1.2 s; the knee of the leg that swings bends by 60 degrees (Winter 1991).
        assert 33 <= period <= 39 and share > 0.5, (side, period, share)
        swings = [knee[start : start + 36].min() for start in range(0, FRAMES - 36, 36)]
        assert all(-80 < deepest < -40 for deepest in swings), swings


def test_the_particle_filter_keeps_them_too_given_half_as_much_time_again(session, model):
    # At equal time, with 20 000 particles, one run of three lost a leg for some frames.
    draws = bb.track(jax.random.key(0), session, model, bb.kernels.sir(), particles=32_000, frames=58)
    for frame in (0, 16, 24, 39, 57):
        off = _off(session, model, draws, frame)
        assert max(off.values()) < 45, f"frame {frame}: {off}"


def _periodic(curve):
    """The period of 20 to 60 frames whose wave and half wave explain most of a curve's variance, and what share of it."""
    frames, shares = np.arange(len(curve)), {}
    for period in range(20, 61):
        turns = 2 * np.pi * np.outer(frames, [1, 2]) / period
        waves = np.hstack([np.ones((len(curve), 1)), np.sin(turns), np.cos(turns)])
        left = curve - waves @ np.linalg.lstsq(waves, curve)[0]
        shares[period] = 1 - left.var() / curve.var()
    best = max(shares, key=shares.__getitem__)
    return best, shares[best]


def _mean(result):
    return np.exp(result.log_weights[0]) @ result.states["pose"][0]
