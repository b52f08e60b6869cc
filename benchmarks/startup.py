"""Start-up time of the light commands against ``python -c "import click"``.

Usage: ``python benchmarks/startup.py [--runs 15] [--limit 2.5]``

Every round runs the yardstick and every command once, one after the other, so that what slows the machine
for a while slows both sides; the order rotates from round to round. Both sides start the same interpreter,
and the yardstick imports what no click command can do without. Printed are the median time of each command
and the median of its ratios to the yardstick of the same round. Commands run as ``python -m flexid_cli``, and
through the console script too where it is installed beside the interpreter.

Exit codes: 0 all within the limit; 1 some ratio exceeds it; 2 a command failed.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import sysconfig
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
YARDSTICK = [sys.executable, "-c", "import click"]
ARGUMENTS = (["--version"], ["--help"], ["tune-filter", "--f1", "3.9", "--nd", "4"])


def commands() -> dict[str, list[str]]:
    """Name and argument vector of everything that is measured."""
    found = {
        " ".join(["python -m flexid_cli", *arguments]): [sys.executable, "-m", "flexid_cli", *arguments]
        for arguments in ARGUMENTS
    }
    script = shutil.which("flexid", path=sysconfig.get_path("scripts"))
    if script is not None:
        found |= {" ".join(["flexid", *arguments]): [script, *arguments] for arguments in ARGUMENTS}
    return found


def environment() -> dict[str, str]:
    """The caller's environment, but with byte code kept, as after the first use of an installed program."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return kept | {"PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))}


def seconds(command: list[str], env: dict[str, str]) -> float:
    """Wall time of one run; raises CalledProcessError where it fails."""
    start = time.perf_counter()
    subprocess.run(command, cwd=ROOT, env=env, check=True, capture_output=True)
    return time.perf_counter() - start


def measure(runs: int) -> tuple[list[float], dict[str, list[float]]]:
    """Times of the yardstick and of each command, run by run."""
    env = environment()
    measured = commands()
    vectors = [YARDSTICK, *measured.values()]
    for vector in vectors:  # compiles the byte code and fills the file cache
        seconds(vector, env)
    times: list[list[float]] = [[] for _ in vectors]
    for run in range(runs):
        for shift in range(len(vectors)):
            index = (run + shift) % len(vectors)
            times[index].append(seconds(vectors[index], env))
    return times[0], dict(zip(measured, times[1:], strict=True))


def main() -> int:
    """Measure, print a table, and say by the exit code whether the limit holds."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--runs", type=int, default=15, help="rounds (default: 15)")
    parser.add_argument("--limit", type=float, default=2.5, help="largest ratio (default: 2.5)")
    options = parser.parse_args()
    try:
        yardstick, times = measure(max(1, options.runs))
    except subprocess.CalledProcessError as error:
        sys.stderr.write(f"{' '.join(error.cmd)} failed:\n{error.stderr.decode(errors='replace')}")
        return 2
    ratios = {
        name: statistics.median(a / b for a, b in zip(values, yardstick, strict=True))
        for name, values in times.items()
    }
    print(f"{'median of ' + str(len(yardstick)) + ' runs':<52}{'ms':>8}{'ratio':>8}")
    print(f"{'python -c import click':<52}{1e3 * statistics.median(yardstick):>8.1f}{1.0:>8.2f}")
    for name, values in times.items():
        verdict = "" if ratios[name] <= options.limit else f"  above {options.limit:g}"
        print(f"{name:<52}{1e3 * statistics.median(values):>8.1f}{ratios[name]:>8.2f}{verdict}")
    return int(any(ratio > options.limit for ratio in ratios.values()))


if __name__ == "__main__":
    sys.exit(main())
