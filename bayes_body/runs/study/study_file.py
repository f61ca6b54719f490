"""A study in writing: which sessions, which models and kernels, how many runs, and what is made of them.

`OUT/study.toml` has the same form. It is written by each start of a study, with the sessions as absolute paths instead of patterns.
"""

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from bayes_body.base.errors import input_error
from bayes_body.base.files.atomic import make_folder, write_text
from bayes_body.base.toml.read import read_toml, validate
from bayes_body.base.toml.schema import Count, Name, Schema
from bayes_body.runs.limits import FEWEST_KEPT, LARGEST_SEED

NAME = "study.toml"

type Value = bool | int | float | str
# The forms in which `bayes-body export` writes a motion.
type Export = Literal["trc", "mot", "c3d", "bvh", "csv", "npz"]
type Step = Literal["smooth", "report", "view", "gait"]
Plain = Annotated[str, Field(min_length=1, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


class TrackTable(Schema):
    """Options of `bayes-body track`, by their names there. What is not given has the default of that command."""

    model: Name | None = None
    """A definition's name, or the path of a file"""
    kernel: Name | None = None
    """Of the model, if none is named"""
    particles: Count | None = None
    """Particles of a run"""
    layers: Count | None = None
    """Annealing layers of a frame (annealed only)"""
    move: Name | None = None
    """hmc or random_walk (tempered only)"""
    moves: Count | None = None
    """Markov moves of a particle per stage (tempered only)"""
    leapfrog_steps: Count | None = None
    """Leapfrog steps of a trajectory (tempered and hmc only)"""
    set: dict[str, Value] = {}
    """Other options of the kernel, such as `{ step = 0.1 }`"""
    first_frame: Annotated[int, Field(strict=True, ge=0)] | None = None
    """Number of the first frame"""
    frames: Count | None = None
    """Number of frames; all by default"""
    init: Literal["given", "auto"] | None = None
    """Where the first pose comes from"""
    recover: Annotated[bool, Field(strict=True)] | None = None
    """Start anew where the person is found again after a loss"""
    keep_draws: Annotated[int, Field(strict=True, ge=FEWEST_KEPT)] | None = None
    """Draws of a frame and run that are stored; all particles by default"""
    pictures: Annotated[bool, Field(strict=True)] | None = None
    """Whether overlay.mp4 and stills are drawn; they are by default"""
    plugins: list[str] = []
    """Files with terms of your own; they are executed"""


class VariantTable(TrackTable):
    """One way to track all sessions."""

    name: Plain
    """Begins the names of its runs' folders"""


class StudyFile(TrackTable):
    """The whole file. Options outside of `[[variant]]` hold for all variants that do not give their own."""

    title: Name = ""
    """Heading of the page"""
    sessions: Annotated[list[Name], Field(min_length=1)]
    """Folders of sessions, or patterns such as `sessions/*/`; relative to this file"""
    person: Count | Literal["all"] | None = None
    """Of recordings with several people: the number of one, or `"all"`; by default the one in view of most cameras for the longest time"""
    out: Name | None = None
    """Folder of the study, relative to this file; `--out` comes before it"""
    runs: Count = 1
    """Independent runs of a session; R-hat needs two or more"""
    seed: Annotated[int, Field(strict=True, ge=0, le=LARGEST_SEED)] = 0
    """Seed of the first run; the next ones count on from it"""
    steps: list[Step] = ["report"]
    """What is done after tracking: smooth, report, view, gait (which needs smooth)"""
    export: list[Export] = []
    """Formats for other programs"""
    cpus: Count | None = None
    """Cores of a unit; by default one, or more if there are fewer units than cores"""
    gpus: Annotated[int, Field(strict=True, ge=0, le=1)] | None = None
    """GPUs of a unit, 0 or 1; 1 by default where JAX can use one"""
    at_once: Count | None = None
    """Most units at once; by default as many as cores and memory allow"""
    retries: Count = 10
    """How often a unit may die without a new frame before it counts as failed"""
    cluster: Name | None = None
    """As the option `--cluster`"""
    variant: list[VariantTable] = []
    """Models and kernels to compare"""

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [variant.name for variant in self.variant]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"variant '{name}' is given twice; expected one table for each name; rename one of them")
        if "gait" in self.steps and "smooth" not in self.steps:
            raise ValueError('steps has "gait" without "smooth"; expected both: strides are events of smoothed paths; add "smooth"')
        if self.seed + self.runs - 1 > LARGEST_SEED:
            raise ValueError(f"seed {self.seed} with {self.runs} runs; expected seeds up to {LARGEST_SEED}; give a smaller seed")
        return self


def read_study_file(path: Path) -> StudyFile:
    """Return a study from its file, with all paths made absolute by the file's folder.

    Raises:
        InputError: the file cannot be read, or is not TOML.
        FaultyFileError: it has faults; one sentence for each.
    """
    if path.is_dir():
        raise input_error(path, "a folder", "a study's file", f"name the file, such as {path / NAME}")
    study = validate(StudyFile, read_toml(path), str(path))
    return absolute(study, path.parent)


def absolute(study: StudyFile, folder: Path) -> StudyFile:
    """Return the study with paths that do not depend on the current folder."""

    def resolved(text: str) -> str:
        return str((folder / Path(text).expanduser()).absolute())

    def of_track(table: TrackTable) -> dict[str, Any]:
        # A model without a suffix is one that ships.
        model = table.model if table.model is None or Path(table.model).suffix != ".toml" else resolved(table.model)
        return {"model": model, "plugins": [resolved(plugin) for plugin in table.plugins]}

    cluster = study.cluster
    if cluster is not None and "://" not in cluster:
        cluster = resolved(cluster)
    return study.model_copy(
        update=of_track(study)
        | {
            "sessions": [resolved(pattern) for pattern in study.sessions],
            "out": None if study.out is None else resolved(study.out),
            "cluster": cluster,
            "variant": [variant.model_copy(update=of_track(variant)) for variant in study.variant],
        }
    )


def write_study_file(study: StudyFile, folder: Path) -> None:
    """Write `study.toml` into the folder of a study, without what has its default.

    Raises:
        InputError: the file system refuses it.
    """
    import tomlkit

    document = tomlkit.document()
    document.add(tomlkit.comment("Written by bayes-body: `bayes-body study` with this file continues the study."))
    for key, value in study.model_dump(exclude_defaults=True).items():
        if key == "sessions":
            value = tomlkit.item(value).multiline(True)
        elif key == "variant":
            value = [_without_none(table) for table in value]
        document[key] = value
    write_text(make_folder(folder) / NAME, tomlkit.dumps(document))


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if value is not None and value != [] and value != {}}
