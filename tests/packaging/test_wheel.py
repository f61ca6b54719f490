"""What the wheel holds: the package and the model definitions, and nothing else."""

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def names(tmp_path_factory) -> set[str]:
    folder = tmp_path_factory.mktemp("dist")
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)], cwd=ROOT, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    return {name for name in zipfile.ZipFile(wheel).namelist() if not name.split("/")[0].endswith(".dist-info")}


def test_the_top_level_is_the_package_alone(names):
    assert {name.split("/")[0] for name in names} == {"bayes_body"}


def test_every_file_comes_from_the_package_or_the_models(names):
    definitions = {name for name in names if name.startswith("bayes_body/_models/")}
    foreign = {name for name in names - definitions if not (ROOT / name).is_file()}
    foreign |= {name for name in definitions if not (ROOT / "models" / name.removeprefix("bayes_body/_models/")).is_file()}
    assert foreign == set()
    assert not [name for name in definitions if name.endswith(".py")]


def test_every_definition_is_there(names):
    definitions = {f"bayes_body/_models/{path.relative_to(ROOT / 'models').as_posix()}" for path in (ROOT / "models").rglob("*.toml")}
    assert definitions
    assert definitions <= names


def test_every_module_is_there_with_the_mark_of_a_typed_package(names):
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "bayes_body").rglob("*.py")}
    assert modules | {"bayes_body/py.typed"} <= names
