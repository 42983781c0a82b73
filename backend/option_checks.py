"""Options that make no sense are refused where they are made, by their names.

Compiled loops check no bounds: a count of 0 that reaches them reads somebody else's memory.
"""

import dataclasses
import math
from collections.abc import Collection, Iterator
from typing import Any


def check_numbers(
    options: Any,  # noqa: ANN401
    *,
    may_be_zero: Collection[str] = (),
    may_be_inf: Collection[str] = (),
    may_be_negative: Collection[str] = (),
    shares: Collection[str] = (),
) -> None:
    """Refuse numbers that are not above 0 and finite, but for the fields named.

    Args:
        options: a dataclass; its numbers are looked at and those in its tuples, not None (which
            stands for a number to be found) and not options within.
        may_be_zero: fields that 0 switches off, or leaves out.
        may_be_inf: limits that infinity switches off.
        may_be_negative: fields of any sign.
        shares: fields that are 1 at most.

    Raises:
        ValueError: the field, what it needs and what it is.
    """
    for field in dataclasses.fields(options):
        name = field.name
        for number in _numbers(getattr(options, name)):
            needed = ""
            if math.isinf(number) and number > 0 and name not in may_be_inf:
                needed = "be finite"
            elif field.type is int and not float(number).is_integer():
                needed = "be a whole number"
            elif name in shares and not 0 <= number <= 1:
                needed = "lie within 0 to 1"
            elif name in may_be_negative:
                needed = "be a number" if math.isnan(number) else ""
            elif name in may_be_zero:
                needed = "" if number >= 0 else "not be negative"
            elif not number > 0:
                needed = "be positive"
            if needed:
                raise ValueError(f"{name} must {needed}, got {number:g}")


def _numbers(value: object) -> Iterator[float]:
    """Yield the numbers of one field."""
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value
