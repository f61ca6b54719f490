"""The page in a browser without a network: all pictures load, nothing complains, it fits a phone, and it can be seen."""

import re

import cv2
import pytest

from bayes_body.results.storage.saved_run import load_run
from bayes_body.view.report import write_report

pytestmark = pytest.mark.slow

# Read by the test alone: the page itself has no script, and forbids any.
PROBE = """<script>addEventListener("load", () => {
  const images = [...document.images], root = document.documentElement;
  root.dataset.broken = images.filter(image => !(image.complete && image.naturalWidth > 0)).length;
  root.dataset.images = images.length;
  root.dataset.overflow = root.scrollWidth - root.clientWidth;
  root.dataset.height = root.scrollHeight;
})</script></body>"""


@pytest.fixture(scope="module")
def page(make_run, draw_pictures):
    folder = make_run()
    draw_pictures(folder, 5)
    with load_run(folder) as run:
        return write_report(run)


@pytest.mark.parametrize("width", [1200, 500])
def test_all_pictures_load_and_nothing_is_wider_than_the_window(browser, page, width):
    text = page.read_text(encoding="utf-8")
    policy = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
    assert policy in text
    probed = page.with_name("probed.html")
    probed.write_text(text.replace(policy, f"{policy}; script-src 'unsafe-inline'").replace("</body>", PROBE), encoding="utf-8")
    html, _ = browser(probed, "--dump-dom", f"--window-size={width},900")
    found = {key: int(value) for key, value in re.findall(r'data-(broken|images|overflow|height)="(-?\d+)"', html)}
    assert found["broken"] == 0 and found["images"] == text.count("<img")
    assert found["overflow"] == 0
    assert 3000 < found["height"] < 40000


def test_the_page_can_be_seen_and_nothing_complains(browser, page, tmp_path):
    _, log = browser(page, f"--screenshot={tmp_path / 'page.png'}", "--window-size=1200,2500")
    assert "CONSOLE" not in log, log
    picture = cv2.imread(str(tmp_path / "page.png"))
    assert picture.shape == (2500, 1200, 3)
    # Ink in every part of the page, and more paper than ink.
    paper = picture[-1, 0]
    ink = (picture != paper).any(axis=-1)
    assert all(ink[start : start + 500].any() for start in range(0, 2500, 500)) and ink.mean() < 0.5
