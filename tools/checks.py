"""Check what people write into files: numbers, and names that are nearly right."""

import difflib
import math
from collections.abc import Collection


def finite_number(value: object, name: str) -> float:
    """Return a number from a file as a float; a text that is one (`1e-3` in YAML) counts.

    Raises:
        ValueError: not a number, nan or infinite; the message has the name and the value.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(f"{name} must be a number, got {value!r}")  # noqa: TRY004 (file content)
    try:
        number = float(value)
    except ValueError:
        comma = isinstance(value, str) and value.count(",") == 1
        hint = " (write a decimal point)" if comma else ""
        raise ValueError(f"{name} must be a number, got {value!r}{hint}") from None
    if not math.isfinite(number):
        raise ValueError(f"{name} must be finite, got {number}")
    return number


def whole_number(value: object, name: str) -> int:
    """Return a whole number from a file as an int.

    Raises:
        ValueError: not a number, nan, infinite or not whole; with the name and the value.
    """
    number = finite_number(value, name)
    if not number.is_integer():
        raise ValueError(f"{name} must be a whole number, got {number:g}")
    return int(number)


def nearest(name: str, known: Collection[str]) -> str:
    """Return ` (did you mean 'x'?)` for the known name that looks most like `name`, or nothing."""
    folded = {option.casefold(): option for option in sorted(known, reverse=True)}
    close = difflib.get_close_matches(name.casefold(), list(folded), n=1, cutoff=0.5)
    return f" (did you mean {folded[close[0]]!r}?)" if close else ""


def refuse_unknown(found: Collection[str], known: Collection[str], what: str) -> None:
    """Refuse the first name that isn't known.

    Raises:
        ValueError: names it and the nearest known one, or all known ones where none is near.
    """
    for name in found:
        if name not in known:
            hint = nearest(name, known) or f" (known: {', '.join(sorted(known))})"
            raise ValueError(f"unknown {what} {name!r}{hint}")
