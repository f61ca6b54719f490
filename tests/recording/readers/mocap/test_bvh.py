"""BVH: channels in any order against SciPy's intrinsic rotations, and sentences about files that are cut off anywhere."""

import numpy as np
import pytest
from recording.readers.mocap.conftest import BVH
from scipy.spatial.transform import Rotation

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.mocap import landmarks, read_motion

# y up to z up, as the reader turns.
TURN = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])


def rotation(order, *angles):
    return Rotation.from_euler(order, angles, degrees=True).as_matrix()


def test_channels_of_any_order(bvh):
    motion = read_motion(bvh(), up="y")
    assert motion.joints == ("Hips", "Leg", "Leg_end", "Head", "Head_end") and motion.parents == (-1, 0, 1, 0, 3)
    # 0.0083333 s are 120 frames a second.
    assert motion.fps == 120
    hips, leg, head = rotation("ZXY", 30, -40, 50), rotation("YXZ", 10, 20, 30), rotation("ZYX", -15, 25, 35)
    expected = {
        "Hips": [10, 96, -20],
        "Leg": [10, 96, -20] + hips @ [10, -5, 0],
        "Leg_end": [10, 96, -20] + hips @ ([10, -5, 0] + leg @ [0, -90, 0]),
        "Head": [10, 96, -20] + hips @ [0, 60, 0],
        "Head_end": [10, 96, -20] + hips @ ([0, 60, 0] + head @ [0, 25, 0]),
    }
    for j, joint in enumerate(motion.joints):
        assert np.allclose(motion.positions_m[1, j], TURN @ expected[joint] / 100), joint
    assert np.allclose(motion.rotations[1, 3], TURN @ hips @ head)
    assert np.allclose(motion.positions_m[0, 2], TURN @ [0.1, 0.0, 0.0])


def test_position_channels_take_the_offset_s_place(bvh):
    text = BVH.replace("CHANNELS 3 Yrotation Xrotation Zrotation", "CHANNELS 4 Yposition Yrotation Xrotation Zrotation")
    text = text.replace("OFFSET 0 0 0\n  CHANNELS 6", "OFFSET 7 8 9\n  CHANNELS 6")
    motion = read_motion(bvh(text[: text.index("0 95")] + "0 95 0 0 0 0 -11 0 0 0 0 0 0\n" * 2), up="y")
    assert np.allclose(motion.positions_m[0, :2], [[0, 0, 0.95], [0, 0.1, 0.84]])


def test_layouts_that_programs_write(bvh):
    same = read_motion(bvh(), up="y")
    lines = BVH.replace("\n", "\r\n").replace("OFFSET", "offset").replace("Zrotation", "ZROTATION").replace("Frames: 2", "Frames:\t2")
    joined = BVH.replace("\n  {", " {").replace("Frame Time: 0.0083333", "Frame Time:0.0083333\n")
    for text in (lines, joined, f"\n{BVH}\n\n"):
        assert np.array_equal(read_motion(bvh(text), up="y").positions_m, same.positions_m)
    assert read_motion(bvh(BVH.replace("Frame Time: 0.0083333", "Frame Time: .0400"))).fps == 25
    assert np.isclose(read_motion(bvh(BVH.replace("0.0083333", "0.016683")), up="y").fps, 59.94, atol=1e-2)
    assert read_motion(bvh(), fps=30.0).fps == 30


def person(names, scale=1.0):
    """A person at rest, by names of `hips, leg, ..., wrist` with L or R in it for the sides."""
    hip, knee, ankle, toe, shoulder, elbow, wrist, head = names
    lines, depth = [], 0

    def joint(kind, name, offset, *children):
        nonlocal depth
        pad = "  " * depth
        lines.extend([f"{pad}{kind} {name}", pad + "{", f"{pad} OFFSET {' '.join(str(scale * value) for value in offset)}"])
        if kind != "End":
            lines.append(f"{pad} CHANNELS 3 Zrotation Xrotation Yrotation")
        depth += 1
        for child in children:
            joint(*child)
        depth -= 1
        lines.append(pad + "}")

    def limbs(side, sign):
        name = [part.replace("SIDE", side) for part in (hip, knee, ankle, toe, shoulder, elbow, wrist)]
        leg = ("JOINT", name[0], (10 * sign, -5, 0), ("JOINT", name[1], (0, -42, 0), ("JOINT", name[2], (0, -41, 0))))
        leg = (*leg[:3], (*leg[3][:3], (*leg[3][3][:3], ("JOINT", name[3], (0, -7, 12), ("End", "Site", (0, 0, 6))))))
        hand = ("JOINT", name[6], (25 * sign, 0, 0), ("End", "Site", (18 * sign, 0, 0)))
        return leg, ("JOINT", name[4], (18 * sign, 50, 0), ("JOINT", name[5], (28 * sign, 0, 0), hand))

    sides = ("Left", "Right") if "SIDE" in hip and not hip.endswith("SIDE") else ("L", "R")
    left, right = limbs(sides[0], 1), limbs(sides[1], -1)
    joint("ROOT", "Hips", (0, 0, 0), left[0], right[0], left[1], right[1], ("JOINT", head, (0, 60, 0), ("End", "Site", (0, 24, 0))))
    channels = sum("CHANNELS" in line for line in lines) * 3
    return "HIERARCHY\n" + "\n".join(lines) + f"\nMOTION\nFrames: 1\nFrame Time: 0.01\n{' '.join(['0'] * channels)}\n"


DIALECTS = {
    "MotionBuilder": ("SIDEUpLeg", "SIDELeg", "SIDEFoot", "SIDEToeBase", "SIDEArm", "SIDEForeArm", "SIDEHand", "Head"),
    "Mixamo": tuple(f"mixamorig:{n}" for n in ("SIDEUpLeg", "SIDELeg", "SIDEFoot", "SIDEToeBase", "SIDEArm", "SIDEForeArm", "SIDEHand", "Head")),
    "Biovision": ("SIDEHip", "SIDEKnee", "SIDEAnkle", "SIDEToe", "SIDEShoulder", "SIDEElbow", "SIDEWrist", "Head"),
    "none": ("SIDEThigh", "SIDEShin", "SIDEFoot", "SIDEToe", "SIDEShldrArm", "SIDEForeArm", "SIDEHand", "Head"),
    "Blender": ("thigh.SIDE", "shin.SIDE", "foot.SIDE", "toe.SIDE", "upper_arm.SIDE", "forearm.SIDE", "hand.SIDE", "head"),
}


@pytest.mark.parametrize("dialect", [name for name in DIALECTS if name != "none"])
def test_dialects(bvh, dialect):
    places = {name: place[0] for name, place in landmarks(read_motion(bvh(person(DIALECTS[dialect])))).items()}
    # (x, y, z) of the file is (z, x, y) here.
    expected = {
        "l_hip": (0, 0.1, -0.05),
        "r_knee": (0, -0.1, -0.47),
        "l_ankle": (0, 0.1, -0.88),
        "l_elbow": (0, 0.46, 0.5),
        "r_wrist": (0, -0.71, 0.5),
    }
    expected |= {"head": (0, 0, 0.84), "pelvis": (0, 0, -0.05), "thorax": (0, 0, 0.5), "l_toe": (0.18, 0.1, -0.95), "r_shoulder": (0, -0.18, 0.5)}
    for name, place in expected.items():
        if dialect != "Biovision" or name != "l_toe":
            assert np.allclose(places[name], place), name


def test_cmu_bvh_keeps_the_unit_and_the_wrist_of_its_asf(bvh):
    names = ("SIDEUpLeg", "SIDELeg", "SIDEFoot", "SIDEToeBase", "SIDEArm", "SIDEForeArm", "SIDEFingerBase", "Head")
    path = bvh(person(names, scale=0.01 * 0.45 / 0.0254))
    with pytest.raises(InputError, match=r"a person 3\d.\d cm tall, in the unit 'cm'; .* 'cmu' would make 1\.\d\d m"):
        read_motion(path)
    places = landmarks(read_motion(path, unit="cmu"))
    assert np.allclose(places["l_wrist"][0], [0, 0.71, 0.5])
    # The head's bone ends at the eyes: 0.13 of thigh and shank are missing.
    assert np.allclose(places["head"][0], [0, 0, 0.84 + 0.13 * 0.83])


def test_names_of_one_s_own(bvh):
    motion = read_motion(bvh(person(DIALECTS["none"])))
    with pytest.raises(
        InputError, match=r"no l_shoulder, r_shoulder among its \d+ names \(Hips, LeftThigh, .*\); .* give the joints for l_shoulder, r_shoulder"
    ):
        landmarks(motion)
    own = {"l_shoulder": "LeftShldrArm", "r_shoulder": "RightShldrArm"}
    assert np.allclose(landmarks(motion, own)["thorax"][0], [0, 0, 0.5])
    with pytest.raises(InputError, match=r"names: l_shoulder: 'LeftShldrArn', which somebody lacks; .* 'LeftShldrArm'\?"):
        landmarks(motion, own | {"l_shoulder": "LeftShldrArn"})
    with pytest.raises(InputError, match=r"names: 'l_sholder'; expected landmarks; did you mean 'l_shoulder'\?"):
        landmarks(motion, {"l_sholder": "LeftShldrArm"})


def test_the_upward_axis_is_where_the_head_is(bvh):
    text = person(DIALECTS["MotionBuilder"])
    upright = landmarks(read_motion(bvh(text)))
    offsets = [line.split()[1:] for line in text.splitlines() if "OFFSET" in line]
    for turned in (lambda x, y, z: (z, x, y), lambda x, y, z: (y, z, x), lambda x, y, z: (x, f"-{y}".replace("--", ""), f"-{z}".replace("--", ""))):
        lines = iter(offsets)
        other = "\n".join(f" OFFSET {' '.join(turned(*next(lines)))}" if "OFFSET" in line else line for line in text.splitlines())
        places = landmarks(read_motion(bvh(other)))
        assert np.allclose(places["head"][0, 2], upright["head"][0, 2]) and np.allclose(places["l_knee"][0, 2], upright["l_knee"][0, 2])
        sides = [np.linalg.det([p["l_hip"][0] - p["r_hip"][0], p["l_toe"][0] - p["l_ankle"][0], [0, 0, 1]]) for p in (places, upright)]
        assert np.isclose(*sides) and abs(sides[0]) > 0.01


def test_cut_off_anywhere(bvh):
    """From the first byte to the last number: a sentence, and never a shorter motion."""
    text = BVH.rstrip()
    for end in range(len(text) - 1):
        with pytest.raises(InputError, match=r"somebody.bvh") as error:
            read_motion(bvh(text[:end]))
        if end > text.index("OFFSET") and text[end - 1] == "\n":
            assert "expected" in str(error.value)


BAD = {
    "in the hierarchy": (BVH[: BVH.index("  JOINT Head")], r"line 14: cut off in the hierarchy, in 'Hips'"),
    "before the motion": (BVH[: BVH.index("MOTION")], r"cut off: 5 joints, and no MOTION"),
    "without frames": (BVH[: BVH.index("Frames")], r"cut off: no 'Frames:'"),
    "fewer frames": (BVH.replace("Frames: 2", "Frames: 3"), r"cut off: 2 frames where 'Frames:' says 3"),
    "more frames": (BVH.replace("Frames: 2", "Frames: 1"), r": 2 frames where 'Frames:' says 1"),
    "in a row": (BVH[:-10], r"line 29: \d+ values; expected 12, the channels of the hierarchy"),
    "no number": (BVH.replace("10 96", "10 x"), r"line 29: 'x'; expected numbers"),
    "NaN": (BVH.replace("10 96", "10 nan"), r"line 29: nan; expected finite"),
    "a short offset": (BVH.replace("OFFSET 10 -5 0", "OFFSET 10 -5"), r"line 8: OFFSET of 'Leg': 'CHANNELS'"),
    "an unknown channel": (BVH.replace("Yrotation Xrotation Zrotation", "Yrotation Xrotation Wrotation"), r"line 9: 'Wrotation' in the hierarchy"),
    "a channel twice": (BVH.replace("Yrotation Xrotation Zrotation", "Yrotation Xrotation Xrotation"), r"line 9: 'Xrotation' in the hierarchy"),
    "too few channels": (BVH.replace("CHANNELS 3 Y", "CHANNELS 4 Y"), r"line 10: 'End' in the hierarchy"),
    "two roots": (BVH.replace("MOTION", "ROOT Other\nMOTION"), r"line 25: 'ROOT' in the hierarchy"),
    "a name twice": (BVH.replace("JOINT Head", "JOINT Leg"), r"a second joint 'Leg'"),
    "no time": (BVH.replace("Frame Time: 0.0083333", "Frame Time: 0"), r"2 frames of 0 s each"),
    "something else": ("<html>", r"line 1: '<html>'; expected a BVH file"),
    "nothing": ("", r"line 1: ''; expected a BVH file"),
}


@pytest.mark.parametrize("what", BAD)
def test_damaged_files(bvh, what):
    text, sentence = BAD[what]
    with pytest.raises(InputError, match=sentence):
        read_motion(bvh(text))


@pytest.mark.parametrize(("unit", "says"), [("m", "168 m"), ("mm", "16.8 cm"), (0.0001, "1.68 cm")])
def test_a_unit_that_makes_no_person_says_the_height(bvh, unit, says):
    text = person(DIALECTS["MotionBuilder"])
    with pytest.raises(InputError, match=rf"a person \d+(\.\d+)? {says.split()[1]} tall, in the unit .* 'cm' would make 1\.\d\d m"):
        read_motion(bvh(text), unit=unit)
    for options, sentence in (
        ({"unit": "parsec"}, "unit: parsec; expected one of m, cm"),
        ({"up": "up"}, "up: up; expected"),
        ({"fps": -1.0}, "second: -1"),
    ):
        with pytest.raises(InputError, match=sentence):
            read_motion(bvh(text), **options)
