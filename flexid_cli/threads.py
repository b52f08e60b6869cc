"""Independent work on all processors, where it is done in code that lets go of the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from queue import Empty, SimpleQueue
from threading import Thread
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
# An interrupt that comes just before a wait begins does not end it: it is seen after this time.
LONGEST_WAIT_S = 0.2


def side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Results of ``function`` in the order of the items; of errors the first item's is raised.

    An interrupt does not wait for the work: its threads die with the process.
    """
    work = list(items)
    workers = min(len(work), processors())
    if workers < 2:
        return [function(item) for item in work]
    waiting: SimpleQueue[int] = SimpleQueue()
    for k in range(len(work)):
        waiting.put(k)
    results: dict[int, Result] = {}
    errors: dict[int, BaseException] = {}

    def run() -> None:
        while not errors:
            try:
                k = waiting.get_nowait()
            except Empty:
                return
            try:
                results[k] = function(work[k])
            except BaseException as error:  # noqa: BLE001 - raised by the caller's thread
                errors[k] = error

    threads = [Thread(target=run, daemon=True) for _ in range(workers)]
    for thread in threads:
        thread.start()
    for thread in threads:
        while thread.is_alive():
            thread.join(LONGEST_WAIT_S)
    if errors:
        raise errors[min(errors)]
    return [results[k] for k in range(len(work))]


def processors() -> int:
    """Processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1
