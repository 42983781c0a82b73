"""A cluster over real TCP: the same bits, whoever dies or joins; whoever is not fit is named."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from painted_team import QUICK, painted_pair

from groundfuse.tools import cluster_tasks
from groundfuse.tools.cluster_probe import probe
from groundfuse.tools.cluster_tasks import badge, difference, look_task, pair_task
from groundfuse.tools.errors import TeamError
from groundfuse.tools.front_end import run_front_end
from groundfuse.tools.fuse_team import RunOptions
from groundfuse.tools.packing import packed
from groundfuse.tools.settings import with_settings
from groundfuse.tools.store import Store
from groundfuse.tools.team_folder import read_team
from groundfuse.tools.workers import Threads

OPTIONS = with_settings(RunOptions(), QUICK).front_end
ROOT = Path(__file__).parents[1]


def run(workers, progress=lambda items, _total, _title: items):
    team = read_team(painted_pair(), ["A", "B"])
    stage = contextlib.nullcontext
    found = run_front_end(team, OPTIONS, workers, Store(), progress, lambda _: stage())
    return packed((found.edges, found.rejected, found.repetition, found.key))


class Machines:
    """A scheduler and workers, each a process of its own, that end with the test."""

    def __init__(self, folder):
        pytest.importorskip("distributed")
        self.folder, self.started = folder, []
        with socket.socket() as probe_socket:
            probe_socket.bind(("127.0.0.1", 0))
            port = probe_socket.getsockname()[1]
        self.address = f"tcp://127.0.0.1:{port}"
        where = ("--host", "127.0.0.1", "--port", str(port), "--no-dashboard")
        self.scheduler = self._start("scheduler", *where)
        self.workers = []

    def _start(self, *words, **environment):
        log = (self.folder / f"{len(self.started)}.log").open("w")
        process = subprocess.Popen(
            [sys.executable, "-m", "dask", *words],
            stdout=log,
            stderr=log,
            cwd=self.folder,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"} | environment,
        )
        log.close()
        self.started.append(process)
        return process

    def add_worker(self, **environment):
        words = ("worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        self.workers.append(self._start(*words, **environment))

    def await_scheduler(self, num_workers=0):
        from distributed import Client

        with Client(self.address, timeout=60, set_as_default=False) as client:
            if num_workers:
                client.wait_for_workers(num_workers, timeout=60)

    def close(self):
        for process in reversed(self.started):
            process.kill()
            process.wait()


@pytest.fixture
def machines(tmp_path):
    made = Machines(tmp_path)
    yield made
    made.close()


@pytest.fixture(scope="module")
def by_threads():
    return run(Threads(2))


def test_one_worker_is_killed_and_one_joins_midway(machines, by_threads):
    """Then all are killed, and at last the scheduler: one line each, and no waiting for ever."""
    from groundfuse.tools.cluster import Cluster

    for _ in range(2):
        machines.add_worker()
    machines.await_scheduler(2)
    shown = {}

    def progress(items, total, title):
        for number, item in enumerate(items):
            shown[title] = (number + 1, total)
            if (title, number) == ("features", 1):
                machines.add_worker()
            if (title, number) == ("pairs", 4):
                machines.workers[0].send_signal(signal.SIGKILL)
            yield item

    with Cluster(machines.address, num_threads=2, patience_s=3.0) as cluster:
        assert cluster.num_threads == 2
        assert run(cluster, progress) == by_threads
        assert shown == {"features": (7, 7), "pairs": (21, 21)}

        def alone(items, _total, _title):
            for item in items:
                for worker in machines.workers:
                    worker.kill()
                yield item

        with pytest.raises(TeamError) as caught:
            run(cluster, alone)
        line = "no worker for 3 s; what was found is stored, run again to go on"
        assert str(caught.value) == f"{machines.address}: {line}"
        machines.scheduler.kill()
        with pytest.raises(TeamError) as caught:
            run(cluster)
        line = "the scheduler is lost; what was found is stored, run again"
        assert str(caught.value) == f"{machines.address}: {line}"


def command(address, out):
    """Run the command on a cluster; the line that it refuses with."""
    words = ["--team", str(painted_pair()), "--out", str(out), "--quiet", "--scheduler", address]
    done = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "fuse_team.py"), *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 2, done.stderr
    (line,) = done.stderr.splitlines()
    return line.removeprefix("fuse_team: ")


def test_machines_that_are_not_fit_are_named(machines, tmp_path):
    """Without a worker; then with one that can't import groundfuse."""
    from groundfuse.tools.cluster import Cluster

    machines.await_scheduler()
    with pytest.raises(TeamError, match=r"^tcp://.*: the scheduler has no workers$"):
        Cluster(machines.address)
    other = tmp_path / "other" / "groundfuse"
    other.mkdir(parents=True)
    (other / "__init__.py").write_text("raise ImportError('a broken package')")
    machines.add_worker(PYTHONPATH=str(other.parent))
    machines.await_scheduler(1)
    line = command(machines.address, tmp_path / "out")
    assert line.startswith(f"{machines.address}: worker tcp://127.0.0.1:")
    assert line.endswith(" cannot import groundfuse: ImportError: a broken package")


def test_where_no_scheduler_answers(monkeypatch):
    pytest.importorskip("distributed")
    from groundfuse.tools import cluster_check

    monkeypatch.setattr(cluster_check, "CONNECT_S", 0.5)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))  # and doesn't listen
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        begin = time.monotonic()
        with pytest.raises(TeamError) as caught:
            cluster_check.connected(address)
    assert str(caught.value) == f"{address}: no scheduler answers"
    assert time.monotonic() - begin < 30.0


@pytest.mark.parametrize("address", ["localhost", "tcp://localhost", "http://x:80", "tcp://:x"])
def test_what_is_no_address(address):
    from groundfuse.tools.cluster_check import connected

    with pytest.raises(TeamError) as caught:
        connected(address)
    assert str(caught.value) == f"--scheduler {address}: needed tcp://HOST:PORT"


def test_without_the_package_it_says_how_to_get_it(monkeypatch):
    from groundfuse.tools.cluster_check import connected

    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(TeamError, match=r"pip install 'groundfuse\[cluster\]'$"):
        connected("tcp://localhost:1")


# Badges


def test_a_badge_tells_what_differs_the_plainest_first():
    ours = badge()
    assert difference(ours, dict(ours)) is None
    assert difference(ours, {**ours, "host": "far away"}) is None
    other = {**ours, "arithmetic": "x"}
    assert difference(ours, other).startswith("computes otherwise than this machine")
    other["code"] = "x"
    assert difference(ours, other) == "has another groundfuse than this machine"
    other["numpy"] = "1.0"
    assert difference(ours, other) == f"has numpy 1.0, this machine {ours['numpy']}"
    assert difference(ours, {}) == f"has python None, this machine {ours['python']}"


def test_the_probe_gives_the_badge_or_the_reason(monkeypatch):
    found = probe()
    assert {name: found[name] for name in badge()} == badge()
    monkeypatch.setitem(sys.modules, "groundfuse.tools.cluster_tasks", None)
    assert probe()["failed"].startswith("ModuleNotFoundError: import of groundfuse.tools.cluster")


def test_a_worker_that_joins_with_other_code_refuses():
    """It was not there to be asked beforehand."""
    other = {**badge(), "code": "x"}
    for work in (
        lambda: look_task(other, b"", None, OPTIONS),
        lambda: pair_task(other, b"", b"", None, OPTIONS),
    ):
        with pytest.raises(TeamError, match=r"^a worker that joined on \S+ has another groundfuse"):
            work()


def test_the_arithmetic_is_that_of_what_is_computed(monkeypatch):
    before = cluster_tasks._arithmetic()
    assert cluster_tasks._arithmetic() == before
    monkeypatch.setattr(cluster_tasks.np, "exp", lambda x: x)
    assert cluster_tasks._arithmetic() != before


def other_versions(**changed):
    packages = {"python": "3.11.7.final.0", "distributed": "2026.8.0", "cloudpickle": "3.1"}
    return {"packages": {**packages, **changed}}


class Told:
    """A client that only tells of versions."""

    def __init__(self, **changed):
        self.found = {
            "client": other_versions(),
            "scheduler": other_versions(),
            "workers": {"tcp://w:1": other_versions(), "tcp://w:2": other_versions(**changed)},
        }

    def get_versions(self, *, check):
        assert check is False
        return self.found


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"python": "3.12.1.final.0"}, "has python 3.12, this machine 3.11"),
        ({"distributed": "2025.1"}, "has distributed 2025.1, this machine 2026.8.0"),
        ({"cloudpickle": None}, "has cloudpickle None, this machine 3.1"),
    ],
)
def test_another_base_is_refused_before_code_is_sent(changed, why):
    from groundfuse.tools.cluster_check import refusal_of

    assert refusal_of(Told(**changed), badge()) == f"worker tcp://w:2 {why}"
