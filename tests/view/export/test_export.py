"""Exports read back by other means than they were written: units, rates, axes and values."""

import csv
import json

import ezc3d
import numpy as np
import pytest
from sealed import seal

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.mocap.c3d import open_c3d
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.export import motion as motions
from bayes_body.view.export.formats import export, export_formats, formats_in, targets
from bayes_body.view.export.motion import read_motion

MARKERS = ("l_shoulder", "l_elbow", "l_wrist")
MOMENTS = ("mean", "sd", "q05", "q95")


def read_trc(path):
    """As OpenSim does: by the names of line 2 and the places of line 4; returns the header, times, and positions by marker."""
    lines = path.read_text(encoding="utf-8").splitlines()
    assert lines[0].split("\t") == ["PathFileType", "4", "(X/Y/Z)", path.name]
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    names = lines[3].split("\t")
    assert names[:2] == ["Frame#", "Time"] and lines[4].split("\t")[2:] == [f"{a}{m}" for m in (1, 2, 3) for a in "XYZ"]
    rows = np.array([[float(cell) for cell in line.split("\t")] for line in lines[5:] if line])
    assert rows.shape[1] == len(names)
    assert np.array_equal(rows[:, 0], np.arange(1, len(rows) + 1))
    return header, rows[:, 1], {name: rows[:, place : place + 3] for place, name in enumerate(names) if place > 1 and name}


@pytest.fixture
def written(make_run, tmp_path):
    """`written("trc", up="y")`: the motion, and the file that holds it."""

    def call(name, *, run=None, **options):
        out = tmp_path / "out" / f"arm.{name}"
        with load_run(run or make_run()) as saved:
            return export(saved, name, out, **options), out

    return call


def test_trc(written):
    motion, path = written("trc")
    for moment in MOMENTS:
        header, times, positions = read_trc(path if moment == "mean" else path.with_stem(f"arm_{moment}"))
        assert header["Units"] == "mm" and header["NumFrames"] == "5" and header["NumMarkers"] == "3"
        assert header["DataRate"] == header["CameraRate"] == header["OrigDataRate"] == "60"
        assert np.allclose(times, np.arange(5) / 60, atol=5e-7)
        assert tuple(positions) == MARKERS
        for m, marker in enumerate(MARKERS):
            assert np.abs(positions[marker] - 1000 * getattr(motion.markers, moment)[:, m]).max() < 5.1e-4


def residuals_of(path):
    """By the format's description, with a reader that shares nothing with ezc3d: residuals (frame, point), mm, and the step."""
    content, parameters = open_c3d(path, path.read_bytes())
    header = content.values("u2", 0, 12)
    points, frames, start = int(header[1]), int(header[4] - header[3]) + 1, int(header[8])
    (scale,) = content.values("f4", 12, 1)
    # The header and the parameter agree; negative: the data are floats.
    assert scale == parameters["POINT:SCALE"] < 0
    words = content.values("f4", 512 * (start - 1), 4 * points * frames).reshape(frames, points, 4)[..., 3]
    assert np.array_equal(words, words.astype(int)) and words.min() >= 0
    # No camera measured these points.
    assert not (words.astype(int) >> 8).any()
    return (words.astype(int) & 255) * -scale, -scale


def test_c3d_has_the_means_and_their_residuals_and_no_other_points(written):
    motion, path = written("c3d")
    c3d = ezc3d.c3d(str(path))
    assert c3d["parameters"]["POINT"]["LABELS"]["value"] == [*MARKERS] and c3d["data"]["points"].shape == (4, 3, 5)
    assert "EVENT" not in c3d["parameters"] and [each.name for each in path.parent.iterdir()] == ["arm.c3d"]
    residuals, step = residuals_of(path)
    assert np.abs(residuals - 1000 * np.sqrt((motion.markers.sd**2).mean(axis=-1))).max() < 0.51 * step


def test_c3d_with_the_spread(written):
    motion, path = written("c3d", spread=True)
    c3d = ezc3d.c3d(str(path))
    points = c3d["parameters"]["POINT"]
    assert points["UNITS"]["value"] == ["mm"] and points["RATE"]["value"] == [60.0] and c3d["parameters"]["ANALOG"]["USED"]["value"] == [0]
    assert points["LABELS"]["value"] == [*MARKERS, *(f"{marker}_{moment}" for moment in MOMENTS[1:] for marker in MARKERS)]
    assert points["Y_SCREEN"]["value"] == ["+Z"] and "standard deviation" in points["DESCRIPTIONS"]["value"][3]
    data = c3d["data"]["points"]
    assert data.shape == (4, 12, 5)
    for k, moment in enumerate(MOMENTS):
        expected = (1000 * getattr(motion.markers, moment)).astype(np.float32)
        assert np.array_equal(data[:3, 3 * k : 3 * k + 3].transpose(2, 1, 0).astype(np.float32), expected)
    residuals, step = residuals_of(path)
    sd = 1000 * np.sqrt((motion.markers.sd**2).mean(axis=-1))
    # The largest uses the seven bits that there are.
    assert np.abs(residuals[:, :3] - sd).max() < 0.51 * step and step < sd.max() / 126 + 0.01
    assert not residuals[:, 3:].any()


def test_npz(written):
    motion, path = written("npz")
    with np.load(path) as arrays:
        assert tuple(arrays["marker_names"]) == MARKERS and tuple(arrays["angle_names"]) == motion.dof_names and arrays["shift_names"].size == 0
        assert arrays["fps"] == 60 and arrays["up"] == "z" and np.array_equal(arrays["frame"], np.arange(5))
        assert np.array_equal(arrays["time_s"], np.arange(5) / 60) and not arrays["lost"].any()
        for moment in MOMENTS:
            assert np.array_equal(arrays[f"marker_{moment}_m"], getattr(motion.markers, moment))
            assert np.array_equal(arrays[f"angle_{moment}_deg"], getattr(motion.dofs, moment))


def test_csv(written, make_run):
    lost = np.zeros((2, 5), bool)
    lost[1, 3] = True
    run = make_run(lost=lost)
    # The body is off the person in frame 1.
    (run / "summary.json").write_text(json.dumps({"frames_off": [1]}), encoding="utf-8")
    seal(run)
    motion, path = written("csv", run=run)
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["lost"] for row in rows] == ["0", "1", "0", "1", "0"] and [row["frame"] for row in rows] == list("01234")
    # The last nine are the axes of the three angles of the shoulder, the arm's root.
    assert len(rows[0]) == 3 + 4 * (9 + 4 + 1) + 9

    def column(name):
        return np.array([float(row[name]) for row in rows])

    for moment in MOMENTS:
        assert np.abs(column(f"l_wrist_y_{moment}_m") - getattr(motion.markers, moment)[:, 2, 1]).max() < 5.1e-7
        assert np.abs(column(f"elbow_{moment}_deg") - getattr(motion.dofs, moment)[:, 3]).max() < 5.1e-7


@pytest.fixture
def sought(make_run):
    """A run of a mode seeker: it estimates no evidence."""
    return make_run(log_evidence=np.full((2, 5), np.nan))


def test_a_mode_seeker_s_csv_has_means_only(written, sought):
    motion, path = written("csv", run=sought)
    with path.open(encoding="utf-8", newline="") as file:
        header = next(csv.reader(file))
    assert not motion.has_intervals and len(header) == 3 + 9 + 4 + 1 + 9
    assert all(name.split("_")[-2] == "mean" for name in header[3:] if "_axis_" not in name)


def test_a_mode_seeker_s_npz_has_means_only(written, sought):
    _, path = written("npz", run=sought)
    with np.load(path) as arrays:
        values = {name for name in arrays if name.startswith(("marker_", "angle_", "shift_", "clinical_")) and not name.endswith(("names", "axes"))}
    assert values == {"marker_mean_m", "angle_mean_deg", "shift_mean_m", "clinical_mean_deg"}


def test_a_mode_seeker_s_trc_is_one_file(written, sought):
    _, path = written("trc", run=sought)
    assert [each.name for each in path.parent.iterdir()] == ["arm.trc"]


def test_a_mode_seeker_s_c3d_has_no_residuals(written, sought):
    _, path = written("c3d", run=sought, spread=True)
    c3d = ezc3d.c3d(str(path))
    assert c3d["data"]["points"].shape == (4, 3, 5) and not residuals_of(path)[0].any()
    assert "without uncertainty" in c3d["parameters"]["POINT"]["DESCRIPTIONS"]["value"][0]


def test_angles_are_degrees(make_run):
    pose = np.zeros((2, 30, 5, 4))
    pose[..., 3] = -np.pi / 2
    with load_run(make_run(pose=pose)) as run:
        motion = read_motion(run)
    assert np.allclose(motion.dofs.mean, [0, 0, 0, -90]) and np.allclose(motion.dofs.sd, 0, atol=1e-9) and set(motion.dof_units) == {"deg"}


@pytest.mark.parametrize(("given", "wanted"), [("z", "y"), ("y", "z"), ("z", "x"), ("x", "y"), ("z", "z")])
def test_the_world_is_turned_not_mirrored(make_run, given, wanted):
    with load_run(make_run(up=given)) as run:
        before, after = read_motion(run), read_motion(run, up=wanted)
    assert after.up == wanted
    axes = {"x": 0, "y": 1, "z": 2}
    assert np.array_equal(after.markers.mean[..., axes[wanted]], before.markers.mean[..., axes[given]])
    for moment in MOMENTS:
        assert np.array_equal(np.sort(getattr(before.markers, moment)), np.sort(getattr(after.markers, moment)))
    # Three vectors span the same signed volume: no reflection.
    arms = [(motion.markers.mean[:, 1:] - motion.markers.mean[:, :1]).reshape(-1, 3)[[0, 1, 3]] for motion in (before, after)]
    assert np.isclose(np.linalg.det(arms[0]), np.linalg.det(arms[1])) and abs(np.linalg.det(arms[0])) > 1e-9


def test_a_rate_of_one_s_own_renames_the_times_and_nothing_else(written):
    motion, path = written("trc", fps=59.94)
    header, times, _ = read_trc(path)
    assert header["DataRate"] == "59.94" and motion.frames == 5 and np.isclose(times[4], 4 / 59.94, atol=5e-7)


def test_what_is_there_is_not_replaced_unasked(make_run, tmp_path):
    out = tmp_path / "arm.trc"
    with load_run(make_run()) as run:
        # One of the four files is enough.
        (tmp_path / "arm_sd.trc").write_text("mine")
        with pytest.raises(InputError, match=r"arm_sd.trc: already exists; .* --overwrite"):
            export(run, "trc", out)
        assert not out.exists() and (tmp_path / "arm_sd.trc").read_text() == "mine"
        export(run, "trc", out, overwrite=True)
        assert read_trc(out)[0]["NumMarkers"] == "3"


@pytest.mark.parametrize("name", ["trc", "csv", "npz", "c3d"])
def test_a_file_that_cannot_be_written_is_a_sentence(make_run, tmp_path, name):
    (tmp_path / "file").write_text("mine")
    with load_run(make_run()) as run:
        with pytest.raises(InputError, match=r"cannot be made"):
            export(run, name, tmp_path / "file" / f"arm.{name}")
        with pytest.raises(InputError, match=r"cannot be written \(File name too long\)"):
            export(run, name, tmp_path / f"{'a' * 260}.{name}")
        with pytest.raises(InputError, match=r"a folder; expected the name of a file"):
            export(run, name, tmp_path)


def test_a_format_that_does_not_exist(make_run, tmp_path):
    said = r"--to: format 'cd3' does not exist; did you mean 'c3d'\? Known: bvh, c3d, csv, mot, npz, trc\."
    with load_run(make_run()) as run, pytest.raises(InputError, match=said):
        export(run, "cd3", tmp_path / "arm.cd3")
    with pytest.raises(InputError, match=r"--to: format '' does not exist"):
        formats_in("mot,")


def test_a_list_of_formats_has_one_name_for_all_files(tmp_path):
    names = formats_in("mot, csv,mot,c3d")
    assert names == ("mot", "csv", "c3d")
    run, out = tmp_path / "run", tmp_path / "walk.1"
    assert targets(names, None, run) == {name: run / f"motion.{name}" for name in names}
    assert targets(names, tmp_path, run) == {name: tmp_path / f"motion.{name}" for name in names}
    # A name may have dots.
    assert targets(names, out, run) == {name: tmp_path / f"walk.1.{name}" for name in names}
    assert targets(("csv",), out, run) == {"csv": out}
    with pytest.raises(InputError, match=r"--out: .*walk\.csv for 3 formats; expected a name without an ending, or a folder; give --out .*walk,"):
        targets(names, tmp_path / "walk.csv", run)


def test_a_long_run_is_written_in_blocks_of_frames(make_run, tmp_path, monkeypatch):
    texts, arrays, folder = [], [], make_run()
    for frames in (5, 2):
        monkeypatch.setattr(motions, "FRAMES_AT_ONCE", frames)
        outs = {name: tmp_path / str(frames) / f"arm.{name}" for name in ("trc", "csv", "npz", "bvh", "c3d")}
        with load_run(folder) as run:
            written = export_formats(run, outs, up="y")
            assert [block.frames for block in written["csv"].blocks()] == ([5] if frames == 5 else [2, 2, 1])
            assert written["csv"].in_memory.seconds.tolist() == [k / 60 for k in range(5)]
        texts.append({path.name: path.read_bytes() for path in (tmp_path / str(frames)).iterdir() if path.suffix != ".npz"})
        with np.load(outs["npz"]) as file:
            arrays.append(dict(file))
    assert len(texts[0]) == 7 and texts[0] == texts[1] and arrays[0].keys() == arrays[1].keys()
    for name, values in arrays[0].items():
        # A sum over the draws of five frames at once may be rounded in another order.
        assert arrays[1][name].dtype == values.dtype
        if values.dtype.kind == "f":
            np.testing.assert_allclose(arrays[1][name], values, rtol=1e-12, atol=1e-12)
        else:
            np.testing.assert_array_equal(arrays[1][name], values)


def test_of_several_formats_none_is_written_if_a_file_is_there(make_run, tmp_path):
    (tmp_path / "arm.csv").write_text("mine")
    with load_run(make_run()) as run, pytest.raises(InputError, match=r"arm\.csv: already exists"):
        export_formats(run, {"c3d": tmp_path / "arm.c3d", "csv": tmp_path / "arm.csv"})
    assert not (tmp_path / "arm.c3d").exists() and (tmp_path / "arm.csv").read_text() == "mine"
