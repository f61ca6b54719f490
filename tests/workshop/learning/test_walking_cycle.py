"""The walking cycle: learned again it is the one that ships, and what walks by it stands on its feet."""

import itertools

import numpy as np
import pytest
from scipy.signal import find_peaks

from bayes_body.base.errors import InputError
from bayes_body.cli.main import main
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.mocap import landmarks, read_motion
from bayes_body.workshop.learning.gait import ARRAYS, TREE, is_run, learn, points_of, save_cycle, strides
from bayes_body.workshop.learning.walking_cycle import load_cycle, walk

FPS = 60.0
FEET = [f"{side}_{point}" for side in "lr" for point in ("ankle", "toe")]
WALKS = [
    {},
    {"seed": 1},
    {"seed": 2, "speed": 1.2, "height_m": 1.6},
    {"seed": 3, "heading": 2.0, "start": (1.0, -2.0)},
    {"coefficients": [1.5]},
    {"coefficients": [-1.5], "height_m": 1.95},
]


@pytest.fixture(scope="module")
def cycle():
    return load_cycle()


@pytest.fixture(scope="module")
def captured(cmu_mocap):
    """The walks of subject 02, and its run."""
    motions = [(name, read_motion(cmu_mocap / "02" / f"{name}.amc")) for name in ("02_01", "02_02", "02_03")]
    return [(name, landmarks(motion), motion.fps) for name, motion in motions]


def _steps(points):
    """(foot, first, last frame) of each step: between two forward extremes of an ankle, as one sees them in the place of the pelvis."""
    way = (points["pelvis"][-1] - points["pelvis"][0]) * (1, 1, 0)
    way /= np.linalg.norm(way)
    for side in "lr":
        strikes, _ = find_peaks((points[f"{side}_ankle"] - points["pelvis"]) @ way, distance=20, prominence=0.1)
        yield from ((side, a, b) for a, b in itertools.pairwise(strikes))


@pytest.mark.parametrize("options", WALKS, ids=str)
def test_feet_do_not_slide_nor_sink(cycle, options):
    points = walk(cycle, 6.0, FPS, **options)
    steps = list(_steps(points))
    assert len(steps) >= 6
    for side, a, b in steps:
        # Shares of a stride in which the foot is flat on the floor (Perry 1992: from 0.12 to heel off at 0.31).
        toe = points[f"{side}_toe"][a + int(0.14 * (b - a)) : a + int(0.4 * (b - a)), :2]
        ankle = points[f"{side}_ankle"][a + int(0.12 * (b - a)) : a + int(0.31 * (b - a)), :2]
        assert np.linalg.norm(np.ptp(toe, axis=0)) < 0.03
        assert np.linalg.norm(np.ptp(ankle, axis=0)) < 0.03
    lowest = np.min([points[name][:, 2] for name in FEET], axis=0)
    assert lowest.min() > -0.02 and lowest.max() < 0.1


@pytest.mark.parametrize("options", WALKS, ids=str)
def test_bones_keep_their_lengths(cycle, options):
    points = walk(cycle, 4.0, FPS, **options)
    tall = options.get("height_m", 1.75)
    for name, length in zip(cycle.names, cycle.segments, strict=True):
        measured = np.linalg.norm(points[name] - points[TREE[name]], axis=1)
        assert np.ptp(measured) < 1e-9
        assert measured[0] == pytest.approx(length * tall, abs=1e-9)


def test_the_walk_goes_where_it_is_sent(cycle):
    points = walk(cycle, 5.0, FPS, heading=0.7, start=(2.0, 3.0))
    assert points["pelvis"].shape == (300, 3)
    assert set(MARKERS) <= set(points)
    assert np.allclose(points["pelvis"][0, :2], (2.0, 3.0))
    way = points["pelvis"][-1] - points["pelvis"][0]
    assert np.arctan2(way[1], way[0]) == pytest.approx(0.7, abs=0.02)
    # Left is left of the way: up is z.
    across = (points["l_hip"] - points["r_hip"]).mean(axis=0)
    assert np.cross(way / np.linalg.norm(way), across)[2] > 0.1
    assert 1.6 < points["head"][:, 2].mean() < 1.76


def test_speed_makes_strides_follow_faster(cycle):
    slow, fast = (walk(cycle, 6.0, FPS, speed=speed) for speed in (1.0, 1.5))
    ratio = (fast["pelvis"][-1, 0] - fast["pelvis"][0, 0]) / (slow["pelvis"][-1, 0] - slow["pelvis"][0, 0])
    assert ratio == pytest.approx(1.5, abs=0.02)
    # 1.2 to 1.5 m/s is how people walk.
    assert 1.2 < (slow["pelvis"][-1, 0] - slow["pelvis"][0, 0]) / 6.0 < 1.6


def test_seeds_are_walkers(cycle):
    one, again, other, none = (walk(cycle, 3.0, FPS, seed=seed) for seed in (1, 1, 2, None))
    assert all(np.array_equal(one[name], again[name]) for name in one)
    assert np.abs(one["l_knee"] - other["l_knee"]).max() > 0.01
    period = round(np.exp(cycle.pace[0]) * np.sqrt(1.75 / cycle.height_m) * FPS)
    again = np.abs((none["l_wrist"] - none["pelvis"])[period:] - (none["l_wrist"] - none["pelvis"])[:-period])
    assert again.max() < 0.02
    within = np.abs((one["l_wrist"] - one["pelvis"])[period:] - (one["l_wrist"] - one["pelvis"])[:-period])
    assert within.max() > again.max()


def test_a_longer_walk_begins_like_a_shorter_one(cycle):
    short, long = (walk(cycle, seconds, FPS) for seconds in (2.0, 4.0))
    assert np.abs(short["l_ankle"][:, [0, 2]] - long["l_ankle"][:120, [0, 2]]).max() < 1e-9


def test_what_ships_is_what_is_learned(cycle, captured, tmp_path):
    found = learn(captured)
    assert found.strides == 4
    assert found.explained >= 0.95
    assert found.left_out == ("02_03: 2.6 m/s is a run: left out",)
    save_cycle(found.cycle, tmp_path / "again.npz")
    again = load_cycle(tmp_path / "again.npz")
    assert again.names == cycle.names
    for key in ARRAYS[1:]:
        assert np.allclose(getattr(again, key), getattr(cycle, key), atol=2e-4), key
    assert (tmp_path / "again.npz").stat().st_size < 16_000


def test_modes_are_those_of_the_strides(captured):
    walks = captured[:2]
    names = points_of(walks[0][1])
    found = learn(walks).cycle
    rows = np.array([s.series.ravel() for _, points, fps in walks for s in strides(points, names, fps, found.height_m)])
    assert np.abs(rows.mean(axis=0) - found.mean.ravel()).max() < 0.005
    # One standard deviation a mode: together they have the strides' variance.
    assert (found.modes**2).sum() == pytest.approx(rows.var(axis=0, ddof=1).sum(), rel=0.1)


def test_a_run_is_no_walk(captured):
    assert [is_run(points, fps) for _, points, fps in captured] == [False, False, True]
    with pytest.raises(InputError, match=r"0 strides \(02_03: 2.6 m/s is a run: left out\)"):
        learn(captured[2:])


def test_walks_without_ankles_are_left_out(captured):
    name, points, fps = captured[0]
    with pytest.raises(InputError, match="points unknown"):
        learn([(name, {key: each for key, each in points.items() if key != "l_ankle"}, fps)])


@pytest.mark.parametrize("options", [{"seconds": 0.0}, {"fps": float("nan")}, {"speed": -1.0}, {"height_m": 0.0}, {"coefficients": [0.0] * 9}])
def test_numbers_that_are_none_are_sentences(cycle, options):
    with pytest.raises(InputError, match=f"walk: {next(iter(options))}"):
        walk(cycle, **{"seconds": 1.0, "fps": FPS} | options)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"\x93NUMPY"])
def test_a_damaged_cycle_is_a_sentence(tmp_path, content):
    path = tmp_path / "cycle.npz"
    path.write_bytes(content)
    with pytest.raises(InputError, match="learn walking-cycle"):
        load_cycle(path)
    with pytest.raises(InputError, match="no such file"):
        load_cycle(tmp_path / "none.npz")


def test_a_cycle_of_other_shapes_is_a_sentence(tmp_path, cycle):
    path = tmp_path / "cycle.npz"
    save_cycle(cycle, path)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **arrays | {"segments": arrays["segments"][:-1]})
    with pytest.raises(InputError, match="other arrays"):
        load_cycle(path)


def test_the_command_says_where_it_comes_from(captured, cmu_mocap, tmp_path, capsys):
    out = tmp_path / "cycle.npz"
    with pytest.raises(SystemExit) as stopped:
        main(["learn", "walking-cycle", str(cmu_mocap / "02"), "--out", str(out), "--source", "somebody"])
    assert stopped.value.code == 0
    told = out.with_suffix(".toml").read_text()
    assert '"02_01", "02_02"]' in told and 'source = "somebody"' in told
    assert 'command = "bayes-body learn walking-cycle $BAYES_BODY_DATA/cmu_mocap/02 --out cycle.npz"' in told
    assert "02_03: 2.6 m/s is a run" in capsys.readouterr().out
    with pytest.raises(SystemExit) as stopped:
        main(["learn", "walking-cycle", str(tmp_path), "--out", str(tmp_path / "other.npz")])
    assert stopped.value.code == 2
    assert "no captured motion in it" in capsys.readouterr().err
