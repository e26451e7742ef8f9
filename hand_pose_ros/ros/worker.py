"""One image is processed while the newest one waits. There is never a queue."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar('T')


class NewestWorker(Generic[T]):
    """A thread that passes the newest item to `handle`. Older items that still wait are dropped.

    A queue would only make answers late: when an old image is processed, the hand has already moved on.
    """

    def __init__(self, handle: Callable[[T], None]) -> None:
        self._handle = handle
        self._slot: T | None = None
        self._running = True
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name='estimator', daemon=True)
        self._thread.start()

    def put(self, item: T) -> bool:
        """Set the item to be handled next. True if it replaced one that was still waiting, which is dropped."""
        with self._changed:
            dropped, self._slot = self._slot is not None, item
            self._changed.notify()
        return dropped

    def stop(self) -> None:
        """Finish the current item, forget the one that waits, and end the thread."""
        with self._changed:
            self._running = False
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._slot is not None or not self._running)
                if not self._running:
                    return
                item, self._slot = self._slot, None
            assert item is not None
            self._handle(item)
