"""The installed commands: Ctrl-C ends them without a traceback while they load their libraries."""

import signal
from importlib import import_module


def fuse_team() -> int:
    """Run `fuse-team`."""
    return _run("fuse_team")


def fuse_graphs() -> int:
    """Run `fuse-graphs`."""
    return _run("fuse_graphs")


def simulate_team() -> int:
    """Run `simulate-team`."""
    return _run("simulate_team")


def _run(name: str) -> int:
    usual = signal.getsignal(signal.SIGINT)
    if usual is signal.default_int_handler:  # else whoever started it decides
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        command = import_module(f"groundfuse.tools.{name}")
    finally:
        signal.signal(signal.SIGINT, usual)
    done: int = command.main()
    return done
