"""Who is whose detection, by this package and by Pose2Sim's rules: `python tests/bench/association.py [--crossings 10] [--others 2] [--json F]`.

The films are those of tests/crowd_walks.py: two people cross twice in front of four cameras, with 5 % of the keypoints anywhere, doubled and missing
detections, left and right exchanged, in random order; three people with doors; one in the background; one in a poster. All methods get the same
detections without doubles. Pose2Sim's rules are restated in tests/pose2sim_association.py: with the default settings of its demonstration.

A person of a method is the member of the film of whom most detections are; the mode for one person has one. Of several people who are one member the
one with most detections counts, and the others are extra. Read: the share of the frames in which a member is there and in which most of the
detections that the method gives are the member's; the share of the member's detections that it has; the share of its detections that are somebody
else's; the longest time for which another member has most, frames; people too many or too few.
"""

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from crowd_walks import background_film, crossing_film, detect, door_film, poster_film
from pose2sim_association import associate_several, associate_single

from bayes_body.recording.readers.keypoints.person import distinct_people
from bayes_body.recording.readers.people.people import people_of
from bayes_body.recording.readers.people.shares import joint_shares, mean_field_shares

FILMS = {"two cross": crossing_film, "doors": door_film, "background": background_film, "poster": poster_film}
METHODS = ("jointly", "mean field", "Pose2Sim, several people", "Pose2Sim, one person")
EXCLUSIONS = {"jointly": joint_shares, "mean field": mean_field_shares}
# Of a share that is 0, the logarithm of this.
LEAST = 1e-4


def distinct(film, seed):
    """The people of each frame and camera without doubles, and whose they are."""
    found = detect(film, seed=seed)
    people, numbers = [], []
    for frame in range(len(found.points[0])):
        groups = [camera[frame] for camera in found.points]
        people.append([distinct_people(group) if len(group) else group for group in groups])
        rows = [
            [next(i for i, row in enumerate(group) if np.array_equal(row, one, equal_nan=True)) for one in few]
            for group, few in zip(groups, people[-1], strict=True)
        ]
        numbers.append([camera[frame][row] for camera, row in zip(found.numbers, rows, strict=True)])
    return people, numbers


def associated(method, film, people):
    """Everybody's detections (person, frame, camera), -1 for none, and the persons if they have shares."""
    cameras = film.rig.cameras
    if method not in EXCLUSIONS:
        return associate_several(cameras, people) if "several" in method else associate_single(cameras, people)[None], []
    persons = people_of(cameras, people, film.rig.fps, exclude=EXCLUSIONS[method])
    places = np.full((len(persons), len(people), len(cameras)), -1)
    for person, rows in zip(persons, places, strict=True):
        rows[person.first : person.last + 1] = person.places
    return places, persons


def real_members(film):
    """The members who are no pictures."""
    return [member for member in film.members if not member.cameras]


def figures(film, numbers, places):
    """The figures of a film: see the module."""
    owners = np.array([[[numbers[t][c][k] if k >= 0 else 0 for c, k in enumerate(row)] for t, row in enumerate(person)] for person in places])
    owners = owners.reshape(len(places), len(numbers), -1)
    members = {member.number: member for member in real_members(film)}
    counts = np.array([[(person == number).sum() for number in members] for person in owners]).reshape(len(owners), len(members))
    rows, taken = [], set()
    for i in np.argsort(-counts.max(axis=1, initial=0)):
        number = list(members)[int(counts[i].argmax())]
        if number not in taken and counts[i].max() > 0:
            taken.add(number)
            rows.append((number, owners[i]))
    is_single = len(places) == 1
    right = wrong_detections = detections = true = frames = right_detections = longest = 0
    for number, person in rows:
        there = np.array([any((group == number).any() for group in frame) for frame in numbers])
        most = np.array([np.bincount(row[row > 0]).argmax() if (row > 0).any() else 0 for row in person])
        right, frames = right + (most[there] == number).sum(), frames + there.sum()
        detections, wrong_detections = detections + (person > 0).sum(), wrong_detections + ((person > 0) & (person != number)).sum()
        right_detections += (person == number).sum()
        true += sum((group == number).sum() for frame in numbers for group in frame)
        longest = max(longest, max(map(len, "".join("x" if who not in (0, number) else " " for who in most).split()), default=0))
    surplus = 0 if is_single and len(members) > 1 else len(places) - len(members)
    return {
        "right_frames": right / frames,
        "right_detections": right_detections / true,
        "wrong_detections": wrong_detections / detections,
        "longest": longest,
        "extra": surplus,
    }


def soft(persons, numbers):
    """For each detection of a person who is there, the log of its share, and whether it has the largest."""
    logs, largest = [], []
    for person in persons:
        rows = [[numbers[person.first + t][c] for c in range(len(frame))] for t, frame in enumerate(person.shares)]
        chosen = [rows[t][c][k] for t, places in enumerate(person.places.tolist()) for c, k in enumerate(places) if k >= 0]
        number = np.bincount(chosen).argmax()
        for frame, whose in zip(person.shares, rows, strict=True):
            for shares, who in zip(frame, whose, strict=True):
                if (who == number).any():
                    logs.append(np.log(max(shares[who == number].sum(), LEAST)))
                    largest.append(bool(who[shares.argmax()] == number))
    return logs, largest


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--crossings", type=int, default=10, help="films of two people who cross")
    parser.add_argument("--others", type=int, default=2, help="films of every other kind")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    options = parser.parse_args()
    table, shares = [], {method: ([], []) for method in EXCLUSIONS}
    for kind, make in FILMS.items():
        for seed in range(options.crossings if kind == "two cross" else options.others):
            film = make(seed)
            people, numbers = distinct(film, seed)
            for method in METHODS:
                start = time.process_time()
                places, persons = associated(method, film, people)
                used = (time.process_time() - start) / len(people)
                row = {"film": kind, "seed": seed, "method": method, **figures(film, numbers, places), "ms": 1e3 * used}
                table.append(row)
                print(*(f"{value:.4f}" if isinstance(value, float) else value for value in row.values()), sep="; ", flush=True)
                for gathered, values in zip(shares.get(method, ()), soft(persons, numbers), strict=False):
                    gathered += values
    print(f"\n| films | method | {' | '.join(('frames', 'detections', 'of others', 'longest exchange', 'extra people', 'CPU, ms a frame'))} |")
    print("|---|---|" + "---|" * 6)
    for kind in FILMS:
        for method in METHODS:
            rows = [row for row in table if (row["film"], row["method"]) == (kind, method)]
            if rows:
                mean = {key: np.mean([row[key] for row in rows]) for key in ("right_frames", "right_detections", "wrong_detections", "ms")}
                cells = [f"{100 * mean[key]:.1f} %" for key in ("right_frames", "right_detections", "wrong_detections")]
                cells += [str(max(row["longest"] for row in rows)), str(sum(abs(row["extra"]) for row in rows)), f"{mean['ms']:.1f}"]
                print(f"| {kind} | {method} | {' | '.join(cells)} |")
    for method, (logs, largest) in shares.items():
        print(f"{method}: mean log share of the true detection {np.mean(logs):.5f}, largest in {np.mean(largest):.5f} of {len(largest)} pictures")
    if options.json:
        options.json.write_text(json.dumps(table, indent=2))


if __name__ == "__main__":
    main()
