"""What the tests of damaged logs share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

MOST_BYTES = 500_000_000
LIBRARIES_BYTES = 150_000_000  # of an interpreter with NumPy and the readers' libraries


def memory(name: str) -> int:
    """Bytes of this process: ``VmRSS`` now, ``VmHWM`` at most."""
    lines = Path("/proc/self/status").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith(f"{name}:"))
    return int(line.split()[1]) * 1024


@pytest.fixture
def little_memory() -> Iterator[None]:
    """Fail where reading damaged logs would take a process of its own to 500 MB."""
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    except OSError:
        yield
        return
    before = memory("VmRSS")
    yield
    assert memory("VmHWM") - before < MOST_BYTES - LIBRARIES_BYTES
