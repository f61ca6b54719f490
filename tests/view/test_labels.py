"""Names at the ends of lines: near them, in their order, apart."""

import numpy as np
import pytest

from bayes_body.view.labels import label_lines, spread
from bayes_body.view.report.figures import new_panel


@pytest.mark.parametrize("seed", range(20))
def test_names_are_apart_in_the_order_of_the_lines_and_no_farther_off_than_they_must(seed):
    rng = np.random.default_rng(seed)
    heights, gap = rng.uniform(size=rng.integers(1, 7)), 0.12
    places = np.array(spread(heights.tolist(), gap))
    order = np.argsort(heights)
    assert (np.diff(places[order]) >= gap - 1e-12).all() and places.min() >= -1e-12 and places.max() <= 1 + 1e-12
    if (np.diff(heights[order]) >= gap).all():
        np.testing.assert_allclose(places, heights)


def test_two_lines_at_one_height_share_the_way():
    np.testing.assert_allclose(spread([0.5, 0.5], 0.1), [0.45, 0.55])


def test_a_name_stands_beside_the_end_of_its_line_in_its_colour():
    figure, axes = new_panel("", "", "")
    axes.set(xlim=(0, 2), ylim=(0, 10))
    axes.plot([0, 1, 2], [1, 1, 8], color="#112233", label="up")
    axes.plot([0, 1, 2], [5, 2, np.nan], color="#445566", linestyle="--", label="down")
    axes.plot([0, 2], [3, 3])
    label_lines(axes)
    up, down = axes.texts
    assert (up.get_text(), up.get_color(), down.get_text(), down.get_color()) == ("up", "#112233", "down", "#445566")
    # Heights of the last known points, right of the axes, inside the figure.
    assert (up.get_position()[1], down.get_position()[1]) == (pytest.approx(0.8), pytest.approx(0.2))
    figure.canvas.draw()
    edges = [text.get_window_extent() for text in (up, down)]
    assert all(axes.get_window_extent().x1 < edge.x0 and edge.x1 <= figure.bbox.x1 for edge in edges)
