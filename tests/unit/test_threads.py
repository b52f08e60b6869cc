"""Work side by side: the order of the items, and errors as without threads."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import pytest

from flexid_cli import threads
from flexid_cli.errors import DataError


@pytest.mark.parametrize("processors", [1, 2, 5])
def test_results_stand_in_the_order_of_the_items(monkeypatch: pytest.MonkeyPatch, processors: int):
    monkeypatch.setattr(threads, "processors", lambda: processors)
    assert threads.side_by_side(lambda x: x**2, range(9)) == [x**2 for x in range(9)]
    assert threads.side_by_side(lambda x: x, []) == []


def test_two_items_are_worked_on_at_the_same_time(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(threads, "processors", lambda: 2)
    both = threading.Barrier(2, timeout=10.0)
    assert sorted(threads.side_by_side(lambda _: both.wait(), "ab")) == [0, 1]


@pytest.mark.parametrize("processors", [1, 2])
def test_an_error_reaches_the_caller(monkeypatch: pytest.MonkeyPatch, processors: int):
    monkeypatch.setattr(threads, "processors", lambda: processors)

    def fail(x: int) -> int:
        raise DataError(f"item {x}", "cure")

    with pytest.raises(DataError, match="item 0"):
        threads.side_by_side(fail, [0, 1])


def test_an_interrupt_does_not_wait_for_the_work():
    """In a process of its own: work that would take a minute, interrupted from within."""
    program = (
        "import os, signal, threading, time\n"
        "from flexid_cli import threads\n"
        "threads.processors = lambda: 2\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored where a shell put the tests behind
        "threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()\n"
        "try:\n    threads.side_by_side(time.sleep, [60.0, 60.0])\n"
        "except KeyboardInterrupt:\n    print('interrupted')\n"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=root, capture_output=True, text=True, timeout=30.0, check=True
    )
    assert done.stdout == "interrupted\n"
