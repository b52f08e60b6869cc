"""Make the sample logs: the paper's axis, simulated, in every container.

    python sample_logs/make_sample_logs.py [FOLDER]

The axis is Table 1 of Pham, Gautier and Poignet (ICRA 2001) behind a gear of 50, under a P position and PI velocity
loop that follows a chirp from 0.05 to 30 Hz, sampled at 350.87 Hz. The motor current is recorded at the instant from
which the drive holds it, with noise; both encoders are quantised. One JointState topic holds the joints motor,
joint and reference; the motor's effort is its current in A. ``axis3.truth.json`` says what was simulated,
``SHA256SUMS`` what the files must be.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

from flexid_cli.simulate.axis import Axis, Controller, Sensors, chirp, simulate
from flexid_cli.writers.csv import write_csv
from flexid_cli.writers.mcap import write_mcap
from flexid_cli.writers.rosbag1 import write_rosbag1
from flexid_cli.writers.rosbag2 import write_rosbag2
from flexid_cli.writers.table import LogTable

SAMPLE_RATE_HZ = 350.87
DURATION_S = 60.0
GEAR_RATIO = 50.0
TORQUE_CONSTANT = 0.3475
CHIRP_HZ = (0.05, 30.0)
AMPLITUDE_RAD = 0.08
MOTOR_COUNTS = 65536
JOINT_COUNTS = 524288
TORQUE_NOISE_NM = 2.0
START_NS = 1_000_000 * 1_000_000_000  # far from zero, as a real clock is; exact in float64 seconds
SEED = 1
AXIS = Axis()
CONTROLLER = Controller(kp=8.0, kv=3000.0, ki=8000.0, velocity_feedforward=0.0)
SENSORS = Sensors(
    motor_resolution=2.0 * np.pi / MOTOR_COUNTS / GEAR_RATIO,
    joint_resolution=2.0 * np.pi / JOINT_COUNTS,
    torque_noise=TORQUE_NOISE_NM,
)


def record(seed: int) -> LogTable:
    """The simulated run with the torque noise of ``seed``, as a drive would log it."""
    reference = AMPLITUDE_RAD * chirp(*CHIRP_HZ, DURATION_S, SAMPLE_RATE_HZ)
    run = simulate(AXIS, CONTROLLER, reference, SAMPLE_RATE_HZ, sensors=SENSORS, seed=seed)
    return LogTable(
        stamps_ns=START_NS + np.rint(run.time_s * 1e9).astype(np.int64),
        channels={
            "/joint_states/motor/effort": np.round(run.torque / GEAR_RATIO / TORQUE_CONSTANT, 4),
            "/joint_states/motor/position": np.round(run.motor_position * GEAR_RATIO, 7),
            "/joint_states/joint/position": np.round(run.joint_position, 8),
            "/joint_states/reference/position": np.round(run.reference_position * GEAR_RATIO, 6),
        },
        units={
            "/joint_states/motor/effort": "A",
            "/joint_states/motor/position": "rad",
            "/joint_states/joint/position": "rad",
            "/joint_states/reference/position": "rad",
        },
    )


def main(folder: Path) -> None:
    """Write every container, the truth and the sums."""
    table = record(SEED)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "axis3.csv", table, overwrite=True)
    write_mcap(folder / "axis3.mcap", table, overwrite=True)
    write_rosbag1(folder / "axis3.bag", table, compression="bz2", overwrite=True)
    for storage in ("sqlite3", "mcap"):
        target = folder / f"axis3_rosbag2_{storage}"
        shutil.rmtree(target, ignore_errors=True)
        write_rosbag2(target, table, storage=storage, compression="file")
    truth = {
        "source": "Pham, Gautier, Poignet, ICRA 2001, Table 1; joint side, SI",
        "axis": _given(AXIS),
        "resonance_hz": AXIS.resonance_hz,
        "antiresonance_hz": AXIS.antiresonance_hz,
        "controller": _given(CONTROLLER),
        "sensors": {name: value for name, value in asdict(SENSORS).items() if value != 0.0},
        "gear_ratio": GEAR_RATIO,
        "torque_constant_nm_per_a": TORQUE_CONSTANT,
        "sample_rate_hz": SAMPLE_RATE_HZ,
        "seed": SEED,
    }
    (folder / "axis3.truth.json").write_text(json.dumps(truth, indent=2) + "\n", encoding="utf-8")
    write_sums(folder)


def _given(machine: Axis | Controller) -> dict[str, float]:
    """Values by name, without what is not given."""
    return {name: value for name, value in asdict(machine).items() if value is not None}


def write_sums(folder: Path) -> None:
    """SHA-256 of every data file, in the format of sha256sum."""
    files = sorted(
        p for p in folder.rglob("*") if p.is_file() and p.suffix != ".py" and p.name != "SHA256SUMS"
    )
    lines = [
        f"{hashlib.sha256(p.read_bytes()).hexdigest()}  {p.relative_to(folder).as_posix()}\n" for p in files
    ]
    (folder / "SHA256SUMS").write_text("".join(lines), encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent)
