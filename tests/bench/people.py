"""What company costs: `python tests/bench/people.py FOLDER [--films 0 1 2] [--kind cross] [--network simulated] [--json FILE]`.

Films of several people in random order, with 5 % outliers, doubles, and left and right exchanged (tests/crowd_walks.py). A film is imported, its
people are told apart and tracked by the command line as a user would do. Everyone is also tracked in the same film without company. A row has

- error_mm: mean error of the markers, in company and alone, and the ratio;
- coverage_90: the share of true markers in their 90 % intervals, in company and alone;
- exchanged: frames in which the track is nearer to somebody else, and the longest run of them;
- cost: CPU seconds of all people, with telling them apart, with reports and joint pages, over those of one person alone, with a report.
"""

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from crowd_walks import CrowdNetwork, crossing_film, door_film, write_project
from keypoint_walks import Network

from bayes_body.recording.evidence.markers import MARKERS
from bayes_body.recording.readers.people.record import made_sessions, read_crowd
from bayes_body.recording.session.read import load_session
from bayes_body.results.storage.saved_run import load_run

KINDS = {"cross": crossing_film, "door": door_film}
# The errors of `bayes-body simulate`, and those of a network whose errors are heavy-tailed and last for many frames, as those of real ones do.
NETWORKS = {
    "simulated": CrowdNetwork(),
    "lasting": CrowdNetwork(keypoints=Network(outliers=0.05, missing=0.05, noise="assumed", lasting=0.5, fades_frames=30.0)),
}


class Figures(NamedTuple):
    """Of one track: mean error, millimetres; coverage of 90 % intervals; distance of its pelvis from everybody's, (frame, person), metres."""

    error_mm: float
    coverage: float
    distances: np.ndarray


def pelvis_of(run: Path) -> np.ndarray:
    """Mean position of the pelvis in each frame of a run, (frame, 3), metres."""
    with load_run(run) as saved:
        weights = np.exp(saved.tree["sample_stats"]["log_weight"]).fillna(0.0)
        root = saved.tree["posterior"]["pose"].sel(dof=["root_x", "root_y", "root_z"])
        return root.weighted(weights).mean(["chain", "draw"]).transpose("frame", "dof").to_numpy()


def run_program(*arguments: object) -> float:
    """Run a command of the program; return its seconds on all cores."""
    start = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "bayes_body.cli.main", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ)
    if done.returncode:
        sys.exit(f"{' '.join(command[2:])}: {done.stderr[-1500:]}")
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    return end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime


def put_truth(session: Path, markers: np.ndarray) -> None:
    """Give a session the true markers (frame, 15, 3) of its frames."""
    np.savez(session / "truth.npz", markers=markers, names=np.array(MARKERS))
    path = session / "session.toml"
    path.write_text('truth = "truth.npz"\n' + path.read_text())


def who_is(bodies: np.ndarray, truths: dict[int, np.ndarray]) -> int:
    """The true person who is nearest to the bodies (frame, keypoint, 3) in most frames."""
    centres = np.nanmean(bodies, axis=1)
    return min(truths, key=lambda number: float(np.nanmedian(np.linalg.norm(centres - np.nanmean(truths[number], axis=1), axis=-1))))


def figures_of(run: Path, truths: dict[int, np.ndarray]) -> Figures:
    """Of a run, and how far its markers are from everybody's."""
    summary = json.loads((run / "summary.json").read_text())
    pelvis = pelvis_of(run)
    distances = [np.nan_to_num(np.linalg.norm(pelvis - truth[:, MARKERS.index("pelvis")], axis=-1), nan=np.inf) for truth in truths.values()]
    return Figures(summary["error_mm_mean"], summary["coverage_90"], np.stack(distances, axis=-1))


def longest_run(flags: np.ndarray) -> int:
    """The largest number of flags in a row that are true."""
    return max(map(len, "".join("x" if flag else " " for flag in flags).split()), default=0)


def in_company(folder: Path, film, network, seed: int) -> tuple[list[dict], float]:
    """Rows of everybody in a film, tracked together; and the seconds that it took."""
    write_project(folder / "project", film, network, seed)
    run_program("import", "pose2sim", folder / "project", folder / "session", "--up", "z", "--fps", film.rig.fps)
    seconds = run_program("people", folder / "session")
    truths = {member.number: np.where(member.present[:, None, None], member.person.markers, np.nan) for member in film.members}
    crowd, rows = read_crowd(load_session(folder / "session")), []
    for person, home in zip(crowd.persons, made_sessions(folder / "session"), strict=True):
        frames = slice(person.first, person.last + 1)
        here = {number: truth[frames] for number, truth in truths.items()}
        number = who_is(person.bodies, here)
        put_truth(home, here[number])
        rows.append({"person": person.number, "is": number, "first": person.first, "frames": person.frames, "truths": here})
    seconds += run_program("track", folder / "session", "--person", "all", "--out", folder / "runs", "--no-pictures")
    for row in rows:
        here = row.pop("truths")
        figures = figures_of(folder / "runs" / f"session_person_{row['person']}" / "run_1", here)
        wrong = figures.distances.argmin(axis=-1) != list(here).index(row["is"]) if len(here) > 1 else np.zeros(0, bool)
        row |= {"error_mm": figures.error_mm, "coverage_90": figures.coverage, "exchanged": int(wrong.sum()), "longest": longest_run(wrong)}
    return rows, seconds


def without_company(folder: Path, film, network, seed: int, row: dict) -> tuple[dict, float]:
    """The figures of the same person in the same frames of the film with nobody else; and the seconds that it took."""
    alone = film.alone(row["is"])
    write_project(folder / "project", alone, network, seed)
    run_program("import", "pose2sim", folder / "project", folder / "session", "--up", "z", "--fps", film.rig.fps)
    put_truth(folder / "session", alone.members[0].person.markers)
    frames = ["--first-frame", row["first"], "--frames", row["frames"]]
    seconds = run_program("track", folder / "session", "--out", folder / "run", "--no-pictures", *frames)
    # As a study of all people does.
    seconds += run_program("report", folder / "run")
    summary = json.loads((folder / "run" / "summary.json").read_text())
    return {"alone_mm": summary["error_mm_mean"], "alone_coverage_90": summary["coverage_90"]}, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="folder to work in; what is there of these films is replaced")
    parser.add_argument("--kind", choices=KINDS, default="cross")
    parser.add_argument("--films", type=int, nargs="+", default=list(range(10)))
    parser.add_argument("--network", choices=NETWORKS, default="simulated")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    network, rows = NETWORKS[options.network], []
    for seed in options.films:
        film, folder = KINDS[options.kind](seed), options.folder / f"{options.kind}_{options.network}_{seed}"
        shutil.rmtree(folder, ignore_errors=True)
        (folder / "company").mkdir(parents=True)
        people, together_s = in_company(folder / "company", film, network, seed)
        alone_s = []
        for row in people:
            figures, seconds = without_company(folder / f"alone_{row['is']}", film, network, seed, row)
            alone_s.append(seconds)
            row |= figures | {"film": seed, "ratio": row["error_mm"] / figures["alone_mm"]}
            print(
                "film {film} person {person} is {is}, {frames} frames: {error_mm:.1f} mm, alone {alone_mm:.1f}, ratio {ratio:.2f}; "
                "coverage {coverage_90:.2f}, alone {alone_coverage_90:.2f}; exchanged in {exchanged} frames, {longest} in a row".format(**row),
                flush=True,
            )
        cost = together_s / float(np.mean(alone_s))
        print(f"film {seed}: {together_s:.0f} CPU s for all, {cost:.2f} of one person in the mean", flush=True)
        rows += [row | {"cost": cost} for row in people]
        if options.json:
            options.json.write_text(json.dumps(rows, indent=2))


if __name__ == "__main__":
    main()
