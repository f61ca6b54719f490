"""The folder of the files that ship with the package: models, bodies, rigs, learned arrays."""

from pathlib import Path


def definitions_folder() -> Path:
    """Return the folder of the shipped definitions: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).parents[1]
    inside = package / "_models"
    return inside if inside.is_dir() else package.parent / "models"
