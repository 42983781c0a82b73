"""What was seen in the pictures, at hand when a pair needs it, and never all of it in memory."""

import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping

from groundfuse.backend.measurement import FrameId
from groundfuse.frontend.features import Features
from groundfuse.tools.frame_look import Looked, LookJob, look_done, picture_of
from groundfuse.tools.front_end_options import FrontEndOptions
from groundfuse.tools.packing import unpacked
from groundfuse.tools.store import Store

KIND = "look"
MOST_BYTES = 300_000_000


class Shelf:
    """Looks by their keys: the latest in memory, all in the store.

    Args:
        store: where they are.
        jobs: the orders they came from, to look again where an entry is damaged.
        options: those of the orders.
        most_bytes: packed size of what is held in memory.
    """

    def __init__(
        self,
        store: Store,
        jobs: Mapping[bytes, LookJob],
        options: FrontEndOptions,
        most_bytes: int = MOST_BYTES,
    ) -> None:
        self._store = store
        self._jobs = jobs
        self._options = options
        self._most_bytes = most_bytes
        self._held: OrderedDict[bytes, tuple[Looked, int]] = OrderedDict()
        self._num_bytes = 0
        self._guard = threading.Lock()

    @property
    def num_bytes(self) -> int:
        """Packed size of what is in memory."""
        return self._num_bytes

    def looked(self, key: bytes) -> Looked:
        """Return what was seen; looked at again where the store's entry is damaged."""
        with self._guard:
            if key in self._held:
                self._held.move_to_end(key)
                return self._held[key][0]
        data = self.packed(key)
        return self._hold(key, data)

    def packed(self, key: bytes) -> bytes:
        """Return what was seen as bytes."""
        data = self._store.read(key)
        if data is None:
            job = self._jobs[key]
            data = look_done(picture_of(job), job, self._options)
            self._store.save(key, KIND, str(job.frame.id), data)
        return data

    def put(self, job: LookJob, data: bytes) -> Looked:
        """Keep what was seen just now."""
        self._store.save(job.key, KIND, str(job.frame.id), data)
        return self._hold(job.key, data)

    def _hold(self, key: bytes, data: bytes) -> Looked:
        found: Looked = unpacked(data)
        with self._guard:
            if key not in self._held:
                self._num_bytes += len(data)
            self._held[key] = (found, len(data))
            while self._num_bytes > self._most_bytes and len(self._held) > 1:
                _, (_, gone) = self._held.popitem(last=False)
                self._num_bytes -= gone
        return found


class AllFeatures(Mapping[FrameId, Features]):
    """The features of every frame, each fetched when it is asked for."""

    def __init__(self, shelf: Shelf, keys: Mapping[FrameId, bytes]) -> None:
        self._shelf = shelf
        self._keys = keys

    def __getitem__(self, frame: FrameId) -> Features:
        return self._shelf.looked(self._keys[frame]).features

    def __iter__(self) -> Iterator[FrameId]:
        return iter(self._keys)

    def __len__(self) -> int:
        return len(self._keys)
