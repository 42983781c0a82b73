"""The work of a cluster's workers: bytes in, bytes out, on machines that compute as ours does."""

import functools
import platform

import cv2
import numpy as np

from groundfuse.tools.code_version import code_of, libraries
from groundfuse.tools.errors import TeamError
from groundfuse.tools.frame_look import Looked, LookJob, look_done
from groundfuse.tools.front_end_options import FrontEndOptions
from groundfuse.tools.packing import key_of, unpacked
from groundfuse.tools.pair_verdict import PairJob, pair_done


@functools.cache
def badge() -> dict[str, str]:
    """Return what must be equal wherever a result is computed: libraries, code, arithmetic."""
    cv2.setNumThreads(1)
    code = code_of("groundfuse.tools.cluster_tasks", rooms=("frontend", "backend", "tools"))
    return {**libraries(), "code": code, "arithmetic": _arithmetic()}


def difference(ours: dict[str, str], theirs: dict[str, str]) -> str | None:
    """Return in words what tells two badges apart; None where they are equal."""
    for name in sorted(ours, key=lambda name: (name == "arithmetic", name == "code")):
        here, there = ours[name], theirs.get(name)
        if here == there:
            continue
        if name == "code":
            return "has another groundfuse than this machine"
        if name == "arithmetic":
            return "computes otherwise than this machine (another kind of processor?)"
        return f"has {name} {there}, this machine {here}"
    return None


def look_task(wanted: dict[str, str], picture: bytes, job: LookJob, how: FrontEndOptions) -> bytes:
    """Look at a picture.

    Raises:
        TeamError: this worker is not what the run began with, or the picture is none.
    """
    _check(wanted)
    return look_done(picture, job, how)


def pair_task(
    wanted: dict[str, str], seen_a: bytes, seen_b: bytes, job: PairJob, how: FrontEndOptions
) -> bytes:
    """Compare a pair.

    Raises:
        TeamError: this worker is not what the run began with.
    """
    _check(wanted)
    a: Looked = unpacked(seen_a)
    b: Looked = unpacked(seen_b)
    return pair_done(job, a, b, how)


def hold_task(data: bytes) -> bytes:
    """Keep what was seen where pairs that need it are compared."""
    return data


def _check(wanted: dict[str, str]) -> None:
    """Refuse to work where the results would not be the same (TeamError)."""
    why = difference(wanted, badge())
    if why is not None:
        raise TeamError(f"a worker that joined on {platform.node()} {why}")


def _arithmetic() -> str:
    """Return a digest of some of everything that features and fits are made of."""
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 256, (96, 96), dtype=np.uint8), (0, 0), 1.5)
    keypoints, rows = cv2.SIFT.create().detectAndCompute(picture, None)
    square = rng.normal(size=(40, 40))
    short = square.astype(np.float32)
    u, v = (np.asarray(90.0 * rng.random((50, 50)), dtype=np.float32) for _ in range(2))
    return key_of(
        [k.pt for k in keypoints],
        rows,
        cv2.remap(picture.astype(np.float32), u, v, cv2.INTER_LINEAR),
        short @ short.T,
        np.linalg.solve(square, square[0]),
        *np.linalg.eigh(square @ square.T),
        np.exp(np.sin(square)).sum(),
        np.arctan2(square, square.T),
    ).hex()
