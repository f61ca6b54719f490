"""c3d and trc: files by the writers of other programs and by our own, read back to the digits that they hold."""

import struct

import numpy as np
import pytest

from bayes_body.base.errors import InputError
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.mocap import landmarks, read_motion
from bayes_body.results.posterior.moments import Moments
from bayes_body.view.export.c3d import write_c3d
from bayes_body.view.export.motion import Motion
from bayes_body.view.export.trc import write_trc


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1000.0), ("m", 1.0), ("cm", 100.0)])
def test_c3d(c3d, points, unit, scale):
    motion = read_motion(c3d(unit, scale))
    assert motion.joints == tuple(points[0]) and motion.fps == 100 and motion.rotations is None and set(motion.parents) == {-1}
    # Floats of 32 bits.
    assert np.allclose(motion.positions_m, points[1], rtol=1e-6, atol=0)
    places = landmarks(motion)
    assert set(MARKERS) <= set(places) and {"l_toe", "r_heel", "neck"} <= set(places)
    for name, marker in {"l_hip": "LHip", "r_wrist": "RWrist", "head": "Head", "l_toe": "LBigToe", "r_heel": "RHeel"}.items():
        assert np.allclose(places[name], points[1][:, points[0].index(marker)], atol=1e-6)


def test_c3d_of_other_axes_and_with_gaps(c3d, points):
    names, positions = points
    gapped = positions.copy()
    gapped[3:5, 2] = np.nan
    motion = read_motion(c3d(positions=gapped[..., [1, 2, 0]], up="+Y"))
    assert np.array_equal(np.isnan(motion.positions_m), np.isnan(gapped)) and np.allclose(motion.positions_m, gapped, equal_nan=True, atol=1e-6)
    assert np.allclose(read_motion(c3d(up="")).positions_m, positions, atol=1e-6)
    upside_down = read_motion(c3d(positions=positions * [1, -1, -1], up="-Z"))
    assert np.allclose(upside_down.positions_m, positions, atol=1e-6)
    prefixed = read_motion(c3d(names=[f"Anna:{name}" for name in names]))
    assert prefixed.joints == tuple(names)


def blocks(points, processor):
    """A C3D file of integers by hand, in the byte order of a processor: three points, four frames, two analog values a frame."""
    order = ">" if processor == 86 else "<"

    def real(value):
        if processor != 85:
            return struct.pack(f"{order}f", value)
        low, high = struct.unpack("<HH", struct.pack("<f", 4 * value))
        return struct.pack("<HH", high, low)

    def words(*values):
        return struct.pack(f"{order}{len(values)}h", *values)

    def record(owner, name, content):
        return bytes([len(name)]) + struct.pack("b", owner) + name + words(2 + len(content)) + content

    def text(owner, name, texts):
        return record(owner, name, struct.pack("b", -1) + bytes([2, len(texts[0]), len(texts)]) + "".join(texts).encode() + b"\0")

    scale = 0.25
    header = bytes([2, 0x50]) + words(3, 2, 1, 4, 0) + real(scale) + words(4, 1) + real(50.0)
    parameters = bytes([1, 0x50, 2, processor]) + record(-1, b"POINT", b"\0")
    parameters += text(1, b"LABELS", ["ANKL", "KNEE", "HEAD"]) + text(1, b"UNITS", ["mm"])
    parameters += record(1, b"RATE", struct.pack("b", 4) + b"\0" + real(50.0) + b"\0") + b"\0\0"
    rows = b""
    for frame in range(4):
        for point in range(3):
            rows += words(*(int(value / scale) for value in points[frame, point]), -1 if (frame, point) == (2, 1) else 0)
        rows += words(7, 8)
    return header.ljust(512, b"\0") + parameters.ljust(1024, b"\0") + rows.ljust(512, b"\0")


@pytest.mark.parametrize("processor", [84, 85, 86], ids=["Intel", "DEC", "MIPS"])
def test_c3d_of_integers_by_other_processors(tmp_path, processor):
    expected = np.array([[[1, -2, 80], [3, 4, 450], [5, 6, 1700]]] * 4) + np.arange(4)[:, None, None]
    path = tmp_path / "old.c3d"
    path.write_bytes(blocks(expected, processor))
    motion = read_motion(path)
    assert motion.joints == ("ANKL", "KNEE", "HEAD") and motion.fps == 50
    assert np.isnan(motion.positions_m[2, 1]).all() and np.isnan(motion.positions_m).sum() == 3
    assert np.allclose(np.nan_to_num(motion.positions_m), np.where(np.isnan(motion.positions_m), 0, expected / 1000))


@pytest.fixture
def exported(tmp_path):
    """`exported(write, up)`: true positions z up, and the motion read back from one of our own files."""

    def call(write, suffix, up):
        rng = np.random.default_rng(5)
        mean = np.array([2.0, -1.0, 0.0]) + rng.normal(0, 0.01, (7, 15, 3))
        heights = {"head": 1.75, "hip": 0.9, "knee": 0.5, "ankle": 0.1, "shoulder": 1.4, "elbow": 1.1, "wrist": 0.9, "pelvis": 0.9, "thorax": 1.4}
        mean[..., 2] += [heights[name.rpartition("_")[2]] for name in MARKERS]
        order = {"z": [0, 1, 2], "y": [1, 2, 0], "x": [2, 0, 1]}[up]
        moments = Moments(*(mean[..., order] + shift for shift in (0.0, 0.0, -0.1, 0.1)))._replace(sd=np.full((7, 15, 3), 0.02))
        none = Moments(*(np.zeros((7, 0)),) * 4)
        motion = Motion("a walk", 59.94, up, MARKERS, moments, (), (), none, np.zeros(7, bool), None)
        write(motion, tmp_path / f"own{suffix}")
        return mean, read_motion(tmp_path / f"own{suffix}")

    return call


@pytest.mark.parametrize("up", ["x", "y", "z"])
@pytest.mark.parametrize(("write", "suffix", "digits"), [(write_c3d, ".c3d", 2e-7), (write_trc, ".trc", 5.1e-7)])
def test_our_own_files_come_back(exported, write, suffix, digits, up):
    mean, motion = exported(write, suffix, up)
    # The spread is no marker, whichever axis points up it is found, and the fifteen keep their places.
    assert motion.joints == MARKERS and np.isclose(motion.fps, 59.94, rtol=1e-6)
    assert np.abs(motion.positions_m - mean).max() < digits
    places = landmarks(motion)
    assert tuple(places) == MARKERS and np.array_equal(places["thorax"], motion.positions_m[:, MARKERS.index("thorax")])


@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("mm", 1000.0), ("cm", 100.0)])
def test_trc(trc, points, unit, scale):
    motion = read_motion(trc(unit, scale))
    assert motion.joints == tuple(points[0]) and motion.fps == 60
    assert np.allclose(motion.positions_m, points[1], atol=0.51e-6 / scale + 1e-12)
    assert np.allclose(landmarks(motion)["pelvis"], points[1][:, [0, 8]].mean(axis=1), atol=1e-6)


def test_gaps_of_a_trc(trc, points):
    path = trc()
    lines = path.read_text().splitlines()
    cells = lines[7].split("\t")
    cells[2:5] = "", "", ""
    cells[8:11] = "NaN", "NaN", "NaN"
    lines[7] = "\t".join(cells)
    path.write_text("\r\n".join([*lines[:5], "", *lines[5:], ""]))
    motion = read_motion(path)
    assert np.argwhere(np.isnan(motion.positions_m).all(axis=-1)).tolist() == [[2, 0], [2, 2]] and np.isnan(motion.positions_m).sum() == 6


BAD_TRC = {
    "a ragged row": (lambda lines: [*lines[:7], "\t".join(lines[7].split("\t")[:-2]), *lines[8:]], r"line 8: a ragged row of 57 cells; expected 59"),
    "a cell too many": (lambda lines: [*lines[:7], lines[7] + "\t1.0", *lines[8:]], r"line 8: a ragged row of 60 cells"),
    "cut off": (lambda lines: lines[:10], r"cut off: 5 rows where NumFrames says 12"),
    "cut off in the header": (lambda lines: lines[:3], r"and 3 lines; expected a TRC file"),
    "other markers": (lambda lines: [line.replace("\t19\t", "\t20\t") for line in lines], r"line 4: 19 names, .*; expected 20, as NumMarkers says"),
    "no unit": (lambda lines: [line.replace("Units", "Unit") for line in lines], r"lines 2 and 3: no Units"),
    "another unit": (
        lambda lines: [lines[0], lines[1], lines[2].replace("\tm\t", "\tfurlong\t"), *lines[3:]],
        r"Units: 'furlong'; expected one of m",
    ),
    "no number": (lambda lines: [*lines[:7], lines[7].replace("0.", "O.", 3), *lines[8:]], r"line 8: '.*O\..*'; expected numbers"),
    "a name twice": (lambda lines: [line.replace("LHip", "RHip") for line in lines], r"line 4: 'RHip' 2 times"),
    "no rate": (lambda lines: [*lines[:2], lines[2].replace("60.0", "0", 1), *lines[3:]], r"frames per second: 0; expected"),
    "something else": (lambda lines: ["time,x,y"] * 9, r"'time,x,y' and 9 lines; expected a TRC file"),
}


@pytest.mark.parametrize("what", BAD_TRC)
def test_damaged_trc(trc, what):
    change, sentence = BAD_TRC[what]
    path = trc()
    path.write_text("\n".join(change(path.read_text().splitlines())))
    with pytest.raises(InputError, match=sentence):
        read_motion(path)


def test_c3d_that_cannot_be_used(c3d, points, tmp_path):
    with pytest.raises(InputError, match=r"no points in it; expected a C3D file with points"):
        read_motion(c3d(names=[], positions=np.zeros((3, 0, 3))))
    with pytest.raises(InputError, match=r"no l_hip, l_knee, .* head among its 19 names \(M0, M1, .*\); expected the names of one of"):
        landmarks(read_motion(c3d(names=[f"M{m}" for m in range(19)])))
    with pytest.raises(InputError, match=r"POINT:UNITS: 'ell'; expected one of m, cm"):
        read_motion(c3d("ell"))
    with pytest.raises(InputError, match=r"POINT:LABELS: 'LHip' 2 times"):
        read_motion(c3d(names=["LHip" if name == "RHip" else name for name in points[0]]))
    path = c3d()
    whole = path.read_bytes()
    for length, sentence in ((100, "no C3D header"), (700, "cut off"), (len(whole) - 900, r"cut off: \d+ bytes; expected \d+")):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=sentence):
            read_motion(path)
    path.write_bytes(b"PK\3\4" * 1000)
    with pytest.raises(InputError, match=r"no C3D header; expected a C3D file with points; name another file"):
        read_motion(path)


@pytest.mark.parametrize(("unit", "says"), [("mm", r"1\.7\d mm"), (100.0, r"17\d\.?\d? m")])
def test_a_unit_that_makes_no_person_says_the_height(c3d, trc, unit, says):
    """What the file says is wrong as often as what a user says."""
    for path in (c3d("m", 1.0), trc()):
        with pytest.raises(InputError, match=rf"a person {says} tall, in the unit .*; expected 0.2 to 2.7 m; give the unit: 'm' would make 1\.7\d m"):
            read_motion(path, unit=unit)
    with pytest.raises(InputError, match=r"a person 17\d\d m tall, in the unit 'm'; .* 'mm' would make"):
        read_motion(c3d("m", 1000.0))
