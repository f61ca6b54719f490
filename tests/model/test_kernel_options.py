"""A kernel's options: the definition's, those of the run that is continued, and those given for this run."""

import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.registry import names
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition
from bayes_body.model.kernel_options import kernel_options, kernel_sentences, unknowns_sentence


def test_the_definition_s_kernel_has_the_definition_s_options():
    kind, options = kernel_options(load_definition("silhouettes"))
    assert kind == "tempered" and options.particles == 300 and options.prediction == "gaussian"


def test_another_kernel_has_its_own_defaults():
    kind, options = kernel_options(load_definition("silhouettes"), "sir")
    assert kind == "sir" and options == type(options)()


@pytest.mark.parametrize("kernel", names("kernel"))
def test_the_defaults_can_be_given(kernel):
    _, options = kernel_options(load_definition("arm"), kernel)
    assert kernel_options(load_definition("arm"), kernel, options.model_dump())[1] == options


def test_a_run_that_is_continued_keeps_its_options_and_given_ones_go_first():
    definition = load_definition("silhouettes")
    stored = {"kind": "tempered", "particles": 77, "moves": 3}
    assert kernel_options(definition, None, {"particles": 78}, stored)[1].particles == 78
    _, options = kernel_options(definition, None, {}, stored)
    assert options.particles == 77 and options.moves == 3
    assert kernel_options(definition, "sir", {}, stored)[1].particles != 77


@pytest.mark.parametrize(("name", "said"), [("layers", "--layers"), ("foo", "--set foo")])
def test_an_option_that_does_not_exist_is_named_as_it_was_given(name, said):
    with pytest.raises(InputError, match=rf"{said}: the kernel 'sir' has no such option; expected one of particles.*; leave it out"):
        kernel_options(load_definition("arm"), "sir", {name: 3})


def test_a_model_s_kernel_has_its_options_but_for_those_that_are_changed(textured_session):
    model = build_model("silhouettes", textured_session)
    own, changed, other = model.kernel(), model.kernel(moves=3, particles=50), model.kernel("annealed", layers=2)
    assert own.kind == "tempered" and own.options == model.definition.kernel.options
    assert changed.options == own.options.model_copy(update={"moves": 3, "particles": 50}) and changed.options.prediction == "gaussian"
    assert other.kind == "annealed" and other.options.layers == 2 and other.options.particles == 1000


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"move_s": 3}, r"model\.kernel\(move_s=\.\.\.\): the kernel 'tempered' has no such option; did you mean 'moves'\?"),
        ({"layers": 3}, r"model\.kernel\(layers=\.\.\.\): the kernel 'tempered' has no such option; known: candidates, "),
        ({"moves": 0}, "the options of the kernel 'tempered': moves = 0; expected a number greater than or equal to 1"),
    ],
)
def test_an_option_that_a_script_cannot_change_is_refused(textured_session, changes, said):
    with pytest.raises(InputError, match=said):
        build_model("silhouettes", textured_session).kernel(**changes)


def test_a_kernel_that_does_not_exist_is_refused(textured_session):
    with pytest.raises(InputError, match="kernel 'temperd' does not exist; did you mean 'tempered'"):
        build_model("silhouettes", textured_session).kernel("temperd")


def test_keypoints_of_one_camera_get_the_kernel_that_sees_both_ways_of_a_limb():
    keypoints = load_definition("keypoints")
    assert [kernel_options(keypoints, cameras=cameras)[0] for cameras in (1, 2, 4, None)] == ["tempered", "laplace", "laplace", "laplace"]
    # Named or not, it has the options that suit the model.
    for kind, options in (kernel_options(keypoints, cameras=1), kernel_options(keypoints, "tempered", cameras=4)):
        assert (kind, options.prediction, options.particles) == ("tempered", "gaussian", 1000)
    assert kernel_options(load_definition("silhouettes"), cameras=1)[0] == "tempered"


def test_the_choice_is_said_and_a_kernel_for_more_cameras_is_warned_of():
    keypoints = load_definition("keypoints")
    line, warning = kernel_sentences(keypoints, "laplace", 4)
    assert line == "kernel     laplace, because 4 cameras have what the model reads; --kernel names another." and not warning
    line, warning = kernel_sentences(keypoints, "tempered", 1)
    assert line.startswith("kernel     tempered, because with 1 camera a limb may be bent") and not warning
    line, warning = kernel_sentences(keypoints, "laplace", 1)
    assert not line and warning.startswith("the kernel laplace with 1 camera: a limb may be bent") and warning.endswith("use --kernel tempered.")
    assert kernel_sentences(load_definition("silhouettes"), "tempered", 1) == ("", "")


@pytest.mark.parametrize(
    ("kind", "changes", "remedy"),
    [
        ("sir", {}, "use --kernel tempered --set prediction=gaussian, or --kernel laplace"),
        ("annealed", {}, "use --kernel tempered --set prediction=gaussian, or --kernel laplace"),
        ("hmc", {}, "use --set prediction=gaussian, or --kernel laplace"),
        ("hmc", {"prediction": "gaussian"}, ""),
        ("tempered", {"prediction": "particles"}, "use --set prediction=gaussian, or --kernel laplace"),
        ("tempered", {"prediction": "gaussian"}, ""),
        ("laplace", {}, ""),
    ],
)
def test_a_kernel_that_follows_unknowns_by_its_particles_is_warned_of(kind, changes, remedy):
    _, options = kernel_options(load_definition("keypoints"), kind, changes)
    sentence = unknowns_sentence(kind, options, ["lengths", "keypoint_offsets"])
    assert (remedy in sentence and f"the kernel {kind} follows the unknowns (lengths, keypoint offsets)" in sentence) if remedy else not sentence
    assert not unknowns_sentence(kind, options, [])
