"""A simulated walker whose motion was not used for anything that was learned is found in single frames, without a first pose."""

import dataclasses

import numpy as np
import pytest

from bayes_body.cli.main import main
from bayes_body.evidence.markers import MARKERS
from bayes_body.initial.person_search import PersonSearch
from bayes_body.recording.truth import read_truth
from bayes_body.session.read import load_session

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("optimised")]
FRAMES = (0, 10, 20)


def test_a_walker_is_found_in_single_frames(cmu_mocap, tmp_path):
    walk = ["simulate", str(cmu_mocap / "38" / "38_02.amc"), "--frames", "21", "--subject", "38_02", "--seed", "11", "--out", str(tmp_path / "walk")]
    with pytest.raises(SystemExit) as stopped:
        main(walk)
    assert stopped.value.code == 0
    session = dataclasses.replace(load_session(tmp_path / "walk"), initial={}, initial_keypoints={}, initial_markers={})
    truth, person = read_truth(session.truth_path, session.frames), PersonSearch(session)
    found = [person.frame(frame) for frame in FRAMES]
    own = [k for k, name in enumerate(found[0].names) if name in MARKERS]
    order = [MARKERS.index(found[0].names[k]) for k in own]
    apart = [np.linalg.norm(each.markers[own] - truth[frame][order], axis=1).mean() for each, frame in zip(found, FRAMES, strict=True)]
    print(
        "mm", np.round(1e3 * np.array(apart)), "sd", [round(1e3 * each.sd_m) for each in found], "turned", [round(each.turned, 2) for each in found]
    )
    assert max(apart) < 0.1
    assert all(0.01 < each.sd_m < 0.15 and each.turned < 0.5 and each.ess > 1 for each in found)
