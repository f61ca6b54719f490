"""What is learned from measured people: against people drawn from known bones, and against the file that ships."""

import numpy as np
import pytest
from learn_lengths import BONES, DEFINITION, SAMPLE, as_toml, held_out, main, read_people, variation

from bayes_body.base.errors import InputError
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.model.unknowns.people import bone_variation

SHARES = {"torso": 0.3, "pelvis": 0.16, "thigh": 0.24, "calf": 0.25, "clavicle": 0.23, "upper_arm": 0.19, "forearm": 0.15, "heel": 0.04}
SHARES |= {"head": 1 - 0.3 - 0.24 - 0.25 - 0.04, "foot": 0.15, "hand": 0.11}


def table(path, sex, count, separator=",", seed=0):
    """A table of people whose calves and arms differ, by as much as is returned, and who have the columns of the survey."""
    rng = np.random.default_rng(seed)
    stature = 1700 * np.exp(0.05 * rng.normal(size=count))
    common, own = rng.normal(size=(2, count))
    share = {name: np.full(count, value) for name, value in SHARES.items()}
    share["upper_arm"], share["forearm"] = SHARES["upper_arm"] * np.exp(0.04 * common), SHARES["forearm"] * np.exp(0.03 * common + 0.04 * own)
    heights = {"stature": stature, "lateralmalleolusheight": share["heel"] * stature}
    heights["lateralfemoralepicondyleheight"] = heights["lateralmalleolusheight"] + share["calf"] * stature
    heights["trochanterionheight"] = heights["lateralfemoralepicondyleheight"] + share["thigh"] * stature
    heights["suprasternaleheight"] = heights["trochanterionheight"] + share["torso"] * stature
    columns = heights | {start: share[bone] * stature for bone, (start, _) in BONES.items() if start not in heights}
    rows = [separator.join(["Gender", *columns, "WritingPreference"])]
    rows += [separator.join([sex, *(f"{values[person]:.6f}" for values in columns.values()), "Right hand"]) for person in range(count)]
    path.write_text("\n".join(rows) + "\n", encoding="latin-1")
    return path


def test_bones_are_learned_from_tables_of_men_and_women(tmp_path):
    people = read_people([table(tmp_path / "men.csv", "Male", 4000), table(tmp_path / "women.csv", "Female", 1000, ";", 1)])
    learned = variation(people)
    places = {name: place for place, name in enumerate(BONES)}
    np.testing.assert_allclose(learned.shares, [SHARES[name] for name in BONES], rtol=0.005)
    sd = dict(zip(BONES, learned.sd, strict=True))
    assert learned.stature_sd == pytest.approx(0.05, rel=0.1)
    assert (sd["upper_arm"], sd["forearm"], sd["calf"]) == pytest.approx((0.04, 0.05, 0.0), rel=0.1, abs=1e-6)
    arm = learned.covariance[places["upper_arm"], places["forearm"]]
    assert arm == pytest.approx(0.04 * 0.03, rel=0.15)
    assert learned.covariance[places["calf"], places["calf"]] == pytest.approx(DEFINITION["calf"] ** 2, rel=1e-4)
    scores = held_out(people)
    assert scores["with correlations"] > scores["without"]


def test_the_file_that_ships_is_what_the_program_learns(capsys):
    main([])
    shipped = (definitions_folder() / "learned" / "bone_lengths.toml").read_text("utf-8")
    assert capsys.readouterr().out == shipped == as_toml(variation(read_people([SAMPLE])), "", 187)
    names = tuple(BONES)
    correlations = bone_variation().correlations(names)
    np.testing.assert_array_equal(correlations, correlations.T)
    assert np.linalg.eigvalsh(correlations).min() > 0.1
    assert set(bone_variation().sd) == set(names)


REFUSED = {
    "no column": ("Gender,stature\nMale,1700\n", "no column .*footlength"),
    "nobody": ("# a comment\n", "no rows"),
    "one sex": (None, "Female: 0 people"),
    "no number": ("WORD", "'WORD'; expected a number of millimetres"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_table_that_says_too_little_is_refused(case, tmp_path):
    text, sentence = REFUSED[case]
    path = table(tmp_path / "men.csv", "Male", 30)
    if text == "WORD":
        path.write_text(path.read_text().replace("\nMale,", "\nMale,WORD,", 1))
    elif text is not None:
        path.write_text(text)
    with pytest.raises(InputError, match=sentence):
        read_people([path])
