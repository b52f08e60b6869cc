"""One short simulated record for the tests of `flexid identify`, and a way to damage it."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from flexid_cli.simulate.axis import Axis, Controller, Sensors, chirp, simulate

Array = NDArray[np.float64]
Columns = dict[str, Array]
WriteLog = Callable[..., Path]

RATE_HZ = 200.0
CONFIG = """\
version: 1
axis: {name: short, gear_ratio: 50, torque_constant_nm_per_a: 0.35}
signals:
  time:               {source: time, unit: s}
  motor_current:      {source: current, unit: A, hold: sample}
  motor_position:     {source: motor, unit: rad, side: motor}
  joint_position:     {source: joint, unit: rad}
  reference_position: {source: reference, unit: rad, side: motor}
"""


@pytest.fixture(scope="session")
def short_axis() -> Axis:
    """A robot's wrist: 4.05 Hz free-free, 3.60 Hz with the motor locked."""
    return Axis(Jm=17.5, K=2400.0, JL=4.7, FVm=24.0, FSm=4.1, FV=8.3, FS=0.85, MX=-0.5, MY=-5.0)


@pytest.fixture(scope="session")
def short_run(short_axis: Axis) -> Columns:
    """20 s of a chirp at 200 Hz: time in s, current in A, motor and reference at the motor, joint in rad."""
    reference = 0.08 * chirp(0.1, 15.0, 20.0, RATE_HZ)
    controller = Controller(kp=8.0, kv=300.0, ki=800.0, velocity_feedforward=0.0)
    sensors = Sensors(motor_resolution=2e-6, joint_resolution=1e-5, torque_noise=0.2)
    run = simulate(short_axis, controller, reference, RATE_HZ, sensors=sensors, substeps=8)
    return {
        "time": run.time_s,
        "current": np.round(run.torque / 50.0 / 0.35, 4),
        "motor": np.round(50.0 * run.motor_position, 6),
        "joint": np.round(run.joint_position, 7),
        "reference": np.round(50.0 * run.reference_position, 6),
    }


@pytest.fixture
def columns(short_run: Columns) -> Columns:
    """A copy of the record that a test may damage."""
    return {name: values.copy() for name, values in short_run.items()}


@pytest.fixture
def write_log(tmp_path: Path) -> WriteLog:
    """Write columns as ``run.csv``; NaN and infinity as words."""

    def write(columns: Mapping[str, Array], name: str = "run.csv") -> Path:
        path = tmp_path / name
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        with path.open("w", encoding="utf-8", newline="") as stream:
            csv.writer(stream).writerows([list(columns), *rows])
        return path

    return write


@pytest.fixture
def log(write_log: WriteLog, short_run: Columns) -> Path:
    """The record as it is."""
    return write_log(short_run)


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """Its configuration."""
    path = tmp_path / "axis.yaml"
    path.write_text(CONFIG, encoding="utf-8")
    return path
