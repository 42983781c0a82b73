"""Which code computes something: a digest of the sources it rests on, and of the libraries.

What was computed by other code is not taken from a store: a release that changes how features are
found computes them anew, one that changes a drawing does not.
"""

import functools
import hashlib
import platform
import re
import sys
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

import cv2

IMPORTS = re.compile(
    r"^[ \t]*from[ \t]+(groundfuse[.\w]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n]*)"
    r"|^[ \t]*import[ \t]+(groundfuse[.\w]*)",
    re.MULTILINE,
)
LIBRARIES = ("cv2", "gtsam", "numba", "numpy", "scipy")


@functools.cache
def libraries() -> dict[str, str]:
    """Return what the numbers may depend on besides our own code, by name."""
    found = {"python": ".".join(map(str, sys.version_info[:2])), "machine": platform.machine()}
    others = {name: version(name) for name in LIBRARIES if name != "cv2"}
    return {**found, "cv2": cv2.__version__, **others}


@functools.cache
def code_of(*modules: str, rooms: tuple[str, ...] = ("frontend", "backend")) -> str:
    """Return a digest of modules, of ours that they import, and of the libraries they use.

    Args:
        modules: full names, such as `groundfuse.frontend.features`.
        rooms: imports are followed into these.
    """
    sources = {name: _source(name) for name in _closure(modules, rooms)}
    every = "\n".join(sources.values())
    used = {
        name: number
        for name, number in libraries().items()
        if name not in LIBRARIES or re.search(rf"^\s*(import|from) {name}\b", every, re.MULTILINE)
    }
    text = repr((sorted(sources.items()), sorted(used.items())))
    return hashlib.blake2b(text.encode(), digest_size=20).hexdigest()


def _closure(modules: tuple[str, ...], rooms: tuple[str, ...]) -> set[str]:
    todo, seen = list(modules), set[str]()
    while todo:
        name = todo.pop()
        if name not in seen:
            seen.add(name)
            todo += [other for other in imported(_source(name)) if other.split(".")[1] in rooms]
    return seen


def imported(source: str) -> list[str]:
    """Return the modules of ours that a source imports, by their full names."""
    found = []
    for module, names, whole in IMPORTS.findall(source):
        words = re.findall(r"\w+", re.sub(r"#.*|\bas\s+\w+", "", names))
        found += [module or whole, *(f"{module}.{word}" for word in words)]
    return [name for name in dict.fromkeys(found) if _is_module(name)]


def _is_module(name: str) -> bool:
    _, _, inner = name.partition(".")
    return inner.count(".") == 1 and _path(name).is_file()


@functools.cache
def _room(name: str) -> Path:
    spec = find_spec(name)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"there is no package {name}")
    return Path(next(iter(spec.submodule_search_locations)))


def _path(module: str) -> Path:
    room, _, name = module.rpartition(".")
    return _room(room) / f"{name}.py"


@functools.cache
def _source(module: str) -> str:
    return _path(module).read_text("utf-8")
