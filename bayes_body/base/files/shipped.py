"""The files that ship with the package: models, bodies, rigs, learned arrays."""

from pathlib import Path


def definitions_folder() -> Path:
    """Return the folder of the shipped definitions: inside the package in a wheel, beside it in a checkout."""
    package = Path(__file__).parents[2]
    inside = package / "_models"
    return inside if inside.is_dir() else package.parent / "models"


def learned_file(name: str | Path) -> Path:
    """Return the .npz of what was learned: that of a name in models/learned/ if there is one, else the path itself."""
    shipped = definitions_folder() / "learned" / f"{name}.npz"
    return shipped if shipped.is_file() else Path(name)
