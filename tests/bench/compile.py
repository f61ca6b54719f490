"""What compilation costs: every model with its kernel, and the search for a person. `python tests/bench/compile.py SESSION [--keypoints SESSION]`.

A program is traced and lowered by JAX, then compiled by XLA. XLA's time grows with the number of kernels (operations that are not inside a fusion)
and of instructions. The instructions are attributed to the files of the package from which they came, innermost first. Each program is compiled in
a process of its own, with an empty compilation cache. Compare two versions on the same idle machine: `--json` writes the table, `--before` reads an
older one and prints ratios.
"""

import argparse
import collections
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SEARCH = "person search"
# What tracking compiles only for a frame that needs it.
FALLBACK = ", fallback"
CALLS = 3
# Headers of the tables of stack frames in the text of an optimised program, and a line of each.
TABLES = re.compile(r"^(FileNames|FunctionNames|FileLocations|StackFrames)$(.*?)^\s*$", re.M | re.S)
PACKAGE = "/bayes_body/"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("session", type=Path, help="a session with silhouettes, such as the recording of `bayes-body demo`")
    parser.add_argument("--keypoints", type=Path, help="a session with keypoints, for the models that read them; without it these are left out")
    parser.add_argument("--program", nargs="+", help=f"models, MODEL:KERNEL, '{SEARCH}', or a model with '{FALLBACK}'; default: all")
    parser.add_argument("--json", type=Path, help="write the rows there")
    parser.add_argument("--before", type=Path, help="rows of another version, for ratios")
    parser.add_argument("--row", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.row:
        print(json.dumps(row(arguments.row, arguments.session)))
        return
    before = json.loads(arguments.before.read_text()) if arguments.before else {}
    rows = {}
    widths = {"trace": 7, "lower": 7, "XLA": 7, "CPU": 7, "HLO lines": 11, "kernels": 9, "instr.": 8, "run": 8, "XLA ratio": 11, "run ratio": 11}
    print(f"{'program':<30}" + "".join(f"{heading:>{width}}" for heading, width in widths.items()))
    for name, session in programs(arguments):
        command = [sys.executable, __file__, str(session), "--row", name]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        if result.returncode:
            print(f"{name:<30}{result.stderr.strip().splitlines()[-1]}", flush=True)
            continue
        rows[name] = json.loads(result.stdout.splitlines()[-1])
        print(line(name, rows[name], before.get(name)), flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(rows, indent=1))


def programs(arguments):
    """Names of programs, each with the folder of its session."""
    from bayes_body.base.files.shipped import definitions_folder
    from bayes_body.model.definition import load_definition
    from bayes_body.model.kernel_options import kernel_of, kernel_options
    from bayes_body.tracking.program import parts_of

    names = arguments.program or [SEARCH, *sorted(path.stem for path in definitions_folder().glob("*.toml")), "keypoints:tempered"]
    for name in names:
        model = name.removesuffix(FALLBACK).partition(":")[0]
        reads_keypoints = name != SEARCH and any(term.kind == "markers_gaussian" for term in load_definition(model).likelihoods)
        session = arguments.keypoints if reads_keypoints else arguments.session
        if session is None:
            continue
        yield name, session
        if (
            not arguments.program
            and name != SEARCH
            and ":" not in name
            and parts_of(kernel_of(*kernel_options(load_definition(name), None, {}))) is not None
        ):
            yield f"{name}{FALLBACK}", session


def line(name: str, figures: dict, before: dict | None) -> str:
    ratios = [f"{figures[key] / before[key]:.2f}" if before and before[key] else "" for key in ("compile", "run")]
    sizes = f"{figures['lines']:>11}{figures['kernels']:>9}{figures['instructions']:>8}"
    seconds = "".join(f"{figures[key]:>7.1f}" for key in ("trace", "lower", "compile", "cpu"))
    origins = ", ".join(f"{file} {count}" for file, count in list(figures["origins"].items())[:6])
    return f"{name:<30}{seconds}{sizes}{figures['run']:>8.3f}{ratios[0]:>11}{ratios[1]:>11}\n    {origins}"


def row(name: str, folder: Path) -> dict:
    """The figures of one program. Seconds of the clock, and CPU seconds of XLA; `run` is the fastest of some calls."""
    import bayes_body

    bayes_body.configure()
    import jax
    from jax.experimental.compilation_cache import compilation_cache

    function, arguments = (search_program if name == SEARCH else frame_program)(name, folder)
    # The fit of a first pose may come from the user's cache. What is measured must not.
    with tempfile.TemporaryDirectory() as empty:
        jax.config.update("jax_compilation_cache_dir", empty)
        compilation_cache.reset_cache()
        return measured(function, arguments)


def measured(function, arguments) -> dict:
    """The figures of a function's program."""
    import jax

    start = time.perf_counter()
    traced = jax.jit(function).trace(*arguments)
    traced_at = time.perf_counter()
    lowered = traced.lower()
    lowered_at, cpu = time.perf_counter(), cpu_seconds()
    program = lowered.compile()
    figures = {"trace": traced_at - start, "lower": lowered_at - traced_at, "compile": time.perf_counter() - lowered_at, "cpu": cpu_seconds() - cpu}
    text, calls = program.as_text(), []
    for _ in range(CALLS):
        begin = time.perf_counter()
        jax.block_until_ready(program(*arguments))
        calls.append(time.perf_counter() - begin)
    return {**figures, "run": min(calls), "lines": lowered.as_text().count("\n"), **size(text)}


def frame_program(name: str, folder: Path):
    """The step of one frame, as it is tracked: the model's kernel, or the one after a colon, with its particles; or that of the kernel's fallback."""
    import jax

    from bayes_body.base.errors import InputError
    from bayes_body.initial import load_model
    from bayes_body.kernels.batching import everywhere, replicated
    from bayes_body.model.build import build_model
    from bayes_body.model.definition import load_definition
    from bayes_body.model.kernel_options import kernel_of, kernel_options
    from bayes_body.recording.observation.frames import read_frame
    from bayes_body.recording.session.read import load_session
    from bayes_body.tracking.program import parts_of

    session, wants_fallback = load_session(folder), name.endswith(FALLBACK)
    name, _, kind = name.removesuffix(FALLBACK).partition(":")
    kind, options = kernel_options(load_definition(name), kind or None, {})
    try:
        model = load_model(name, session)
    except InputError:
        # An arm has too few of the markers: it stays where its definition puts it.
        model = build_model(name, session)
    kernel, start = kernel_of(kind, options), everywhere(model.start(options.particles))
    if (parts := parts_of(kernel)) is not None:
        kernel = parts.fallback if wants_fallback else parts.first
    density = everywhere(model.density(model.observe(read_frame(session, 1)), start))

    def frame(key, index, particles, density):
        after = kernel(jax.random.fold_in(key, index), particles, density.with_previous(particles))
        return jax.lax.with_sharding_constraint(after, replicated())

    return frame, (everywhere(jax.random.key(0)), everywhere(jax.numpy.int32(1)), start, density)


def search_program(name: str, folder: Path):
    """The search in frame 0, for the way that is detected first."""
    import jax

    from bayes_body.initial.detection.detect import TRUSTED, detect
    from bayes_body.initial.search import person_search
    from bayes_body.kernels.batching import everywhere
    from bayes_body.recording.observation.frames import read_frame
    from bayes_body.recording.session.read import load_session

    session = load_session(folder)
    hunt, frame = person_search.PersonSearch(session), read_frame(session, 0)
    detected = detect(session, frame, TRUSTED)
    root = hunt.model.body.placement.names[0]
    half, _ = person_search._by_facing(detected.parts[root], hunt.up)[0]
    density = everywhere(hunt.model.density(hunt.model.observe(frame), hunt._before))
    roots = person_search.proposals_of(detected._replace(parts={root: half}, landmarks={}), hunt.model.body, hunt._frames)[0]
    return person_search.search, (everywhere(jax.random.key(0)), density, everywhere(roots))


def cpu_seconds() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def size(text: str) -> dict:
    """Numbers of kernels and instructions of an optimised program, and the instructions by file of the package."""
    inside, kernels, instructions, origins = "", 0, 0, collections.Counter()
    file_of = files_by_frame(text)
    for text_line in text.splitlines():
        if text_line.startswith(("%", "ENTRY")) and text_line.rstrip().endswith("{"):
            inside = text_line.split()[0]
        elif " = " in text_line and text_line.startswith("  "):
            if re.search(r" (parameter|constant|get-tuple-element|tuple|bitcast)\(", text_line):
                continue
            instructions += 1
            kernels += not inside.startswith(("%fused", "%wrapped", "%parallel"))
            frame = re.search(r"stack_frame_id=(\d+)", text_line)
            origins[file_of.get(int(frame[1]), "elsewhere") if frame else "elsewhere"] += 1
    return {"kernels": kernels, "instructions": instructions, "origins": dict(origins.most_common(12))}


def files_by_frame(text: str) -> dict[int, str]:
    """For each stack frame, the file of the package that is innermost in it."""
    tables = {name: [entry for entry in body.strip().splitlines() if entry] for name, body in TABLES.findall(text)}
    if "StackFrames" not in tables:
        return {}
    names = {int(number): path.strip('"') for number, path in (entry.split(maxsplit=1) for entry in tables["FileNames"])}
    locations = {int(entry.split()[0]): int(re.search(r"file_name_id=(\d+)", entry)[1]) for entry in tables["FileLocations"]}
    frames = {}
    for entry in tables["StackFrames"]:
        number, place, parent = int(entry.split()[0]), *(int(re.search(rf"{key}=(\d+)", entry)[1]) for key in ("file_location_id", "parent_frame_id"))
        frames[number] = names[locations[place]], parent

    def innermost(number: int) -> str:
        while number in frames:
            path, parent = frames[number]
            if PACKAGE in path and not path.endswith("shapes.py"):
                return path.rsplit(PACKAGE, 1)[1]
            if parent == number:
                break
            number = parent
        return "elsewhere"

    return {number: innermost(number) for number in frames}


if __name__ == "__main__":
    main()
