"""The one code of colours and lines for every picture, plot and page: no other file chooses a colour.

| mark | what it means |
|---|---|
| blue, orange, green | the left side of the body, its right side, its middle |
| line style, form of a mark | the run |
| black | what was measured or computed, without a side; over an image it has a white edge |
| grey | what a model expects, and what is only context |
| purple | limits, and frames in which the person was lost |
| the colours of PEOPLE | who it is, in pictures of several people, which do not show sides |

The hues are those of Okabe & Ito (2008), which colour-blind people can distinguish. Over an image they are lighter than on paper. Axes of the world
and of segments are red, green and blue for x, y and z, as in other programs, and have their names.
"""

import re
from typing import Any

type Colour = tuple[int, int, int]

# On paper, for plots.
INK, GREY, WARNING, SKIN = "#1b1f24", "#6b7280", "#cc79a7", "#dfe3e8"
SIDES = {"l": "#0072b2", "r": "#d55e00", "": "#009e73"}
NAMES = {"l": "left", "r": "right", "": "middle"}
AXES = ("#d62020", "#1f9d3a", "#2050d8")
# Over images and in the 3D page: red, green, blue.
OVER_IMAGE: dict[str, Colour] = {"l": (40, 160, 255), "r": (255, 130, 30), "": (50, 220, 160)}
TRUTH, KEYPOINTS, CAMERAS, FLOOR, FLOOR_LINES = (214, 39, 120), (240, 190, 0), (70, 78, 88), (200, 205, 211), (200, 200, 200)
WORLD_AXES: tuple[Colour, ...] = ((255, 40, 40), (40, 220, 40), (40, 90, 255))
# Person 1, 2, ... of a recording: on paper, and over images. After the last the colours begin again, and the names tell people apart.
PEOPLE: tuple[tuple[str, Colour], ...] = (
    ("#0072b2", (60, 140, 255)),
    ("#e69f00", (255, 190, 30)),
    ("#aa2266", (224, 33, 138)),
    ("#117733", (0, 170, 90)),
    ("#9aa0a8", (255, 255, 255)),
)
# Colour maps: quantities that are large or small, and those whose large values are bad.
SEQUENTIAL, BAD = "Greys", "Purples"
# Dashes in multiples of a line's width, and marks, by run; runs after the last begin again.
DASHES = ((5, 1.8), (1.2, 1.2), (6, 1.5, 1.2, 1.5), (9, 2.5), (3, 1.2), (1.2, 3), (5, 1, 1, 1, 1, 1))
RUN_LINES: tuple[Any, ...] = ("-", *((0, dashes) for dashes in DASHES))
RUN_MARKS = ("o", "x", "^", "+", "s", "1", "d", ".")


def side_of(name: str) -> str:
    """Return the side of a part, a dof, a marker or a clinical angle: `l`, `r`, or an empty text for the middle of the body.

    Bodies begin a name with its side (`l_knee`), clinical angles end with it (`knee_flexion_l`).
    """
    side = re.match(r"([lr])_", name) or re.search(r"_([lr])$", name)
    return side[1] if side else ""


def paper(name: str) -> str:
    """Return the colour of a name's side in plots."""
    return SIDES[side_of(name)]


def over_image(name: str) -> Colour:
    """Return the colour of a name's side over images, red, green, blue."""
    return OVER_IMAGE[side_of(name)]


def person_colour(number: int) -> Colour:
    """Return the colour of person `number`, counted from 1, over images: red, green, blue."""
    return PEOPLE[(number - 1) % len(PEOPLE)][1]


def person_ink(number: int) -> str:
    """Return the colour of person `number`, counted from 1, in plots and on pages."""
    return PEOPLE[(number - 1) % len(PEOPLE)][0]


def bgr(colour: Colour) -> Colour:
    """Return a colour in the order of OpenCV: blue, green, red."""
    red, green, blue = colour
    return blue, green, red


def run_line(run: int) -> Any:
    """Return the line style of a run, counted from 0."""
    return RUN_LINES[run % len(RUN_LINES)]


def run_mark(run: int) -> str:
    """Return the mark of a run's points."""
    return RUN_MARKS[run % len(RUN_MARKS)]
