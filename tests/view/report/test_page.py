"""The page: it opens alone, says what is so, holds what it promises, and stays below its size."""

import base64
import json
import re
from xml.etree import ElementTree

import numpy as np
import pytest
import xarray as xr
from sealed import seal

from bayes_body.base.errors import InputError
from bayes_body.results.metrics.plausibility_sentences import fit_sentences
from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.report import page as pages
from bayes_body.view.report.bands import band_section
from bayes_body.view.report.figures import style
from bayes_body.view.report.filtering import filter_section
from bayes_body.view.report.head import findings, key_figures, provenance_section, verdict
from bayes_body.view.report.inspection import Inspection
from bayes_body.view.report.markup import Markup
from bayes_body.view.report.page import LARGEST, SECTIONS, fitted, page, sections_of, write_report
from bayes_body.view.report.pictures import QUALITIES, picture_section
from bayes_body.view.report.runs import run_section
from bayes_body.view.report.unknowns import unknown_section

# Each angle is a plot: where one is enough.
HIP = {"dofs": ("l_hip_y",), "units": ("rad",)}


@pytest.fixture(scope="module")
def folder(make_run, draw_pictures):
    """A run with pictures."""
    made = make_run()
    draw_pictures(made, 5)
    return made


@pytest.fixture(scope="module")
def whole(folder) -> str:
    with load_run(folder) as run:
        return page(run)


def alts(found) -> str:
    return "\n".join(image["alt"] for image in found.of("img"))


def test_a_page_opens_without_a_network_and_without_scripts(whole, parse):
    found = parse(whole)
    assert {name for name, _ in found.tags}.isdisjoint({"script", "link", "iframe", "object", "embed", "video", "audio", "form", "base"})
    addresses = [value for _, attributes in found.tags for key, value in attributes.items() if key in ("src", "srcset", "href", "action", "poster")]
    assert addresses and all(re.match(r"data:image/(svg\+xml|png|webp);base64,|#[a-z]+$", value) for value in addresses)
    assert "url(" not in found.styles and "@import" not in found.styles
    (policy,) = [each["content"] for each in found.of("meta") if each.get("http-equiv") == "Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert all(image["alt"] for image in found.of("img"))


def test_every_section_is_there_and_led_to(whole, parse):
    found = parse(whole)
    names = [name for name, _, _ in SECTIONS if name not in ("truth", "clinical", "gait", "unknowns", "joint", "chains", "messages")]
    assert [each["id"] for each in found.of("section")] == names
    assert [each["href"] for each in found.of("a")] == [f"#{name}" for name in names]


@pytest.mark.slow
def test_the_same_run_makes_the_same_page_and_its_parts_are_watched(folder, whole):
    seen = []
    with load_run(folder) as run:
        assert page(run, lambda parts: (seen.append(part) or part for part in parts)) == whole
        assert seen == list(range(len(sections_of(Inspection(run)))))


@pytest.mark.slow
def test_what_comes_from_files_cannot_be_markup(make_run, parse):
    evil = '<script>alert("1")</script><img src=x onerror=alert(1)> & </title>'
    with load_run(make_run(title=evil, dofs=("<b>hip</b>", "l_knee"), units=("rad", "rad"))) as run:
        text = page(run)
    found = parse(text)
    assert not found.of("script") and not found.of("b") and evil not in text
    assert found.text.count(evil) >= 3
    assert not any(key.startswith("on") for _, attributes in found.tags for key in attributes)


@pytest.mark.slow
def test_names_in_plots_are_no_formulas_and_hold_no_control_characters(make_run, parse):
    names = (r"$\frac{$", r"l_$\frac{$ $", "a\x1b[31m", "r_a\nb", "<&>")
    folder = make_run(dofs=names)
    with xr.open_datatree(folder / "posterior.nc") as tree:
        loaded = tree.load()
    loaded["filter"] = loaded["filter"].to_dataset().assign_coords(camera=[r"$\frac{$", "c\x1b]0;x\x07"])
    loaded.to_netcdf(folder / "posterior.nc", engine="h5netcdf")
    seal(folder)
    with load_run(folder) as run:
        found = parse(page(run))
    assert "\x1b" not in found.text + alts(found) and r"c\x1b]0;x\x07" in alts(found) and r"$\frac{$" in alts(found)
    images = [base64.b64decode(image["src"].partition("base64,")[2]) for image in found.of("img") if "svg+xml" in image["src"]]
    assert len(images) > len(names)
    for image in images:
        # A control character would not be XML.
        assert ElementTree.fromstring(image).tag.endswith("svg")


def test_a_valid_run_is_said_to_be_one_and_a_bad_one_has_warnings(inspect):
    pose = 0.1 * np.random.default_rng(0).normal(size=(2, 400, 5, 5))
    same = {"draws": 400, "log_evidence": np.zeros((2, 5))}
    valid = inspect(pose=pose, **same).warnings
    assert verdict({}, valid, agreement_known=True) == "The runs agree; no limit is crossed."
    assert verdict({}, valid, agreement_known=False) == "No limit is crossed."
    assert "No limit is crossed" in findings(valid)
    pose[1, :, 3:, 2] += 1
    lost = np.zeros((2, 5), bool)
    lost[0, 4] = True
    bad = inspect(pose=pose, lost=lost, **same).warnings
    told = verdict({}, bad, agreement_known=True)
    assert told.startswith("Warning: frame 4: lost") and "1 more warning below." in told
    assert "Frames 3-4: the runs disagree" in findings(bad) and "l_knee" in findings(bad) and "<code>--particles</code>" in findings(bad)


def test_the_verdict_begins_with_the_result():
    summary = {"frames": 60, "frames_lost": 2, "iou_median": 0.812, "error_mm_mean": 48.4, "coverage_90": 0.91}
    said = (
        "60 frames tracked, 2 lost; overlap with the silhouettes 0.81; mean markers 48\u00a0mm from the truth; "
        "91\u00a0% of the truth inside the 90\u00a0% intervals."
    )
    assert verdict(summary, [], agreement_known=True).splitlines() == [said, "The runs agree; no limit is crossed."]
    again = verdict(summary | {"frames_restarted": [7, 30]}, [], agreement_known=True)
    assert again.startswith("60 frames tracked, 2 lost, restarted at frames 7, 30; overlap")
    keypoints = verdict(summary | {"reads": ["keypoints"], "reprojection_px_median": 4.24}, [], agreement_known=True)
    assert "; median reprojection error of the keypoints 4.2\u00a0px; mean markers" in keypoints and "silhouettes" not in keypoints
    bare = {"frames": 1, "frames_lost": 0, "iou_median": None, "error_mm_mean": None, "coverage_90": None}
    assert verdict(bare, ["a"], agreement_known=True).splitlines() == ["1 frame tracked, none lost.", "Warning: a"]


def test_what_was_not_known_has_a_panel_for_each_unknown_and_unit(make_run, parse):
    entry = {"prior_mean": 0.0, "prior_sd": 0.02, "mean": 0.01, "sd": 0.01, "sd_ratio": 0.5, "rhat": None}
    camera = entry | {"name": "cameras", "entry": "a_move_x", "unit": "m", "mean": -0.08, "sd": 0.019, "sd_ratio": 0.95}
    rows = [entry | {"name": "lengths", "entry": "l_thigh", "unit": ""}, camera, camera | {"entry": "a_turn_x", "unit": "rad"}]
    folder = make_run()
    path = folder / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | {"unknowns": rows}), encoding="utf-8")
    seal(folder)
    with load_run(folder) as run, style():
        inspection = Inspection(run)
        content = unknown_section(inspection)
        assert "unknowns" in [name for name, _, _ in sections_of(inspection)]
        assert any(warning.startswith("cameras: a move x -80 mm (4.0 prior sd)") for warning in inspection.warnings)
    found = parse(content)
    assert [image["alt"].split(", in the last frame")[0] for image in found.of("img")] == ["Lengths, %", "Cameras, mm", "Cameras, °"]
    assert "2 of 3 entries stay as uncertain as their prior" in found.text
    assert "-80 ± 19 mm" in found.text and "1 ± 1 %" in found.text


def test_a_body_off_the_person_is_a_warning(make_run):
    folder = make_run()
    figures = {"fit_by": "silhouettes", "fit_first": 0.31, "fit_worst": 0.12, "fit_worst_frame": 4, "frames_off": [2, 3, 4]}
    path = folder / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | figures), encoding="utf-8")
    seal(folder)
    with load_run(folder) as run:
        first, later = Inspection(run).warnings[:2]
    assert first.startswith("frame 0: the body in its first pose does not fit the image") and "0.31" in first
    assert later.startswith("from frame 2 the body no longer covers the person") and "0.12" in later
    # A track that comes back says where.
    figures |= {"frames": 9, "frames_off": [2, 3, 4], "frames_restarted": [5]}
    again = fit_sentences(figures)[1]
    assert again.startswith("frames 2-4: the body does not cover the person; it was restarted at frame 5, where the person was found again: at worst")


def test_figures_have_their_units_and_what_does_not_exist_is_a_dash(inspect):
    evidence = np.array([[-10.0, -20.0], [-11.0, -21.0]])
    it = inspect(frames=2, log_evidence=evidence)
    cells = dict(re.findall(r'<th scope="row">([^<]*)</th><td>([^<]*)</td>', key_figures(it.run.summary, it.diagnosis)))
    assert cells["frames"] == "2" and cells["time per frame, all runs"] == "0.25\u00a0s"
    assert cells["overlap with the silhouettes (IoU), median"] == "–"
    assert cells["effective particles"] == "60 (median), 60 (minimum) of 60"
    # The runs' evidence is averaged before the logarithm.
    mean, sd = np.log((np.exp(-30) + np.exp(-32)) / 2), np.std([-30, -32], ddof=1)
    assert cells["log-evidence"] == f"{mean:.1f} ± {sd:.1f}\u00a0nats (sd over the runs)"


@pytest.mark.slow
def test_a_single_run_has_no_agreement_and_says_so(inspect, parse):
    it = inspect(runs=1)
    with style():
        found = parse(run_section(it))
    assert "no R-hat" in found.text and "--runs 2 or more" in found.text and "Rank plot" not in alts(found)
    assert "Distribution of" in alts(found)
    assert "spread unknown (a single run)" in key_figures(it.run.summary, it.diagnosis)


@pytest.mark.slow
def test_several_runs_are_ranked_at_the_first_the_worst_and_the_last_frame(inspect, parse):
    pose = 0.1 * np.random.default_rng(0).normal(size=(2, 60, 5, 2))
    pose[1, :, 3, 1] += 2
    with style():
        found = parse(run_section(inspect(dofs=("l_hip_y", "l_knee"), units=("rad", "rad"), pose=pose)))
    assert re.findall(r"Rank plot of left knee, frame (\d)", alts(found)) == ["0", "3", "4"]
    assert re.search(r"The largest is \d\.\d\d: left knee at frame 3", found.text)


@pytest.mark.slow
def test_a_mode_seeker_shows_no_evidence_and_no_tail(inspect, parse):
    with style():
        seeker = parse(filter_section(inspect(log_evidence=np.full((2, 5), np.nan))))
        sampler = parse(filter_section(inspect()))
    assert "estimates no evidence" in seeker.text and "estimates no evidence" not in sampler.text
    # All weights of the runs made here are the same: they have no tail.
    assert "Log-evidence" in alts(sampler) and "Log-evidence" not in alts(seeker)


def test_a_mode_seeker_has_no_intervals_and_a_sentence_why(inspect, parse):
    with style():
        seeker = inspect(**HIP, log_evidence=np.full((2, 5), np.nan))
        angles, runs = parse(band_section(seeker)), parse(run_section(seeker))
        sampler = inspect(**HIP)
        bands, close = parse(band_section(sampler)), parse(run_section(sampler))
    assert "not a measure of uncertainty" in angles.text and "band" not in alts(angles) and "left hip y over the frames: mean" in alts(angles)
    assert "not a measure of uncertainty" in runs.text and "Rank plot" in alts(runs)
    for shown in ("intervals of", "Distribution of", "Effective sample size"):
        assert shown in alts(close) and shown not in alts(runs)
    assert "not a measure of uncertainty" not in bands.text and "widest 90 % band" in alts(bands)


@pytest.mark.slow
def test_panels_of_what_a_kernel_has(inspect, parse):
    number = np.array([[[1], [2], [3], [2], [1]]] * 2)
    by_layer = np.where(np.arange(3) < number, 0.5, np.nan)
    seen = np.array([[True, True]] * 4 + [[True, False]])
    weights = np.random.default_rng(0).normal(size=(2, 400, 5))
    with style():
        plain = parse(filter_section(inspect(acceptance_rate=np.full((2, 5, 3), np.nan))))
        rich = parse(filter_section(inspect(draws=400, log_weight=weights, survival_rate=by_layer, seen=seen)))
    assert "Acceptance" not in alts(plain) and "Number of layers" not in alts(plain) and "Pareto" not in alts(plain)
    assert "Acceptance" in alts(rich) and "Number of layers in each frame, from 1 to 3" in alts(rich) and "Pareto" in alts(rich)
    assert "left in 100%; right in 80%" in alts(rich)


def test_lost_frames_are_shaded_and_said_to_be(inspect, parse):
    lost = np.zeros((2, 5), bool)
    lost[1, 2] = True
    with style():
        assert "Lost frames are shaded" in parse(band_section(inspect(**HIP, lost=lost))).text
        assert "shaded" not in parse(band_section(inspect(**HIP))).text


@pytest.mark.slow
def test_one_frame_and_dofs_that_never_move(inspect, parse):
    pose = np.zeros((2, 60, 1, 5))
    pose[..., 1] = np.random.default_rng(0).normal(size=(2, 60, 1))
    it = inspect(frames=1, pose=pose)
    with style():
        found = parse(Markup(band_section(it) + filter_section(it) + run_section(it)))
    assert re.findall("Rank plot of (.*):", alts(found)) == ["left hip y, frame 0"]


def test_pictures_that_are_gone_are_said_to_be_gone(make_run, draw_pictures, parse):
    folder = make_run()
    found = parse(picture_section(folder, QUALITIES[0]))
    assert "no moving picture" in found.text and "no stills" in found.text and not found.of("img")
    draw_pictures(folder, 5)
    (folder / "overlay.mp4").write_bytes(b"no video")
    found = parse(picture_section(folder, QUALITIES[0]))
    assert "cannot be read: there is no moving picture" in found.text
    assert re.findall(r"Frame (\d):", alts(found)) == ["0", "4"]


@pytest.mark.slow
def test_pictures_get_worse_until_the_page_fits(inspect, draw_pictures, parse):
    it = inspect()
    draw_pictures(it.run.folder, 4, (320, 240), noise=True)
    sections = [Markup("<p>text</p>"), picture_section(it.run.folder, QUALITIES[0]), Markup("<p>more</p>")]
    whole = len(fitted(it, sections, 10**9).encode())
    worse = fitted(it, sections, whole)
    assert len(worse.encode()) < whole and parse(worse).of("img") and "<p>text</p>" in worse and "<p>more</p>" in worse
    bare = fitted(it, sections, 20_000)
    assert len(bare.encode()) < 20_000 and "The pictures are left out" in bare and not parse(bare).of("img")
    with pytest.raises(InputError, match=r"0\.0 MB without pictures; expected less than 0\.001 MB"):
        fitted(it, sections, 1000)


def test_how_it_was_made(inspect):
    text = provenance_section(inspect().run)
    cells = dict(re.findall(r'<th scope="row">([^<]*)</th><td>([^<]*)</td>', text))
    assert (cells["platform"], cells["devices"], cells["bayes-body"], cells["title"]) == ("an abacus", "bead:0", "0.0.9", "blobs")
    assert cells["cameras"] == "a 160 × 120\u00a0px; b 128 × 144\u00a0px" and "kind = &quot;silhouette_edges&quot;" in text


@pytest.mark.slow
def test_a_run_whose_session_cannot_be_used(make_run, parse):
    folder = make_run(**HIP)
    record = (folder / "run.toml").read_text(encoding="utf-8")
    (folder / "run.toml").write_text(record.replace("fps = ", "fsp = "), encoding="utf-8")
    seal(folder)
    with load_run(folder) as run:
        found = parse(page(run))
    assert "The session can no longer be read" in found.text and "left hip y over the frames" in alts(found)


def test_the_file_is_written_where_it_is_asked_for(make_run, tmp_path, monkeypatch):
    monkeypatch.setattr(pages, "page", lambda run, watch: "a page")
    with load_run(make_run()) as run:
        assert write_report(run) == run.folder / "report.html"
        assert write_report(run, tmp_path / "made" / "walk.html").read_text(encoding="utf-8") == "a page"
        with pytest.raises(InputError, match="a folder; expected the name of a file"):
            write_report(run, run.folder)


@pytest.mark.long
def test_a_long_run_of_a_whole_body_stays_below_the_limit(make_run, draw_pictures, parse):
    frames, runs, layers = 2000, 3, 8
    rng = np.random.default_rng(1)
    joints = ("hip", "knee", "shoulder", "elbow", "clavicle")
    dofs = (*(f"{side}_{joint}_{axis}" for side in "lr" for joint in joints for axis in "xyz"), "head_x")
    pose = rng.normal(size=(runs, 40, frames, len(dofs))).astype(np.float32)
    number = rng.integers(2, layers + 1, (runs, frames, 1))
    by_layer = np.where(np.arange(layers) < number, rng.random((runs, frames, layers)), np.nan)
    layered = dict.fromkeys(("survival_rate", "inverse_temperature", "acceptance_rate"), by_layer)
    seen, lost = rng.random((frames, 2)) > 0.2, rng.random((runs, frames)) > 0.9
    folder = make_run(draws=40, frames=frames, runs=runs, dofs=dofs, units=("rad",) * len(dofs), pose=pose, seen=seen, lost=lost, **layered)
    draw_pictures(folder, 200, (1280, 960), noise=True)
    with load_run(folder) as run:
        text = page(run)
    assert 1_000_000 < len(text.encode()) < LARGEST == 10_000_000
    found = parse(text)
    assert "The plots show every 5th frame of 2,000" in found.text
    assert alts(found).count("over the frames: mean") == len(dofs)
