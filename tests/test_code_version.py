"""Whose sources a digest covers: of what is imported, and no more."""

import ast
from pathlib import Path

import pytest

from groundfuse.tools import code_version
from groundfuse.tools.code_version import _closure, code_of, imported, libraries

ROOT = Path(__file__).parents[1]
FEATURES = "groundfuse.frontend.features"


def imported_by_syntax(path):
    """The same by Python's own grammar."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    rooms = ("frontend", "backend", "tools")
    return {
        name
        for name in found
        if name.startswith("groundfuse.") and (ROOT / f"{name[11:].replace('.', '/')}.py").is_file()
        if name.split(".")[1] in rooms
    }


@pytest.mark.parametrize("room", ["frontend", "backend", "tools"])
def test_imports_are_found_as_python_finds_them(room):
    for path in sorted((ROOT / room).glob("*.py")):
        assert set(imported(path.read_text())) == imported_by_syntax(path), path


def test_a_closure_holds_what_is_used_and_no_more():
    found = _closure((FEATURES,), ("frontend", "backend"))
    assert {FEATURES, "groundfuse.frontend.overhead_view", "groundfuse.backend.measurement"} < found
    assert "groundfuse.frontend.mosaic" not in found
    assert "groundfuse.backend.team" not in found
    whole = _closure(("groundfuse.tools.pictures",), ("frontend", "backend", "tools"))
    assert {"groundfuse.tools.drawing", "groundfuse.frontend.mosaic"} < whole
    alone = _closure(("groundfuse.tools.pair_verdict",), ("frontend", "backend"))
    assert not {name for name in alone if ".tools." in name} - {"groundfuse.tools.pair_verdict"}


@pytest.fixture
def edited(monkeypatch):
    """Pretend that a module reads otherwise."""

    def edit(module):
        source = code_version._source

        def other(name):
            return source(name) + "#" * (name == module)

        monkeypatch.setattr(code_version, "_source", other)
        return code_version.code_of.__wrapped__(FEATURES)

    return edit


def test_only_what_is_used_changes_a_digest(edited):
    before = code_of(FEATURES)
    assert edited("groundfuse.frontend.mosaic") == before
    assert edited("groundfuse.frontend.repetition") != before


def test_a_library_counts_where_it_is_imported(monkeypatch):
    before = [code_of.__wrapped__(m) for m in (FEATURES, "groundfuse.backend.team")]
    monkeypatch.setattr(code_version, "libraries", lambda: {**libraries(), "cv2": "9.9"})
    after = [code_of.__wrapped__(m) for m in (FEATURES, "groundfuse.backend.team")]
    assert after[0] != before[0]
    assert after[1] == before[1]
    assert set(libraries()) == {"python", "machine", "cv2", "gtsam", "numba", "numpy", "scipy"}
