"""The parts of a team's mosaics in its store: one entry for each place, the latest."""

import threading
from collections.abc import Iterator, Sequence
from typing import Any

from groundfuse.tools.code_version import code_of
from groundfuse.tools.packing import key_of, packed
from groundfuse.tools.store import Store

KIND = "mosaic part"


class MosaicMemory:
    """Parts of the mosaics of one run; see `frontend.kept_parts.Memory`.

    Args:
        store: of the team.
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        # How a picture is read counts too; what other code rendered is not found.
        self._code = code_of("groundfuse.frontend.mosaic_stream", "groundfuse.tools.image_file")
        self._used: set[bytes] = set()
        self._guard = threading.Lock()

    def of(self, mosaic: str) -> "PartMemory":
        """Return the parts of one of the mosaics."""
        return PartMemory(self, mosaic)

    def load(self, mosaic: str, name: str) -> Any:  # noqa: ANN401
        """Return a part of a mosaic, None where there is none."""
        return self._store.load(self._key(mosaic, name))

    def load_all(self, mosaic: str, names: Sequence[str]) -> Iterator[Any]:
        """Yield many parts of a mosaic, as `load` returns them."""
        return self._store.load_all([self._key(mosaic, name) for name in names])

    def save(self, mosaic: str, name: str, part: object) -> None:
        """Keep a part in place of what had its name (DataError: the disk is full, or fails)."""
        self._store.save(self._key(mosaic, name), KIND, f"{mosaic}: {name}", packed(part))

    def forget_others(self) -> None:
        """Forget all parts that were neither loaded nor saved: no mosaic has them any more."""
        self._store.forget_others(KIND, self._used)

    def _key(self, mosaic: str, name: str) -> bytes:
        key = key_of(KIND, self._code, mosaic, name)
        with self._guard:
            self._used.add(key)
        return key


class PartMemory:
    """The parts of one mosaic; see `MosaicMemory`."""

    def __init__(self, every: MosaicMemory, mosaic: str) -> None:
        self._every, self._mosaic = every, mosaic

    def load(self, name: str) -> Any:  # noqa: ANN401
        """Return a part; None where there is none."""
        return self._every.load(self._mosaic, name)

    def load_all(self, names: Sequence[str]) -> Iterator[Any]:
        """Yield many parts."""
        return self._every.load_all(self._mosaic, names)

    def save(self, name: str, part: object) -> None:
        """Keep a part."""
        self._every.save(self._mosaic, name, part)
