"""Files appear completely or not at all, and a link in a stranger's folder leads no writer elsewhere."""

import pytest

from bayes_body.base.errors import InputError
from bayes_body.base.files import atomic
from bayes_body.base.files.atomic import PARTIAL, replacing, write_text


@pytest.fixture
def victim(tmp_path):
    path = tmp_path / "victim"
    path.write_text("precious")
    return path


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    return path


def test_a_link_with_the_name_that_older_versions_wrote_to_is_not_followed(folder, victim):
    (folder / f"{PARTIAL}motion.csv").symlink_to(victim)
    write_text(folder / "motion.csv", "0,1\n")
    assert victim.read_text() == "precious" and (folder / "motion.csv").read_text() == "0,1\n"


def test_a_name_that_is_taken_is_refused_even_if_it_is_a_link_to_nothing(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(atomic.secrets, "token_hex", lambda _: "known")
    elsewhere = tmp_path / "elsewhere"
    (folder / f"{PARTIAL}known.csv").symlink_to(elsewhere)
    with pytest.raises(InputError, match=r"motion\.csv: cannot be written \(File exists\)"):
        write_text(folder / "motion.csv", "0,1\n")
    assert not elsewhere.exists() and not (folder / "motion.csv").exists()


def test_a_link_in_place_of_the_file_is_replaced(folder, victim):
    (folder / "motion.csv").symlink_to(victim)
    write_text(folder / "motion.csv", "0,1\n")
    assert victim.read_text() == "precious" and not (folder / "motion.csv").is_symlink()


def test_an_interrupted_block_changes_nothing_and_leaves_nothing(folder):
    write_text(folder / "kept.txt", "before")

    def interrupted() -> None:
        with replacing(folder / "kept.txt") as partial:
            partial.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [path.name for path in folder.iterdir()] == ["kept.txt"] and (folder / "kept.txt").read_text() == "before"


def test_the_longest_name_is_written(folder):
    name = "x" * 251 + ".txt"
    write_text(folder / name, "long")
    assert (folder / name).read_text() == "long"
