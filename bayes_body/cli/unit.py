"""The program of a unit of a study: `python -m bayes_body.cli.unit`, started by `bayes-body study` and not by a user."""

from bayes_body.cli.main import main
from bayes_body.runs.study.unit_process import compute

if __name__ == "__main__":
    compute(main)
