"""Build HTML from plain text. Text from a file or a user is escaped when it is added, so that all markup on the page comes from this package.

Control characters are escaped as on a terminal. A number and its unit stay on one line: the space between them is a non-breaking space.
"""

import re
from collections.abc import Iterable, Sequence
from html import escape
from typing import NamedTuple

from bayes_body.base.errors import printable

UNITS = re.compile(r"(?<=\d) (?=(?:%|°|mm|m|px|ms|s|kB|MB|nats)(?!\w))")


class Markup(str):
    """Text that is already HTML."""


class Picture(NamedTuple):
    """A picture that is embedded in the page.

    Attributes:
        uri: `data:` URI with the whole content.
        alt: description for readers who cannot see it.
        caption: what to look for; empty if the picture is self-explanatory.
        inverts: whether it is drawn in dark ink on a transparent background, so that a dark page inverts it.
        still_uri: `data:` URI of the picture shown instead on paper, or if the reader's system asks for less motion.
    """

    uri: str
    alt: str
    caption: str = ""
    inverts: bool = True
    still_uri: str | None = None


def tag(name: str, *content: str, **attributes: str) -> Markup:
    """Return `<name attributes>content</name>`. Content that is not `Markup` is escaped. The argument `class_` sets `class`."""
    inside = "".join(map(_escaped, content))
    return Markup(f"<{name}{_attributes(attributes)}>{inside}</{name}>")


def _escaped(text: str) -> Markup:
    return text if isinstance(text, Markup) else Markup(UNITS.sub("\u00a0", escape(printable(text))))


def _attributes(attributes: dict[str, str]) -> str:
    return "".join(f' {key.rstrip("_")}="{escape(printable(value))}"' for key, value in attributes.items())


def joined(parts: Iterable[str]) -> Markup:
    """Return the parts, one line each; parts that are not `Markup` are escaped."""
    return Markup("\n".join(map(_escaped, parts)))


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """Return a table whose first column names its rows; without `head` it has no heading row."""
    top = [tag("thead", tag("tr", *(tag("th", cell, scope="col") for cell in head)))] if head else []
    body = [tag("tr", tag("th", first, scope="row"), *(tag("td", cell) for cell in cells)) for first, *cells in rows]
    return tag("div", tag("table", *top, tag("tbody", *body)), class_="scroll")


def figure(picture: Picture) -> Markup:
    """Return the picture with its caption."""
    image = Markup(f"<img{_attributes({'src': picture.uri, 'alt': picture.alt} | ({'class': 'plot'} if picture.inverts else {}))}>")
    if picture.still_uri:
        quiet = Markup(f"<source{_attributes({'media': '(prefers-reduced-motion: reduce), print', 'srcset': picture.still_uri})}>")
        image = tag("picture", quiet, image)
    return tag("figure", image, *([tag("figcaption", picture.caption)] if picture.caption else []))


def figures(pictures: Iterable[Picture], kind: str = "panels") -> Markup:
    """Return the pictures side by side, as many in a row as fit. `kind` is their CSS class, which sets their width."""
    return tag("div", *(figure(picture) for picture in pictures), class_=kind)


def section(name: str, title: str, *content: str) -> Markup:
    """Return a section of the page; `#name` links to it."""
    return tag("section", tag("h2", title), *content, id=name)


def details(summary: str, *content: str, shown: bool = False) -> Markup:
    """Return content that the reader can fold and unfold; with `shown` it is unfolded at first."""
    return tag("details", tag("summary", summary), *content, **({"open": ""} if shown else {}))
