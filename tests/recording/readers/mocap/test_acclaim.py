"""asf/amc: the kinematics against arithmetic by hand, the real walks against the floor, and sentences about damaged files."""

import math
import time

import numpy as np
import pytest
from recording.readers.mocap.conftest import AMC, ASF, UNIT

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.mocap import landmarks, read_motion
from bayes_body.recording.readers.mocap.asf import read_asf

SUBJECTS = ("02", "05", "06", "07", "08", "16", "35", "38", "39")
# The floor of this trial is 4.5 cm below that of the subject's other one.
ABOVE_THE_FLOOR = ("38_01",)


def at(motion, joint, frame=0):
    """Where a joint is, in the file's unit and axes: x, y, z with y up."""
    z, x, y = motion.positions_m[frame, motion.joints.index(joint)] / UNIT
    return [x, y, z]


def test_a_motion_by_hand(somebody):
    motion = read_motion(somebody())
    assert motion.joints == ("root", "leg", "foot", "back", "head", "foot_end", "head_end")
    assert motion.parents == (-1, 0, 1, 0, 3, 2, 4) and motion.fps == 120 and motion.name == "somebody_01"
    # At rest: the bones along their directions (which need not be of length one), the root at its values.
    for joint, place in {"root": [1, 20, 3], "leg": [1, 20, 3], "foot": [1, 4, 3], "back": [1, 20, 3], "head": [1, 30, 3]}.items():
        assert np.allclose(at(motion, joint), place)
    # The axis turns x into y: rx turns about y, and what pointed along z points along x.
    assert np.allclose(at(motion, "foot_end"), [5, 4, 3])
    # About x first, which leaves x alone, then about y: x becomes -z. The other way round it would become y.
    assert np.allclose(at(motion, "head_end"), [1, 30, -2])


def test_the_root_turns_all(somebody):
    motion = read_motion(somebody())
    # A quarter turn about y: the head's x becomes -z. The leg is turned about z before: down becomes x, and then -z.
    assert np.allclose(at(motion, "head_end", 1), [1, 30, -2])
    assert np.allclose(at(motion, "foot", 1), [1, 20, -13])
    # In world axes (z up) the file's y is z, so the root's frame has its y axis up.
    assert np.allclose(motion.rotations[:, 0, :, 1], [0, 0, 1])


def test_order_orientation_and_position_of_the_root(somebody):
    asf = ASF.replace("order TX TY TZ RX RY RZ", "order RY TZ TY TX RX RZ").replace("position 0 0 0", "position 0 0 10")
    asf = asf.replace("orientation 0 0 0", "orientation 0 90 0")
    amc = AMC.replace("root 1 20 3 0 0 0", "root 0 3 20 1 0 0")
    motion = read_motion(somebody(amc, asf))
    assert np.allclose(at(motion, "root"), [1, 20, 13])
    # Turned at rest by a quarter about y: what was along -z is along -x.
    assert np.allclose(at(motion, "head_end"), [-4, 30, 13])


def test_radians_and_a_unit_of_one_s_own(somebody):
    amc = AMC.replace(":DEGREES", ":RADIANS").replace("head 90 90", f"head {math.pi / 2} {math.pi / 2}").replace("foot 90", "foot 0")
    motion = read_motion(somebody(amc.replace("leg 0 0 90", "leg 0 0 0").replace("0 90 0\n", "0 0 0\n")))
    assert np.allclose(at(motion, "head_end"), [1, 30, -2])
    metres = read_motion(somebody(), unit=0.08).positions_m
    assert np.allclose(metres, 0.08 / UNIT * read_motion(somebody()).positions_m)


@pytest.mark.parametrize("subject", SUBJECTS)
def test_feet_stand_on_the_floor(cmu_mocap, subject):
    check_walks(cmu_mocap / subject, 1)


@pytest.mark.slow
@pytest.mark.parametrize("subject", SUBJECTS)
def test_feet_stand_on_the_floor_in_all_walks(cmu_mocap, subject):
    check_walks(cmu_mocap / subject, None)


def check_walks(folder, most):
    """The ball of the foot that stands: its joint is some 4 cm up, and stays within 5 cm of that; bones keep the skeleton's lengths."""
    files, subject = sorted(folder.glob("*.amc"))[:most], folder.name
    assert files
    bones = {bone.name: float(np.linalg.norm(bone.offset)) * UNIT for bone in read_asf(folder / f"{subject}.asf").bones}
    for path in files:
        motion = read_motion(path)
        joint = {name: motion.positions_m[:, motion.joints.index(name)] for name in motion.joints}
        balls = np.stack([joint["ltoes"], joint["rtoes"]])
        speed = np.linalg.norm(np.gradient(balls, axis=1), axis=-1) * motion.fps
        standing = balls[speed < 0.15][:, 2]
        assert len(standing) > 20
        middle = np.median(standing)
        assert 0.02 < middle < (0.1 if path.stem in ABOVE_THE_FLOOR else 0.06), path
        assert np.mean(np.abs(standing - middle) < 0.05) > 0.9, path
        for side in "lr":
            for bone, end in ((f"{side}femur", f"{side}tibia"), (f"{side}tibia", f"{side}foot")):
                assert np.allclose(np.linalg.norm(joint[bone] - joint[end], axis=-1), bones[bone], atol=1e-9)
        assert 0.34 < bones["lfemur"] < 0.45 and 0.38 < bones["ltibia"] < 0.47


@pytest.mark.parametrize("subject", SUBJECTS)
def test_crowns_are_a_stature_above_the_floor(cmu_mocap, subject):
    """From two sides: the crown over the feet, and thigh and shank over their share of the stature (0.491, Drillis & Contini)."""
    motion = read_motion(min((cmu_mocap / subject).glob("*.amc")))
    places = landmarks(motion)
    feet = np.median(np.minimum(places["l_toe"][:, 2], places["r_toe"][:, 2]))
    crown = np.median(places["head"][:, 2]) - feet
    leg = sum(np.linalg.norm(places[f"l_{a}"][0] - places[f"l_{b}"][0]) for a, b in (("hip", "knee"), ("knee", "ankle")))
    assert 1.55 < crown < 1.85 and abs(crown - leg / 0.491) < 0.07
    assert np.allclose(places["pelvis"], (places["l_hip"] + places["r_hip"]) / 2)
    # On the left is on the left of who walks on.
    ahead = places["pelvis"][-1] - places["pelvis"][0]
    assert ((np.cross([0, 0, 1], ahead) * (places["l_hip"] - places["r_hip"])).sum(axis=-1) > 0).mean() > 0.9


@pytest.mark.long
def test_two_thousand_frames_in_about_a_second(cmu_mocap, tmp_path):
    text = (cmu_mocap / "05" / "05_01.amc").read_text()
    blocks = text[text.index("\n1\n") + 3 :].split("\n2\n")[0]
    path = tmp_path / "05_99.amc"
    path.write_text(":FULLY-SPECIFIED\n:DEGREES\n" + "".join(f"{frame}\n{blocks}\n" for frame in range(1, 2001)))
    # Of the processor: others may keep the machine busy.
    start = time.process_time()
    motion = read_motion(path, skeleton=cmu_mocap / "05" / "05.asf")
    assert time.process_time() - start < 2 and len(motion.positions_m) == 2000


def without(text, start, end):
    return text[: text.index(start)] + text[text.index(end, text.index(start)) + len(end) :]


BAD_AMC = {
    "a bone that the skeleton lacks": (AMC.replace("leg 0 0 90", "tail 0 0 90"), r"line 11: the bone 'tail'; expected .*root, leg, foot, head"),
    "a bone left out": (AMC.replace("foot 90\n", ""), r"frame 7 has no values of foot"),
    "a bone left out of the last frame": (AMC.replace("head 0 0\n", ""), r"frame 8 has no values of head"),
    "short of values": (AMC.replace("leg 0 0 90", "leg 0 90"), r"line 11: 2 values of the bone 'leg' in frame 8; expected 3"),
    "too many values": (AMC.replace("foot 0\n", "foot 0 1\n"), r"line 12: 2 values of the bone 'foot'"),
    "a bone without values": (AMC.replace("foot 0\n", "foot\n"), r"line 12: 'foot'; expected a frame number, or a bone and its values"),
    "a bone twice": (AMC.replace("leg 0 0 90", "leg 0 0 90\nleg 0 0 90"), r"line 12: the bone 'leg' twice in frame 8"),
    "frames out of turn": (AMC.replace("\n8\n", "\n9\n"), r"line 9: frame 9 after frame 7; expected consecutive frame numbers"),
    "no number": (AMC.replace("foot 90", "foot 9o"), r"line 7: '9o'; expected numbers"),
    "NaN": (AMC.replace("foot 90", "foot nan"), r"line 7: nan; expected finite numbers"),
    "values before a frame": (AMC.replace("7\n", ""), r"line 4: values before the first frame number"),
    "nothing": ("", r"no frame; expected an AMC motion"),
    "something else": ('{"a": [1,\n2]}\n', r"line 1: the bone '{\"a\":'"),
    "binary": ("a\0b", r"line 1: the byte 0x00: not text"),
}


@pytest.mark.parametrize("what", BAD_AMC)
def test_damaged_motions(somebody, what):
    amc, sentence = BAD_AMC[what]
    with pytest.raises(InputError, match=sentence) as error:
        read_motion(somebody(amc))
    assert "somebody_01.amc" in str(error.value)


BAD_ASF = {
    "a bone of the hierarchy that is not there": (
        without(ASF, "  begin\n     id 2", "  end\n"),
        r"the hierarchy has a bone 'foot' missing in :bonedata",
    ),
    "a bone that the motion needs": (without(ASF, "  begin\n     id 2", "  end\n").replace("    leg foot\n", ""), r"line 7: the bone 'foot'"),
    "a bone left out of the hierarchy": (ASF.replace("    leg foot\n", ""), r"nothing leads from the root to foot"),
    "a circle": (ASF.replace("    leg foot\n", "    leg foot\n    foot leg\n"), r":hierarchy: the bone 'leg' twice"),
    "a bone twice": (ASF.replace("name foot", "name leg"), r"a second bone 'leg'"),
    "no length": (ASF.replace("     length 16\n", ""), r"no length; expected length and 1 values"),
    "a short direction": (ASF.replace("direction 0 -1 0", "direction 0 -1"), r"direction with 2 values; expected 3"),
    "no direction": (ASF.replace("direction 0 -1 0", "direction 0 0 0"), r"bone 'leg' of length 16 along \[0.0, 0.0, 0.0\]"),
    "another axis order": (ASF.replace("axis 0 0 90 XYZ", "axis 0 0 90 XYY"), r"axis order 'xyy'"),
    "another dof": (ASF.replace("dof rx\n", "dof l\n"), r"dof l; expected rx, ry, rz"),
    "no hierarchy": (ASF[: ASF.index(":hierarchy")], r"no :hierarchy; expected an ASF"),
    "cut off in a bone": (ASF[: ASF.index("length 10")] + ASF[ASF.index(":hierarchy") :], r"'begin' without its 'end'"),
    "something else": ("<html></html>", r"no :root, :bonedata, :hierarchy"),
    "a length of nothing": (ASF.replace("length 0.45", "length 0"), r"length 0; expected a number above 0"),
}


@pytest.mark.parametrize("what", BAD_ASF)
def test_damaged_skeletons(somebody, what):
    asf, sentence = BAD_ASF[what]
    with pytest.raises(InputError, match=sentence):
        read_motion(somebody(asf=asf))


@pytest.mark.parametrize(
    ("unit", "says"), [("mm", "2.52 cm tall, in the unit 'mm'"), (8.0, "201.6 m tall, in the unit '8 m'"), ("ft", "7.681 m tall")]
)
def test_a_unit_that_makes_no_person_says_the_height(somebody, unit, says):
    """The skeleton is 26 units high where it stands upright, and less in the other frame."""
    with pytest.raises(InputError, match=rf"a person {says}.*; expected 0.8 to 2.7 m; give the unit: 'cmu' would make 1.42 m"):
        read_motion(somebody(), unit=unit)


def test_the_skeleton_beside_the_motion(somebody, tmp_path):
    path = somebody()
    # The only one there will do, whatever it is called; of several that of the motion's number.
    (tmp_path / "somebody.asf").rename(tmp_path / "other.asf")
    assert len(read_motion(path).joints) == 7
    (tmp_path / "third.asf").write_text("no skeleton")
    with pytest.raises(InputError, match=r"2 .asf beside it \(other.asf, third.asf\); expected somebody.asf"):
        read_motion(path)
    assert len(read_motion(path, skeleton=tmp_path / "other.asf").joints) == 7
    for file in ("other.asf", "third.asf"):
        (tmp_path / file).unlink()
    with pytest.raises(InputError, match=r"no .asf beside it"):
        read_motion(path)
    with pytest.raises(InputError, match=r"none.asf: no such file"):
        read_motion(path, skeleton=tmp_path / "none.asf")


def test_what_is_no_motion_capture(tmp_path, somebody):
    for name, sentence in (("a.mp4", r"the suffix '.mp4'; expected one of .amc, .bvh, .c3d, .trc"), ("a.amc", r"a.amc: no such file")):
        with pytest.raises(InputError, match=sentence):
            read_motion(tmp_path / name)
    with pytest.raises(InputError, match=r"a skeleton without a motion"):
        read_motion(somebody().with_name("somebody.asf"))
    with pytest.raises(InputError, match=r"a skeleton is given with it"):
        read_motion(tmp_path / "a.bvh", skeleton=tmp_path / "a.asf")
    (tmp_path / "b.amc").mkdir()
    with pytest.raises(InputError, match=r"b.amc: a folder"):
        read_motion(tmp_path / "b.amc")
