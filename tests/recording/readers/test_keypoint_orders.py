"""The order of keypoints follows from a body's proportions, by camera and by stretch of frames; orders that cannot be are refused."""

import numpy as np
import pytest
from body_figures import figures, seen_by

from bayes_body.base.errors import InputError
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS, read_openpose
from bayes_body.recording.readers.keypoints.orders import LARGEST, CameraPoses, check_body, decide_orders
from bayes_body.recording.readers.keypoints.proportions import misfit


def cameras(layout, count=2, **errors):
    """A person of 24 frames, seen by cameras from two sides."""
    views = seen_by(figures(layout, 24), count, **errors)
    return {f"cam{c}": CameraPoses(poses, np.arange(len(poses))) for c, poses in enumerate(views)}


def moved(seen, places):
    return seen._replace(poses=np.roll(seen.poses, places, axis=1))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_right_orders_are_read_even_with_many_wrong_detections(layout):
    for wrong in (0.0, 0.1, 0.3):
        orders = decide_orders(cameras(layout, wrong=wrong), len(LAYOUTS[layout]))
        assert set(orders.layouts.values()) == {layout}
        assert orders.remark is None or f"read as {layout}" in orders.remark
        assert decide_orders(cameras(layout, wrong=wrong), len(LAYOUTS[layout]), layout).remark is None


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("is_named", [False, True])
def test_points_that_are_moved_by_one_place_are_refused(layout, is_named):
    for places, word in ((1, "later"), (-1, "earlier")):
        seen = {camera: moved(poses, places) for camera, poses in cameras(layout, wrong=0.1).items()}
        with pytest.raises(InputError, match=rf"^keypoints: lengths .* {layout} with all points one place {word}, and by .*; write each point"):
            decide_orders(seen, len(LAYOUTS[layout]), layout if is_named else None)


def test_a_single_camera_whose_points_are_moved_is_named():
    seen = cameras("COCO_17", 3)
    seen["cam1"] = moved(seen["cam1"], 1)
    with pytest.raises(InputError, match=r"^keypoints of cam1: lengths .* COCO_17 with all points one place later"):
        decide_orders(seen, 17)


def test_cameras_in_different_orders_are_read_in_theirs():
    seen = {"a": cameras("BODY_25B")["cam0"], "b": cameras("BODY_25")["cam1"]}
    orders = decide_orders(seen, 25)
    assert orders.layouts == {"a": "BODY_25B", "b": "BODY_25"}
    assert orders.remark is not None and "a: BODY_25B; b: BODY_25" in orders.remark
    with pytest.raises(InputError, match=r"^keypoints of b: .* in the order BODY_25, .*; leave --layout out"):
        decide_orders(seen, 25, "BODY_25B")
    with pytest.raises(InputError, match=r"^keypoints: .*; give --layout BODY_25\.$"):
        decide_orders({"b": seen["b"]}, 25, "BODY_25B")


@pytest.mark.parametrize("name", [None, "BODY_25B"])
def test_an_order_that_changes_is_refused_with_the_frame(name):
    seen = {}
    for (camera, first), last in zip(cameras("BODY_25B").items(), cameras("BODY_25").values(), strict=True):
        seen[camera] = CameraPoses(np.concatenate([first.poses[:15], last.poses[15:]]), first.frames)
    with pytest.raises(InputError, match=r"^keypoints: from frame 115 to frame 123, .* BODY_25, .* one network"):
        decide_orders(seen, 25, name, first_frame=100)


def test_points_in_no_known_order_are_refused_unless_the_order_is_given():
    shuffled, names = np.random.default_rng(3).permutation(26), LAYOUTS["HALPE_26"]
    orders = decide_orders({camera: people._replace(poses=people.poses[:, shuffled]) for camera, people in cameras("HALPE_26").items()}, 26)
    body = figures("HALPE_26", 24)
    with pytest.raises(InputError, match=r"^keypoints: lengths differ .* in the order HALPE_26; expected at most 30%; .* --layout HALPE_26"):
        check_body(orders, body[:, shuffled], names, is_named=False)
    (remark,) = check_body(orders, body[:, shuffled], names, is_named=True)
    assert remark.startswith("--layout HALPE_26: lengths differ")
    # One camera has no body, and a right body is right whatever a picture of it shows.
    assert check_body(orders, body[:0], names, is_named=False) == []
    assert check_body(orders, body, names, is_named=False) == []


@pytest.mark.parametrize("layout", ["COCO_17", "COCO_18", "HALPE_26"])
def test_a_body_seen_along_its_axis_is_not_refused(layout):
    from_above = np.repeat(200 * figures(layout, 1)[..., [0, 2]], 24, axis=0)
    orders = decide_orders({"a": CameraPoses(from_above, np.arange(24))}, len(LAYOUTS[layout]))
    assert orders.misfit > LARGEST and orders.remark is None
    assert check_body(orders, np.zeros((0, len(LAYOUTS[layout]), 3)), LAYOUTS[layout], is_named=False) == []


def test_layouts_that_cannot_be():
    seen = cameras("BODY_25")
    with pytest.raises(InputError, match=r"--layout: 'BODY25': no such order; did you mean 'BODY_25'\?"):
        decide_orders(seen, 25, "BODY25")
    with pytest.raises(InputError, match="--layout COCO_17: 25 keypoints per person; expected 17"):
        decide_orders(seen, 25, "COCO_17")
    with pytest.raises(InputError, match="keypoints: 20 per person"):
        decide_orders(seen, 20)
    hidden = seen["cam0"].poses.copy()
    hidden[:, 5:] = np.nan
    with pytest.raises(InputError, match=r"25 per person, which may be BODY_25 or BODY_25B; .*--layout"):
        decide_orders({"a": CameraPoses(hidden, np.arange(24))}, 25)


def test_the_real_data_say_body_25b(pose2sim_beam):
    seen = {}
    for camera in ("cam01", "cam02", "cam03", "cam04"):
        people = read_openpose(pose2sim_beam / "pose" / f"{camera}_json", range(100))[..., :2]
        visible = np.isfinite(people[..., 0]).any(axis=-1)
        seen[camera] = CameraPoses(people[visible], np.nonzero(visible)[0])
    assert set(decide_orders(seen, 25).layouts.values()) == {"BODY_25B"}
    everybody = np.concatenate([poses.poses for poses in seen.values()])
    assert misfit(everybody, LAYOUTS["BODY_25B"]) < 0.1 < 0.3 < misfit(everybody, LAYOUTS["BODY_25"])
