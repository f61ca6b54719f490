"""How thick a body looks: trousers are found where they are, images see them, legs pass without them, and what cannot be fitted is said."""

from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.base.geometry.camera import project
from bayes_body.initial import FirstPose, apply_first_pose, first_pose, restored, stored
from bayes_body.initial.fitting.outline import fit_outline
from bayes_body.model.body.solids import part_transforms
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.recording.session.read import load_session, save_session
from bayes_body.recording.session.session import Segmentation, Subject
from bayes_body.results.metrics.fit import intersection_over_union, projected_masks

# Fits and replications run for longer than they compile.
pytestmark = pytest.mark.usefixtures("optimised")

HEIGHT_M = 1.75
STANDING = {
    "root_z": 0.95,
    "root_yaw": 0.4,
    "l_hip_y": -0.3,
    "r_hip_y": 0.25,
    "l_knee": -0.2,
    "r_knee": -0.5,
    "l_shoulder_y": -1.2,
    "r_shoulder_y": 1.2,
}
# Of calves in trousers, against the body's: at the knee and at the ankle.
WIDE = (1.4, 1.9)


@pytest.fixture(scope="module")
def recording(scene, tmp_path_factory):
    """`recording(masks)`: a session of four cameras whose first frame has these silhouettes; None leaves a camera's away."""

    def make(masks, cameras=4, **known):
        folder = tmp_path_factory.mktemp("outline")
        session = scene(cameras, initial=STANDING, fit_outline=True, **known)
        views = []
        for view, mask in zip(session.views, masks, strict=True):
            name = view.camera.name
            (folder / name).mkdir()
            # A picture of one grey level everywhere would be a camera that failed.
            room = np.random.default_rng(0).integers(60, 120, view.camera.size_px[::-1], np.uint8)
            cv2.imwrite(str(folder / name / "0.png"), room)
            if mask is not None:
                cv2.imwrite(str(folder / name / "m0.png"), np.uint8(255) * mask)
            views.append(replace(view, images=f"{name}/%d.png", masks=f"{name}/m%d.png"))
        return replace(session, folder=folder, views=tuple(views), frames=1)

    return make


def dressed(scene):
    """Silhouettes of somebody in the pose whose calves look thicker than they are: not the body that is fitted, but one with limbs of other
    lengths, hands and feet of its own, and ragged edges."""
    lengths = {f"{side}_{part}": share * HEIGHT_M for side in "lr" for part, share in {"thigh": 0.250, "calf": 0.242, "upper_arm": 0.182}.items()}
    someone = replace(scene(4, initial=STANDING), subject=Subject(height_m=HEIGHT_M, lengths_m=lengths))
    usual = build_model("deutscher_2005", someone).body
    radii = dict(zip(usual.topology.names, np.asarray(usual.radii, float).tolist(), strict=True))
    trousers = {f"{side}_calf": tuple(np.multiply(radii[f"{side}_calf"], WIDE).tolist()) for side in "lr"}
    model = build_model("deutscher_2005", replace(someone, subject=replace(someone.subject, outline_radii_m=trousers)))
    pose = np.asarray(model.initial["pose"])
    limbs, ends = projected_masks(model, pose, someone), hands_and_feet(model, pose)
    return [ragged(limb | end, seed) for seed, (limb, end) in enumerate(zip(limbs, ends, strict=True))]


def hands_and_feet(model, pose):
    """Discs in each camera's image: a hand below each forearm, a foot before each ankle."""
    parts = part_transforms(model.body, jnp.asarray(pose))
    names = model.body.topology.names
    forward = np.array([np.cos(STANDING["root_yaw"]), np.sin(STANDING["root_yaw"]), 0])
    masks = [np.zeros((1920, 1088), np.uint8) for _ in range(4)]
    for part, ahead, radius in [(f"{side}_{limb}", *size) for side in "lr" for limb, size in {"calf": (0.07, 0.05), "forearm": (0.0, 0.045)}.items()]:
        k = names.index(part)
        place = np.asarray(parts.origin[k] + (model.body.lengths[k] + 0.03) * parts.z[k]) + ahead * forward
        pixels = np.asarray(jax.jit(jax.vmap(project, (0, None)))(model.rig, jnp.asarray([place, place + np.array([0, 0, radius])]))[0])
        for mask, ((u, v), (_, top)) in zip(masks, pixels, strict=True):
            cv2.circle(mask, (round(u), round(v)), round(abs(v - top)), 1, -1)
    return [mask.astype(bool) for mask in masks]


def ragged(mask, seed):
    """With an edge that wanders by some pixels."""
    noise = cv2.GaussianBlur(np.random.default_rng(seed).normal(size=mask.shape), (0, 0), 4)
    return cv2.GaussianBlur(mask.astype(float), (0, 0), 3) + np.clip(0.25 * noise / noise.std(), -0.45, 0.45) > 0.5


def ratios(outline, model):
    radii = np.asarray(model.body.radii, float)
    return {part: np.divide(outline.radii_m[part], radii[k]) for k, part in enumerate(model.body.topology.names)}


def trousers(thick):
    """Whether calves are about as thick as they look: the ankle, of few pixels, is drawn to what is usual."""
    knee, ankle = thick["l_calf"]
    return knee == pytest.approx(WIDE[0], rel=0.1) and 1.2 < ankle < WIDE[1]


@pytest.mark.slow
def test_trousers_are_found_where_they_are(scene, recording):
    masks = dressed(scene)
    session = recording(masks)
    usual = build_model("silhouettes", session)
    found = fit_outline(usual, session)
    assert found.after > found.before + 0.04
    thick = ratios(found, usual)
    assert trousers(thick)
    assert thick["r_calf"] == pytest.approx(thick["l_calf"])
    for part in ("torso", "l_thigh", "l_upper_arm", "l_forearm"):
        assert thick[part] == pytest.approx(1, abs=0.12), part
    for part in ("l_foot", "r_foot", "l_hand", "r_hand"):
        assert thick[part] == pytest.approx(1, abs=1e-6), part
    # Somebody as large touches the person in all views, and the body in its first pose tells whose a figure is.
    crowd = recording([mask | np.roll(mask, np.ptp(np.flatnonzero(mask.any(axis=0))), axis=1) for mask in masks])
    crowd = replace(crowd, segmentation=Segmentation(figures="near_body"))
    assert trousers(ratios(fit_outline(usual, crowd), usual))


@pytest.mark.long
def test_images_see_the_clothes_and_legs_pass_without_them(scene, recording):
    masks = dressed(scene)
    session = recording(masks)
    usual = build_model("silhouettes", session)
    model = apply_first_pose(usual, session, first_pose(usual, session))
    calf = model.body.topology.names.index("l_calf")
    likelihood, intersection = (factor.log_potential for factor in model.factors)
    assert likelihood.body.outline_radii[calf, 0] > 1.3 * usual.body.radii[calf, 0]
    assert intersection.args[0].radii[calf, 0] == usual.body.radii[calf, 0]
    overlap = [
        np.mean([intersection_over_union(a, b) for a, b in zip(projected_masks(m, np.asarray(m.initial["pose"]), session), masks, strict=True)])
        for m in (usual, model)
    ]
    assert overlap[1] > overlap[0] + 0.03


@pytest.mark.long
def test_a_camera_that_shows_nobody_is_left_out(scene, recording):
    masks = dressed(scene)
    nobody = np.zeros_like(masks[1])
    session = recording([masks[0], nobody, masks[2], None])
    usual = build_model("silhouettes", session)
    assert trousers(ratios(fit_outline(usual, session), usual))
    with pytest.raises(InputError, match=r"fit_outline: true, but no camera shows a silhouette in the first frame; expected .*; set it to false"):
        fit_outline(usual, recording([nobody] * 4))


@pytest.mark.long
def test_a_moving_camera_looks_from_where_it_is_in_the_first_frame(scene, recording):
    masks = dressed(scene)
    session = recording(masks)
    true = session.views[0].camera
    np.savez(session.folder / "moving.npz", rotation=np.asarray(true.rotation)[None], translation_m=np.asarray(true.translation_m)[None])
    elsewhere = replace(true, translation_m=np.add(true.translation_m, (1.0, 0.0, 0.0)))
    moving = replace(session, views=(replace(session.views[0], camera=elsewhere, path="moving.npz"), *session.views[1:]))
    still, moved = (fit_outline(build_model("silhouettes", each), each) for each in (session, moving))
    assert moved.after == pytest.approx(still.after, abs=1e-4)


def test_without_silhouettes_it_says_what_to_give(scene, recording):
    session = recording([None] * 4)
    bare = replace(session, views=tuple(replace(view, masks=None) for view in session.views))
    with pytest.raises(InputError, match=r"fit_outline: true, in a session without silhouettes; .*; set it to false, or give each \[\[camera\]\]"):
        first_pose(build_model("silhouettes", bare), bare)


@pytest.mark.slow
def test_a_pose_elsewhere_is_said_and_changes_nothing(scene, recording):
    masks = dressed(scene)
    session = replace(recording(masks), initial=STANDING | {"root_x": 0.6}, positions=frozenset({"root_x", "root_z"}))
    usual = build_model("silhouettes", session)
    found = first_pose(usual, session)
    assert not found.outline_radii_m
    assert "overlaps the silhouettes with an IoU of 0." in found.remarks[0]
    assert "the outline was not fitted" in found.remarks[0]


def test_what_is_kept_comes_back(model):
    pose = model.initial["pose"]
    found = FirstPose(pose, "fitted", lengths_m={"l_thigh": 0.5}, outline_radii_m={"l_calf": (0.1, 0.07)})
    table = stored(model, found)
    again = restored(model, table, "run.toml")
    assert (again.lengths_m, again.outline_radii_m) == (found.lengths_m, found.outline_radii_m)
    assert (again.pose == pose).all()
    for radii in ({"l_calf": 0.1}, {"l_calf": [0.1]}, [0.1, 0.1]):
        with pytest.raises(InputError, match="lengths or radii that are not numbers"):
            restored(model, table | {"outline_radii_m": radii}, "run.toml")
    with pytest.raises(InputError, match="some values are not numbers"):
        restored(model, table | {"outline_radii_m": {"l_calf": [0.1, "thick"]}}, "run.toml")


def test_another_bodys_outline_is_not_taken(scene):
    session = scene(1)
    strange = replace(session, subject=Subject(body="arm_4", height_m=1.8, outline_radii_m={"upper_arm": (0.3, 0.3)}))
    model = build_model("silhouettes", strange)
    found = FirstPose(model.initial["pose"], "fitted", outline_radii_m={"l_calf": (0.1, 0.07)})
    calf = model.body.topology.names.index("l_calf")
    assert np.asarray(apply_first_pose(model, strange, found).body.outline_radii[calf]) == pytest.approx((0.1, 0.07))


def test_a_session_says_how_thick_somebody_looks(recording, scene):
    session = replace(recording([None] * 4), subject=Subject(body="person_31", outline_radii_m={"l_calf": (0.09, 0.06)}))
    again = load_session(save_session(session))
    assert again.fit_outline
    assert again.subject.outline_radii_m == {"l_calf": (0.09, 0.06)}
    model = build_model(load_definition("silhouettes"), again)
    calf = model.body.topology.names.index("l_calf")
    assert np.asarray(model.body.outline_radii[calf]) == pytest.approx((0.09, 0.06))
    # Thicker than the body's own: that stays as it is.
    assert model.body.radii[calf, 1] < 0.05
    wrong = replace(again, subject=replace(again.subject, outline_radii_m={"l_cafl": (0.09, 0.06)}))
    with pytest.raises(InputError, match=r"subject.outline_radii_m.l_cafl: no such name; .*l_calf"):
        build_model(load_definition("silhouettes"), wrong)
    save_session(session)
    path = session.folder / "session.toml"
    path.write_text(path.read_text().replace("[0.09, 0.06]", "[0.09, -0.06]"))
    with pytest.raises(FaultyFileError, match="outline_radii_m"):
        load_session(path)
