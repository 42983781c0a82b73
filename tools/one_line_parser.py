"""A command line of ours: its examples as they stand, and what is wrong with it in one line."""

import argparse
from typing import NoReturn

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C ended: what a shell makes of signal 2."""


class OneLineParser(argparse.ArgumentParser):
    """The parser of one command.

    Args:
        name: of the command, without `.py`.
        description: what it does.
        epilog: examples.
        says: under what name it complains; by default its own.
    """

    def __init__(
        self, name: str, description: str, epilog: str, *, says: str | None = None
    ) -> None:
        super().__init__(
            prog=f"{name}.py",
            description=description,
            epilog=epilog,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self._says = says or name

    def error(self, message: str) -> NoReturn:
        """Say what is wrong in one line."""
        self.exit(2, f"{self._says}: {message}\n")
