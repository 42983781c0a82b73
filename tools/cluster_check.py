"""Before any work goes to a cluster: does its scheduler answer, and are its machines fit for it?

A worker, or a scheduler, that cannot import the package would let a run wait for ever without a
word; one with other versions would give other results. So each is asked, and a refusal says who
and why.
"""

import logging
import re
from typing import Any

from groundfuse.tools.cluster_tasks import difference
from groundfuse.tools.errors import TeamError

CONNECT_S = 10.0
SCHEMES = r"(tcp|tls|ucx|ws|wss)://\S+:\d+"


def connected(address: str) -> Any:  # noqa: ANN401
    """Return a client of the scheduler at an address.

    Raises:
        TeamError: there is no such package, no such address, or no answer.
    """
    if not re.fullmatch(SCHEMES, address):
        raise TeamError(f"--scheduler {address}: needed tcp://HOST:PORT")
    try:
        import dask.config  # noqa: PLC0415
        import distributed  # noqa: PLC0415
    except ImportError as error:
        raise TeamError(
            "--scheduler needs the package distributed: pip install 'groundfuse[cluster]'"
        ) from error
    # Whatever matters is told in our own words.
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    dask.config.set({"distributed.admin.large-graph-warning-threshold": "1 GiB"})
    try:
        return distributed.Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:  # TimeoutError is an OSError
        raise TeamError(f"{address}: no scheduler answers") from error


def refusal_of(client: Any, ours: dict[str, str]) -> str | None:  # noqa: ANN401
    """Return why the cluster is not fit; None where it is.

    Args:
        client: connected.
        ours: this machine's badge.
    """
    found = client.get_versions(check=False)
    if not found["workers"]:
        return "the scheduler has no workers"
    machines = {"the scheduler": found["scheduler"]}
    machines |= {f"worker {name}": versions for name, versions in found["workers"].items()}
    for name, versions in machines.items():  # before anything of ours is sent there
        why = _other_base(found["client"], versions)
        if why is not None:
            return f"{name} {why}"
    badges = {"the scheduler": _probed(client.run_on_scheduler)}
    badges |= {f"worker {name}": theirs for name, theirs in _probed(client.run).items()}
    for name, theirs in badges.items():
        if "failed" in theirs:
            return f"{name} cannot import groundfuse: {theirs['failed']}"
        # The scheduler computes nothing, so its arithmetic is its own.
        bare = {k: v for k, v in ours.items() if name != "the scheduler" or k != "arithmetic"}
        why = difference(bare, theirs)
        if why is not None:
            return f"{name} {why}"
    return None


def _other_base(ours: Any, theirs: Any) -> str | None:  # noqa: ANN401
    """Return what keeps code from being sent at all: another Python, or another Dask."""
    for name in ("python", "distributed", "cloudpickle"):
        here, there = ours["packages"][name], (theirs or {}).get("packages", {}).get(name)
        if name == "python" and there is not None:
            here, there = (".".join(text.split(".")[:2]) for text in (here, there))
        if here != there:
            return f"has {name} {there}, this machine {here}"
    return None


def _probed(run: Any) -> dict[str, Any]:  # noqa: ANN401
    """Run the probe somewhere, sent as code instead of as a name."""
    import cloudpickle  # noqa: PLC0415

    from groundfuse.tools import cluster_probe  # noqa: PLC0415

    cloudpickle.register_pickle_by_value(cluster_probe)
    try:
        answers: dict[str, Any] = run(cluster_probe.probe)
    finally:
        cloudpickle.unregister_pickle_by_value(cluster_probe)
    return answers
