"""Every transform is named `a_from_b`, and inner names cancel: checked on the source itself.

`a_from_b @ c_from_d` needs b = c. An assignment, a keyword and the return of a function must bear
the name of what they get; `.inverse()` and `inv(...)` swap. Qualifiers go in front of a name
(`guess_map_from_base`). Single letters are frames of a pair: they may stand for any named frame.
"""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAME = re.compile(r"_?(?P<to>\w+?)_from_(?P<source>\w+)")
Frames = tuple[str, str] | None


def of_name(name: str) -> Frames:
    match = NAME.fullmatch(name)
    return None if match is None else (match["to"], match["source"])


def same(one: str, other: str) -> bool:
    """Whether two words name one frame, but for qualifiers in front."""
    if (len(one) == 1) != (len(other) == 1):
        return True
    return one == other or one.endswith(f"_{other}") or other.endswith(f"_{one}")


class Checker(ast.NodeVisitor):
    def __init__(self) -> None:
        self.faults: list[str] = []
        self.functions: list[Frames] = []

    def frames(self, node: ast.AST | None) -> Frames:  # noqa: PLR0911 (a table)
        match node:
            case ast.Name(id=name) | ast.Attribute(attr=name):
                return of_name(name)
            case ast.Subscript(value=value):
                return self.frames(value)
            case ast.Call(func=ast.Attribute(value=value, attr="inverse"), args=[]):
                return self.swapped(value)
            case ast.Call(func=ast.Attribute(attr="inv") | ast.Name(id="inv"), args=[value]):
                return self.swapped(value)
            case ast.Call(func=function):
                return self.frames(function)
            case ast.BinOp(left=left, op=ast.MatMult(), right=right):
                first, second = self.frames(left), self.frames(right)
                return None if first is None or second is None else (first[0], second[1])
        return None

    def swapped(self, node: ast.AST) -> Frames:
        found = self.frames(node)
        return None if found is None else (found[1], found[0])

    def need(self, node: ast.AST, wanted: Frames, value: ast.AST | None) -> None:
        got = self.frames(value)
        if wanted and got and not (same(wanted[0], got[0]) and same(wanted[1], got[1])):
            line = getattr(node, "lineno", 0)
            self.faults.append(f"{line}: {'_from_'.join(wanted)} gets {'_from_'.join(got)}")

    def visit_BinOp(self, node: ast.BinOp) -> None:
        if isinstance(node.op, ast.MatMult):
            left, right = self.frames(node.left), self.frames(node.right)
            if left and right and not same(left[1], right[0]):
                names = f"{'_from_'.join(left)} @ {'_from_'.join(right)}"
                self.faults.append(f"{node.lineno}: {names}")
        self.generic_visit(node)

    def visit_Assign(self, node: ast.Assign) -> None:
        for target in node.targets:
            pairs = [(target, node.value)]
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(target.elts, node.value.elts, strict=False))
            for name, value in pairs:
                self.need(node, self.frames(name), value)
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self.need(node, self.frames(node.target), node.value)
        self.generic_visit(node)

    def visit_keyword(self, node: ast.keyword) -> None:
        self.need(node.value, of_name(node.arg or ""), node.value)
        self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        self.functions.append(of_name(node.name))
        self.generic_visit(node)
        self.functions.pop()

    def visit_Return(self, node: ast.Return) -> None:
        self.need(node, self.functions[-1], node.value)
        self.generic_visit(node)


def faults(source: str) -> list[str]:
    checker = Checker()
    checker.visit(ast.parse(source))
    return checker.faults


SOURCES = [
    path for room in ("frontend", "backend", "tools") for path in (ROOT / room).rglob("*.py")
]


@pytest.mark.parametrize(
    "path", sorted(SOURCES), ids=lambda path: f"{path.parent.name}/{path.stem}"
)
def test_inner_names_cancel(path):
    assert faults(path.read_text()) == []


@pytest.mark.parametrize(
    "source",
    [
        "team_from_base @ team_from_map",
        "x = team_from_map @ base_from_map",
        "team_from_base = map_from_base",
        "map_from_base = base_from_map @ map_from_base",
        "map_from_base = map_from_base.inverse()",
        "map_from_base = np.linalg.inv(map_from_base)",
        "f(team_from_base=map_from_base)",
        "def px_from_floor(k):\n    return ray_from_floor(k)",
        "team_from_map[robot] @ team_from_base[frame]",
        "a_from_b @ a_from_b",
        "self.team_from_map: Se2 = edge.team_from_base",
        "x, map_from_base = y, team_from_base",
        "world_from_map @ guess_base_from_map",
        "base_from_foot_a @ foot_b_from_foot_a",
    ],
)
def test_planted_faults_are_found(source):
    assert faults(source)


@pytest.mark.parametrize(
    "source",
    [
        "team_from_base = team_from_map @ map_from_base",
        "base_from_map = map_from_base.inverse()",
        "world_from_base = world_from_map @ guess_map_from_base",
        "guess_map_from_base = map_from_base",
        "team_from_base[edge.b] = team_from_base[edge.a] @ edge.a_from_b",
        "a_from_c = a_from_b @ b_from_c",
        "x = base_from_foot_a @ foot_a_from_foot_b @ base_from_foot_b.inverse()",
        "points = pixels @ px_from_floor.T",
        "def px_from_floor(k):\n    return px_from_ray(k) @ ray_from_floor(k)",
        "f(team_from_base=team_from_map @ map_from_base)",
    ],
)
def test_right_names_pass(source):
    assert faults(source) == []
