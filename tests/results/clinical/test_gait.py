"""Gait events against a walk in closed form, and against the feet of captured people whose walks the method's error was not measured on."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from bayes_body.base.errors import InputError
from bayes_body.results.clinical.gait import CONTACT, LIFT, POINTS, cadence, gait_of, speed

from .contact import captured

FPS, SECONDS, STRIDE_S, SPEED, SWING = 50.0, 6.0, 1.1, 1.3, 0.35
# Nearer to a recording's ends than this, s, an event cannot be seen: the ankle has not turned round yet.
END_S = 0.2


def walking(draws, rng, up=2, sd=0.0):
    """A walk in a direction that is no axis: the ankles swing as cosines about the pelvis; (draw, frame, marker, 3)."""
    t = np.arange(round(FPS * SECONDS)) / FPS
    forward, upward = np.roll([0.6, 0.8, 0.0], up - 2), np.roll([0.0, 0.0, 1.0], up - 2)
    left = np.cross(upward, forward)
    pelvis = SPEED * t[:, None] * forward + 0.9 * upward
    points = []
    for name in POINTS:
        side, phase = (1, 0.0) if name[0] == "l" else (-1, 0.5)
        swing = SWING * np.cos(2 * np.pi * (t / STRIDE_S - phase))[:, None] * forward - 0.8 * upward
        points.append(pelvis + side * 0.09 * left + (swing if "ankle" in name else 0))
    return np.stack(points, axis=1) + sd * rng.normal(size=(draws, 1, 1, 3))


@pytest.mark.parametrize("up", [2, 1])
def test_a_walk_in_closed_form(up):
    gait = gait_of(walking(400, np.random.default_rng(0), up), FPS, up)
    for kind, error, phase in (("foot strike", CONTACT, 0.0), ("toe off", LIFT, 0.5)):
        for side, shift in (("l", 0.0), ("r", 0.5)):
            expected = np.arange(-1, 8) * STRIDE_S + (phase + shift) * STRIDE_S
            expected = expected[(expected > 0) & (expected < SECONDS - 2 / FPS)]
            found = [event for event in gait.events if event.kind == kind and event.side == side]
            assert all(event.share == 1 for event in found)
            # Between frames; the draws differ by the error of the method only, whose heavy tails a median ignores.
            np.testing.assert_allclose([np.median(event.times) for event in found], expected - error.mean, atol=0.003)
            spreads = [np.diff(np.quantile(event.times, (0.05, 0.95)))[0] for event in found]
            assert min(spreads) > 2 * 1.64 * error.events and max(spreads) < 2 * 2.5 * (error.events + error.walks)
    assert len(gait.strides) == 8
    for stride in gait.strides:
        assert stride.duration.mean() == pytest.approx(STRIDE_S, abs=2e-3) and stride.length.mean() == pytest.approx(SPEED * STRIDE_S, abs=5e-3)
        assert np.nanmean(stride.stance) == pytest.approx(0.5 - (LIFT.mean - CONTACT.mean) / STRIDE_S, abs=5e-3) or np.isnan(stride.stance).all()
    assert cadence(gait).mean() == pytest.approx(120 / STRIDE_S, abs=0.2) and speed(gait).mean() == pytest.approx(SPEED, abs=5e-3)


def test_draws_that_lack_an_event_say_so():
    paths = walking(10, np.random.default_rng(0))
    # In four draws the person stands.
    paths[:4] = paths[:4, :1]
    gait = gait_of(paths, FPS, 2)
    assert {event.share for event in gait.events} == {0.6}
    assert np.isnan(cadence(gait)[:4]).all() and np.isfinite(cadence(gait)[4:]).all()
    assert gait_of(np.repeat(paths[:2], 2, axis=0), FPS, 2) == ((), ())
    with pytest.raises(InputError, match=r"gait: 20 frames; expected at least 30"):
        gait_of(paths[:, :20], FPS, 2)


def error_paths(rng, draws, frames, fps, sd, tau):
    """Gaussian errors of every marker and axis with a correlation of tau seconds, and rough noise of a tenth of their size."""
    pad = int(4 * tau * fps) + 2
    smooth = gaussian_filter1d(rng.normal(size=(draws, frames + 2 * pad, len(POINTS), 3)), tau * fps / np.sqrt(2), axis=1)[:, pad:-pad]
    return sd * smooth / smooth.std() + 0.1 * sd * rng.normal(size=smooth.shape)


def compared(paths, rng, fps, sd=0.02, tau=0.1, draws=200):
    """Errors in frames of all events in these walks, whether the 90 % intervals hold the truth, and the true events that were not found."""
    errors, held, missing = [], [], 0
    for path in paths:
        places, rate, true = captured(path)
        known = np.stack([places[name] for name in POINTS], axis=1)[:: round(rate / fps)]
        # The truth and the draws are equally far from the estimate, in law: the intervals are those of a posterior that is right.
        noise = error_paths(rng, draws + 1, len(known), fps, sd, tau)
        gait = gait_of(known + noise[0] - noise[1:], fps, 2)
        for (kind, side), times in true.items():
            events = [event for event in gait.events if (event.kind, event.side) == (kind, side)]
            for time in times:
                if not END_S < time < len(known) / fps - END_S:
                    continue
                means = np.array([np.nanmean(event.times) for event in events])
                nearest = np.abs(means - time).argmin()
                missing += abs(means[nearest] - time) > 0.25
                low, high = np.nanquantile(events[nearest].times, (0.05, 0.95))
                errors.append(fps * (means[nearest] - time))
                held.append(low <= time <= high)
    return np.array(errors), np.array(held), missing


WALKS = ("06/06_01", "35/35_01", "35/35_28", "38/38_01", "39/39_01", "39/39_12")


@pytest.mark.slow
def test_events_of_captured_people(cmu_mocap):
    errors, held, missing = compared([cmu_mocap / f"{walk}.amc" for walk in WALKS], np.random.default_rng(4), 60.0)
    assert len(errors) > 40 and missing == 0
    assert np.abs(errors).mean() < 1 and (np.abs(errors) <= 2).mean() > 0.9
    assert held.mean() > 0.8


@pytest.mark.long
@pytest.mark.parametrize(("fps", "sd", "tau"), [(60.0, 0.01, 0.1), (60.0, 0.02, 0.1), (60.0, 0.03, 0.2), (30.0, 0.02, 0.1)])
def test_events_of_all_people_that_were_kept_back(cmu_mocap, fps, sd, tau):
    paths = sorted(path for subject in ("06", "35", "38", "39") for path in (cmu_mocap / subject).glob("*.amc"))
    errors, held, missing = compared(paths, np.random.default_rng(0), fps, sd, tau)
    spread = np.sqrt(held.mean() * (1 - held.mean()) / len(held))
    figures = f"{len(errors)} events: {np.abs(errors).mean():.2f} frames off on average, 95 % within {np.quantile(np.abs(errors), 0.95):.2f}"
    print(f"{fps:g} fps, errors of {1000 * sd:g} mm over {tau} s: {figures}; covered {held.mean():.3f} (sd {spread:.3f}), {missing} missing")
    assert missing == 0 and np.quantile(np.abs(errors), 0.95) < 2 and 0.8 < held.mean() < 0.98
