"""The simulator's person: closed, the right way round, alike for a seed, sized as people are, dressed in cloth that lags behind."""

from dataclasses import replace

import numpy as np
import pytest
from workshop.simulation.walker import FPS, walker

from bayes_body.base.errors import InputError
from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.mocap import landmarks, read_motion, resample
from bayes_body.workshop.simulation.person import build_person
from bayes_body.workshop.simulation.person_bones import chain, turned
from bayes_body.workshop.simulation.person_motion import complete
from bayes_body.workshop.simulation.person_shape import folded
from bayes_body.workshop.simulation.surface import ANGLES, sweep


@pytest.fixture(scope="module")
def walk():
    return walker()


def _volume(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return np.sum(np.cross(a, b) * c) / 6


def test_the_surface_is_closed(walk):
    mesh = build_person(1).mesh(walk, 10)
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    there, back = ({tuple(edge) for edge in each.tolist()} for each in (edges, edges[:, ::-1]))
    assert len(there) == len(edges) and there == back
    assert mesh.faces.min() == 0 and mesh.faces.max() == len(mesh.vertices) - 1 and len(mesh.colours) == len(mesh.faces)


@pytest.mark.parametrize("seed", range(6))
def test_triangles_face_outwards_and_people_have_peoples_volume(walk, seed):
    """Clothed, with what tubes share counted twice; inside out it would be negative."""
    person = build_person(seed, 1.75)
    mesh = person.mesh(walk, 10)
    assert 0.080 < _volume(mesh) < 0.135
    # Each tube for itself: none is inside out.
    first = 0
    for tube in person.tubes:
        count = len(tube.stations) * ANGLES
        own = (mesh.faces < first + count).sum(axis=1) >= 2
        own &= (mesh.faces >= first).sum(axis=1) >= 2
        assert _volume(mesh._replace(faces=mesh.faces[own])) > 1e-5, tube.name
        first += count


def test_a_seed_is_a_person(walk):
    first, again, other = (build_person(seed).mesh(walk, 30) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.vertices, again.vertices)
    np.testing.assert_array_equal(first.colours, again.colours)
    assert other.vertices.shape != first.vertices.shape or np.abs(other.vertices - first.vertices).max() > 0.005


def test_seeds_differ_in_height_girth_and_clothes():
    people = [build_person(seed) for seed in range(30)]
    heights = [person.build.height_m for person in people]
    assert 1.45 < min(heights) < 1.6 and 1.75 < max(heights) < 1.95
    assert np.ptp([person.build.waist for person in people]) > 0.1
    assert {person.outfit.top for person in people} == {"short", "long"} == {person.outfit.legs for person in people}
    assert len({person.colours[200].round(2).tobytes() for person in people}) > 8


def test_limbs_are_where_the_landmarks_are(walk):
    """Each joint lies inside its tube, and the surface about a wrist is a wrist's radius away, about a knee a clothed knee's."""
    person = build_person(2, 1.75)
    vertices = person.mesh(walk, 20).vertices
    for joint, low, high in (("l_wrist", 0.012, 0.045), ("r_wrist", 0.012, 0.045), ("l_knee", 0.03, 0.09), ("r_knee", 0.03, 0.09)):
        nearest = np.linalg.norm(vertices - walk[joint][20], axis=1).min()
        assert low < nearest < high, joint
    head = vertices[np.abs(vertices[:, 2] - (walk["head"][20, 2] - 0.1)) < 0.02]
    assert 0.14 < np.ptp(head[:, 1]) < 0.22 and 0.17 < np.ptp(head[:, 0]) < 0.26
    assert abs(vertices[:, 2].max() - walk["head"][20, 2]) < 0.03


def test_toes_point_ahead_and_thumbs_too(walk):
    person = build_person(2, 1.75)
    mesh = person.mesh(walk, 0)
    first = 0
    for tube in person.tubes:
        own = mesh.vertices[first : first + len(tube.stations) * ANGLES]
        first += len(own)
        joint = walk[f"{tube.name[:2]}{'ankle' if 'foot' in tube.name else 'wrist'}"][0] if tube.name[0] in "lr" else None
        if tube.name.endswith("foot"):
            assert 0.14 < own[:, 0].max() - joint[0] < 0.24 and 0.03 < joint[0] - own[:, 0].min() < 0.12
        if tube.name.endswith("thumb"):
            assert own[:, 0].mean() > joint[0] + 0.01


def test_cloth_lags_behind_by_one_to_three_centimetres(walk):
    """Against the same person in clothes that have no room: cloth moves to and fro as far as it has room, less so in slow motion; skin stays."""
    person = build_person(3, 1.75)
    tight = replace(person, tubes=tuple(tube._replace(room_m=0 * tube.room_m) for tube in person.tubes))
    room = np.concatenate([tube.room_m for tube in person.tubes])
    moved = person.perform(walk, FPS).rings.centres - tight.perform(walk, FPS).rings.centres
    far = np.linalg.norm(moved, axis=-1)
    assert (far <= room + 1e-12).all() and far[:, room == 0].max() == 0
    assert 0.01 < far.max() < 0.03 and 0.01 < np.ptp(moved, axis=0).max() < 0.05
    slow = np.ptp(person.perform(walk, FPS / 10).rings.centres - tight.perform(walk, FPS / 10).rings.centres, axis=0)
    assert slow.max() < 0.8 * np.ptp(moved, axis=0).max()


def test_folds_change_with_the_bend(walk):
    person = build_person(3, 1.75)
    performance = person.perform(walk)
    straight, bent = (performance.bend[frame] for frame in (np.argmin(performance.bend.sum(axis=1)), np.argmax(performance.bend.sum(axis=1))))
    change = folded(person.folds, bent)[0] - folded(person.folds, straight)[0]
    assert 0.002 < np.abs(change).max() < 0.02


def test_skin_runs_on_across_a_knee_that_is_bent_far():
    """Rings a centimetre apart along the bones stay near each other across 130 degrees, and their axes stay square."""
    angle = np.radians(130.0)
    points = [np.array([place], float) for place in ((0, 0, 1.0), (0, 0, 0.6), (-0.4 * np.sin(angle), 0, 0.6 - 0.4 * np.cos(angle)))]
    left = np.array([[0.0, 1.0, 0.0]])
    rings = sweep(chain(points, [left, left]), np.linspace(0.0, 2.0, 81), np.array([0.065]))
    assert np.linalg.norm(np.diff(rings.centres[0], axis=0), axis=1).max() < 0.0101
    turn = np.sum(rings.tangents[0, 1:] * rings.tangents[0, :-1], axis=1)
    assert np.degrees(np.arccos(turn.min())) < 35
    np.testing.assert_allclose(np.sum(rings.tangents * rings.lateral, axis=-1), 0.0, atol=1e-12)


def test_the_shortest_turn(walk):
    random = np.random.default_rng(0)
    start, end, vectors = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in random.standard_normal((3, 50, 3)))
    np.testing.assert_allclose(turned(start, end, start), end, atol=1e-9)
    axis = np.cross(start, end)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    np.testing.assert_allclose(turned(start, end, axis), axis, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(turned(start, end, vectors), axis=1), 1.0)


def test_what_a_motion_lacks_is_derived(walk):
    whole = complete(walk)
    for side in ("l", "r"):
        ahead = whole[f"{side}_toe"] - walk[f"{side}_ankle"]
        assert (ahead[:, 0] > 0.1).mean() > 0.6 and np.linalg.norm(ahead, axis=1).max() < 0.25
        assert 0.1 < np.linalg.norm(whole[f"{side}_hand"] - walk[f"{side}_wrist"], axis=1).min() < 0.25


def test_gaps_are_closed_in_time(walk):
    gap = {name: track.copy() for name, track in walk.items()}
    gap["l_knee"][10:14] = np.nan
    np.testing.assert_allclose(complete(gap)["l_knee"][10:14], walk["l_knee"][10:14], atol=0.01)
    assert np.isfinite(build_person(0).mesh(gap, 11).vertices).all()


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda walk: {name: track for name, track in walk.items() if name != "l_knee"}, "l_knee"),
        (lambda walk: walk | {"l_knee": np.full_like(walk["l_knee"], np.nan)}, "l_knee: unknown in every frame"),
        (lambda walk: walk | {"l_knee": walk["l_knee"][:5]}, "l_knee: shape"),
    ],
)
def test_motions_that_carry_nobody(walk, change, sentence):
    with pytest.raises(InputError, match=sentence):
        build_person(0).perform(change(walk))


@pytest.mark.parametrize("height", [0.02, 175.0, float("nan")])
def test_heights_that_nobody_has(height):
    with pytest.raises(InputError, match="height"):
        build_person(0, height)


def test_one_frame_is_enough(walk):
    single = {name: track[:1] for name, track in walk.items() if name in MARKERS}
    assert np.isfinite(build_person(0).mesh(single, 0).vertices).all()


@pytest.mark.parametrize(("subject", "motion"), [("02", "02_03"), ("39", "39_05"), ("06", "06_01")])
def test_captured_walks(data_dir, subject, motion):
    """Nothing jumps from one frame to the next by more than a running foot does, nobody floats, and soles stay on the floor."""
    path = data_dir("cmu_mocap") / subject / f"{motion}.amc"
    performance = build_person(7).perform(landmarks(resample(read_motion(path), FPS)), FPS)
    meshes = np.stack([performance.mesh(frame).vertices for frame in range(0, min(len(performance), 120))])
    assert np.isfinite(meshes).all()
    assert np.linalg.norm(np.diff(meshes, axis=0), axis=-1).max() * FPS < 14.0
    assert np.median(meshes[..., 2].min(axis=1)) < 0.03
