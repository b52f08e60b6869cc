"""The start-up benchmark says by its exit code whether the limit holds; its numbers need a quiet machine."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path


@pytest.mark.parametrize(("limit", "exit_code"), [("1000", 0), ("0.001", 1)])
def test_exit_code_follows_the_limit(root: Path, limit: str, exit_code: int):
    vector = [sys.executable, "benchmarks/startup.py", "--runs", "1", "--limit", limit]
    done = subprocess.run(vector, cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == exit_code, done.stderr
    for command in ("--version", "--help", "tune-filter --f1 3.9 --nd 4"):
        assert f"python -m flexid_cli {command} " in done.stdout
