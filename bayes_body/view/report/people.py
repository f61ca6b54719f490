r"""The report of several people of one recording: who they are, pictures of all, their paths on the floor, and how near they come to each other.

A person's place is the middle of the body's markers, and distances are horizontal. Two people who are nearer than NEAR_M may have been exchanged if
the posterior cannot tell them apart: if the distance of their means is at most $1.645 \sqrt{s_1^2 + s_2^2}$, with s the standard deviations of the
places, which is the half-width of a 90 % interval of the distance.
"""

import os
from collections.abc import Iterator, Sequence
from importlib.resources import files
from itertools import combinations
from pathlib import Path
from string import Template
from typing import NamedTuple
from urllib.parse import quote

import numpy as np
from jaxtyping import Bool, Float

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import check_free, has_mark, make_folder, write_text
from bayes_body.base.progress import Watch, unwatched
from bayes_body.results.posterior.blocks import placing_blocks, pooled, weights_of_runs
from bayes_body.results.posterior.moments import Moments, weighted_moments
from bayes_body.results.storage.names import OVERLAY_FILE, PEOPLE_REPORT_FILE
from bayes_body.results.storage.saved_moments import markers_of_each
from bayes_body.view.colours import run_line
from bayes_body.view.people import People, Person
from bayes_body.view.report.figures import draw_limit, encoded, frames_a_point, new_panel, style, time_axis, time_label
from bayes_body.view.report.markup import Markup, Picture, details, figures, joined, section, table, tag
from bayes_body.view.report.page import FILE_NAME as RUN_REPORT
from bayes_body.view.report.page import LARGEST, MARK
from bayes_body.view.report.pictures import QUALITIES, read_stills

# Metres within which two people are near each other. Seconds: a shorter time is no doubt, and a shorter interruption does not end one.
NEAR_M, LEAST_S = 0.3, 0.05
# Half-width of a 90 % interval in standard deviations. Share of the common frames above which two tracks are one person's.
HALF_WIDTH, MOST_SHARE = 1.645, 0.5
# So many frames of a path show their bands.
BANDS = 60
DOUBT = "{a} and {b} may have been exchanged between frames {first} and {last}: there they are within each other's uncertainty."
TWINS = "{a} and {b} may be one person who was tracked twice: in frames {first} to {last} they are within each other's uncertainty."
NO_DOUBT = "Nobody comes so near to another person that the posterior could not tell the two apart."
PATHS = "The middle of each body from above, with its 90 % intervals, and a dot where the path begins."
DISTANCES = "The horizontal distance between the middles of two bodies, in the frames that both have."


class Nearness(NamedTuple):
    """Two people who are at nearly the same place for a while.

    Attributes:
        first: the person.
        second: the other person.
        frames: numbers of the frames, from the first to the last.
        is_same: whether it is most of the frames that both have.
    """

    first: Person
    second: Person
    frames: range
    is_same: bool

    @property
    def sentence(self) -> str:
        """What it means for the reader."""
        form = TWINS if self.is_same else DOUBT
        return form.format(a=self.first.label.capitalize(), b=self.second.label, first=self.frames.start, last=self.frames[-1])


def write_people_report(people: People, out: Path | None = None, watch: Watch = unwatched, overwrite: bool = False) -> Path:
    """Write the report of several people: one HTML file. Return its path.

    Args:
        people: the people.
        out: the file; by default PEOPLE_REPORT_FILE in the folder that holds the runs.
        watch: wraps the places of the people to show progress.
        overwrite: whether to replace a file that is not a report.

    Raises:
        InputError: the file exists and is not a report, it cannot be written, or a body has no markers.
    """
    path = out or people.folder / PEOPLE_REPORT_FILE
    check_free(path, overwrite or has_mark(path, MARK))
    make_folder(path.parent)
    tracks = [place_moments(people.persons[place]) for place in watch(range(len(people.persons)))]
    with style():
        shown = _sections(people, tracks, path.parent)
    write_text(path, _page(people, tracks, shown))
    return path


def place_moments(person: Person) -> Moments:
    """Return the moments of the middle of the body's markers, (frame, 3), metres.

    Raises:
        InputError: the body has no markers.
    """
    run, moments = person.run, []
    if not run.model.body.markers.names:
        raise input_error(f"the body '{run.model.body.name}'", "no virtual markers", "at least one", "give the body file a table [markers]")
    for piece, changes in placing_blocks(run.tree, run.model.placing, width=3 * len(run.model.body.markers.names)):
        weights = pooled(weights_of_runs(piece.log_weights)) / piece.poses.shape[0]
        moments.append(weighted_moments(markers_of_each(run, piece.poses, changes).mean(axis=2), weights))
    return Moments(*(np.concatenate(parts) for parts in zip(*moments, strict=True)))


def near_spans(people: People, tracks: Sequence[Moments]) -> list[Nearness]:
    """Return where two people are nearer than NEAR_M, and within each other's uncertainty, for at least LEAST_S."""
    spans, least = [], max(2, round(LEAST_S * people.fps))
    for (a, track_a), (b, track_b) in combinations(zip(people.persons, tracks, strict=True), 2):
        common = _common(a, b)
        if not common:
            continue
        distances = _distances(people, (a, track_a), (b, track_b))
        sds = [_horizontal(people, _during(person, track.sd, common)) for person, track in ((a, track_a), (b, track_b))]
        # Of one axis: the root mean square of both axes.
        sd = np.sqrt(sum((axes**2).mean(axis=1) for axes in sds))
        for start, stop in _spans((distances < NEAR_M) & (distances <= HALF_WIDTH * sd), least):
            frames = range(common.start + start, common.start + stop)
            spans.append(Nearness(a, b, frames, len(frames) > MOST_SHARE * len(common)))
    return spans


def _spans(is_near: Bool[np.ndarray, " frame"], least: int) -> Iterator[tuple[int, int]]:
    """Yield start and stop of each stretch of at least `least` frames; interruptions of fewer frames do not end one."""
    places = np.flatnonzero(is_near)
    if not places.size:
        return
    pieces = np.split(places, np.flatnonzero(np.diff(places) > least) + 1)
    yield from ((int(piece[0]), int(piece[-1]) + 1) for piece in pieces if len(piece) >= least)


def _common(a: Person, b: Person) -> range:
    start = max(a.frames.start, b.frames.start)
    return range(start, max(start, min(a.frames.stop, b.frames.stop)))


def _during(person: Person, values: Float[np.ndarray, "frame 3"], frames: range) -> Float[np.ndarray, "common 3"]:
    return values[frames.start - person.frames.start : frames.stop - person.frames.start]


def _horizontal(people: People, values: Float[np.ndarray, "frame 3"]) -> Float[np.ndarray, "frame 2"]:
    return values[:, list(_axes(people))]


def _axes(people: People) -> tuple[int, int]:
    """Return the horizontal axes, in the order in which they are seen from above."""
    up = "xyz".index(people.session.up)
    return (up + 1) % 3, (up + 2) % 3


def _distances(people: People, first: tuple[Person, Moments], second: tuple[Person, Moments]) -> Float[np.ndarray, " common"]:
    common = _common(first[0], second[0])
    places = [_horizontal(people, _during(person, track.mean, common)) for person, track in (first, second)]
    return np.linalg.norm(places[0] - places[1], axis=1)


def _sections(people: People, tracks: Sequence[Moments], folder: Path) -> list[Markup]:
    # In the folder of the runs of several recordings, the pictures of each are beside its report.
    pictured = folder if folder.resolve().is_relative_to(people.folder) else people.folder
    stills = read_stills(pictured / Path(OVERLAY_FILE).stem, QUALITIES[1])
    command = tag("code", "bayes-body overlay")
    no_stills = tag("p", command, " with the same runs makes pictures of all people, which the next report then shows.")
    # In the middle of the recording more people are there than at its ends.
    middle, more = stills[len(stills) // 2 :][:1], [*stills[: len(stills) // 2], *stills[len(stills) // 2 + 1 :]]
    pictures = [figures(middle, "large")] if stills else [no_stills]
    pictures += [details(f"{len(more)} more", figures(more, "large"))] if more else []
    distances = _distance_panel(people, tracks)
    paragraphs = [tag("p", DISTANCES), figures([distances], "wide")] if distances else [tag("p", "No two people are there in the same frame.")]
    return [
        section("people", "People", _table(people, folder)),
        section("paths", "Paths on the floor", tag("p", PATHS), figures([_plan(people, tracks)], "wide")),
        section("distances", "Distances", *paragraphs),
        section("pictures", "Pictures", *pictures),
    ]


def _table(people: People, folder: Path) -> Markup:
    rows = []
    for person in people.persons:
        report = person.run.folder / RUN_REPORT
        address = quote(Path(os.path.relpath(report.resolve(), folder.resolve())).as_posix(), errors="surrogateescape")
        link = tag("a", "report", href=f"./{address}") if report.is_file() else "none yet"
        disc = tag("span", "\u25cf", style=f"color: {person.ink}; font-size: 1.3em; line-height: 1")
        warnings, lost = person.run.summary.get("warnings"), person.run.summary.get("frames_lost")
        rows.append(
            (
                joined([disc, person.label]),
                f"{person.frames.start} to {person.frames[-1]}",
                "" if lost is None else f"{lost:,}",
                f"{len(warnings)}" if isinstance(warnings, list) else "",
                link,
            )
        )
    return table(("", "frames", "lost frames", "warnings", "report"), rows)


def _plan(people: People, tracks: Sequence[Moments]) -> Picture:
    """Return the paths from above, both axes in the same scale."""
    from matplotlib.collections import EllipseCollection

    first, second = _axes(people)
    figure, axes = new_panel("Paths from above", f"{'xyz'[first]}, m", f"{'xyz'[second]}, m", (5.2, 4.2))
    for person, track in zip(people.persons, tracks, strict=True):
        step = -(-len(track.mean) // BANDS)
        middle, low, high = (_horizontal(people, values) for values in (track.mean, track.q05, track.q95))
        if not person.run.mode_seeker:
            widths, heights = (high - low)[::step].T
            bands = EllipseCollection(
                widths, heights, np.zeros(len(widths)), units="xy", offsets=((low + high) / 2)[::step], transOffset=axes.transData,
                facecolor=person.ink, edgecolor="none", alpha=0.25,
            )  # fmt: skip
            axes.add_collection(bands)
        axes.plot(*middle[:: frames_a_point(len(middle))].T, color=person.ink, label=person.label)
        axes.plot(*middle[0], color=person.ink, marker="o", markersize=6)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.12)
    axes.legend(loc="best")
    alt = "; ".join(
        f"{person.label} walks {np.linalg.norm(np.diff(_horizontal(people, track.mean), axis=0), axis=1).sum():.2f} m"
        for person, track in zip(people.persons, tracks, strict=True)
    )
    return encoded(figure, f"Paths from above: {alt}.")


def _distance_panel(people: People, tracks: Sequence[Moments]) -> Picture | None:
    """Return the distances of all pairs over time; None if no two people are there together."""
    figure, axes = new_panel("Distances", time_label(people.fps), "distance, m", (5.2, 2.6))
    smallest, largest = [], NEAR_M
    for number, (a, b) in enumerate(combinations(range(len(tracks)), 2)):
        first, second = people.persons[a], people.persons[b]
        if not (common := _common(first, second)):
            continue
        values, step = _distances(people, (first, tracks[a]), (second, tracks[b])), frames_a_point(len(common))
        places = np.asarray(common) - people.frames.start
        axes.plot(places[::step], values[::step], linestyle=run_line(number), label=f"{first.number} and {second.number}")
        frame, largest = common[int(values.argmin())], max(largest, float(values.max()))
        smallest.append(f"{first.label} and {second.label}: smallest {values.min():.2f} m, in frame {frame}")
    if not smallest:
        return None
    time_axis(axes, len(people.frames), people.fps)
    axes.set_ylim(0, 1.15 * largest)
    draw_limit(axes, NEAR_M, "near")
    return encoded(figure, f"{'; '.join(smallest)}.", f"{'; '.join(smallest).capitalize()}.")


def _page(people: People, tracks: Sequence[Moments], sections: Sequence[Markup]) -> str:
    """Return the page's HTML.

    Raises:
        InputError: it would be too large.
    """
    doubts = [span.sentence for span in near_spans(people, tracks)]
    first, last = people.frames.start, people.frames[-1]
    titles = (("people", "People"), ("paths", "Paths on the floor"), ("distances", "Distances"), ("pictures", "Pictures"))
    values = {
        "title": f"People of {people.name}",
        "subtitle": f"{people.session.title}: {len(people.persons)} people in the frames {first} to {last}, {people.fps:g} a second",
        "verdict": " ".join([*(doubts or [NO_DOUBT]), people.missing]).rstrip(),
        "scales": "Colours are those of the people on all pages and pictures of several people.",
        "contents": joined(tag("li", tag("a", title, href=f"#{name}")) for name, title in titles),
        "figures": "",
        "sections": joined(sections),
        "footer": "Made by bayes-body report. This file is complete in itself and needs no network.",
    }
    text = Template(files(__package__).joinpath("page.html").read_text(encoding="utf-8")).substitute(
        {name: joined([value]) for name, value in values.items()}
    )
    if len(text.encode()) >= LARGEST:
        raise input_error("the report", f"{len(text.encode()) / 1e6:.1f} MB", f"less than {LARGEST / 1e6:g} MB", "report fewer people at a time")
    return text
