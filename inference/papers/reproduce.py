"""Measure the rows of a paper's page: the command line of `poon_fleet_2002.py`, `sidenbladh_2000.py`, `darby_2008.py` and `sigal_2011.py`.

An experiment fills one row or several, once for every subject and seed. Its values are stored as soon as a case is done, so that a run that is killed
loses no case that was finished.
"""

import argparse
import os
import platform
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from itertools import cycle, product
from pathlib import Path
from typing import Any, NamedTuple

import platformdirs
from filmed_walk import film, placed_by_hand
from paper_page import STORED, Page, add_values, is_measured, load_page, save_page

import bayes_body as bb
from bayes_body.base.errors import InputError, RunWarning, input_error
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.base.progress import steps_bar
from bayes_body.recording.readers.rig import read_rig
from bayes_body.recording.session.session import Session

# Walks of the CMU database by people from whom nothing that ships was learned.
SUBJECTS, SEEDS = ("38_02", "35_02"), (0, 1)
VERSIONS = ("bayes-body", "jax", "numpy")

type Values = Mapping[str, float | None]


class Case(NamedTuple):
    """One measurement: who walks, the seed of the film and of the sampler, the sizes, and where files are.

    Attributes:
        subject: a motion of the CMU database, such as `38_02`; None for facts that depend on nobody.
        seed: of the person, the room and the sampler; 0 for facts.
        sizes: numbers of frames, particles and so on.
        motions: the folder of the database.
        work: a folder for films.
        pictures: a folder for pictures; None for cases that draw none.
    """

    subject: str | None
    seed: int
    sizes: Mapping[str, Any]
    motions: Path | None
    work: Path
    pictures: Path | None

    @property
    def motion(self) -> Path:
        """The captured motion of the subject.

        Raises:
            InputError: nobody has said where it is.
        """
        return self.captured(str(self.subject))

    def captured(self, name: str) -> Path:
        """Return the file of a captured motion.

        Raises:
            InputError: nobody has said where it is.
        """
        if self.motions is None:
            expected = "a folder with walks of the CMU database (mocap.cs.cmu.edu), as 38/38_02.amc"
            raise input_error("--motions", "not given", expected, "give it, or set BAYES_BODY_DATA to the folder that holds cmu_mocap")
        return self.motions / name.split("_")[0] / f"{name}.amc"

    def recorded(self, name: str) -> Path:
        """Return the folder of a real recording, which is beside the captured motions.

        Raises:
            InputError: nobody has said where it is, or it is not there.
        """
        folder = None if self.motions is None else self.motions.parent / name
        if folder is None or not folder.is_dir():
            raise input_error(name, "not there", "a folder of this name beside the CMU database", "set BAYES_BODY_DATA, or leave out this row")
        return folder

    def film(self, rig: str, frames: int, cameras: int | None = None, fps: float | None = None, radius_m: float | None = None) -> Session:
        """Return the film of the subject's walk, whose first pose is placed by hand. It is filmed if that was not done before.

        Args:
            rig: its name in models/rigs.
            frames: their number.
            cameras: only the first so many of the rig are used.
            fps: frames per second; by default the rig's.
            radius_m: bends the walk into a circle.

        Raises:
            InputError: the motion cannot be read.
        """
        described = read_rig(definitions_folder() / "rigs" / f"{rig}.toml")
        described = replace(described, fps=fps or described.fps)
        folder = self.work / "films" / f"{self.subject}_{self.seed}_{rig}_{described.fps:g}_{frames}_{radius_m or 'straight'}"
        if not folder.exists():
            # Renamed when it is whole: a film that was interrupted is not taken for one.
            partial = folder.with_name(f"{folder.name}_partial_{os.getpid()}")
            film(partial, described, frames, self.seed, self.motion, f"walk {self.subject}", radius_m=radius_m)
            partial.rename(folder)
        session = bb.load_session(folder)
        return replace(session, views=session.views[:cameras], initial={}, initial_keypoints={}, initial_markers=placed_by_hand(session, self.seed))


class Experiment(NamedTuple):
    """What fills some rows at once.

    Attributes:
        rows: names of the rows.
        measure: returns the values of a case by row and figure.
        sizes: how much is computed.
        quick: the smallest sizes with which it runs.
        facts: whether the result depends on no subject and no seed.
        costly: whether the first subject is measured with the first seed only, the second with the second, and so on.
        pairs: subjects and seeds of recordings that are no walks of the page's subjects.
    """

    rows: tuple[str, ...]
    measure: Callable[[Case], Mapping[str, Values]]
    sizes: Mapping[str, Any] = {}
    quick: Mapping[str, Any] = {}
    facts: bool = False
    costly: bool = False
    pairs: Sequence[tuple[str, int]] = ()

    def cases(self, quick: bool, subjects: Sequence[str], seeds: Sequence[int]) -> Iterator[tuple[str | None, int | None]]:
        """Yield subjects and seeds; with `quick`, the first of each."""
        if self.facts:
            yield None, None
            return
        pairs = self.pairs or list(zip(subjects, cycle(seeds)) if self.costly else product(subjects, seeds))
        yield from pairs[: 1 if quick else None]


def parse(paper: str, experiments: Sequence[Experiment]) -> argparse.Namespace:
    """Return the arguments of a paper's program."""
    parser = argparse.ArgumentParser(description=f"Measure what docs/papers/{paper}.md reports.")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--all", action="store_true", help="measure every row that this program measures")
    what.add_argument("--rows", nargs="+", default=[], metavar="NAME", help="measure these rows, and those that the same experiment fills")
    what.add_argument("--list", action="store_true", help="print the rows; without any of these three, only the claims are written anew")
    parser.add_argument("--quick", action="store_true", help="the smallest sizes, one subject and one seed, into another file: a trial")
    parser.add_argument("--again", action="store_true", help="measure rows again that were measured with the same settings")
    parser.add_argument("--subjects", nargs="+", default=list(SUBJECTS), help="motions of the database (%(default)s)")
    parser.add_argument("--seeds", nargs="+", type=bb.whole_number(0), default=list(SEEDS), help="seeds (%(default)s)")
    parser.add_argument("--motions", type=Path, help="the CMU database; by default cmu_mocap in the folder BAYES_BODY_DATA")
    parser.add_argument("--work", type=Path, help="folder for films; by default in the cache of this user")
    parser.add_argument("--json", type=Path, help="the page's file; by default the one in docs, with --quick one in the folder for films")
    arguments = parser.parse_args()
    names = {name for experiment in experiments for name in experiment.rows}
    for name in arguments.rows:
        if name not in names:
            parser.error(f"--rows: {name}; expected rows that this program measures: {', '.join(sorted(names))}")
    if arguments.motions is None and os.environ.get("BAYES_BODY_DATA"):
        arguments.motions = Path(os.environ["BAYES_BODY_DATA"]) / "cmu_mocap"
    arguments.work = arguments.work or Path(platformdirs.user_cache_dir("bayes_body")) / "papers"
    arguments.json = arguments.json or (arguments.work / "quick" if arguments.quick else STORED) / f"{paper}.json"
    return arguments


def reproduce(paper: str, experiments: Sequence[Experiment]) -> None:
    """Run a paper's program; a wrong input is one sentence and status 2.

    Args:
        paper: the name of the page.
        experiments: what fills its rows.
    """
    arguments = parse(paper, experiments)
    try:
        page = load_page(paper, arguments.json)
        if arguments.list:
            print_rows(page)
            return
        save_page(page, arguments.json)
        wanted = [experiment for experiment in experiments if arguments.all or set(arguments.rows) & set(experiment.rows)]
        if wanted:
            bb.configure()
            measure(page, wanted, arguments)
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)


def measure(page: Page, experiments: Sequence[Experiment], arguments: argparse.Namespace) -> None:
    """Measure all cases of some experiments that the page does not have yet.

    Raises:
        InputError: a motion is missing, or a file cannot be written.
    """
    # The figures themselves say how good a run is.
    warnings.simplefilter("ignore", RunWarning)
    quick = arguments.quick
    cases = [(experiment, *case) for experiment in experiments for case in experiment.cases(quick, arguments.subjects, arguments.seeds)]
    with steps_bar(len(cases), "the first case") as show:
        for done, (experiment, subject, seed) in enumerate(cases):
            sizes = {**experiment.sizes, **(experiment.quick if quick else {})}
            rows = [page.row(name) for name in experiment.rows]
            show(done, f"{experiment.rows[0]}, {subject or 'a fact'}{'' if seed is None else f', seed {seed}'}")
            if not arguments.again and all(is_measured(row, sizes, subject, seed) for row in rows):
                continue
            draws = experiment.facts or (subject, seed) == next(experiment.cases(quick, arguments.subjects, arguments.seeds))
            pictures = arguments.json.parent if draws else None
            values = experiment.measure(Case(subject, seed or 0, sizes, arguments.motions, arguments.work, pictures))
            for row in rows:
                add_values(row, sizes, subject, seed, values[row.name])
                row.versions = {name: version(name) for name in VERSIONS} | {"python": platform.python_version()}
                row.date = time.strftime("%Y-%m-%d")
            save_page(page, arguments.json)
            print_values(rows, subject, seed)
        show(len(cases), "")


def print_values(rows: Sequence[Any], subject: str | None, seed: int | None) -> None:
    """Print what a case has measured."""
    for row in rows:
        for figure in row.figures:
            for value in figure.values:
                if (value.subject, value.seed) == (subject, seed):
                    print(f"{row.name}, {subject}, {seed}: {figure.name} {value.value:g} {figure.unit}", flush=True)


def print_rows(page: Page) -> None:
    """Print the rows of a page: name, state, where the claim is, and the claim."""
    for row in page.rows:
        print(f"{row.name:<24}{row.status:<18}{row.where:<24}{row.claim}")
