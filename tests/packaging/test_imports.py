"""`import bayes_body` is light: what takes a second to import is imported when it is used."""

import subprocess
import sys

HEAVY = ("jax", "arviz", "blackjax", "cv2")

PROGRAM = f"""
import sys
import bayes_body
print(*(name for name in {HEAVY} if name in sys.modules))
"""


def test_import_brings_in_nothing_heavy(tmp_path):
    # A fresh interpreter, away from the checkout: the installed package is what is imported.
    output = subprocess.run([sys.executable, "-c", PROGRAM], cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert output.split() == []
