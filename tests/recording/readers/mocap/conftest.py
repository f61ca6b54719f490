"""Small files of the four formats, written by hand or by other programs' writers, whose joints are where plain arithmetic puts them."""

import ezc3d
import numpy as np
import pytest

# Metres of one unit of a skeleton of `length 0.45`.
UNIT = 0.0254 / 0.45

ASF = """\
# by hand
:version 1.10
:name somebody
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
   root: is no keyword here
:root
   order TX TY TZ RX RY RZ
   axis XYZ
   position 0 0 0
   orientation 0 0 0
:bonedata
  begin
     id 1
     name leg
     direction 0 -1 0
     length 16
     axis 0 0 0 XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
     id 2
     name foot
     direction 0 0 2
     length 4
     axis 0 0 90 XYZ
    dof rx
  end
  begin
     id 3
     name back
     direction 0 1 0
     length 10
     axis 0 0 0 XYZ
  end
  begin
     id 4
     name head
     direction 1 0 0
     length 5
     axis 0 0 0 XYZ
    dof rx ry
  end
:hierarchy
  begin
    root leg back
    leg foot
    back head
  end
"""

AMC = """\
#!OML:ASF somebody.asf
:FULLY-SPECIFIED
:DEGREES
7
root 1 20 3 0 0 0
leg 0 0 0
foot 90
head 90 90
8
root 1 20 3 0 90 0
leg 0 0 90
foot 0
head 0 0
"""

BVH = """\
HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Leg
  {
    OFFSET 10 -5 0
    CHANNELS 3 Yrotation Xrotation Zrotation
    End Site
    {
      OFFSET 0 -90 0
    }
  }
  JOINT Head
  {
    OFFSET 0 60 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    End Site
    {
      OFFSET 0 25 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0083333
0 95 0 0 0 0 0 0 0 0 0 0
10 96 -20 30 -40 50 10 20 30 -15 25 35
"""


@pytest.fixture
def somebody(tmp_path):
    """`somebody(amc=..., asf=...)`: the path of the motion, its skeleton beside it."""

    def call(amc=AMC, asf=ASF, name="somebody"):
        (tmp_path / f"{name}.asf").write_text(asf)
        path = tmp_path / f"{name}_01.amc"
        path.write_text(amc)
        return path

    return call


@pytest.fixture
def bvh(tmp_path):
    """`bvh(text)`: the path of a file that holds it."""

    def call(text=BVH, name="somebody.bvh"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return call


@pytest.fixture
def points():
    """Marker names, and positions (frame, marker, 3) of a standing person, metres, z up."""
    names = [f"{side}{part}" for side in "RL" for part in ("Hip", "Knee", "Ankle", "BigToe", "Heel", "Shoulder", "Elbow", "Wrist")]
    names += ["Hip", "Neck", "Head"]
    heights = {"Hip": 0.9, "Knee": 0.48, "Ankle": 0.08, "BigToe": 0.03, "Heel": 0.03, "Shoulder": 1.42, "Elbow": 1.13, "Wrist": 0.88}
    heights |= {"Neck": 1.5, "Head": 1.75}
    out = np.zeros((12, len(names), 3))
    for m, name in enumerate(names):
        side, part = (name[0], name[1:]) if name[1:] in heights else ("", name)
        out[:, m, 1] = {"L": 0.15, "R": -0.15, "": 0.0}[side]
        out[:, m, 2] = heights[part]
    out[..., 0] += 0.013 * np.arange(12)[:, None]
    return names, out + np.random.default_rng(3).normal(0, 0.01, out.shape)


@pytest.fixture
def c3d(tmp_path, points):
    """`c3d(unit=..., scale=..., names=..., positions=...)`: the path of a file by ezc3d."""

    def call(unit="mm", scale=1000.0, names=None, positions=None, up="+Z", rate=100.0):
        names, positions = points[0] if names is None else names, points[1] if positions is None else positions
        document = ezc3d.c3d()
        parameters = document["parameters"]["POINT"]
        parameters["UNITS"]["value"] = [unit]
        parameters["RATE"]["value"] = [rate]
        parameters["LABELS"]["value"] = list(names)
        data = np.ones((4, len(names), len(positions)))
        data[:3] = scale * positions.transpose(2, 1, 0)
        document["data"]["points"] = data
        if up:
            document.add_parameter("POINT", "Y_SCREEN", [up])
        document.write(str(tmp_path / "somebody.c3d"))
        return tmp_path / "somebody.c3d"

    return call


@pytest.fixture
def trc(tmp_path, points):
    """`trc(unit=..., scale=...)`: the path of a file as Pose2Sim lays it out, y up."""

    def call(unit="m", scale=1.0, names=None, positions=None, rate="60.0"):
        names, positions = points[0] if names is None else names, points[1] if positions is None else positions
        rows = scale * positions[..., [1, 2, 0]].reshape(len(positions), -1)
        lines = [
            "PathFileType\t4\t(X/Y/Z)\tsomebody.trc",
            "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
            f"{rate}\t60.0\t{len(rows)}\t{len(names)}\t{unit}\t60.0\t0\t{len(rows)}",
            "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t",
            "\t\t" + "\t".join(f"{axis}{m + 1}" for m in range(len(names)) for axis in "XYZ"),
            *(f"{f}\t{f / 60:.4f}\t" + "\t".join(f"{value:.6f}" for value in row) for f, row in enumerate(rows)),
        ]
        (tmp_path / "somebody.trc").write_text("\n".join(lines) + "\n")
        return tmp_path / "somebody.trc"

    return call
