"""Names in plots that are not part of the report: no formulas, no control characters."""

from bayes_body.errors import escaped


def plot_text(name: str) -> str:
    """Return a name from a file so that matplotlib shows it as it is: a dollar sign does not begin a formula."""
    return escaped(name).replace("$", r"\$")
