"""The schema of `run.toml`. Options of the kernel and the texts are checked by those who use them."""

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from bayes_body.base.toml.schema import Count, Schema

Text = Annotated[str, Field(strict=True)]
# Keys of older and newer versions are kept.
OPEN = ConfigDict(extra="allow", frozen=True)


class RunTable(Schema):
    """`[run]`: the settings of the user."""

    session: Text
    model: Text
    runs: Count = 1
    seed: Annotated[int, Field(strict=True, ge=0)] = 0
    first_frame: Annotated[int, Field(strict=True, ge=0)] | None = None
    frames: Count | None = None
    init: Literal["given", "auto"] = "given"
    recover: Annotated[bool, Field(strict=True)] = False
    keep: Count | None = None


class KernelTable(Schema):
    """`[kernel]`: its kind, and all its options."""

    model_config = OPEN
    kind: Text


class SmoothingTable(Schema):
    """`[smoothing]` of a smoothed run: the run whose frames were smoothed, and the options of the smoother."""

    folder: Text
    run: Text
    last: Text
    frames: Count
    seed: Annotated[int, Field(strict=True, ge=0)]
    draws: Count
    start: Literal["ensemble", "particles"]
    moves: Annotated[int, Field(strict=True, ge=0)]
    leapfrog_steps: Count
    candidates: Count


class DefinitionTable(Schema):
    """`[definition]`: the text of the definition and of its body."""

    title: Text = ""
    text: Text
    body_text: Text | None = None


class SessionText(Schema):
    """`[session]`: the text of session.toml."""

    text: Text


class CheckTable(Schema):
    """`[check]`: the version of the format, the id of the run, and a digest of all other tables."""

    format: Annotated[int, Field(strict=True)]
    run: Text
    sha256: Text


class RunFile(Schema):
    """The whole file."""

    run: RunTable
    kernel: KernelTable
    versions: dict[str, Text]
    machine: dict[str, Any] = {}
    inputs: dict[str, Text] = {}
    definition: DefinitionTable
    session: SessionText
    plugins: dict[str, Text] = {}
    first_pose: dict[str, Any] = {}
    smoothing: SmoothingTable | None = None
    check: CheckTable
