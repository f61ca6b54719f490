"""HTML from plain texts: whatever comes from a file or a user is escaped where it enters, so that nothing on the page can be markup but our own.

A number and its unit never stand on two lines: the space between them is one that does not break.
"""

import re
from collections.abc import Iterable, Sequence
from html import escape
from typing import NamedTuple

UNITS = re.compile(r"(?<=\d) (?=(?:%|°|mm|m|px|ms|s|kB|MB|nats)(?!\w))")


class Markup(str):
    """Text that is HTML already."""


class Picture(NamedTuple):
    """A picture that the page carries in itself.

    Attributes:
        uri: `data:` and all of it.
        alt: what it shows, for who cannot see it.
        caption: what to look for; empty where the picture says it.
        inverts: whether it is drawn in dark ink on nothing, and so is turned light on a dark page.
        still: what stands in its place where nothing shall move, or on paper.
    """

    uri: str
    alt: str
    caption: str = ""
    inverts: bool = True
    still: str | None = None


def tag(name: str, *content: str, **attributes: str) -> Markup:
    """`<name attributes>content</name>`; what is not `Markup` is escaped. `class_` is `class`."""
    inside = "".join(map(_escaped, content))
    return Markup(f"<{name}{_attributes(attributes)}>{inside}</{name}>")


def _escaped(text: str) -> Markup:
    return text if isinstance(text, Markup) else Markup(UNITS.sub("\u00a0", escape(text)))


def _attributes(attributes: dict[str, str]) -> str:
    return "".join(f' {key.rstrip("_")}="{escape(value)}"' for key, value in attributes.items())


def joined(parts: Iterable[str]) -> Markup:
    """The parts one after the other; what is not `Markup` is escaped."""
    return Markup("\n".join(map(_escaped, parts)))


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """A table whose first column names its rows; without `head` it has no heading row."""
    top = [tag("thead", tag("tr", *(tag("th", cell, scope="col") for cell in head)))] if head else []
    body = [tag("tr", tag("th", first, scope="row"), *(tag("td", cell) for cell in rest)) for first, *rest in rows]
    return tag("div", tag("table", *top, tag("tbody", *body)), class_="scroll")


def figure(picture: Picture) -> Markup:
    """The picture with its caption."""
    image = Markup(f"<img{_attributes({'src': picture.uri, 'alt': picture.alt} | ({'class': 'plot'} if picture.inverts else {}))}>")
    if picture.still:
        quiet = Markup(f"<source{_attributes({'media': '(prefers-reduced-motion: reduce), print', 'srcset': picture.still})}>")
        image = tag("picture", quiet, image)
    return tag("figure", image, *([tag("figcaption", picture.caption)] if picture.caption else []))


def figures(pictures: Iterable[Picture], kind: str = "panels") -> Markup:
    """Pictures side by side, as many in a row as fit; `kind` is how wide they are: `panels` or `stills`."""
    return tag("div", *(figure(picture) for picture in pictures), class_=kind)


def section(name: str, title: str, *content: str) -> Markup:
    """A section of the page that `#name` leads to."""
    return tag("section", tag("h2", title), *content, id=name)


def details(summary: str, *content: str, shown: bool = False) -> Markup:
    """What is shown when it is asked for, or with `shown` until it is folded away."""
    return tag("details", tag("summary", summary), *content, **({"open": ""} if shown else {}))
