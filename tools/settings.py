"""Options by name: `front_end.match.min_votes=20` on the command line; all in the record."""

import dataclasses
import enum
import math
from collections.abc import Iterator, Sequence
from typing import Any, TypeVar

from groundfuse.tools.checks import nearest
from groundfuse.tools.errors import TeamError

Options = TypeVar("Options")


def with_settings(options: Options, settings: Sequence[str]) -> Options:
    """Return options with `stage.option=value` applied, in order.

    Raises:
        TeamError: no `=`, an unknown name (the nearest known one is named), or a value of the
            wrong type; a number must be 0 or above (`inf` switches a limit off), several stand
            with commas between them.
    """
    for setting in settings:
        name, equals, text = setting.partition("=")
        if not equals:
            raise TeamError(f"--set {setting}: needed STAGE.OPTION=VALUE")
        whole = name.strip()
        there = [full for full in option_names(options) if _last(full) == _last(whole)]
        if there and whole not in there:
            raise TeamError(f"--set {whole}: did you mean {' or '.join(there)}?")
        options = _replaced(options, whole.split("."), text.strip(), whole)
    return options


def option_names(options: object) -> Iterator[str]:
    """Yield the full name of every option, in the order of the record."""
    for field in dataclasses.fields(options):  # type: ignore[arg-type]
        value = getattr(options, field.name)
        if dataclasses.is_dataclass(value):
            yield from (f"{field.name}.{name}" for name in option_names(value))
        else:
            yield field.name


def _last(name: str) -> str:
    return name.rpartition(".")[2]


def _replaced(options: Options, path: Sequence[str], text: str, whole: str) -> Options:
    known = {f.name for f in dataclasses.fields(options)}  # type: ignore[arg-type]
    if path[0] not in known:
        hint = nearest(path[0], known) or f", known are {', '.join(sorted(known))}"
        raise TeamError(f"--set {whole}: no option {path[0]!r}{hint}")
    old = getattr(options, path[0])
    if dataclasses.is_dataclass(old) and not isinstance(old, type):
        if len(path) == 1:
            names = ", ".join(f.name for f in dataclasses.fields(old))
            raise TeamError(f"--set {whole}: names a group of options ({names})")
        new: Any = _replaced(old, path[1:], text, whole)
    elif len(path) > 1:
        raise TeamError(f"--set {whole}: {path[0]!r} is an option, not a group")
    else:
        new = _parsed(old, text, whole)
    try:
        changed: Options = dataclasses.replace(options, **{path[0]: new})  # type: ignore[type-var]
    except ValueError as error:
        raise TeamError(f"--set {whole}: {error}") from error
    return changed


def _parsed(old: object, text: str, whole: str) -> object:
    """Return the text as a value of the old one's type."""
    if isinstance(old, enum.Enum):
        choices = [str(member.value) for member in type(old)]
        if text not in choices:
            raise TeamError(f"--set {whole}: got {text!r}, needed one of {', '.join(choices)}")
        return type(old)(text)
    if isinstance(old, bool):
        if text.lower() not in {"true", "false"}:
            raise TeamError(f"--set {whole}: got {text!r}, needed true or false")
        return text.lower() == "true"
    if isinstance(old, str):
        return text
    if isinstance(old, tuple):
        return tuple(_number(word, whole, whole_only=False) for word in text.split(","))
    return _number(text, whole, whole_only=isinstance(old, int))


def _number(text: str, whole: str, *, whole_only: bool) -> float:
    """Return a number from 0 on."""
    needed = "a whole number" if whole_only else "a number"
    try:
        number = int(text) if whole_only else float(text)
    except ValueError as error:
        raise TeamError(f"--set {whole}: got {text!r}, needed {needed}") from error
    if number < 0 or math.isnan(number):
        raise TeamError(f"--set {whole}: got {text!r}, needed {needed} from 0 on")
    return number


def record(options: object) -> Any:  # noqa: ANN401
    """Return options as plain dictionaries for JSON."""
    if dataclasses.is_dataclass(options) and not isinstance(options, type):
        return {f.name: record(getattr(options, f.name)) for f in dataclasses.fields(options)}
    if isinstance(options, enum.Enum):
        return options.value
    if isinstance(options, tuple | list):
        return [record(item) for item in options]
    return options
