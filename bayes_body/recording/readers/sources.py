"""Find the recording of a camera or of its empty scene: a video or a folder of numbered images, named after the camera.

A folder of numbered images becomes one printf pattern.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from bayes_body.base.errors import InputError, input_error, nearest
from bayes_body.recording.readers.file_names import composed
from bayes_body.recording.readers.images import read_grey
from bayes_body.recording.readers.videos.clock import VideoClock
from bayes_body.recording.readers.videos.video import probe, read_clock

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


VIDEOS = (".mp4", ".avi", ".mov", ".mkv")
# Codecs work on blocks of 16 pixels: 1080 rows are coded as 1088, and some programs calibrate on the padded image.
BLOCK = 16


@dataclass(frozen=True)
class Source:
    """A camera's recording.

    Attributes:
        path: the video, or the folder of images.
        series: the images; None for a video.
        size_px: (width, height).
        fps: frames per second, or 0 if unknown.
        first: the number of its first frame; 0 for a video.
        count: number of frames.
        clock: when a video's frames were filmed; None for images.
    """

    path: Path
    series: Series | None
    size_px: tuple[int, int]
    fps: float
    first: int
    count: int
    clock: VideoClock | None = None


def find_source(folders: Sequence[Path], name: str) -> Source:
    """The recording of the camera `name`: NAME.mp4 (avi, mov, mkv), a folder NAME, or the only video whose name ends in _NAME.

    Args:
        folders: where to look; the first one with a recording is used.
        name: the camera's name.

    Raises:
        InputError: none, more than one, or one that cannot be read.
    """
    for folder in folders:
        paths = _named(folder, name)
        if len(paths) > 1:
            raise input_error(
                folder, f"{', '.join(path.name for path in paths)} for camera '{name}'", "one recording of each camera", "keep only one of them"
            )
        if paths:
            return _source(paths[0])
    stems = [path.stem for folder in folders for path in recordings(folder)]
    looked = " or ".join(str(folder) for folder in folders)
    raise InputError(f"camera '{name}': no video or folder of images with its name in {looked}; {nearest(name, stems)}")


def has_source(folders: Sequence[Path], name: str) -> bool:
    """Whether one of the folders has a recording of the camera `name`."""
    return any(_named(folder, name) for folder in folders)


def deeper_folders(folder: Path, name: str) -> list[Path]:
    """The folders one or two levels deeper that have a recording of the camera `name`."""
    inner = [path for pattern in ("*", "*/*") for path in sorted(folder.glob(pattern)) if path.is_dir() and not path.name.startswith(".")]
    return [path for path in inner if _named(path, name)]


def recordings(folder: Path) -> list[Path]:
    """The videos of a folder, and its folders of images."""
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    return [path for path in paths if path.suffix.lower() in VIDEOS or (path.is_dir() and any(_images(path)))]


def _images(folder: Path) -> Iterator[Path]:
    return (path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)


def _named(folder: Path, name: str) -> list[Path]:
    paths = recordings(folder)
    name = composed(name)
    exact = [path for path in paths if name in (_stem(path), composed(path.name))]
    return exact or [path for path in paths if path.is_file() and re.search(rf"[_ ]{re.escape(name)}$", _stem(path))]


def _stem(path: Path) -> str:
    return composed(path.stem if path.is_file() else path.name)


def _source(path: Path) -> Source:
    if path.is_dir():
        series = find_series(path)
        height, width = read_grey(series.path(series.first)).shape
        return Source(path, series, (width, height), 0.0, series.first, series.count)
    info = probe(path)
    return Source(path, None, info.size_px, info.fps, 0, info.frames, read_clock(path))


def find_background(folder: Path, name: str, size_px: tuple[int, int]) -> Path:
    """The image or video of the empty scene for the camera `name`: NAME.png or similar in `folder`.

    Raises:
        InputError: none, more than one, or not of the camera's image size.
    """
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    matches = [path for path in paths if composed(path.stem) == composed(name) and path.suffix.lower() in (*VIDEOS, *SUFFIXES)]
    if len(matches) != 1:
        problem = "no image or video" if not matches else ", ".join(path.name for path in matches)
        raise input_error(
            f"--background {folder}", f"{problem} for camera '{name}'", f"one of the empty scene, such as {name}.png or {name}.mp4", "add it"
        )
    (path,) = matches
    if path.suffix.lower() in SUFFIXES:
        read_grey(path, size_px)
    elif probe(path).size_px != size_px:
        width, height = probe(path).size_px
        raise input_error(
            path, f"{width} x {height} pixels", f"{size_px[0]} x {size_px[1]}, like its camera's recording", "film it with the same settings"
        )
    return path


def settled_size(camera: str, calibrated_px: tuple[int, int] | None, source: Source) -> str | None:
    """Compare the sizes of a recording and its calibration. Returns None if they are equal, or a remark if only a codec's padding is missing.

    Raises:
        InputError: the sizes differ otherwise.
    """
    if calibrated_px in (None, source.size_px):
        return None
    (width, height), (w, h) = calibrated_px, source.size_px
    padded = tuple(-(-side // BLOCK) * BLOCK for side in (w, h))
    if all(full in (side, padded_side) for full, side, padded_side in zip((width, height), (w, h), padded, strict=True)):
        cut = f"calibrated at {width} x {height}, the recording has {w} x {h}"
        return f"{cut}: the last columns or rows are assumed to be padding, since codecs pad to multiples of {BLOCK}."
    remedy = "name the recording that the camera was calibrated for, or calibrate again"
    raise input_error(camera, f"{source.path.name} has {w} x {h} pixels", f"{width} x {height}, as in its calibration", remedy)


def is_scaled(calibrated_px: tuple[int, int], size_px: tuple[int, int]) -> bool:
    """Return whether pictures have the shape of those of the calibration, up to half a pixel, and another size."""
    factor = size_px[0] / calibrated_px[0]
    return size_px != calibrated_px and abs(size_px[1] - factor * calibrated_px[1]) <= 0.5
