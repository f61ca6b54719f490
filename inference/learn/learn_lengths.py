r"""Learn how people's bones differ in length from a table of measured people: models/learned/bone_lengths.toml, the prior of the unknown `lengths`.

    python inference/learn/learn_lengths.py > models/learned/bone_lengths.toml
    python inference/learn/learn_lengths.py MEN.csv WOMEN.csv

Without a table, it reads the sample beside it. It reads the public files of the survey too. With the share $s_k$ of bone k in the stature $h$,

$$\log \ell_k = \log h + \log s_k, \qquad
\Sigma = \operatorname{cov} \log s + \operatorname{diag} d^2,$$

over men and women with equal weights. What is measured lies on the skin, between landmarks that are not the joints' centres. So only the variation
is learned, not the mean, and $d_k$ is added: by how much a body file's bone and the landmarks' distance differ in the mean. For thigh, calf and arm
it is the difference between two tables of means, Drillis & Contini 1966 (the body files') and this one: 1 to 5 %. For bones whose ends are no joints,
or lie some centimetres from their landmarks, it is a judgement.
"""

import argparse
import csv
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from bayes_body.base.errors import InputError, input_error

SAMPLE = Path(__file__).with_name("ansur_2012_sample.csv")
STATURE, SEX = "stature", "Gender"
# A bone is the first measurement, less the second. A pelvis and clavicles are halves of breadths, which have the same logarithmic deviations.
BONES: Mapping[str, tuple[str, str | None]] = {
    "torso": ("suprasternaleheight", "trochanterionheight"),
    "pelvis": ("bicristalbreadth", None),
    "thigh": ("trochanterionheight", "lateralfemoralepicondyleheight"),
    "calf": ("lateralfemoralepicondyleheight", "lateralmalleolusheight"),
    "clavicle": ("biacromialbreadth", None),
    "upper_arm": ("acromionradialelength", None),
    "forearm": ("radialestylionlength", None),
    "head": (STATURE, "suprasternaleheight"),
    "heel": ("lateralmalleolusheight", None),
    "foot": ("footlength", None),
    "hand": ("handlength", None),
}
# Relative. A hip's centre lies well inside of the crest that is measured, and a shoulder's some centimetres inside of the acromion.
DEFINITION: Mapping[str, float] = {
    "torso": 0.05, "pelvis": 0.12, "thigh": 0.03, "calf": 0.03, "clavicle": 0.10, "upper_arm": 0.03, "forearm": 0.03, "head": 0.08, "heel": 0.05,
    "foot": 0.05, "hand": 0.05,
}  # fmt: skip
FEWEST = 2 * len(BONES)
FOLDS = 5


class People(NamedTuple):
    """Measured people: logarithms of their statures and of the bones' shares, and weights in which both sexes count alike."""

    log_stature: Float[np.ndarray, " person"]
    log_shares: Float[np.ndarray, "person bone"]
    weights: Float[np.ndarray, " person"]


class Variation(NamedTuple):
    """How people differ.

    Attributes:
        stature_sd: standard deviation of the logarithm of stature.
        shares: means of the bones' shares of stature.
        sd: standard deviations of their logarithms, without that of the definition.
        covariance: of the logarithms, with it.
    """

    stature_sd: float
    shares: Float[np.ndarray, " bone"]
    sd: Float[np.ndarray, " bone"]
    covariance: Float[np.ndarray, "bone bone"]


def read_people(paths: Sequence[Path]) -> People:
    """Read tables of measured people, separated by commas or semicolons, in millimetres; lines that begin with # are comments.

    Raises:
        InputError: a table cannot be read, a column is missing, a number is none, or there are too few people.
    """
    rows = [row for path in paths for row in _rows(path)]
    sexes = [sex for sex, _ in rows]
    for sex in ("Male", "Female"):
        if sexes.count(sex) < FEWEST:
            raise input_error(f"{SEX} = {sex}", f"{sexes.count(sex)} people", f"{FEWEST} or more", "give a table of men and one of women")
    weights = np.array([0.5 / sexes.count(sex) for sex in sexes])
    logarithms = np.log(np.array([values for _, values in rows]))
    return People(logarithms[:, 0], logarithms[:, 1:] - logarithms[:, :1], weights)


def _rows(path: Path) -> list[tuple[str, list[float]]]:
    """Return the sex, stature and bones of each person of a table."""
    try:
        lines = [line for line in path.read_text("latin-1").splitlines() if line.strip() and not line.startswith("#")]
    except OSError as error:
        raise input_error(str(path), str(error.strerror), "a table of measured people", "check the path") from error
    if not lines:
        raise input_error(str(path), "no rows", "a table of measured people", "check the path")
    reader = csv.DictReader(lines, delimiter=";" if ";" in lines[0] else ",")
    missing = {SEX, STATURE, *(name for pair in BONES.values() for name in pair if name)} - set(reader.fieldnames or ())
    if missing:
        raise input_error(str(path), f"no column {', '.join(sorted(missing))}", "the columns of ANSUR II", "use its public files")
    return [_person(path, number, row) for number, row in enumerate(reader, start=1)]


def _person(path: Path, number: int, row: Mapping[str, str | None]) -> tuple[str, list[float]]:
    def measured(name: str) -> float:
        try:
            return float(row[name] or "")
        except ValueError:
            raise input_error(
                f"{path}, person {number}: {name}", f"'{row[name]}'", "a number of millimetres", "correct the row or take it out"
            ) from None

    lengths = [measured(STATURE), *(measured(start) - (measured(end) if end else 0.0) for start, end in BONES.values())]
    if not all(0 < length < math.inf for length in lengths):
        raise input_error(f"{path}, person {number}", "a bone without length", "heights in the order of a body", "correct the row or take it out")
    return str(row[SEX]), lengths


def variation(people: People) -> Variation:
    """Return how people differ."""
    weights = people.weights / people.weights.sum()
    stature, shares = weights @ people.log_stature, weights @ people.log_shares
    centred = people.log_shares - shares
    covariance = (weights[:, None] * centred).T @ centred
    with_definition = covariance + np.diag([DEFINITION[name] ** 2 for name in BONES])
    stature_sd = float(np.sqrt(weights @ (people.log_stature - stature) ** 2))
    return Variation(stature_sd, np.exp(shares), np.sqrt(np.diagonal(covariance)), with_definition)


def held_out(people: People, seed: int = 0) -> dict[str, float]:
    """Return the log-density of people who were not learned from, nats a person, with correlations and without. Their means are learned too."""
    folds = np.random.default_rng(seed).permutation(len(people.weights)) % FOLDS
    scores: dict[str, list[float]] = {"with correlations": [], "without": []}
    for fold in range(FOLDS):
        known, new = (People(*(field[chosen] for field in people)) for chosen in (folds != fold, folds == fold))
        learned = variation(known)
        off = new.log_shares - np.log(learned.shares)
        scores["with correlations"].append(_log_density(off, learned.covariance))
        scores["without"].append(_log_density(off, np.diag(np.diagonal(learned.covariance))))
    return {name: float(np.mean(values)) for name, values in scores.items()}


def _log_density(off: Float[np.ndarray, "person bone"], covariance: Float[np.ndarray, "bone bone"]) -> float:
    quadratic = np.einsum("ni,ij,nj->n", off, np.linalg.inv(covariance), off)
    return float(-0.5 * (quadratic.mean() + np.linalg.slogdet(2 * np.pi * covariance)[1]))


def as_toml(learned: Variation, source: str, count: int) -> str:
    """Return the file of the prior."""
    sd = np.sqrt(np.diagonal(learned.covariance))
    correlation = np.round(learned.covariance / np.outer(sd, sd), 2) + 0.0  # no -0.00
    columns: tuple[tuple[str, str, Mapping[str, float]], ...] = (
        ("share", "the bone's mean length between landmarks, of stature; not used: the body file has its own means", _named(learned.shares)),
        ("measured_sd", "standard deviation of the logarithm of the share, among people", _named(learned.sd)),
        ("definition_sd", "the same of the bone's definition: between landmarks on the skin, and between the joints of a body file", DEFINITION),
        ("sd", "both together", _named(sd)),
    )
    tables = "\n\n".join(
        f"# {about}\n[{name}]\n" + "\n".join(f"{bone} = {value:.4f}" for bone, value in table.items()) for name, about, table in columns
    )
    rows = "\n".join(
        f"{bone} = {{ {', '.join(f'{other} = {value:.2f}' for other, value in _named(row[:place]).items())} }}"
        for place, (bone, row) in enumerate(zip(BONES, correlation, strict=True))
        if place
    )
    return f"""# Logarithms of bones over stature: standard deviations and correlations among people, both sexes with equal weights.
title = "How people's bones differ in length: the prior of the unknown 'lengths'"
source = "2012 Anthropometric Survey of U.S. Army Personnel (Gordon et al. 2014, NATICK/TR-15/007, public domain)"
command = "python inference/learn/learn_lengths.py{source}"
people = {count}
stature_sd = {learned.stature_sd:.4f}

{tables}

# of the logarithms of shares, with the definition's deviation; each pair once
[correlation]
{rows}
"""


def _named(values: Float[np.ndarray, " bone"]) -> dict[str, float]:
    return dict(zip(BONES, values.tolist(), strict=False))


def main(arguments: Sequence[str] | None = None) -> None:
    """Learn, write the file to the standard output and the scores to the standard error."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", nargs="*", type=Path, help="CSV files of ANSUR II, of men and of women; the sample beside this program by default")
    tables = parser.parse_args(arguments).tables
    people = read_people(tables or [SAMPLE])
    print(as_toml(variation(people), "".join(f" {path.name}" for path in tables), len(people.weights)), end="")
    for name, score in held_out(people).items():
        print(f"held-out log-density {name}: {score:.2f} nats a person", file=sys.stderr)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
