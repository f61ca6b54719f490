"""What image motion knows of an arm's twist while the arm is straight, and when it has bent (Sidenbladh, Black & Fleet 2000, 7, arm tracking).

    python inference/bending_arm.py --out RUN --json figures.json

Films a person whose arm hangs straight and then bends, and tracks the arm with filters that begin with every twist. Copy this file and change it.
"""

import argparse
import json
import sys
from pathlib import Path

import bayes_body as bb
from bayes_body.errors import InputError


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Track an arm that bends by image motion.")
    parser.add_argument("--out", type=Path, required=True, help="folder for the recording")
    parser.add_argument("--json", type=Path, required=True, help="file for the figures")
    parser.add_argument("--motion", type=Path, help="a captured walk; by default the walking cycle that ships")
    parser.add_argument("--model", default="sidenbladh_2000_arm", help="a definition of the arm (%(default)s)")
    parser.add_argument("--twist", type=float, default=20.0, help="the true twist of the upper arm, degrees (%(default)s)")
    parser.add_argument("--particles", type=bb.whole_number(1), default=40_000, help="particles (%(default)s)")
    parser.add_argument("--runs", type=bb.whole_number(1), default=10, help="independent filters (%(default)s)")
    parser.add_argument("--seed", type=bb.whole_number(0), default=0, help="seed of the person and the room (%(default)s)")
    parser.add_argument("--quick", action="store_true", help="one filter with 500 particles: a trial")
    return parser.parse_args()


def main() -> None:
    arguments = parse()
    bb.configure()
    particles, runs = (500, 1) if arguments.quick else (arguments.particles, arguments.runs)
    filmed = bb.compare.film_arm(arguments.out / "recording", arguments.twist, arguments.seed, arguments.motion, bb.watched("filming"))
    rows = []
    for seed in bb.watched("filters")(range(runs)):
        found = bb.compare.twist_interval(filmed, particles, seed, arguments.model)
        row = {"before_deg": found.before_deg, "after_deg": found.after_deg, "holds": found.holds, "passes": found.passes, "effective": found.ess}
        rows.append(row | {"low_deg": found.low.tolist(), "high_deg": found.high.tolist()})
        print(f"filter {seed}: 90 % interval {found.before_deg:.0f} degrees wide before, {found.after_deg:.0f} after, ", end="")
        print(f"{found.low[-1]:.0f} to {found.high[-1]:.0f} in the last frame; truth {found.true:.0f}")
    passed = sum(row["passes"] for row in rows)
    arguments.json.write_text(json.dumps({"twist_deg": arguments.twist, "passed": passed, "runs": rows}, indent=2) + "\n", encoding="utf-8")
    print(f"{passed} of {runs} filters knew nothing before and the truth after")


if __name__ == "__main__":
    try:
        main()
    except (InputError, OSError) as error:
        print(error, file=sys.stderr)
        sys.exit(2)
