"""What the judge of plausibility says of a run, as sentences with figures: warnings before the run, in its summary and in its report."""

from collections.abc import Callable, Mapping
from statistics import median
from typing import Any, NamedTuple

from bayes_body.initial.fitting.outline import LEAST_OVERLAP
from bayes_body.results.metrics.plausibility import BESIDE, LEAST_COVER, MOST_DISTANCE, SILHOUETTE
from bayes_body.results.posterior.mixing_sentences import frame_ranges

# How many times as far from the body a camera's keypoints are as those of the others, and the least share of the diagonal that counts.
WORSE, LEAST_ERROR = 2.0, 0.01
# The share of the diagonal above which the keypoints of a camera contradict the body; at least half of the cameras must.
MOST_ERROR = 0.02


class _Wording(NamedTuple):
    """One figure: its keys in the summary (`KEY_first`, `KEY_worst`), whether a value is off, and the words for it."""

    key: str
    is_off: Callable[[float], bool]
    figure: Callable[[float], str]


_KEYPOINTS = _Wording(
    "fit",
    lambda value: value > MOST_DISTANCE,
    lambda value: f"its markers are {value:.2f} of the person's size in the image away from the keypoints (limit {MOST_DISTANCE:g}; 0 is best)",
)
_COVER = _Wording(
    "fit",
    lambda value: value < LEAST_COVER,
    lambda value: f"its overlap with the silhouettes, relative to the smaller area, is {value:.2f} (limit {LEAST_COVER:g}; 1 is best)",
)
_OVERLAP = _Wording(
    "overlap",
    lambda value: value < LEAST_OVERLAP,
    lambda value: (
        f"its overlap with the silhouettes (IoU) is {value:.2f} (limit {LEAST_OVERLAP:g}; good poses have 0.6 or more), "
        "so one is much larger than the other"
    ),
)
_WORDINGS = {"silhouettes": (_COVER, _OVERLAP), "keypoints": (_KEYPOINTS,)}


def fit_sentences(figures: Mapping[str, Any]) -> list[str]:
    """Return warnings about a first pose that does not fit, and about frames in which the body is not on the person or nothing tells.

    Args:
        figures: the figures from `first_fit` or `fit_figures`, or a whole summary. A summary from an older version gives fewer warnings.
    """
    wordings = _WORDINGS.get(figures.get("fit_by") or "", ())
    sentences = [_first(wordings, figures), _describe_lost_frames(wordings, figures), _outside(figures), _beside(figures), _blind(figures)]
    sentences += [_most_cameras(figures) or _worst_camera(figures)]
    return [sentence for sentence in sentences if sentence]


def _worst_camera(figures: Mapping[str, Any]) -> str | None:
    """A sentence on a camera whose keypoints the posterior does not reach while it reaches those of the others."""
    cameras: Mapping[str, Mapping[str, float]] = figures.get("reprojection_by_camera") or {}
    if len(cameras) < 3:
        return None
    worst = max(cameras, key=lambda name: cameras[name]["of_diagonal"])
    usual = median(figure["of_diagonal"] for name, figure in cameras.items() if name != worst)
    share = cameras[worst]["of_diagonal"]
    if share <= LEAST_ERROR or share <= WORSE * usual:
        return None
    return (
        f"camera '{worst}' fits worse than the others: its keypoints are {cameras[worst]['px']:.0f} px ({share:.1%} of the image's diagonal) from "
        f"the body, those of the others {usual:.1%} (median): its calibration, its clock or its keypoints may be wrong; look at its pictures, "
        "or remove its [[camera]] from session.toml."
    )


def _most_cameras(figures: Mapping[str, Any]) -> str | None:
    """A sentence on keypoints that the posterior does not reach in half of the cameras or more."""
    cameras: Mapping[str, Mapping[str, float]] = figures.get("reprojection_by_camera") or {}
    contradicting = [name for name, figure in cameras.items() if figure["of_diagonal"] > MOST_ERROR]
    if not contradicting or 2 * len(contradicting) < len(cameras):
        return None
    listed = ", ".join(f"{name} {cameras[name]['px']:.0f} px ({cameras[name]['of_diagonal']:.1%} of the diagonal)" for name in contradicting)
    return (
        f"the body is far from the keypoints in {len(contradicting)} of {len(cameras)} cameras: {listed}, limit {MOST_ERROR:.0%}: the "
        "calibration, the order of the keypoints or the person's size may be wrong; import the recording again and read what it says of the cameras."
    )


def _crossed(wordings: tuple[_Wording, ...], figures: Mapping[str, Any], end: str) -> tuple[_Wording, float] | None:
    """The first of the wordings whose figure is off, and the figure."""
    values = ((wording, figures.get(f"{wording.key}_{end}")) for wording in wordings)
    return next(((wording, value) for wording, value in values if value is not None and wording.is_off(value)), None)


def _first(wordings: tuple[_Wording, ...], figures: Mapping[str, Any]) -> str | None:
    crossed = _crossed(wordings, figures, "first")
    if crossed is None:
        return None
    wording, value = crossed
    bystander = figures.get("fit_bystander")
    if bystander is not None:
        return (
            f"frame {figures.get('first_frame', 0)}: the first pose is that of another person: it is {bystander:.2f} of a person's size in the image "
            f"away from that person's keypoints, and {value:.2f} from those of the person who is tracked; remove the first pose from the session, or "
            "track the other person with --person."
        )
    remedy = "check the calibration, the units, the subject's height, the silhouettes and the first pose of the session"
    return f"frame {figures.get('first_frame', 0)}: the body in its first pose does not fit the image: {wording.figure(value)}; {remedy}."


def _describe_lost_frames(wordings: tuple[_Wording, ...], figures: Mapping[str, Any]) -> str | None:
    off, crossed = figures.get("frames_off") or [], _crossed(wordings, figures, "worst")
    if not off or crossed is None:
        return None
    wording, worst = crossed
    start = figures.get("first_frame", 0)
    to_the_end = off[-1] == start + figures.get("frames", 0) - 1 and off == list(range(off[0], off[-1] + 1))
    if off[0] == start and to_the_end:
        extent = "from the first frame to the last the body does not cover the person"
    elif to_the_end:
        extent = f"from frame {off[0]} the body no longer covers the person"
    else:
        extent = f"{frame_ranges(off)}: the body does not cover the person"
    at_worst = f"at worst, at frame {figures[f'{wording.key}_worst_frame']}, {wording.figure(worst)}"
    restarts = figures.get("frames_restarted") or []
    restarted = (
        f"; it was restarted at frame{'s' * (len(restarts) > 1)} {', '.join(map(str, restarts))}, where the person was found again"
        if restarts
        else ""
    )
    remedy = "the poses there do not follow the person: look at the overlay, and raise --particles or correct the first pose"
    return f"{extent}{restarted}: {at_worst}; {remedy}."


def _outside(figures: Mapping[str, Any]) -> str | None:
    outside = figures.get("frames_outside") or []
    if not outside:
        return None
    return f"{frame_ranges(outside)}: the body is outside of the image of every camera: only the motion prior determines its pose there."


def _beside(figures: Mapping[str, Any]) -> str | None:
    beside = figures.get("frames_beside") or []
    if not beside or figures.get("fit_by") != "keypoints":
        # By the silhouettes, such frames are lost already.
        return None
    problem = f"the body lies beside the silhouettes of all cameras (overlap below {BESIDE:g}), although it is fitted to keypoints"
    remedy = "the keypoints are another person's, or the silhouettes or the calibration are wrong: look at the overlay"
    return f"{frame_ranges(beside)}: {problem}; {remedy}."


def _blind(figures: Mapping[str, Any]) -> str | None:
    blind = figures.get("frames_blind") or []
    if not blind:
        return None
    least, most = (f"{100 * share:g}" for share in SILHOUETTE)
    problem = f"no camera's silhouette can be a person's: each covers less than {least} % or more than {most} % of its image"
    remedy = "nothing there tells whether the body is on the person: look at the overlay, and correct masks or background"
    return f"{frame_ranges(blind)}: {problem}; {remedy}."
