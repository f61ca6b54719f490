"""The report of several people: what its page says, and when a reader is told to doubt who is who."""

import numpy as np
import pytest
from people_runs import person_run

from bayes_body.cli.main import main
from bayes_body.results.posterior.moments import Moments
from bayes_body.results.storage.saved_moments import marker_moments
from bayes_body.view.colours import person_ink
from bayes_body.view.people import open_people
from bayes_body.view.report.people import near_spans, place_moments

ARM_DOFS = ("shoulder_x", "shoulder_y", "shoulder_z", "elbow")


@pytest.fixture(scope="module")
def runs(make_run, tmp_path_factory):
    """Two arms at one shoulder, which bends alike: one in the frames 0 to 29 of the recording, the other from 10 on."""
    run = make_run(dofs=ARM_DOFS, units=("rad",) * 4, frames=40)
    study = tmp_path_factory.mktemp("people") / "study"
    return [person_run(run, study, number, frames) for number, frames in ((1, range(30)), (2, range(10, 40)))]


def test_the_page(runs, draw_pictures, parse, capsys):
    study = runs[0].parents[1]
    draw_pictures(study, 5)
    (runs[0] / "report.html").write_text("")
    with pytest.raises(SystemExit) as stopped:
        main(["report", *map(str, runs)])
    path = study / "people.html"
    assert stopped.value.code == 0 and capsys.readouterr().out.startswith(f"{path}: ")
    page = parse(path.read_text(encoding="utf-8"))
    # The title is that of the recording, not of a person of it.
    assert ", person 1: 2 people" not in page.text
    assert "2 people in the frames 0 to 39, 60 a second" in page.text and "0 to 29" in page.text and "10 to 39" in page.text
    # Both are the same arm: this is no crossing of two people.
    assert "Person 1 and person 2 may be one person who was tracked twice: in frames 10 to 29" in page.text
    assert [link["href"] for link in page.of("a") if not link["href"].startswith("#")] == ["./walk_person_1/run_1/report.html"]
    assert [span["style"].split(";")[0] for span in page.of("span")] == [f"color: {person_ink(number)}" for number in (1, 2)]
    # Two stills, the paths and the distances.
    assert len(page.of("img")) == 4 and all(image["alt"] for image in page.of("img"))
    assert "smallest 0.00 m, in frame 10" in page.text


def test_places_are_the_middle_of_the_markers(runs):
    with open_people(runs) as people:
        person = people.persons[1]
        expected = marker_moments(person.run).mean.mean(axis=1)
        assert np.abs(place_moments(person).mean - expected).max() < 1e-6


def crossing(sd):
    """Two tracks of 30 frames that both have: they are 5 cm apart for 8 frames, and before and after far from each other."""
    distance = np.full(20, 1.0)
    distance[6:14] = 0.05
    places = np.zeros((2, 30, 3))
    # The first one's frames 10 to 29 are the second one's 0 to 19.
    places[1, :20, 0] = distance
    return [Moments(place, np.full((30, 3), sd), place - sd, place + sd) for place in places]


@pytest.mark.parametrize(("sd", "doubted"), [(0.05, True), (0.01, False)])
def test_a_near_passage_is_doubted_only_where_the_posterior_is_wide(runs, sd, doubted):
    with open_people(runs) as people:
        spans = near_spans(people, crossing(sd))
        sentences = [span.sentence for span in spans]
    expected = "Person 1 and person 2 may have been exchanged between frames 16 and 23: there they are within each other's uncertainty."
    assert sentences == ([expected] if doubted else [])


def test_who_is_far_or_only_touched_is_not_doubted(runs):
    far, touched = crossing(0.05), crossing(0.05)
    far[1].mean[:, 0] += 0.5
    touched[1].mean[6:13, 0] = 1.0
    with open_people(runs) as people:
        assert near_spans(people, far) == near_spans(people, touched) == []
