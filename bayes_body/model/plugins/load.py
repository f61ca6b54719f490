"""Load plugins: Python files that register a user's own likelihoods, observations, dynamics, potentials or kernels, for use from TOML.

A definition cannot load code. A plugin is run only if its file is named by `load_plugin` or `--plugin`. Its terms are checked, and each fault is
reported in a sentence that names the file and the line.
"""

import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from bayes_body.base import registry
from bayes_body.base.errors import InputError, input_error
from bayes_body.base.registry import Place, Room
from bayes_body.density.factor import State
from bayes_body.model.plugins.blame import Origin, blamed, failure, line_of
from bayes_body.model.plugins.check import check_factors, check_transition, checked_term
from bayes_body.model.plugins.terms import owned

# The prefix of plugins' names in sys.modules. No import statement finds them.
MODULES = "bayes_body plugin"


class Plugin(NamedTuple):
    """A plugin that was run.

    Attributes:
        path: its file.
        text: the content of the file when it was run.
        places: room and name of each of its terms.
    """

    path: Path
    text: str
    places: tuple[Place, ...]


_loaded: dict[Path, Plugin] = {}


def load_plugin(path: Path | str) -> Plugin:
    """Run a file that registers terms. If the file has changed since, run it again and replace its terms; if not, do nothing.

    Raises:
        InputError: the file does not exist or is not Python, its code fails, it registers nothing or a name that is taken, or a term is unusable.
    """
    path = Path(path).resolve()
    text = _read(path)
    loaded = _loaded.get(path)
    if loaded and loaded.text == text:
        return loaded
    for namesake in _loaded.values():
        if namesake.path.name == path.name and namesake.path != path:
            raise input_error(path, f"the plugin {namesake.path} has the same file name", "a file name of its own", "rename one of them")
    if loaded:
        unload(loaded)
    with registry.additions() as places:
        _execute(path, text)
    plugin = _loaded[path] = Plugin(path, text, tuple(places))
    try:
        _check(plugin)
    except InputError:
        unload(plugin)
        raise
    for place in places:
        term = registry.find(*place)
        registry.replace(place, term._replace(build=_guarded(plugin, place, term.build)))
    return plugin


def unload(plugin: Plugin) -> None:
    """Remove a plugin and its terms."""
    registry.forget(plugin.places)
    _loaded.pop(plugin.path, None)
    sys.modules.pop(_module_name(plugin.path), None)


def loaded() -> tuple[Plugin, ...]:
    """Return the loaded plugins, in the order of loading."""
    return tuple(_loaded.values())


def providing(places: Collection[Place]) -> tuple[Plugin, ...]:
    """Return the plugins that provide at least one of the terms."""
    return tuple(plugin for plugin in loaded() if set(plugin.places) & set(places))


def check_own_factors(density: Any, state: State) -> None:
    """Check the factors and the motion prior that are not built in against the requirements of a density. Without such terms this costs nothing.

    Args:
        density: the density of the first frame (`bayes_body.density.density.Density`).
        state: the first pose.

    Raises:
        InputError: as in `plugins.check.check_factors` and `check_transition`.
    """
    rooms: tuple[Room, ...] = ("likelihood", "potential")
    terms = {name: where_of(room, name) for room in rooms for name in registry.own_names(room)}
    if terms:
        check_factors(density, state, terms)
    if registry.own_names("dynamics"):
        check_transition(density, state)


def where_of(room: Room, name: str) -> str:
    """Return the name of a term in error messages, with the file of the plugin that provides it."""
    (path,) = [f"{plugin.path}: " for plugin in providing({(room, name)})] or [""]
    return f"{path}{room} '{name}'"


@contextmanager
def plugins_to_blame() -> Iterator[None]:
    """Convert an error in a plugin's code, raised in the `with` block, to an InputError that names the plugin's line.

    Raises:
        InputError: a plugin's code failed.
    """
    try:
        yield
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        for plugin in loaded():
            if fault := blamed(plugin.path, plugin.text, error):
                raise fault from error
        raise


# -- reading and running ----------------------------------------------------------------------------------------------------------------------


def _read(path: Path) -> str:
    if not path.is_file():
        raise input_error(path, "a folder" if path.exists() else "no such file", "a Python file that registers terms", "check the path")
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise input_error(path, f"cannot be read ({error.strerror})", "a Python file", "check its permissions") from None
    except UnicodeDecodeError:
        raise input_error(path, "not text", "a Python file in UTF-8", "check the path, or save the file as UTF-8") from None


def _execute(path: Path, text: str) -> None:
    """Run the file as a separate module.

    Python's loader is not used. It would create a folder of compiled code beside the user's file, and could run a different text from the one stored.
    """
    try:
        code = compile(text, str(path), "exec", dont_inherit=True)
    except SyntaxError as error:
        problem = f"{error.msg} in the line `{(error.text or '').strip()}`"
        raise input_error(f"{path}: line {error.lineno}", problem, "Python", "correct that line") from None
    except (ValueError, RecursionError, MemoryError) as error:
        raise input_error(path, str(error), "Python", "check the path") from None
    module = ModuleType(_module_name(path))
    module.__file__ = str(path)
    # Annotations are looked up in the module of the class.
    sys.modules[module.__name__] = module
    try:
        exec(code, module.__dict__)
    except (Exception, SystemExit) as error:
        sys.modules.pop(module.__name__)
        if isinstance(error, ImportError) and (error.name or "").startswith("bayes_body"):
            raise _moved_module(path, error) from None
        raise failure(path, text, error, line_of(path, error)) from error


def _moved_module(path: Path, error: ImportError) -> InputError:
    """The error of a plugin that imports a module of this package by a path that it had in another version."""
    subject = f"{path}: line {line_of(path, error)}"
    remedy = "write `import bayes_body as bb`, and take bb.Schema, bb.Factor, bb.InputError and the like"
    return input_error(subject, f"{error.name} is not where this plugin looks ({error.msg})", "names of `bayes_body` itself", remedy)


def _module_name(path: Path) -> str:
    return f"{MODULES} {path.stem}"


def _check(plugin: Plugin) -> None:
    """Check that its terms can be used, and that each likelihood has an observation that prepares its data."""
    if not plugin.places:
        raise input_error(plugin.path, "registers nothing", "at least one term", 'put @bb.register("likelihood", "mine") above a build function')
    for room, name in plugin.places:
        subject = f"{plugin.path}: {room} '{name}'"
        if room == "likelihood" and name not in registry.names("observation"):
            remedy = 'give its @register observation="markers_gaussian" or another, or register an observation of the same name'
            raise input_error(subject, "no observation", "an observation that prepares its data", remedy)
        if room == "kernel" and "particles" not in registry.find(room, name).options.model_fields:
            raise input_error(subject, "its options have no `particles`", "an option for their number", "add `particles: Count = 1000` to them")


# -- its terms ----------------------------------------------------------------------------------------------------------------------------------


def _guarded(plugin: Plugin, place: Place, build: Callable[..., Any]) -> Callable[..., Any]:
    room, name = place
    origin = Origin(plugin.path, plugin.text, room, name)

    @wraps(build)
    def guarded(**arguments: Any) -> Any:
        try:
            term = build(**arguments)
        except (Exception, SystemExit) as error:
            fault = blamed(plugin.path, plugin.text, error, build)
            if fault is None:
                raise
            raise fault from error
        return owned(origin, checked_term(room, term, arguments.get("name", name), origin.describe(build)))

    return guarded
