"""`bayes-body report`: a path and a size, or a sentence."""

import re

import pytest

from bayes_body.cli.main import main


@pytest.fixture
def report(capsys):
    """`report(folder, "--out", file)`: exit status, standard output and error."""

    def call(*arguments):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stopped:
            main(["report", *map(str, arguments)])
        out, err = capsys.readouterr()
        return stopped.value.code, out, re.sub(r"\x1b\[\d*m", "", err)

    return call


@pytest.mark.slow
def test_a_report(report, make_run, draw_pictures, tmp_path):
    folder = make_run()
    draw_pictures(folder, 5)
    status, out, err = report(folder)
    assert (status, err) == (0, "")
    path = folder / "report.html"
    assert out == f"{path}: {path.stat().st_size / 1e6:.1f} MB; open it in a browser.\n"
    status, out, _ = report(folder, "--out", tmp_path / "walk.html")
    assert status == 0 and str(tmp_path / "walk.html") in out and (tmp_path / "walk.html").read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_a_file_that_is_no_report_is_not_replaced_unasked(report, make_run, tmp_path):
    folder, mine = make_run(), tmp_path / "session.toml"
    mine.write_text('title = "mine"')
    status, out, err = report(folder, "--out", mine)
    assert (status, out) == (2, "") and "session.toml: already exists; " in err and "--overwrite" in err
    assert mine.read_text() == 'title = "mine"'
    status, _, err = report(folder, "--out", tmp_path)
    assert status == 2 and "a folder; expected the name of a file" in err
    assert report(folder, "--out", mine, "--overwrite")[0] == 0
    # Now it is a report, which may be replaced by a newer one.
    assert report(folder, "--out", mine)[0] == 0


def test_what_is_no_run_is_a_sentence(report, make_run, tmp_path):
    def refused(folder, *parts):
        status, out, err = report(folder)
        assert status == 2 and out == "" and "Traceback" not in err and err.startswith("bayes-body: ")
        assert all(part in err for part in parts)

    refused(tmp_path / "none", "no such folder", "check the path")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "no run.toml", "bayes-body track")
    folder = make_run()
    (folder / "posterior.nc").unlink()
    refused(folder, "holds no posterior.nc", "expected a finished run")
    assert not (folder / "report.html").exists()
