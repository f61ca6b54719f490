r"""Tiling textures: fields whose amplitude falls as $1/f$, as on natural surfaces, and the materials of a room made from them."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

# Texels per side; the surface decides how often the material repeats.
SIDE = 512

type Field = Float[np.ndarray, "row column"]
type Texture = UInt8[np.ndarray, "row column 3"]


def pink(rng: np.random.Generator, exponent: float = 1.0) -> Field:
    """A periodic field with mean 0 and standard deviation 1, whose amplitude falls with frequency to the power of `exponent`."""
    shift = rng.integers(0, SIDE, 2).tolist()
    return np.roll(_pink(exponent)[:: int(rng.choice([-1, 1]))], shift, axis=(0, 1))


@cache
def _pink(exponent: float) -> Field:
    """One field for each exponent. Textures use it shifted and flipped, which is not recognisable."""
    white = np.random.default_rng(round(1000 * exponent)).standard_normal((SIDE, SIDE))
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None])
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(np.fft.rfft2(white) / frequency**exponent, (SIDE, SIDE))
    return (field / field.std()).astype(np.float32)


def colour(rng: np.random.Generator, darkest: float = 40.0, brightest: float = 210.0, saturation: float = 0.5) -> Float[np.ndarray, "3"]:
    """A random colour: blue, green, red, grey levels."""
    grey = rng.uniform(darkest, brightest)
    return np.clip(grey * (1 + saturation * rng.uniform(-1, 1, 3)), 10, 245)


def finish(base: Float[np.ndarray, "row column 3"], field: Field, contrast: float) -> Texture:
    """Colours plus a field with a standard deviation of `contrast` grey levels."""
    return np.clip(base + contrast * field[..., None], 0, 255).astype(np.uint8)


def plain(rng: np.random.Generator, strength: float) -> Texture:
    """Plaster, lino or cardboard: one colour with soft spots."""
    return finish(np.broadcast_to(colour(rng, 90.0, 200.0, 0.1), (SIDE, SIDE, 3)), pink(rng, 1.1), 7 * strength)


def carpet(rng: np.random.Generator, strength: float) -> Texture:
    """Carpet: fine and coarse grain."""
    return finish(np.broadcast_to(colour(rng, 70.0, 150.0, 0.15), (SIDE, SIDE, 3)), pink(rng, 0.6), 14 * strength)


def planks(rng: np.random.Generator, strength: float) -> Texture:
    """Boards side by side, each with its own shade, with grain along them."""
    boards = 8
    shade = np.repeat(rng.normal(0, 14 * strength, boards), SIDE // boards)[:, None]
    grain = cv2.resize(pink(rng, 0.9), (SIDE, 4 * SIDE))[::4] * 10 * strength
    gaps = np.where(np.arange(SIDE) % (SIDE // boards) < 3, -35 * strength, 0)[:, None]
    base = np.array([70.0, 105.0, 140.0]) * rng.uniform(0.8, 1.3)
    return np.clip(base + (shade + grain + gaps)[..., None], 0, 255).astype(np.uint8)


def tiles(rng: np.random.Generator, strength: float) -> Texture:
    """Square tiles of two shades, with joints."""
    cells = 4
    row, column = np.indices((SIDE, SIDE)) * cells // SIDE
    joint = np.minimum(*(np.indices((SIDE, SIDE)) % (SIDE // cells))) < 4
    shade = np.where((row + column) % 2, 20, -20) * strength - 40 * strength * joint
    return finish(colour(rng, 100.0, 170.0, 0.12) + shade[..., None], pink(rng, 0.9), 8 * strength)


def bricks(rng: np.random.Generator, strength: float) -> Texture:
    """Rows of bricks; every second row is shifted."""
    rows, columns = 16, 8
    y, x = np.indices((SIDE, SIDE))
    row = y * rows // SIDE
    shifted = (x + (row % 2) * SIDE // columns // 2) % SIDE
    column = shifted * columns // SIDE
    joint = (y % (SIDE // rows) < 4) | (shifted % (SIDE // columns) < 4)
    shade = rng.normal(0, 13 * strength, (rows, columns))[row, column] + 30 * strength * joint
    return finish(np.array([75.0, 95.0, 140.0]) + shade[..., None], pink(rng, 0.7), 9 * strength)


def stripes(rng: np.random.Generator, strength: float) -> Texture:
    """Stripes, for wallpaper or a curtain."""
    wave = np.sign(np.sin(2 * np.pi * rng.integers(4, 12) * np.arange(SIDE) / SIDE))[None, :, None]
    wave = strength * rng.uniform(8, 18) * rng.uniform(0.7, 1.3, 3) * wave
    return finish(np.broadcast_to(colour(rng, 100.0, 190.0, 0.2) + wave, (SIDE, SIDE, 3)), pink(rng), 7 * strength)


def bookshelf(rng: np.random.Generator, strength: float) -> Texture:
    """Books on shelves."""
    picture = np.full((SIDE, SIDE, 3), colour(rng, 60.0, 140.0, 0.2))
    boards = int(rng.integers(3, 6))
    height = SIDE // boards
    for board in range(boards):
        column = 8
        while column < SIDE - 12:
            width, tall = int(rng.integers(8, 34)), int(height * rng.uniform(0.6, 0.9))
            bottom = (board + 1) * height - 8
            picture[bottom - tall : bottom, column : min(column + width, SIDE - 8)] = colour(rng, 30.0, 200.0, 0.45)
            column += width + (int(rng.integers(20, 60)) if rng.random() < 0.1 else 1)
    return finish(picture, pink(rng, 0.8), 6 * strength)


def drawers(rng: np.random.Generator, strength: float) -> Texture:
    """The front of a cupboard: panels with handles."""
    picture = np.full((SIDE, SIDE, 3), colour(rng, 80.0, 200.0, 0.2))
    rows, columns = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    for r in range(rows):
        for c in range(columns):
            top, first_column, bottom, right = r * SIDE // rows, c * SIDE // columns, (r + 1) * SIDE // rows, (c + 1) * SIDE // columns
            cv2.rectangle(picture, (first_column + 5, top + 5), (right - 5, bottom - 5), (picture[0, 0] * 0.6).tolist(), 4)
            cv2.circle(picture, ((first_column + right) // 2, (top + bottom) // 2), 9, (picture[0, 0] * 0.4).tolist(), -1)
    return finish(picture, pink(rng), 6 * strength)


def poster(rng: np.random.Generator, strength: float) -> Texture:
    """Shapes of any colour on a sheet, and lines of writing."""
    picture = np.full((SIDE, SIDE, 3), colour(rng, 60.0, 230.0, 0.25))
    for _ in range(int(rng.integers(4, 12))):
        centre, size = rng.integers(0, SIDE, 2).tolist(), rng.integers(20, 170, 2).tolist()
        cv2.ellipse(picture, centre, size, float(rng.uniform(0, 180)), 0, 360, colour(rng, 20.0, 230.0, 0.5).tolist(), -1, cv2.LINE_AA)
    for line in range(int(rng.integers(0, 9))):
        top = SIDE // 2 + 24 * line
        cv2.line(picture, (40, top), (int(rng.uniform(200, SIDE - 40)), top), (30, 30, 30), 6)
    return finish(picture, pink(rng), 5 * strength)


type Maker = Callable[[np.random.Generator, float], Texture]
FLOORS: tuple[Maker, ...] = (carpet, planks, tiles)
WALLS: tuple[Maker, ...] = (plain, plain, bricks, stripes)
FRONTS: tuple[Maker, ...] = (bookshelf, bookshelf, drawers, plain, carpet, stripes)
