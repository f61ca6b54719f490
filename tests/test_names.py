"""Names are nouns of the field: a pronoun, a participle or a preposition alone names nothing. Their number may only fall."""

import ast
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "bayes_body"
WORDS = """
found each own one other here there kept held told seen given left rest away around now at of on it its what which where before after ahead
known unknown whole others both all some none nothing later again still apart near far along across alone together enough
"""
EMPTY_WORDS = frozenset(WORDS.split())
# Lower it where names become better. It is raised only with the list of words.
MOST = 75


def bound_names(tree: ast.AST) -> Iterator[str]:
    """Yield every name that a file binds: variables, arguments, attributes of classes, functions, imports under another name.

    Names that Python gives, such as `__all__`, are left out.
    """
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name) | ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                pass
            case ast.alias(asname=str(name)):
                pass
            case _:
                continue
        if not (name.startswith("__") and name.endswith("__")):
            yield name


def test_few_names_are_empty_words_and_never_more_than_before():
    names = {path: list(bound_names(ast.parse(path.read_text(encoding="utf-8")))) for path in PACKAGE.rglob("*.py")}
    empty = {path: Counter(name.strip("_") for name in bound if name.strip("_") in EMPTY_WORDS) for path, bound in names.items()}
    count, total = sum(map(Counter.total, empty.values())), sum(map(len, names.values()))
    worst = sorted(empty, key=lambda path: -empty[path].total())[:5]
    most = "; ".join(f"{path.relative_to(PACKAGE)}: {dict(empty[path])}" for path in worst)
    assert count <= MOST, f"{count} of {total} names say nothing, {MOST} are allowed; most of them in {most}"
    assert count > MOST - 20, f"only {count} of {total} names say nothing: lower MOST to {count}"
