"""What is made when it is needed and forgotten when others need the room."""

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from typing import Generic, Protocol, TypeVar


class Sized(Protocol):
    """Something that knows how much memory it takes."""

    @property
    def nbytes(self) -> int:
        """Memory held."""
        ...


Thing = TypeVar("Thing", bound=Sized)


class Cache(Generic[Thing]):
    """The most recently used things, within a budget; safe with threads.

    A thing that two threads ask for at once is made once.
    """

    def __init__(self, make: Callable[[int], Thing], budget_bytes: int) -> None:
        """Take what makes each thing from its number; nothing is made yet."""
        self._make = make
        self._budget_bytes = budget_bytes
        self._held: OrderedDict[int, Future[Thing]] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def get(self, number: int) -> Thing:
        """Return a thing, made now if it isn't held; what its making raises comes through."""
        mine: Future[Thing] = Future()
        with self._lock:
            found = self._held.setdefault(number, mine)
            self._held.move_to_end(number)
        return self._made(number, mine) if found is mine else found.result()

    def _made(self, number: int, future: "Future[Thing]") -> Thing:
        try:
            thing = self._make(number)
        except BaseException as error:
            with self._lock:
                del self._held[number]
            future.set_exception(error)
            raise
        future.set_result(thing)
        with self._lock:
            self._bytes += thing.nbytes
            self._forget()
        return thing

    def _forget(self) -> None:
        """Let the longest unused go, but not the last of all nor what is still being made."""
        for number, future in list(self._held.items()):
            if self._bytes <= self._budget_bytes or len(self._held) == 1:
                return
            if future.done():
                del self._held[number]
                self._bytes -= future.result().nbytes
