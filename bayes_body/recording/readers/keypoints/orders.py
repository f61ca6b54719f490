"""In which order the points of keypoint files are, by camera and by stretch of frames: the body's proportions tell (proportions.py).

The orders that are compared are those of the layouts with this number of points, and the same with all points moved by one place. A camera's frames
are split where another order begins to fit: the path of orders with the smallest sum of misfits, where each change costs as much as some wrong poses.
An order is contradicted only if another one fits clearly better over a whole stretch, and fits well.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.recording.readers.faults import Faults
from bayes_body.recording.readers.keypoints.openpose import LAYOUTS
from bayes_body.recording.readers.keypoints.proportions import Poses, misfit, pose_misfits

# To choose between two layouts, and to contradict the expected one: the misfit in the wrong order must be this many times as large.
CLEARLY, CONTRADICTS = 1.5, 2.0
# Misfits of an order that fits well, of one that is chosen, and of points in no known order.
FITS, DECIDES, LARGEST = 0.12, 0.2, 0.3
# A stretch of fewer poses says little. Whether points have no known order is judged on more.
FEWEST_POSES, FEWEST_IN_ALL = 5, 10
# Misfit, summed over poses, at which a change of the order is assumed.
CHANGE = 1.0
ONE_ORDER = "give the keypoints of one network"


class Order(NamedTuple):
    """A layout, and by how many places all points are moved in the files: 0, 1 later or -1 earlier."""

    layout: str
    moved: int = 0

    @property
    def keypoints(self) -> tuple[str, ...]:
        """The names of the points of a file."""
        names = LAYOUTS[self.layout]
        return names[-self.moved :] + names[: -self.moved]

    def __str__(self) -> str:
        if not self.moved:
            return self.layout
        return f"{self.layout} with all points one place {'later' if self.moved > 0 else 'earlier'}"


class CameraPoses(NamedTuple):
    """The people of all frames of a camera: their points, column and row, NaN where not found; and each one's frame, in ascending order."""

    poses: Poses
    frames: Int[np.ndarray, " pose"]


class Stretch(NamedTuple):
    """Consecutive frames of a camera in one order, `order`, and the poses in them."""

    camera: str
    first: int
    last: int
    order: Order
    poses: Poses


class Orders(NamedTuple):
    """The layout of each camera's files, a sentence for the user (or None), and the misfit of all people in these orders; 0 if each fits well."""

    layouts: Mapping[str, str]
    remark: str | None = None
    misfit: float = 0.0


def layout_names(count: int, name: str | None = None) -> list[str]:
    """The layouts with this number of points; the one that the user names.

    Raises:
        InputError: no order of that name or with this number of points.
    """
    fitting = [layout for layout, keypoints in LAYOUTS.items() if len(keypoints) == count]
    if name is None:
        if not fitting:
            layouts = ", ".join(f"{layout} ({len(keypoints)})" for layout, keypoints in LAYOUTS.items())
            raise input_error("keypoints", f"{count} per person", layouts, "write them in one of these orders")
        return fitting
    if name not in LAYOUTS:
        raise InputError(f"--layout: '{name}': no such order; {nearest(name, LAYOUTS)}")
    if name not in fitting:
        remedy = "name the order in which the keypoints are written"
        raise input_error(f"--layout {name}", f"{count} keypoints per person", f"{len(LAYOUTS[name])}", remedy)
    return [name]


def decide_orders(cameras: Mapping[str, CameraPoses], count: int, name: str | None = None, first_frame: int = 0) -> Orders:
    """Decide the order of each camera's points.

    Args:
        cameras: the people whom each camera sees.
        count: number of points of a person.
        name: the layout that the user names; None: the number of points decides, then the body's proportions.
        first_frame: number of the frame 0, as the user knows it.

    Raises:
        FaultyFileError: the points are not in the named order, all are moved by one place, or the order changes from a frame on.
        InputError: no order of that name or with this number of points, or proportions do not decide between two.
    """
    named = layout_names(count, name)
    layouts = layout_names(count)
    orders = [Order(layout, moved) for moved in (0, 1, -1) for layout in layouts]
    poses = np.concatenate([camera.poses for camera in cameras.values()])
    # The layouts by their misfit: a tie leaves them as they are.
    ranked = sorted(named, key=lambda layout: misfit(poses, LAYOUTS[layout]))
    expected = Order(ranked[0])
    stretches = [stretch for camera, people in cameras.items() for stretch in _stretches(camera, people, orders, expected)]
    contradicting = [stretch for stretch in stretches if stretch.order != expected]
    _refuse(contradicting, cameras, expected, name, first_frame)
    if not contradicting:
        remark = _describe_choice(poses, expected.layout, ranked[1] if len(ranked) > 1 else None)
        return Orders(dict.fromkeys(cameras, expected.layout), remark, misfit(poses, expected.keypoints))
    read = {stretch.camera: stretch.order.layout for stretch in stretches}
    listed = "; ".join(f"{', '.join(camera for camera in read if read[camera] == layout)}: {layout}" for layout in dict.fromkeys(read.values()))
    return Orders(read, f"By the body's proportions the cameras' points are in different orders, and are read so ({listed}).")


def _describe_choice(poses: Poses, layout: str, second: str | None) -> str | None:
    """Say how one of two layouts was chosen; refuse points that fit the second one nearly as well, or none of them."""
    if second is None:
        return None
    first_misfit, second_misfit = misfit(poses, LAYOUTS[layout]), misfit(poses, LAYOUTS[second])
    if not (first_misfit <= DECIDES and second_misfit > CLEARLY * first_misfit):
        problem = f"{len(LAYOUTS[layout])} per person, which may be {layout} or {second}"
        remedy = f"choose one with --layout {layout} or --layout {second}"
        raise input_error("keypoints", problem, "people whose limb lengths decide between them", remedy)
    differences = f"lengths differ from a body's proportions by {first_misfit:.0%}, and by {second_misfit:.0%} in the order {second}"
    return f"The keypoints are read as {layout}: {differences}."


def check_body(orders: Orders, body: Poses, names: tuple[str, ...], is_named: bool) -> list[str]:
    """Refuse points that are no body in the order in which they are read; return a sentence if the user names the order.

    Pictures alone do not tell: seen along its axis, a body has no proportions. So the triangulated body must contradict the order too.

    Args:
        orders: as decided.
        body: the triangulated points of the subject, one pose a frame, metres; NaN where not found.
        names: of the points.
        is_named: whether the user names the order.

    Raises:
        InputError: the points are in no known order.
    """
    if len(body) < FEWEST_IN_ALL or not (LARGEST < orders.misfit < np.inf and LARGEST < (difference := misfit(body, names)) < np.inf):
        return []
    layouts = " and ".join(dict.fromkeys(orders.layouts.values()))
    problem, expected = f"lengths differ from a body's proportions by {difference:.0%} in the order {layouts}", f"at most {LARGEST:.0%}"
    if is_named:
        return [f"--layout {layouts}: {problem}, expected {expected}: check that the points are in this order."]
    raise input_error("keypoints", problem, expected, f"write the points in this order, or give --layout {layouts} if they are")


def _refuse(contradicting: Sequence[Stretch], cameras: Mapping[str, CameraPoses], expected: Order, name: str | None, first_frame: int) -> None:
    """Refuse points that are moved, or whose order changes from a frame on, or is not the one that the user names; one sentence for each kind."""
    kinds: dict[tuple[range | None, Order], list[Stretch]] = {}
    for stretch in contradicting:
        frames = cameras[stretch.camera].frames
        is_whole = stretch.first <= frames[0] and stretch.last >= frames[-1]
        span = None if is_whole else range(stretch.first + first_frame, stretch.last + first_frame + 1)
        if span is not None or stretch.order.moved or name is not None:
            kinds.setdefault((span, stretch.order), []).append(stretch)
    faults = Faults()
    for (span, order), stretches in kinds.items():
        named, poses = [stretch.camera for stretch in stretches], np.concatenate([stretch.poses for stretch in stretches])
        is_everywhere = len(named) == len(cameras)
        better, worse = misfit(poses, order.keypoints), misfit(poses, expected.keypoints)
        when = "" if span is None else f"from frame {span[0]} to frame {span[-1]}, "
        problem = f"{when}lengths differ from a body's proportions by {better:.0%} in the order {order}, and by {worse:.0%} in the order {expected}"
        with faults.collect():
            subject = "keypoints" if is_everywhere else f"keypoints of {', '.join(named)}"
            raise input_error(subject, problem, f"the order {expected.layout} in all frames", _remedy(order, span is None, is_everywhere))
    faults.raise_any()


def _remedy(order: Order, is_whole: bool, is_everywhere: bool) -> str:
    if order.moved:
        return "write each point in its place; perhaps one is missing at the beginning of the list, or one is too many"
    if not is_whole:
        return ONE_ORDER
    return f"give --layout {order.layout}" if is_everywhere else "leave --layout out: each camera is then read in its order"


def _stretches(camera: str, people: CameraPoses, orders: Sequence[Order], expected: Order) -> list[Stretch]:
    """Split a camera's frames where another order begins to fit. A stretch that does not contradict the expected order has that one."""
    if not len(people.poses):
        return []
    path = _path(np.stack([pose_misfits(people.poses, order.keypoints) for order in orders], axis=1))
    ends = [*np.flatnonzero(np.diff(path)) + 1, len(path)]
    stretches = list[Stretch]()
    for first, end in zip([0, *ends[:-1]], ends, strict=True):
        poses = people.poses[first:end]
        order = orders[path[first]] if _is_contradicted(poses, expected, orders[path[first]]) else expected
        if stretches and stretches[-1].order == order:
            previous = stretches.pop()
            stretches.append(previous._replace(last=int(people.frames[end - 1]), poses=np.concatenate([previous.poses, poses])))
        else:
            stretches.append(Stretch(camera, int(people.frames[first]), int(people.frames[end - 1]), order, poses))
    return stretches


def _is_contradicted(poses: Poses, expected: Order, order: Order) -> bool:
    if order == expected or len(poses) < FEWEST_POSES:
        return False
    fit = misfit(poses, order.keypoints)
    return fit < FITS and misfit(poses, expected.keypoints) > CONTRADICTS * fit


def _path(costs: Float[np.ndarray, "pose order"]) -> Int[np.ndarray, " pose"]:
    """The order of each pose with the smallest sum of costs, where a change costs `CHANGE` (Viterbi)."""
    costs = np.nan_to_num(costs)
    totals, origins = costs[0].copy(), np.zeros(costs.shape, int)
    for k in range(1, len(costs)):
        cheapest = int(np.argmin(totals))
        stays = totals <= totals[cheapest] + CHANGE
        origins[k] = np.where(stays, np.arange(len(totals)), cheapest)
        totals = np.where(stays, totals, totals[cheapest] + CHANGE) + costs[k]
    path = np.empty(len(costs), int)
    path[-1] = np.argmin(totals)
    for k in range(len(costs) - 1, 0, -1):
        path[k - 1] = origins[k, path[k]]
    return path
