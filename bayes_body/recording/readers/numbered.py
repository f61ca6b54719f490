"""A folder of numbered images as one printf pattern."""

import re
from dataclasses import dataclass
from pathlib import Path

from bayes_body.base.errors import input_error

SUFFIXES = (".bmp", ".png", ".jpg", ".jpeg", ".tif", ".tiff")
NAME = re.compile(r"(.*?)(\d{1,18})(\.[^.]+)")


@dataclass(frozen=True)
class Series:
    """Images with consecutive numbers: their folder, the printf pattern of their names, the first number and the count."""

    folder: Path
    name: str
    first: int
    count: int

    def path(self, number: int) -> Path:
        """The file of that number."""
        return self.folder / (self.name % number)


def find_series(folder: Path) -> Series:
    """The images of a folder, which must form one series.

    Raises:
        InputError: no images, names of more than one pattern, or missing numbers.
    """
    names = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in SUFFIXES) if folder.is_dir() else []
    matches = [match for name in names if (match := NAME.fullmatch(name))]
    kinds = sorted({(match[1], match[3]) for match in matches})
    if not matches:
        raise input_error(folder, "no numbered images in it", "images such as image0000.png", "name the folder that holds them")
    if len(kinds) > 1 or len(matches) < len(names):
        odd_name = next((name for name in names if not NAME.fullmatch(name)), f"{kinds[-1][0]}...{kinds[-1][1]}")
        raise input_error(
            folder, f"images of more than one kind, {kinds[0][0]}...{kinds[0][1]} and {odd_name}", "one series", "keep only one series in it"
        )
    return _series(folder, *kinds[0], [match[2] for match in matches])


def _series(folder: Path, prefix: str, suffix: str, digits: list[str]) -> Series:
    width = min(map(len, digits))
    conversion = f"%0{width}d" if any(text.startswith("0") for text in digits) else "%d"
    # Escape percent signs in the name: they are not the frame number.
    series = Series(folder, f"{prefix}".replace("%", "%%") + conversion + suffix.replace("%", "%%"), min(map(int, digits)), len(digits))
    present = {prefix + text + suffix for text in digits}
    missing = [name for number in range(series.first, series.first + series.count) if (name := series.name % number) not in present]
    if missing:
        problem = f"{len(missing)} of {series.count} numbers from the first on are missing, or written with other digits; the first is {missing[0]}"
        raise input_error(folder, problem, "consecutive numbers with the same number of digits", "restore the images, or renumber them")
    return series
