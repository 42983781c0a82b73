"""Killed without warning at any moment, the next run goes on and ends with the same bytes."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from painted_team import QUICK, painted_pair

from groundfuse.tools import fuse_team

ROOT = Path(__file__).parents[1]
SETTINGS = [word for setting in QUICK for word in ("--set", setting)]
TIMED = {"report.txt", "store.sqlite", "store.sqlite.lock"}
BY_FILE = [str(ROOT / "tools" / "fuse_team.py")]
INSTALLED = [
    "-c",
    "from groundfuse.tools import installed; raise SystemExit(installed.fuse_team())",
]
"""What the installed command does."""


def start(out, *more, preexec_fn=None, way=BY_FILE):
    command = [sys.executable, *way, "--team", str(painted_pair()), "--out", str(out)]
    command += ["--quiet", "--no-mosaic", *SETTINGS, *more]
    both = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.Popen(command, **both, text=True, preexec_fn=preexec_fn)  # noqa: PLW1509


def finish(process):
    text, _ = process.communicate(timeout=120)
    assert process.returncode == 0, text
    return text


def content(out):
    return {p.name: p.read_bytes() for p in out.iterdir() if p.name not in TIMED}


def stored_bytes(out):
    """How much the store has taken in so far."""
    files = (out / f"store.sqlite{suffix}" for suffix in ("", "-wal"))
    return sum(path.stat().st_size for path in files if path.exists())


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    finish(start(out))
    return content(out), stored_bytes(out)


def test_killed_again_and_again_it_ends_the_same(undisturbed, tmp_path):
    """Early and late, while it looks at pictures and while it compares pairs."""
    wanted, full = undisturbed
    rng, out, killed = np.random.default_rng(4), tmp_path / "out", 0
    for share in (0.1, 0.5, 0.8):
        process, enough = start(out), full * (share + 0.1 * rng.random())
        while process.poll() is None and stored_bytes(out) < enough:
            time.sleep(0.002)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        killed += process.returncode == -signal.SIGKILL
    assert killed >= 2
    (out / ".0123456789abcdef.part").write_text("half")  # as a kill while a file is written leaves
    text = finish(start(out))
    assert "team in 1 component" in text
    assert "\nfrom the store: " in text
    assert content(out) == wanted


def heeding_ctrl_c():
    """A process started in the background may have been told to ignore it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.mark.parametrize(("share", "way"), [(0.15, INSTALLED), (0.6, BY_FILE)])
def test_interrupted_it_says_so_in_one_line_and_goes_on(undisturbed, tmp_path, share, way):
    """Ctrl-C while it looks at pictures, and while it compares pairs."""
    wanted, full = undisturbed
    out = tmp_path / "out"
    process = start(out, preexec_fn=heeding_ctrl_c, way=way)
    while process.poll() is None and stored_bytes(out) < share * full:
        time.sleep(0.002)
    process.send_signal(signal.SIGINT)
    text, _ = process.communicate(timeout=60)
    store = out / "store.sqlite"
    assert text == (
        f"fuse_team: interrupted; what was finished is in {store}, the same command goes on "
        "from there\n"
    )
    assert process.returncode == 130
    assert not (out / "store.sqlite-wal").exists()  # closed, not left
    assert "\nfrom the store: " in finish(start(out))
    assert content(out) == wanted


@pytest.mark.parametrize("way", [BY_FILE, INSTALLED], ids=["file", "installed"])
def test_interrupted_amid_its_imports_it_ends_without_a_word(tmp_path, monkeypatch, way):
    stand_in = "import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(30)\n"
    (tmp_path / "cv2.py").write_text(stand_in)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    process = start(tmp_path / "out", preexec_fn=heeding_ctrl_c, way=way)
    text, _ = process.communicate(timeout=25)
    assert (process.returncode, text) == (-signal.SIGINT, "")


def test_what_an_interrupted_run_leaves_is_told(tmp_path, capsys, monkeypatch):
    def stopped(*_, **__):
        raise KeyboardInterrupt

    words = ["--team", str(painted_pair()), "--out", str(tmp_path), "--fresh", "--quiet"]
    monkeypatch.setattr(fuse_team, "fuse_robots", stopped)
    assert fuse_team.main(words) == 130
    kept = f"what was finished is in {tmp_path / 'store.sqlite'}, "
    again = "the same command without --fresh goes on from there"
    assert capsys.readouterr().err == f"fuse_team: interrupted; {kept}{again}\n"
    monkeypatch.setattr(fuse_team, "read_team", stopped)
    assert fuse_team.main([*words, "--store", str(tmp_path / "none")]) == 130
    assert capsys.readouterr().err == "fuse_team: interrupted\n"


def test_a_second_run_at_the_same_time_is_told_so(undisturbed, tmp_path):  # noqa: ARG001
    out = tmp_path / "out"
    first = start(out)
    try:
        while not (out / "options.json").exists():
            assert first.poll() is None
            time.sleep(0.02)
        second = start(out)
        text, _ = second.communicate(timeout=60)
        if first.poll() is None:  # else it was through before the second began
            assert second.returncode == 2
            holder = f"store is held by process {first.pid} on {os.uname().nodename}\n"
            assert text == f"fuse_team: {out}/store.sqlite: {holder}"
        first.communicate(timeout=60)
        assert first.returncode == 0
    finally:
        first.kill()
        first.communicate()
