"""README.md and the pages of the documentation: their code blocks and sections."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def page(name: str) -> str:
    """The text of a page, such as `README.md` or `docs/guide/first_run.md`."""
    return (ROOT / name).read_text(encoding="utf-8")


README, FIRST_RUN = page("README.md"), page("docs/guide/first_run.md")


def blocks(text: str, language: str) -> list[str]:
    """The code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def sections(text: str) -> dict[str, str]:
    """Headings and what stands below each, up to the next."""
    parts = re.split(r"^#+ (.*)$", text, flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def python_blocks() -> dict[str, str]:
    """Every Python block of README and documentation, by page and place: `docs/guide/first_run.md #0`."""
    names = ["README.md", *sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "docs").rglob("*.md"))]
    return {f"{name} #{place}": block for name in names for place, block in enumerate(blocks(page(name), "python"))}
