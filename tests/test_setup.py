"""The set-up script, with stand-ins for Python, apt-get and the system's list of libraries."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "tools" / "setup.sh"
LIBRARIES = (
    "libEGL.so.1",
    "libGL.so.1",
    "libX11.so.6",
    "libusb-1.0.so.0",
    "libudev.so.1",
    "libidn2.so.0",
)
PYTHON = """#!/bin/sh
echo "python $*" >>"$LOG"
case "$1 $2" in
  "- ") exit 0 ;;
  "-m venv") mkdir -p .venv/bin && cp "$0" .venv/bin/python ;;
  "-m pip") [ "$3" = "$FAIL" ] && exit 1 ;;
  "tools/fuse_team.py "*) [ "$FAIL" = fuse ] && echo "no floor" && exit 2 ;;
esac
exit 0
"""


@pytest.fixture
def machine(tmp_path):
    """A checkout and a PATH on which every program that changes the machine is a stand-in."""
    checkout, programs = tmp_path / "check out", tmp_path / "programs"
    (checkout / "tools").mkdir(parents=True)
    programs.mkdir()
    shutil.copy(SCRIPT, checkout / "tools")
    (checkout / "requirements.lock").write_text("numpy==2\n")
    (checkout / "pyproject.toml").write_text("[project]\n")
    found = "\n".join(f"\t{name} (libc6,x86-64) => /lib/{name}" for name in LIBRARIES)
    for name, text in {
        "python3": PYTHON,
        "apt-get": '#!/bin/sh\necho "apt-get $*" >>"$LOG"\n',
        "sudo": "#!/bin/sh\nexit 1\n",
        "id": "#!/bin/sh\necho 1000\n",
        "ldconfig": f"#!/bin/sh\ncat <<'END'\n{found}\nEND\n",
    }.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    return checkout, programs


def set_up(machine, **environment):
    """Run the script; return its code, what it said, and which programs it called."""
    checkout, programs = machine
    log = programs / "log"
    log.write_text("")
    path = f"{programs}:{os.environ['PATH']}"
    done = subprocess.run(
        ["sh", str(checkout / "tools" / "setup.sh")],
        env={"PATH": path, "LOG": str(log), **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stderr, log.read_text().splitlines()


PIP = "python -m pip install -q --disable-pip-version-check "


def test_it_installs_once_and_again_only_after_a_change(machine):
    code, _, calls = set_up(machine)
    assert code == 0
    assert f"{PIP}--require-hashes -r requirements.lock" in calls
    assert calls[-2] == f"{PIP}--no-deps --no-build-isolation -e ."
    assert calls[-1].startswith("python tools/fuse_team.py --robots A B --out /")
    assert set_up(machine) == (0, "", [])
    (machine[0] / "requirements.lock").write_text("numpy==3\n")
    code, _, calls = set_up(machine)
    assert code == 0
    assert "python -m venv --clear .venv" not in calls
    assert calls[-2] == f"{PIP}--no-deps --no-build-isolation -e ."


def test_a_moved_checkout_is_set_up_anew(machine):
    set_up(machine)
    moved = machine[0].rename(machine[0].parent / "elsewhere")
    assert set_up((moved, machine[1]))[2]


def test_a_failed_installation_is_tried_again(machine):
    code, said, _ = set_up(machine, FAIL="install")
    assert code != 0
    assert "done" not in said
    code, said, calls = set_up(machine)
    assert code == 0
    assert calls


def test_a_sample_that_cannot_be_fused_is_told_and_no_obstacle(machine):
    """It only compiles the inner loops beforehand; the folder it wrote to is gone."""
    code, said, calls = set_up(machine, FAIL="fuse")
    assert code == 0
    assert "setup: the sample could not be fused: no floor\n" in said
    assert said.endswith("setup: done\n")
    assert not Path(calls[-1].split()[-2]).exists()


def test_a_machine_without_a_fitting_python_is_told_so(machine):
    (machine[1] / "old").write_text("#!/bin/sh\n[ $1 = --version ] && echo Python 3.9.2\nexit 1\n")
    (machine[1] / "old").chmod(0o755)
    code, said, calls = set_up(machine, PYTHON="old")
    assert (code, calls) == (1, [])
    assert said == (
        "setup: needs Python 3.11, 3.12 or 3.13 with its venv module, found none "
        "(old: Python 3.9.2); on Debian: apt-get install python3-venv\n"
    )


def lose(machine, *libraries):
    path = machine[1] / "ldconfig"
    path.write_text(
        "".join(
            line
            for line in path.read_text().splitlines(keepends=True)
            if not any(name in line for name in libraries)
        )
    )


def test_missing_libraries_are_installed_where_that_is_allowed(machine):
    lose(machine, "libEGL", "libusb")
    (machine[1] / "id").write_text("#!/bin/sh\necho 0\n")
    code, said, calls = set_up(machine)
    assert code == 0
    assert "installing libegl1 libusb-1.0-0 for Open3D" in said
    wanted = "apt-get install -y --no-install-recommends libegl1 libusb-1.0-0 -qq"
    assert [call for call in calls if call.startswith("apt-get")] == ["apt-get update -qq", wanted]


def test_missing_libraries_are_named_where_it_is_not(machine):
    lose(machine, "libGL.so")
    code, said, calls = set_up(machine)
    assert code == 0
    assert not [call for call in calls if call.startswith("apt-get")]
    assert said.startswith(
        "setup: the 3D view (Open3D) needs libgl1; everything else works without. "
        "On Debian: sudo apt-get install -y --no-install-recommends libgl1\n"
    )
