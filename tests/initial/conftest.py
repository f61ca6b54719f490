"""People whose lengths are not the model's, seen by cameras: what a first pose is judged on."""

from typing import NamedTuple

import jax
import numpy as np
import pytest

from bayes_body.base.geometry.camera import project
from bayes_body.initial.fitting.points import as_markers, body_points
from bayes_body.model.body.build import Shape, build_body
from bayes_body.model.body.kinematics import marker_positions
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_body
from bayes_body.recording.session.session import CameraSpec, Session, Subject, View

SIZE = (1088, 1920)
HEIGHT_M = 1.75
# From a world whose z is up to one whose x or y is.
TURNED = {"x": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), "y": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), "z": np.eye(3)}


positions = jax.jit(marker_positions)
projected = jax.jit(jax.vmap(project, (0, None)))


class Person(NamedTuple):
    """Someone in a pose: `places` of all points (metres, z up), by name, and the lengths of the segments."""

    places: dict
    lengths: dict


def _camera(name, azimuth, turn):
    """Four metres from the z axis, 1.6 m up, looking at a person's middle."""
    centre = np.array([4 * np.cos(azimuth), 4 * np.sin(azimuth), 1.6])
    forward = np.array([0, 0, 0.9]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward]) @ turn.T
    return CameraSpec(name, SIZE, (1680.0, 1690.0), (540.0, 955.0), 0.0, (-0.05, 0.13, 6e-4, -4e-4, 0.0), R, -R @ turn @ centre)


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """A session with that many cameras around a person, in a world whose axis `up` points up."""
    folder = tmp_path_factory.mktemp("scene")

    def make(cameras, up="z", **known):
        views = tuple(View(_camera(f"cam{c}", azimuth, TURNED[up]), f"{c}/%d.png") for c, azimuth in enumerate((0.3, 1.9, 3.4, 5.0)[:cameras]))
        return Session(folder, "scene", up, 60.0, 5, 0, views, Subject(height_m=HEIGHT_M), **known)

    return make


@pytest.fixture(scope="session")
def body_schema():
    return load_body("deutscher_31")


@pytest.fixture(scope="session")
def model(scene):
    return build_model("deutscher_2005", scene(1))


@pytest.fixture(scope="session")
def walker(body_schema):
    """A person in mid-stride, arms swinging, heading anywhere: segments some percent off the usual, every point some millimetres off its place."""

    def make(rng, spread=0.06, noise_m=0.01):
        usual = {name: share * HEIGHT_M for name, share in body_schema.lengths_of_height.items()}
        pairs = {name[2:] if name.startswith(("l_", "r_")) else name: np.exp(rng.normal(0, spread)) for name in usual}
        lengths = {name: length * pairs[name[2:] if name.startswith(("l_", "r_")) else name] for name, length in usual.items()}
        body = build_body("other", body_schema, Shape(HEIGHT_M, lengths))
        points = as_markers(body, body_points(body))
        pose = np.float32([_angle(name, rng) for name in body.dof_names])
        places = np.asarray(positions(body.skeleton, points, pose)) + rng.normal(0, noise_m, (len(points.names), 3))
        return Person(dict(zip(points.names, places, strict=True)), lengths)

    return make


def _angle(name, rng):
    # Arms at -1.6 hang at the sides; see the body's chart.
    side = 1 if name.startswith("r_") else -1
    usual = {"root_z": (0.9, 0.02), "root_yaw": (0, 3), "l_knee": (-0.4, 0.2), "r_knee": (-0.4, 0.2), "l_elbow": (-0.6, 0.3), "r_elbow": (0, 0)}
    usual |= {f"{leg}_hip_y": (-0.2, 0.35) for leg in "lr"} | {f"{arm}_shoulder_y": (1.5 * side, 0.35) for arm in "lr"}
    usual |= {"r_elbow": (-0.6, 0.3)}
    mean, sd = usual.get(name, (0.0, 0.1))
    value = rng.normal(mean, sd)
    return min(value, -0.05) if name.endswith(("knee", "elbow")) else value


@pytest.fixture(scope="session")
def seen(model):
    """Keypoints of a person in a session's cameras: each some pixels off, a share of them anywhere."""

    def look(session, person, rng, outliers=0.0, noise_px=4.0):
        places = np.array(list(person.places.values())) @ TURNED[session.up].T
        rig = build_model(model.definition, session).rig
        pixels = np.array(projected(rig, places.astype(np.float32))[0])
        pixels += rng.normal(0, noise_px, pixels.shape)
        wrong = rng.random(pixels.shape[:2]) < outliers
        pixels[wrong] = rng.uniform((80, 80), np.array(SIZE) - 80, pixels.shape)[wrong]
        # Detectors know neither the top of the spine nor the middle of the hips.
        names = [name for name in person.places if name not in ("thorax", "pelvis")]
        keep = [list(person.places).index(name) for name in names]
        keypoints = {
            view.camera.name: {name: (float(uv[0]), float(uv[1]), 0.8) for name, uv in zip(names, pixels[c, keep], strict=True)}
            for c, view in enumerate(session.views)
        }
        chosen = {(view.camera.name, name) for c, view in enumerate(session.views) for name, k in zip(names, keep, strict=True) if wrong[c, k]}
        return keypoints, chosen

    return look


@pytest.fixture(scope="session")
def errors_m(model):
    """Distances between the model's markers in a pose and the person's, by name, metres; pass another body's model where lengths were fitted."""

    def measure(pose, person, up="z", of=None):
        places = np.asarray((of or model).markers(pose)) @ TURNED[up]
        return {name: float(np.linalg.norm(place - person.places[name])) for name, place in zip(model.body.markers.names, places, strict=True)}

    return measure
