"""What is said of the unknowns of a run, and of joints at their limits: lines for a terminal, and warnings with the likely cause."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

# An entry whose standard deviation is more than this share of the prior's is not determined by the recording.
UNDETERMINED = 0.9
# Distance of a posterior's mean from the prior's, in standard deviations of the prior, from which there is a warning.
MOST_SHIFT = 3.0
# Share of the frames in which a dof is near its limit from which there is a warning.
MOST_NEAR_LIMIT = 0.3
# Entries that a line or a sentence names; it only counts the rest.
MOST_NAMED = 3
# Factor and name of the unit in which an entry is shown. What has no unit is a logarithm of a factor, nearly a percentage.
SHOWN = {"": (100.0, "%"), "m": (1000.0, "mm"), "rad": (180.0 / math.pi, "°"), "s": (1000.0, "ms")}
CAUSES = {
    "lengths": "check the subject's height and lengths in the session",
    "widths": "check the subject's height and the silhouettes",
    "cameras": "check the calibration of this camera, and whether it was moved",
    "delays": "check the synchronisation of this camera, and shift it by whole frames first",
    "keypoint_offsets": "check which keypoints the network marks, and the lengths of the session",
    "noise": "check the keypoints of this camera, and sd_px",
}
OTHERWISE = "check its prior in the definition, and the session"


def shown(row: Mapping[str, Any]) -> tuple[float, str]:
    """Return the factor and the unit in which an entry of the summary's table `unknowns` is shown: %, mm, °, ms, or its own."""
    return SHOWN.get(row["unit"], (1.0, row["unit"]))


def shift(row: Mapping[str, Any]) -> float:
    """Return the distance of the posterior's mean from the prior's, in standard deviations of the prior."""
    return (row["mean"] - row["prior_mean"]) / row["prior_sd"]


def title(row: Mapping[str, Any]) -> str:
    """Return the name of an entry in words, such as `lengths: upper arm`."""
    return f"{row['name']}: {row['entry']}".replace("_", " ")


def unknown_lines(summary: Mapping[str, Any]) -> list[str]:
    """Return the lines about the unknowns; none for a run without any."""
    rows: Sequence[Mapping[str, Any]] = summary.get("unknowns") or ()
    if not rows:
        return []
    sampled = [row for row in rows if row["sd_ratio"] is not None]
    open_entries = sum(row["sd_ratio"] > UNDETERMINED for row in sampled)
    rhat = summary.get("unknowns_rhat_max")
    counted = f"{open_entries} of {len(rows)} entries stay as uncertain as their prior" if sampled else f"{len(rows)} entries"
    agreement = "" if rhat is None else f"; R-hat over runs at most {rhat:.2f}"
    largest = sorted(rows, key=lambda row: -abs(shift(row)))[:MOST_NAMED]
    return [f"unknowns    {counted}{agreement}", f"            furthest from the prior's mean: {', '.join(map(_moved, largest))}"]


def _moved(row: Mapping[str, Any]) -> str:
    factor, unit = shown(row)
    gap = "" if unit == "°" else " "
    return f"{title(row)} {factor * (row['mean'] - row['prior_mean']):+.3g}{gap}{unit} ({abs(shift(row)):.1f} prior sd)"


def unknown_sentences(summary: Mapping[str, Any]) -> list[str]:
    """Return warnings about unknowns far from their prior, a sentence for each unknown, and about dofs at their limits, with the likely cause."""
    rows: Sequence[Mapping[str, Any]] = summary.get("unknowns") or ()
    shifted: dict[str, list[Mapping[str, Any]]] = {}
    for row in sorted(rows, key=lambda row: -abs(shift(row))):
        if abs(shift(row)) > MOST_SHIFT:
            shifted.setdefault(row["name"], []).append(row)
    return [*(_describe_far(name, entries) for name, entries in shifted.items()), *_describe_limits(summary)]


def _describe_far(name: str, entries: Sequence[Mapping[str, Any]]) -> str:
    more = f" and {len(entries) - MOST_NAMED} more" if len(entries) > MOST_NAMED else ""
    distance = f"further than {MOST_SHIFT:g} prior standard deviations from what the session says"
    return f"{', '.join(map(_moved, entries[:MOST_NAMED]))}{more}: {distance}; {CAUSES.get(name, OTHERWISE)}."


def _describe_limits(summary: Mapping[str, Any]) -> list[str]:
    shares = {dof: share for dof, share in (summary.get("near_limit_shares") or {}).items() if share >= MOST_NEAR_LIMIT}
    # Of paths from one Gaussian, a sentence of their own says so.
    if not shares or "joint_near_limit_max" in summary:
        return []
    ordered = sorted(shares.items(), key=lambda item: -item[1])
    named = ", ".join(f"{dof} ({share:.0%} of the frames)" for dof, share in ordered[:MOST_NAMED])
    more = f" and {len(shares) - MOST_NAMED} more" if len(shares) > MOST_NAMED else ""
    has_lengths = any(row["name"] == "lengths" for row in summary.get("unknowns") or ())
    cause = (
        "a movement beyond the limits of the body file"
        if has_lengths
        else "wrong lengths of the body: correct the session's, or add [[unknown]] kind = 'lengths'"
    )
    return [f"{named}{more}: within two posterior standard deviations of a limit; the likely cause is {cause}."]
