#!/usr/bin/env bash
# Build the wheel, install it in a fresh environment outside the checkout, and use it there. Run by .ci/run, whose uv and environment it takes.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
constraints=$PWD/.ci/constraints.txt

python3 -m uv run python -m hatchling build -t wheel -d "$work/dist"
wheel=$(echo "$work"/dist/*.whl)
python3 -m uv venv --quiet "$work/env"
python3 -m uv pip install --quiet --python "$work/env" --constraints "$constraints" "$wheel"

cd "$work"
"$work/env/bin/python" - "$wheel" <<'PY'
import sys
import zipfile

names = zipfile.ZipFile(sys.argv[1]).namelist()
top = {name.split("/")[0] for name in names}
top = {name for name in top if not name.endswith(".dist-info")}
if top != {"bayes_body"}:
    sys.exit(f"the wheel's top level is {sorted(top)}; expected bayes_body alone")
if not any(name.startswith("bayes_body/_models/") and name.endswith(".toml") for name in names):
    sys.exit("the wheel holds no model definition under bayes_body/_models")

import bayes_body

if not bayes_body.__file__.startswith(sys.prefix):
    sys.exit(f"bayes_body was imported from {bayes_body.__file__}, not from the wheel")
heavy = sorted({"jax", "arviz", "blackjax"} & set(sys.modules))
if heavy:
    sys.exit(f"import bayes_body imports {heavy}; expected none of them")
print(f"{len(names)} files, top level bayes_body")
PY

models=$("$work/env/bin/bayes-body" models)
for name in deutscher_2005 silhouettes arm; do
  grep -qw "$name" <<<"$models" || {
    printf 'bayes-body models does not list %s:\n%s\n' "$name" "$models" >&2
    exit 1
  }
done
echo "bayes-body models: lists the definitions that the wheel carries"
