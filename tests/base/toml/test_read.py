"""TOML files and their faults in words, beyond what a session's file shows: nested models, unions, kinds, validators."""

import math
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, model_validator

from bayes_body.base.errors import FaultyFileError, InputError
from bayes_body.base.toml.read import read_toml, validate
from bayes_body.base.toml.schema import Name, Schema

type Finite = Annotated[float, Field(allow_inf_nan=False)]


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Edges(Table):
    kind: Literal["edges"]
    scales_px: tuple[int, ...] = ()


class Mask(Table):
    kind: Literal["mask"]
    weight: Finite = 1.0


class Offset(Table):
    x: Finite | str = 0.0


class Joint(Table):
    name: str
    offset: Offset | None = None

    @model_validator(mode="after")
    def _check(self):
        if self.name == "bad":
            raise ValueError("first sentence\nsecond sentence")
        return self


class Model(Table):
    title: str
    sd_deg: dict[str, Finite] = {}
    joints: Annotated[tuple[Joint, ...], Field(alias="joint", min_length=1)]
    likelihood: tuple[Annotated[Edges | Mask, Field(discriminator="kind")], ...] = ()
    pair: tuple[str, float] = ("a", 1.0)


SOUND = {"title": "t", "joint": [{"name": "hip"}]}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"titel": 1}, "titel: unknown key; did you mean 'title'?"),
        ({"joints": []}, "joints: unknown key; did you mean 'joint'?"),
        ({"title": 3}, "title = 3; expected a string; put it in double quotes."),
        ({"sd_deg": {"hip": math.nan}}, "sd_deg.hip = nan; expected a finite number; write a number such as 0.5."),
        ({"sd_deg": 4}, "sd_deg = 4; expected a table; write it as a header in brackets, then lines key = value."),
        ({"joint": []}, "joint = []; expected at least 1 entries, not 0; add what is missing."),
        ({"joint": [{"nam": "hip", "name": "hip"}]}, "joint 'hip'.nam: unknown key; did you mean 'name'?"),
        ({"joint": [{}]}, "joint #1.name: missing; expected a string; add it to joint #1."),
        ({"joint": [{"name": "hip", "offset": {"X": 1}}]}, "joint 'hip'.offset.X: unknown key; known: x"),
        (
            {"joint": [{"name": "hip", "offset": {"x": [1]}}]},
            "joint 'hip'.offset.x = [1]; expected a number or a string; write it without quotes, such as 0.5.",
        ),
        ({"likelihood": [{"kind": "edgse"}]}, "likelihood #1.kind = \"edgse\": no such choice; did you mean 'edges'?"),
        ({"likelihood": [{}]}, "likelihood #1.kind: missing; expected the name of a kind; add it."),
        ({"likelihood": [{"kind": "mask", "wieght": 2.0}]}, "likelihood #1.wieght: unknown key; did you mean 'weight'?"),
        ({"likelihood": [{"kind": "edges", "scales_px": [4, 8.5]}]}, "likelihood #1.scales_px #2 = 8.5; expected a whole number; write it without"),
        ({"pair": ["a"]}, "pair = ['a']; expected 2 entries, not 1; add what is missing."),
        ({"pair": ["a", 1, 2]}, "pair = ['a', 1, 2]; expected at most 2 entries, not 3; remove the surplus entries."),
    ],
)
def test_a_fault_is_one_sentence(change, sentence):
    with pytest.raises(FaultyFileError) as error:
        validate(Model, SOUND | change, "m.toml")
    (found,) = error.value.sentences
    assert found.startswith(f"m.toml: {sentence}")


def test_a_sound_file_and_several_faults():
    assert validate(Model, SOUND, "m.toml").joints[0].name == "hip"
    with pytest.raises(FaultyFileError) as error:
        validate(Model, SOUND | {"sd_deg": {"a": math.inf, "b": "x"}, "extra": 1}, "m.toml")
    assert len(error.value.sentences) == 3


def test_a_validators_lines_are_sentences_as_they_are():
    with pytest.raises(FaultyFileError) as error:
        validate(Model, SOUND | {"joint": [{"name": "bad"}]}, "m.toml")
    assert error.value.sentences == ("m.toml: joint 'bad': first sentence", "m.toml: joint 'bad': second sentence")


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"a = 1\r\nb 2\r\n", "line 2, column 3: expected '=' after a key in a key/value pair in the line `b 2`"),
        (b"a = 1\nb = 1\na = 2\n", "line 3: key 'a' is given twice; expected each key once in its table; remove one of the two."),
        (b"[x]\na.b = 1\na.b = 2\n", "line 3: key 'a.b' is given twice"),
        (b"a = {b = 1, b = 2}\n", "line 1: key 'b' is given twice"),
        (b"[x]\na = 1\n[x]\nb = 2\n", "line 3: the table [x] is given twice; expected one header for each table; put its keys under one header"),
        (b"[[x]]\na = 1\n[x]\nb = 2\n", "line 3: the table [x] is given twice"),
        (b'\xef\xbb\xbfa = "x', 'line 1, column 7: unterminated string in the line `a = "x`'),
        (b"a = 1\nb = '\xe9'\n", "line 2: the byte 0xe9; expected a TOML file, text in UTF-8; save the file as UTF-8, or restore it."),
    ],
)
def test_not_toml(tmp_path, content, sentence):
    path = tmp_path / "m.toml"
    path.write_bytes(content)
    with pytest.raises(InputError) as error:
        read_toml(path)
    assert str(error.value).startswith(f"{path}: {sentence}")


def test_no_file_to_read(tmp_path):
    with pytest.raises(InputError, match="a folder; expected a TOML file"):
        read_toml(tmp_path)
    with pytest.raises(InputError, match=r"none.toml: no such file"):
        read_toml(tmp_path / "none.toml")


def test_a_byte_order_mark_is_no_error(tmp_path):
    (tmp_path / "m.toml").write_bytes(b"\xef\xbb\xbfa = 1\r\n")
    assert read_toml(tmp_path / "m.toml") == {"a": 1}


class Named(Schema):
    name: Name = "a"
    markers: dict[Name, int] = {}


@pytest.mark.parametrize("break_", ["\n", "\r", "\t", "\x1b[31m", "\x00", "\u2028"])
@pytest.mark.parametrize("field", ["name", "markers"])
def test_a_name_is_one_line(field, break_):
    """It is written to files where a line break begins a new record, and to terminals, which obey an escape."""
    name = f"wrist{break_}; rm x"
    with pytest.raises(InputError, match="has control characters; expected one line of text; rename it") as error:
        validate(Named, {field: name if field == "name" else {name: 1}}, "body.toml")
    assert break_ not in str(error.value)


def test_a_name_may_be_of_any_language():
    name = "poignet\u00a0gauche \u624b\u9996"
    assert validate(Named, {"name": name, "markers": {name: 1}}, "body.toml").name == name
