"""Processes that work for another one."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager


def leave_with_parent(grace_s: float = 0.0) -> None:
    """End this process as soon as the one that started it has ended, however that happened.

    Args:
        grace_s: seconds to tidy up in, after a SIGTERM.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        if grace_s:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(grace_s)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextmanager
def blocked(*signals: signal.Signals) -> Iterator[None]:
    """Processes that are started inside do not get these signals: the one that starts them decides when they stop.

    Windows cannot block signals. Nothing happens there.
    """
    if not hasattr(signal, 'pthread_sigmask'):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
