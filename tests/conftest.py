"""Shared fixtures and the switch for slow statistical tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# As the command does it, and before anything imports numpy: two workers on two processors have no threads to spare.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

ROOT = Path(__file__).resolve().parents[1]


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--run-slow", action="store_true", help="run the slow statistical tests too")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--run-slow"):
        return
    skip = pytest.mark.skip(reason="slow statistical test: run with --run-slow")
    for item in items:
        if "slow" in item.keywords:
            item.add_marker(skip)


@pytest.fixture(scope="session")
def root() -> Path:
    """The project's folder."""
    return ROOT


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Real and simulated recordings that are not part of the project."""
    folder = ROOT.parent / "shared" / "recordings"
    if not folder.is_dir():
        pytest.skip(f"needs the recordings beside the project ({folder.name}), which are not here")
    return folder
