"""A run read back: as it was when it was made, whatever became of the files it was made from; and sentences about what is not there."""

import shlex
import shutil
import tomllib

import h5py
import numpy as np
import pytest
from sealed import seal

from bayes_body.base.errors import InputError
from bayes_body.base.files.shipped import definitions_folder
from bayes_body.model.body.solids import pose_space
from bayes_body.model.build import build_model
from bayes_body.model.definition import load_definition, parse_definition
from bayes_body.recording.session.read import load_session
from bayes_body.results.posterior import markers
from bayes_body.results.storage.names import free_folder
from bayes_body.results.storage.saved_moments import angle_moments, marker_moments
from bayes_body.results.storage.saved_run import load_run


def test_what_was_written_is_read_back(make_run):
    with load_run(make_run()) as run:
        assert run.settings["seed"] == 0 and run.kernel == {"kind": "sir", "particles": 30} and run.versions == {"python": "3.12"}
        assert run.summary == {"rhat_max": 1.5} and run.frames == 5 and run.fps == 60.0
        assert run.model.definition == load_definition("arm")
        assert run.session == load_session(run.settings["session"])


def test_the_posterior_is_read_when_it_is_asked_for(make_run):
    with load_run(make_run()) as run:
        assert not run.tree["posterior"]["pose"].variable._in_memory


def test_the_model_is_that_of_the_run_when_the_user_s_files_have_changed(make_run, tmp_path):
    for source, target in (("arm.toml", "mine.toml"), ("bodies/arm_4.toml", "longer.toml")):
        shutil.copyfile(definitions_folder() / source, tmp_path / target)
    mine = tmp_path / "mine.toml"
    mine.write_text(mine.read_text(encoding="utf-8").replace('"arm_4"', '"longer.toml"'), encoding="utf-8")
    folder = make_run(model=mine)
    before = load_definition(mine)
    mine.unlink()
    (tmp_path / "longer.toml").unlink()
    with load_run(folder) as run:
        assert run.model.definition == before


def test_the_session_is_that_of_the_run_when_its_folder_has_changed_or_gone(make_run):
    with load_run(make_run()) as run:
        folder = run.session.folder
        before = run.session
    (folder / "session.toml").write_text("broken")
    with load_run(folder.parent / "run") as run:
        assert run.session == before
        assert run.session.image_path(run.session.views[0], 2) == folder / "a" / "image0002.png"
    shutil.rmtree(folder)
    with load_run(folder.parent / "run") as run:
        assert run.session == before


def test_parsed_from_its_text_a_definition_is_the_same():
    for name in ("arm", "deutscher_2005"):
        loaded = load_definition(name)
        assert parse_definition(name, loaded.text, loaded.body_text) == loaded


def test_faults_of_a_text_are_sentences():
    arm = load_definition("arm")
    for text, body, said in (
        (arm.text.replace("[dynamics]", "[dynamic]", 1), arm.body_text, "dynamic: unknown key"),
        ("title = = 1", arm.body_text, "line 1, column 9"),
        (arm.text, arm.body_text.replace("height_m", "heigth_m", 1), "the body 'arm_4': heigth_m: unknown key"),
    ):
        with pytest.raises(InputError) as error:
            parse_definition("arm", text, body)
        assert str(error.value).startswith("arm: ") and said in str(error.value)


def _edit(name, old, new, sealed=True):
    def change(folder):
        text = (folder / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")
        if sealed:
            seal(folder)

    return change


def _stopped(folder):
    (folder / "posterior.nc").unlink()
    (folder / "frames").mkdir()
    (folder / "frames" / "000000.npz").touch()


def _truncated(folder):
    content = (folder / "posterior.nc").read_bytes()
    (folder / "posterior.nc").write_bytes(content[: len(content) // 3])


def _sealed(change):
    """The change, and all digests made right again: what a person with bad intentions would do."""

    def changed(folder):
        change(folder)
        seal(folder)

    return changed


def _hdf5(make):
    def change(folder):
        with h5py.File(folder / "posterior.nc", "a") as file:
            make(file)

    return change


_external = _hdf5(lambda file: file.create_dataset("a", (10,), "u1", external=[("/etc/hostname", 0, 10)]))
_linked = _hdf5(lambda file: file.__setitem__("a", h5py.ExternalLink("/etc/hostname", "/")))
_huge = _hdf5(lambda file: file.create_dataset("a", (10**12,), "f8", chunks=(1000,)))
_looped = _hdf5(lambda file: file.create_group("a").__setitem__("b", file["a"]))


def _link(folder):
    (folder / "posterior.nc").rename(folder.parent / "elsewhere.nc")
    (folder / "posterior.nc").symlink_to(folder.parent / "elsewhere.nc")


FAULTS = {
    "no run.toml": (lambda folder: (folder / "run.toml").unlink(), ["no run.toml in it", "`bayes-body track`"]),
    "no TOML": (_edit("run.toml", "[kernel]", "[kernel", sealed=False), ["run.toml: line "]),
    "no table": (_edit("run.toml", "[versions]", "[version]"), ["run.toml: versions: missing"]),
    "another seed": (_edit("run.toml", "seed = 0", "seed = 1", sealed=False), ["run.toml: was changed since it was written"]),
    "no kind": (_edit("run.toml", "kind =", "knid ="), ["run.toml: kernel.kind: missing"]),
    "no session": (_edit("run.toml", "session =", "sesion ="), ["run.toml: run.session: missing"]),
    "no posterior": (lambda folder: (folder / "posterior.nc").unlink(), ["holds no posterior.nc", "`bayes-body track`"]),
    "stopped": (_stopped, ["holds frames but no posterior.nc", "continue it with `bayes-body track", "--resume`"]),
    "truncated": (_truncated, ["posterior.nc: was changed since it was written", "--resume`"]),
    "truncated and sealed": (_sealed(_truncated), ["posterior.nc: damaged, HDF5 cannot read it", "--resume`"]),
    "not a posterior": (_sealed(lambda folder: (folder / "posterior.nc").write_bytes(b"mine" * 9)), ["posterior.nc: damaged"]),
    "data elsewhere": (_sealed(_external), ["posterior.nc: the array 'a' lies in another file"]),
    "a link inside": (_sealed(_linked), ["posterior.nc: the entry 'a' is a link to elsewhere"]),
    "arrays without end": (_sealed(_huge), ["posterior.nc: 8000000000000 bytes of arrays in a file of "]),
    "a group in itself": (_sealed(_looped), ["posterior.nc: the group 'b' occurs twice"]),
    "the posterior of another run": (_edit("manifest.json", '"run": "0123', '"run": "ffff', sealed=False), ["manifest.json: belongs to another run"]),
    "no manifest": (lambda folder: (folder / "manifest.json").unlink(), ["manifest.json: no such file"]),
    "a damaged manifest": (lambda folder: (folder / "manifest.json").write_text("{" * 10**5), ["manifest.json: not JSON", "--resume"]),
    "stills elsewhere": (_edit("manifest.json", '"stills": []', '"stills": ["../victim.png"]', sealed=False), ["manifest.json: damaged"]),
    "a link": (_link, ["posterior.nc: a link to elsewhere"]),
    "figures": (lambda folder: (folder / "summary.json").write_text("{"), ["summary.json: was changed since it was written"]),
    "figures that are none": (_sealed(lambda folder: (folder / "summary.json").write_text("[" * 10**5)), ["summary.json: not JSON"]),
    "figures of another kind": (_sealed(lambda folder: (folder / "summary.json").write_text("[]")), ["summary.json: list"]),
    "the body's text": (_edit("run.toml", 'name = \\"elbow\\"', 'name = \\"elbwo\\"'), ["elbwo"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_run_is_a_sentence(make_run, fault):
    change, parts = FAULTS[fault]
    folder = make_run()
    change(folder)
    with pytest.raises(InputError) as error, load_run(folder) as run:
        assert run.model
    assert str(folder) in str(error.value)
    for part in parts:
        assert part in str(error.value)


def test_the_suggested_command_is_one_for_a_shell(make_run):
    folder = make_run(name="run; touch x")
    _edit("run.toml", 'session = "', 'session = "/$(touch y) ')(folder)
    session = tomllib.loads((folder / "run.toml").read_text(encoding="utf-8"))["run"]["session"]
    _stopped(folder)
    with pytest.raises(InputError) as error:
        load_run(folder)
    found = str(error.value).split("`")[1]
    assert shlex.split(found) == ["bayes-body", "track", session, "--out", str(folder), "--resume"]


def test_no_folder_and_no_figures(make_run, tmp_path):
    with pytest.raises(InputError, match=r"none: no such folder; .*; check the path"):
        load_run(tmp_path / "none")
    folder = make_run()
    (folder / "summary.json").unlink()
    with load_run(folder) as run:
        assert run.summary == {}
    with pytest.raises(InputError, match="a file; expected the folder of a run"):
        load_run(folder / "posterior.nc")


@pytest.mark.parametrize("frames", [None, range(1, 4)])
@pytest.mark.parametrize("block", [64, 2])
def test_moments_are_those_of_all_weighted_draws_each_run_counting_the_same(make_run, frames, block):
    with load_run(make_run()) as run:
        found, angles = marker_moments(run, frames, block), angle_moments(run, frames, block)
        pose = np.asarray(run.tree["posterior"]["pose"])[:, :, frames or slice(None)]
        weights = np.exp(np.asarray(run.tree["sample_stats"]["log_weight"]))[:, :, frames or slice(None)]
        places = markers(run.model, pose)
    # Run 0 thrice as heavy as it is: a run's weights say nothing of another's.
    weights[0] *= 3
    by_run = [np.einsum("sf,sf...->f...", weights[r], places[r]) / weights[r].sum(axis=0)[:, None, None] for r in (0, 1)]
    assert found.mean.shape == (len(frames or range(5)), 3, 3)
    assert np.allclose(found.mean, np.mean(by_run, axis=0), atol=1e-6)
    weights /= 2 * weights.sum(axis=1, keepdims=True)
    mean = np.einsum("rsf,rsfd->fd", weights, pose)
    assert np.allclose(angles.mean, mean) and np.allclose(angles.sd**2, np.einsum("rsf,rsfd->fd", weights, (pose - mean) ** 2))
    below = np.einsum("rsf,rsfd->fd", weights, pose < angles.q05)
    at_most = np.einsum("rsf,rsfd->fd", weights, pose <= angles.q05)
    assert (below < 0.05 + 1e-9).all() and (at_most > 0.05 - 1e-9).all()


def test_the_model_s_body_must_be_the_posterior_s(make_run):
    folder = make_run()
    definition = load_definition("deutscher_2005")
    import tomlkit

    document = tomlkit.parse((folder / "run.toml").read_text(encoding="utf-8"))
    document["definition"] = {"text": definition.text, "body_text": definition.body_text}
    (folder / "run.toml").write_text(tomlkit.dumps(document), encoding="utf-8")
    seal(folder)
    with load_run(folder) as run, pytest.raises(InputError, match=r"posterior.nc: dofs shoulder_x"):
        assert build_model(definition, run.session) and run.model


def test_only_an_angle_without_limits_winds(make_run, tmp_path):
    body = (definitions_folder() / "bodies" / "arm_4.toml").read_text(encoding="utf-8")
    assert ", low_deg = -90, high_deg = 90" in body
    (tmp_path / "free.toml").write_text(body.replace(", low_deg = -90, high_deg = 90", ""), encoding="utf-8")
    arm = load_definition("arm").text
    (tmp_path / "mine.toml").write_text(arm.replace('"arm_4"', '"free.toml"'), encoding="utf-8")
    pose = np.random.default_rng(3).normal(0.0, 0.1, size=(2, 30, 5, 4))
    # A few draws a turn further, of a dof with limits and of the one without.
    pose[:, :4, :, [1, 2]] += 2 * np.pi
    with load_run(make_run(model=tmp_path / "mine.toml", pose=pose, log_weight=np.zeros((2, 30, 5)))) as run:
        sd = angle_moments(run).sd
    assert (sd[:, 2] < 0.15).all() and (sd[:, 1] > 1.0).all()


def test_the_spaces_are_those_that_are_stored(make_run):
    with load_run(make_run()) as run:
        assert run.spaces == {"pose": pose_space(run.model.body)}


def test_a_space_that_cannot_be_read_is_a_sentence(make_run):
    with load_run(make_run()) as run:
        run.tree["posterior"]["pose"].attrs["space"] = '{"kind": "SO4"}'
        with pytest.raises(InputError, match=r"the posterior's variable 'pose': not a space: .*SO4"):
            assert run.spaces


@pytest.mark.parametrize(("declared", "evidence", "seeker"), [(None, 0.0, False), (None, np.nan, True), (1, np.nan, False), (0, 0.0, True)])
def test_a_kernel_declares_that_it_seeks_modes_or_is_known_by_the_evidence_that_it_lacks(make_run, declared, evidence, seeker):
    attributes = {} if declared is None else {"samples_posterior": declared}
    with load_run(make_run(log_evidence=np.full((2, 5), evidence), attributes=attributes)) as run:
        assert run.mode_seeker == seeker


def test_a_free_folder_is_the_first_that_does_not_exist(tmp_path):
    assert free_folder(tmp_path / "run") == tmp_path / "run"
    for name in ("run", "run_2"):
        (tmp_path / name).mkdir()
    assert free_folder(tmp_path / "run") == tmp_path / "run_3"
