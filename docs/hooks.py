"""What the site takes from the tree: folders of the navigation, the sources of the models, the figures of the papers, formulas as MathML."""

import html
import re
import tomllib
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError
from paper_tables import with_paper_tables

# What pymdownx.arithmatex (generic) leaves of a formula.
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
# Commands that latex2mathml does not know.
OPERATORS = ("arg", "diag", "logit")


def on_config(config):
    """A navigation entry that ends in `/` becomes the pages of that folder, in the order of their names."""
    docs = Path(config.docs_dir)

    def pages(target):
        if isinstance(target, list):
            return [{title: pages(below) for title, below in entry.items()} for entry in target]
        return sorted(path.relative_to(docs).as_posix() for path in (docs / target).glob("*.md")) if target.endswith("/") else target

    config.nav = pages(config.nav)
    return config


def on_page_markdown(markdown, page, config, files):
    """`models.md` ends with each definition's file, title and source; a page of a paper shows the stored figures."""
    if page.file.src_uri.startswith("papers/"):
        return with_paper_tables(markdown, Path(config.docs_dir) / "papers" / "figures")
    if page.file.src_uri != "models.md":
        return markdown
    models = Path(config.config_file_path).parent / "models"
    rows = ["", "| file | title | source |", "|---|---|---|"]
    for path in sorted(models.rglob("*.toml")):
        definition = tomllib.loads(path.read_text(encoding="utf-8"))
        rows.append(f"| `{path.relative_to(models).as_posix()}` | {definition.get('title', '')} | {definition.get('source', '')} |")
    return markdown + "\n".join([*rows, ""])


def on_page_content(content, page, config, files):
    """Formulas become MathML when the site is built, so that a browser shows them without a script and without a network.

    Raises:
        PluginError: a formula holds a command that the converter does not know.
    """

    def rendered(match):
        latex = html.unescape(match[3])
        for name in OPERATORS:
            latex = re.sub(rf"\\{name}(?![a-zA-Z])", rf"\\operatorname{{{name}}}", latex)
        markup = convert(latex, display="block" if match[2] == "[" else "inline")
        if "\\" in markup:
            raise PluginError(f"{page.file.src_uri}: the formula {match[3]!r} holds a command that latex2mathml does not know; add it to OPERATORS")
        return markup

    return FORMULA.sub(rendered, content)
