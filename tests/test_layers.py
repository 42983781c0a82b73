"""Imports point one way, files and functions stay small: checked on the source itself."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROOMS = ("frontend", "backend", "tools")
BORDER = {
    "groundfuse.backend.compiled",
    "groundfuse.backend.measurement",
    "groundfuse.backend.option_checks",
    "groundfuse.backend.ordering",
    "groundfuse.backend.reprojection",
    "groundfuse.backend.side_by_side",
}
FOREIGN = {
    "frontend": {"gtsam", "gtsam_unstable", "open3d", "tqdm", "joblib", "yaml"},
    "backend": {"cv2", "open3d", "tqdm", "joblib", "yaml"},
    "tools": set(),
}
"""What a room never imports; pictures belong to the one, graphs to the other, the user to tools."""
SELDOM = {"open3d"}
"""Imported inside of functions only: it takes seconds and may not be there."""
MAX_FILE_LINES = 250
MAX_FUNCTION_LINES = 40
"""Without docstrings and empty lines; of a function, its body."""
SOURCES = sorted(path for room in ROOMS for path in (ROOT / room).rglob("*.py"))


def name_of(path: Path) -> str:
    return f"{path.parent.name}/{path.stem}"


def imports(tree: ast.AST) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            module = node.module or ""
            found.add(module)
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


def faults(room: str, source: str) -> list[str]:
    tree = ast.parse(source)
    found = []
    for name in sorted(imports(tree)):
        top = name.split(".")[0]
        if top in FOREIGN[room]:
            found.append(f"{room} imports {name}")
        if top in ROOMS:
            found.append(f"{name} is imported without groundfuse in front")
        if name.startswith("groundfuse."):
            other = [*name.split("."), ""][1]
            border = any(name == module or name.startswith(f"{module}.") for module in BORDER)
            right = {
                "frontend": other == "frontend" or border or name == "groundfuse.backend",
                "backend": other == "backend",
                "tools": True,
            }
            if not right[room]:
                found.append(f"{room} imports {name}")
    top_level = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    if SELDOM & {name.split(".")[0] for name in imports(ast.Module(list(top_level), []))}:
        found.append("a seldom one is imported at the top")
    return found


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_imports_point_one_way(path):
    assert faults(path.parent.name, path.read_text()) == []


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_files_and_functions_are_small(path):
    text = path.read_text()
    tree = ast.parse(text)
    code = {number for number, line in enumerate(text.splitlines(), 1) if line.strip()}
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            code -= set(range(node.lineno, (node.end_lineno or 0) + 1))
    assert len(code) <= MAX_FILE_LINES
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            length = len(code & set(range(node.body[0].lineno, (node.end_lineno or 0) + 1)))
            assert length <= MAX_FUNCTION_LINES, f"{node.name} has {length} lines"


@pytest.mark.parametrize("room", ROOMS)
def test_the_rooms_themselves_hold_a_docstring_only(room):
    """So that importing one module never loads gtsam or OpenCV for another."""
    (only,) = ast.parse((ROOT / room / "__init__.py").read_text()).body
    assert isinstance(only, ast.Expr)
    assert not [path for path in (ROOT / room).rglob("*.py") if path.parent.name != room]


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("frontend", "import gtsam"),
        ("frontend", "from groundfuse.backend.team import fuse"),
        ("frontend", "from groundfuse.backend import team"),
        ("frontend", "def f():\n    import groundfuse.tools.files"),
        ("backend", "import cv2 as cv"),
        ("backend", "from groundfuse.frontend.camera import Camera"),
        ("backend", "from frontend.camera import Camera"),
        ("tools", "import open3d"),
        ("tools", "from open3d.pipelines import registration"),
    ],
)
def test_planted_faults_are_found(room, source):
    assert faults(room, source)


@pytest.mark.parametrize(
    ("room", "source"),
    [
        ("frontend", "from groundfuse.backend.measurement import Se2"),
        ("frontend", "from groundfuse.backend import measurement"),
        ("backend", "from groundfuse.backend.measurement import Se2"),
        ("tools", "def view():\n    import open3d"),
        ("tools", "import cv2, gtsam\nfrom groundfuse.frontend.camera import Camera"),
    ],
)
def test_right_imports_pass(room, source):
    assert faults(room, source) == []
