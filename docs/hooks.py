"""What the site takes from the tree: a navigation entry that ends in `/` is the pages of that folder, and the models' page is their definitions."""

import tomllib
from pathlib import Path

from mkdocs.structure.files import File


def on_config(config):
    """Folders of the navigation become their pages, in the order of their names; a folder without pages is left out."""
    docs, entries = Path(config.docs_dir), []
    for entry in config.nav:
        ((title, target),) = entry.items()
        pages = sorted(path.relative_to(docs).as_posix() for path in (docs / target).glob("*.md")) if target.endswith("/") else target
        if pages:
            entries.append({title: pages})
    config.nav = entries
    return config


def on_files(files, config):
    """`models.md`, unless somebody wrote one: each definition's title, source and file."""
    if files.get_file_from_path("models.md") is None:
        models = Path(config.config_file_path).parent / "models"
        rows = []
        for path in sorted(models.rglob("*.toml")):
            definition = tomllib.loads(path.read_text(encoding="utf-8"))
            rows.append(f"| `{path.relative_to(models).as_posix()}` | {definition.get('title', '')} | {definition.get('source', '')} |")
        text = "\n".join(
            [
                "# Models",
                "",
                "Each is a commented TOML file, to be used by name or copied and changed.",
                "",
                "| file | what | source |",
                "|---|---|---|",
                *rows,
                "",
            ]
        )
        files.append(File.generated(config, "models.md", content=text))
    return files
