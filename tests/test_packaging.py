"""The wheel holds every module and works without the checkout; the lock agrees with the project."""

import ast
import itertools
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
ROOMS = ("frontend", "backend", "tools")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NOT_INSTALLED = {".sh"}
"""`tools/setup.sh` sets a checkout up; whoever has the wheel is past that."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Build from a copy, as the build leaves its own folders behind."""
    source, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for room in ROOMS:
        shutil.copytree(
            ROOT / room, source / room, ignore=shutil.ignore_patterns("__pycache__", ".*")
        )
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(out)!r})"
    done = subprocess.run(
        [sys.executable, "-c", build], cwd=source, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    (built,) = out.glob("*.whl")
    return built


def members(wheel):
    with zipfile.ZipFile(wheel) as archive:
        return {name for name in archive.namelist() if not name.endswith("/")}


def test_every_file_of_the_rooms_is_in_the_wheel(wheel):
    expected = {
        f"groundfuse/{path.relative_to(ROOT)}"
        for room in ROOMS
        for path in (ROOT / room).rglob("*")
        if path.is_file()
        and path.suffix not in NOT_INSTALLED
        and not any(part == "__pycache__" or part.startswith(".") for part in path.parts[-2:])
    }
    assert len(expected) > 30
    installed = {name for name in members(wheel) if ".dist-info/" not in name}
    assert installed == expected


def test_the_wheel_says_what_it_is(wheel):
    assert wheel.name == f"groundfuse-{PROJECT['version']}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        info = f"groundfuse-{PROJECT['version']}.dist-info"
        metadata = archive.read(f"{info}/METADATA").decode()
        commands = archive.read(f"{info}/entry_points.txt").decode()
    for name in ("fuse_team", "fuse_graphs", "simulate_team"):
        assert f"{name.replace('_', '-')} = groundfuse.tools.installed:{name}\n" in commands
    assert f"{info}/licenses/LICENSE" in members(wheel)
    assert "License-Expression: Apache-2.0" in metadata
    for line in PROJECT["dependencies"]:
        name = Requirement(line).name
        assert re.search(rf"^Requires-Dist: {name}\b", metadata, re.MULTILINE), name


def test_every_module_imports_from_the_wheel_alone(wheel, tmp_path):
    """Without the editable install: -S leaves site's hooks out, so only the wheel can answer."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
    modules = [
        name.removesuffix(".py").replace("/", ".")
        for name in sorted(members(wheel))
        if name.endswith(".py") and not name.endswith("__init__.py")
    ]
    paths = [str(tmp_path), sysconfig.get_path("purelib")]
    script = (
        f"import sys, importlib; sys.path[:0] = {paths!r}\n"
        f"for name in {modules!r}:\n"
        "    file = importlib.import_module(name).__file__\n"
        f"    assert file.startswith({str(tmp_path)!r}), file\n"
        "assert 'open3d' not in sys.modules\n"
        "print('all imported')\n"
    )
    done = subprocess.run(
        [sys.executable, "-S", "-c", script],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout == "all imported\n", done.stderr[-2000:]


MODULE_OF = {
    "opencv-python-headless": "cv2",
    "PyYAML": "yaml",
    "gtsam": "gtsam gtsam_unstable",
    "distributed": "distributed dask cloudpickle",
}


def test_every_import_is_declared():
    """What happens to be installed here need not be where the wheel goes."""
    extras = PROJECT["optional-dependencies"]
    runtime = (extra for name, extra in extras.items() if name not in {"test", "dev"})
    wanted = [*PROJECT["dependencies"], *itertools.chain.from_iterable(runtime)]
    names = [Requirement(line).name for line in wanted]
    declared = {module for name in names for module in MODULE_OF.get(name, name).split()}
    found = set()
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import):
                    found |= {alias.name.split(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom):
                    found.add((node.module or "").split(".")[0])
    assert found - declared - sys.stdlib_module_names - {"groundfuse"} == set()
    idle = [name for name in names if not found & set(MODULE_OF.get(name, name).split())]
    assert set(idle) <= {"open3d"}, "a dependency that nothing imports"


def locked():
    """Return the requirement lines of the lock, hashes left out."""
    text = (ROOT / "requirements.lock").read_text()
    return [
        Requirement(line) for line in re.findall(r"^(\S+==[^\\\n]+?) *\\?$", text, re.MULTILINE)
    ]


def test_the_lock_satisfies_the_project():
    wanted = [*PROJECT["dependencies"]]
    for extra in PROJECT["optional-dependencies"].values():
        wanted += extra
    pins = locked()
    for requirement in map(Requirement, wanted):
        own = [pin for pin in pins if pin.name.lower() == requirement.name.lower()]
        assert own, f"{requirement} is not in the lock"
        for pin in own:
            (version,) = (specifier.version for specifier in pin.specifier)
            assert requirement.specifier.contains(version), f"{requirement} but {pin}"
    (opencv,) = (pin for pin in pins if pin.name == "opencv-python-headless")
    assert str(opencv.specifier).startswith("==5.")


def test_the_lock_has_hashes_and_no_address():
    text = (ROOT / "requirements.lock").read_text()
    assert "://" not in text
    blocks = re.split(r"^(?=\S)", text, flags=re.MULTILINE)
    pinned = [block for block in blocks if "==" in block.split("\n")[0]]
    assert len(pinned) == len(locked())
    assert all("--hash=sha256:" in block for block in pinned)


def test_readme_has_the_two_lines_that_ci_and_newcomers_run():
    """One runs the main job, one the tests; `.ci/run` takes the latter out of README."""
    pattern = re.search(r"grep -E '([^']+)' README\.md", (ROOT / ".ci" / "run").read_text())
    assert pattern is not None
    lines = (ROOT / "README.md").read_text().splitlines()
    tests = [line for line in lines if re.search(pattern[1], line)]
    assert tests == ["sh tools/setup.sh && .venv/bin/python -m pytest"]
    job = "sh tools/setup.sh && .venv/bin/python tools/fuse_team.py --robots A B"
    assert sum(line == job for line in lines) == 1


def test_the_command_is_installed():
    assert find_spec("groundfuse.tools.fuse_team") is not None
    assert (Path(sysconfig.get_path("scripts")) / "fuse-team").exists()
