"""How long does `flexid identify` take with everything on, and what share of it is the estimate?

    python benchmarks/identify.py [--runs 5] [--limit 5]

A record of 60 s at 1 kHz with both encoders is simulated by ``benchmarks/machine`` and written as a table; then the
command runs on it as a user calls it: both models, all tests, with and without figures. Printed are medians of wall
time, processor time and peak memory, and the ratio of the wall time to that of an interpreter that only imports
numpy, scipy and numba, run in turn with it: that ratio can be compared between machines.

Exit codes: 0 within the limit; 1 above it; 2 the command failed.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:] = [str(ROOT), *(p for p in sys.path if Path(p or ".").resolve() != ROOT / "benchmarks")]

import numpy as np  # noqa: E402

from benchmarks.coverage import BY_NAME, Setting, simulated  # noqa: E402

RATE_HZ, DURATION_S = 1000.0, 60.0
YARDSTICK = [sys.executable, "-c", "import numpy, scipy.signal, numba"]
CONFIG = """version: 1
axis: {name: axis, gear_ratio: 1}
signals:
  time: {source: time, unit: s}
  joint_torque: {source: torque, unit: N.m, hold: sample}
  motor_position: {source: motor, unit: rad}
  joint_position: {source: joint, unit: rad}
  reference_position: {source: reference, unit: rad}
"""


def write_record(folder: Path) -> None:
    """One noisy run of the smallest machine, as a table and its configuration."""
    machine = replace(BY_NAME["0.01"], rate_hz=RATE_HZ, duration_s=DURATION_S)
    BY_NAME["0.01"] = machine
    run = simulated(machine, Setting("0.01", "0.1%", "white", "chirp"), 1)
    columns = [
        run.time_s,
        run.motor_torque,
        run.motor_position,
        run.joint_position,
        run.reference_position,
    ]
    header = "time,torque,motor,joint,reference"
    np.savetxt(
        folder / "run.csv", np.column_stack(columns), fmt="%.12g", delimiter=",", header=header, comments=""
    )
    gains = f"{{kp: {machine.kp}, kv: {machine.kv}, ki: {machine.ki}, velocity_feedforward: 0.0}}"
    (folder / "axis.yaml").write_text(f"{CONFIG}controller: {gains}\n", encoding="utf-8")


def measured(command: list[str], folder: Path) -> tuple[float, float, float]:
    """Wall time, processor time, s, and peak memory, MB, of one run."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    start = time.perf_counter()
    with subprocess.Popen(
        command, cwd=folder, env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.DEVNULL
    ) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(2)
    unit = 1e6 if sys.platform == "darwin" else 1e3
    return time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss / unit


def main() -> int:
    """Measure and judge."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--limit", type=float, default=5.0, help="seconds")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_record(folder)
        arguments_of = ["identify", "run.csv", "--config", "axis.yaml", "--essential", "--force", "-qq"]
        command = [sys.executable, "-m", "flexid_cli", *arguments_of, "-o", "report.json"]
        commands = (YARDSTICK, command, [*command, "-o", "report.md"])
        for one in commands:  # compiles what is kept compiled
            measured(one, folder)
        rounds = [[measured(one, folder) for one in commands] for _ in range(arguments.runs)]
    print("60 s at 1 kHz, both encoders, both models, --essential; medians")
    for name, k in (("JSON", 1), ("JSON, Markdown, six figures", 2)):
        wall, used, memory = (statistics.median(one[k][m] for one in rounds) for m in range(3))
        ratio = statistics.median(one[k][0] / one[0][0] for one in rounds)
        print(
            f"{name}: {wall:.2f} s, {used:.2f} s of processors, {memory:.0f} MB; {ratio:.1f} times the imports"
        )
    wall = statistics.median(one[1][0] for one in rounds)
    print(f"{'met' if wall <= arguments.limit else 'MISSED'}: {arguments.limit:g} s without figures")
    return int(wall > arguments.limit)


if __name__ == "__main__":
    raise SystemExit(main())
