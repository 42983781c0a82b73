"""How loops become machine code: no interpreter's lock, so that threads run side by side.

The machine code is kept beside the source (or in the user's cache), so only the first run ever
waits for the compiler. What is kept is thrown away when the text of the function's own file
changes, not when another file's does: a compiled function calls compiled functions of its own file
only, and whoever changes what is written here removes `__pycache__`. Plain loops over scalars
compile several times faster than array expressions.
"""

from collections.abc import Callable
from typing import Any, TypeVar

from numba import njit

_njit: Any = njit  # its types know neither all options nor that what it returns can be called alike

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile a function at its first call; a division by zero gives infinity, as in numpy."""
    machine: Function = _njit(cache=True, nogil=True, error_model="numpy")(function)
    return machine


def part(function: Function) -> Function:
    """Compile a function into the compiled functions that call it; there is no other way in.

    What is not put in place costs more than most parts do: each array is handed over as ten words.
    """
    machine: Function = _njit(
        nogil=True,
        error_model="numpy",
        forceinline=True,
        no_cpython_wrapper=True,
        no_cfunc_wrapper=True,
    )(function)
    return machine
