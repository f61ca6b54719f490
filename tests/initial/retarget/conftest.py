"""Motions of a body's own skeleton, placed by rotation matrices of another library, and the command line in-process."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bayes_body.cli.main import main
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.definition import load_body
from bayes_body.recording.readers.mocap.motion import Motion


@pytest.fixture(scope="session")
def schema():
    return load_body("deutscher_31")


@pytest.fixture(scope="session")
def body(schema):
    return build_body("deutscher_31", schema, Shape(1.75))


def _metres(offset, lengths):
    def metres(value):
        if not isinstance(value, str):
            return value
        return (-1 if value[0] == "-" else 1) * lengths[value.lstrip("+-")]

    return [metres(value) for value in (offset.x, offset.y, offset.z)]


def placed(schema, lengths, angles):
    """Places and rotations (frame, joint) by name of the body file's joints, whose values are `angles[name]` (frame)."""
    frames = len(next(iter(angles.values())))
    R, p = {"world": Rotation.identity(frames)}, {"world": np.zeros((frames, 3))}
    waiting = list(schema.joints)
    while waiting:
        joint = next(each for each in waiting if each.parent in R)
        waiting.remove(joint)
        here, at = R[joint.parent], p[joint.parent] + R[joint.parent].apply(_metres(joint.offset, lengths))
        for word in joint.preset:
            here = here * Rotation.from_euler(word[0].upper(), int(word[1:]), degrees=True)
        for dof in joint.dofs:
            axis, sign = "xyz".index(dof.axis[-1]), -1 if dof.axis[0] == "-" else 1
            if dof.is_shift:
                at = at + here.apply(np.eye(3)[axis]) * angles[dof.name][:, None]
            else:
                here = here * Rotation.from_rotvec(sign * angles[dof.name][:, None] * np.eye(3)[axis])
        R[joint.name], p[joint.name] = here, at
    return {name: each for name, each in p.items() if name != "world"}, {name: each.as_matrix() for name, each in R.items() if name != "world"}


@pytest.fixture(scope="session")
def own_motion(schema):
    """`own_motion(lengths, angles)`: a Motion of the body's own skeleton; with `axes` turned as bvh has it, in a world whose y was up."""

    def make(lengths, angles, at_rest=False):
        p, R = placed(schema, lengths, angles)
        names = tuple(p)
        if at_rest:
            _, zero = placed(schema, lengths, {name: np.zeros(1) for name in angles})
            R = {name: R[name] @ zero[name][0].T @ np.roll(np.eye(3), 2, axis=0) for name in names}
        parents = {joint.name: joint.parent for joint in schema.joints}
        indices = tuple(-1 if parents[name] == "world" else names.index(parents[name]) for name in names)
        return Motion("own", 60.0, names, indices, np.stack(list(p.values()), 1), np.stack([R[name] for name in names], 1))

    return make


@pytest.fixture
def command(capsys):
    """`command("mocap", file)`: exit status, and what it wrote on standard output and error."""

    def call(*arguments):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return stopped.value.code, out, re.sub(r"\x1b\[\d*m", "", err)

    return call
