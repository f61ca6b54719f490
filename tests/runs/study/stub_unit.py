"""A unit of a study whose commands are stubs: a file for each frame, then a summary. What a session's folder holds says how it ends.

`fails`: status 2 with a sentence. `dies`: the process is killed after each new frame. `dies_at_once`: before the first. `kills`: before the first, it
kills the process that started it. `waits`: until the file is removed. Every frame is noted in `computed`, so a test sees what was computed twice.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from bayes_body.runs.study.unit_process import compute

FRAMES = 3


def command_line(arguments: list[str]) -> None:
    verb, folder = arguments[0], Path(arguments[1])
    if verb == "track":
        out = Path(arguments[arguments.index("--out") + 1])
        track(folder, out)
    elif verb == "combine":
        finish(Path(arguments[arguments.index("--out") + 1]))
    elif verb in ("overlay", "report", "view") and "--out" in arguments:
        show_people(verb, Path(arguments[arguments.index("--out") + 1]), arguments[1 : arguments.index("--out")])
    sys.exit(0)


def track(session: Path, out: Path) -> None:
    if (session / "fails").exists():
        print(f"bayes-body: {session}: a stub that fails; expected another; remove `fails`.", file=sys.stderr)
        sys.exit(2)
    (out / "frames").mkdir(parents=True, exist_ok=True)
    (out / "run.toml").touch()
    for frame in range(FRAMES):
        path = out / "frames" / f"{frame:06d}.npz"
        if path.exists():
            continue
        if (session / "dies_at_once").exists():
            os.kill(os.getpid(), signal.SIGKILL)
        if (session / "kills").exists():
            os.kill(os.getppid(), signal.SIGKILL)
            # This process is ended, since its standard input is closed.
            time.sleep(60)
        while (session / "waits").exists():
            time.sleep(0.02)
        with (session / "computed").open("a") as noted:
            noted.write(f"{out.name} {frame}\n")
        path.touch()
        if (session / "dies").exists():
            os.kill(os.getpid(), signal.SIGKILL)
    finish(out)


def show_people(verb: str, path: Path, runs: list[str]) -> None:
    """Write whom a page of all people shows, and note that it was made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(runs))
    with path.with_name("made").open("a") as noted:
        noted.write(f"{verb}\n")


def finish(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").write_text(json.dumps({"frames": FRAMES, "frames_lost": 0, "rhat_max": 1.01, "warnings": []}))


if __name__ == "__main__":
    compute(command_line)
