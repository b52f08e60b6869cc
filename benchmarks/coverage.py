"""Do the intervals hold? Bias, spread, claimed spread and coverage over many simulated records.

    python benchmarks/coverage.py --records 200 --jobs 2 --results coverage.jsonl
    python benchmarks/coverage.py --results coverage.jsonl --markdown docs/coverage.md

The table stands beside the page as CSV, too. Where only some cells are measured anew, theirs replace those that stand
there, and the others stay (``--cells '*/motor_only/*' --markdown docs/coverage.md`` with results of these cells).

Every record is simulated by ``benchmarks/machine``, which shares no code with flexid, and goes through the same
steps as a log: stamps, units, filters, estimate. One JSON line a record is appended to the results, and a record that
stands there already is not made again. A cell is one of

    encoders x encoder noise x torque noise x trajectory x axis,

where the same machine's run serves both models: once with the joint encoder, once without it. ``--cells`` takes a
pattern such as ``'*/motor_only/0.1%/*'``.

Encoder noise is white, one sigma in per cent of the RMS torsion, on either encoder; it enters the control loop.
``counts`` is plain quantisation. Torque noise is 1 % of the RMS torque, white over the record's band or coloured:
first order, with its corner at a quarter of the resonance. The controller, the amplitudes and the axes stand below.
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import json
import math
import multiprocessing
import os
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
# Python puts this folder first, where the file's own name would hide the package `coverage` from numba.
sys.path[:] = [str(ROOT), *(p for p in sys.path if Path(p or ".").resolve() != ROOT / "benchmarks")]

from benchmarks.machine import Axis, Controller, Record, Sensors, simulate  # noqa: E402
from flexid_cli.config.load import parse_config  # noqa: E402
from flexid_cli.config.schema import Config  # noqa: E402
from flexid_cli.errors import FlexidError  # noqa: E402
from flexid_cli.estimate.identify import identify  # noqa: E402
from flexid_cli.readers.base import RawChannel, RawLog  # noqa: E402
from flexid_cli.signals.build import recording_from_raw  # noqa: E402
from flexid_cli.signals.recording import Recording  # noqa: E402

Array = np.ndarray

LEVEL = 0.95
TORQUE_NOISE = 0.01
COLOUR_OVER_F1 = 0.25
MOTOR_COUNTS, GEAR_RATIO, JOINT_COUNTS = 65536.0, 50.0, 2.0**19
SYMBOLS = ("Jm", "K", "JL", "FVm", "FSm", "FV", "FS")
JUDGED = ("K", "Jm", "JL")
ROUTES = ("direct", "paper")
ENCODERS = ("two_encoders", "motor_only")
ENCODER_NOISE = ("0.01%", "0.1%", "1%", "counts")
TORQUE_COLOURS = ("white", "coloured")
TRAJECTORIES = ("chirp", "multisine")


@dataclass(frozen=True)
class Machine:
    """One axis, how it is driven, and how it is recorded; joint side, SI.

    ``chirp_rad`` and ``multisine_rad`` are the amplitudes of the set point; ``nd`` the paper's decimation at this
    rate (its own: 26 at 350.87 Hz and 3.9 Hz).
    """

    name: str
    Jm: float
    JL: float
    K: float
    FVm: float
    FSm: float
    FV: float
    FS: float
    MX: float
    MY: float
    reversal: float
    rate_hz: float
    duration_s: float
    kp: float
    kv: float
    ki: float
    chirp_rad: float
    multisine_rad: float

    @property
    def f1_hz(self) -> float:
        """Free-free resonance."""
        return math.sqrt(self.K * (1.0 / self.Jm + 1.0 / self.JL)) / (2.0 * math.pi)

    def run(self, path: Array, sensors: Sensors, seed: int) -> Record:
        """Simulate the axis along a set point."""
        axis = Axis(self.Jm, self.JL, self.K, self.FVm, self.FSm, self.FV, self.FS, self.MX, self.MY,
                    v0=self.reversal, v0l=self.reversal)  # fmt: skip
        gains = Controller(self.kp, self.kv, self.ki, 0.0)
        return simulate(axis, gains, path, self.rate_hz, sensors=sensors, seed=seed)

    @property
    def nd(self) -> int:
        """The paper's decimation, scaled to this rate and resonance."""
        return max(1, round(26 * (self.rate_hz / 350.87) * (3.9 / self.f1_hz)))


TURN = 2.0 * math.pi
MACHINES = (
    # A wrist: resonance 14 Hz, no gravity to speak of.
    Machine("0.01", Jm=0.01, JL=0.006, K=29.0, FVm=0.02, FSm=0.03, FV=0.008, FS=0.008, MX=0.0, MY=0.01,
            reversal=0.01, rate_hz=1000.0, duration_s=20.0, kp=30.0, kv=0.8, ki=4.0, chirp_rad=0.15,
            multisine_rad=0.06),
    # A forearm: resonance 8 Hz.
    Machine("3", Jm=3.0, JL=2.0, K=3000.0, FVm=5.0, FSm=3.0, FV=2.0, FS=1.0, MX=1.0, MY=-2.0,
            reversal=0.005, rate_hz=600.0, duration_s=35.0, kp=16.0, kv=100.0, ki=300.0, chirp_rad=0.12,
            multisine_rad=0.05),
    # The paper's axis 3 (Table 1).
    Machine("175", Jm=174.7996, JL=47.4458, K=20341.0458, FVm=235.91, FSm=41.4254, FV=83.1508, FS=8.4612,
            MX=-0.7241, MY=-53.4201, reversal=0.001, rate_hz=350.87, duration_s=60.0, kp=8.0, kv=3000.0,
            ki=8000.0, chirp_rad=0.08, multisine_rad=0.04),
)  # fmt: skip
BY_NAME = {machine.name: machine for machine in MACHINES}


@dataclass(frozen=True)
class Setting:
    """What one simulated run has; both models see it."""

    machine: str
    noise: str
    colour: str
    trajectory: str

    def cell(self, encoders: str) -> str:
        """Name of the cell: machine/encoders/noise/colour/trajectory."""
        return f"{self.machine}/{encoders}/{self.noise}/{self.colour}/{self.trajectory}"


def settings() -> Iterator[Setting]:
    """All of them, the smallest machine first."""
    for machine in MACHINES:
        for noise in ENCODER_NOISE:
            for colour in TORQUE_COLOURS:
                for trajectory in TRAJECTORIES:
                    yield Setting(machine.name, noise, colour, trajectory)


# --- records --------------------------------------------------------------


def reference(machine: Machine, trajectory: str) -> Array:
    """Set point of the motor: the paper's chirp up to 7.7 f1, or a multisine up to 2 f1 over two slow sweeps."""
    t = np.arange(round(machine.duration_s * machine.rate_hz)) / machine.rate_hz
    f1, T = machine.f1_hz, machine.duration_s
    if trajectory == "chirp":
        low, high = 0.05, 30.0 / 3.9 * f1
        return machine.chirp_rad * np.sin(TURN * (low * t + 0.5 * (high - low) / T * t**2))
    lines = np.unique(np.round(np.geomspace(0.05 * f1, 2.0 * f1, 24) * T)) / T
    k = np.arange(lines.size)
    phases = -math.pi * k * (k + 1) / lines.size
    tones = np.sin(TURN * np.outer(t, lines) + phases) @ (lines[0] / lines) ** 0.5
    slow = np.sin(TURN * 2.0 / T * t) + 0.5 * np.sin(TURN * 5.0 / T * t)
    return machine.multisine_rad * (tones - tones[0] + 2.0 * slow)


def recording_of(run: Record, config: Config, *, joint: bool) -> Recording:
    """The run as flexid reads a log of it."""
    stamps = np.rint(run.time_s * 1e9).astype(np.int64)
    values = {"u": run.motor_torque, "qm": run.motor_position, "ref": run.reference_position}
    if joint:
        values["q"] = run.joint_position
    channels = {name: RawChannel(name, x, {"header_stamp": stamps}) for name, x in values.items()}
    return recording_from_raw(RawLog("memory", (), channels), config)


def configuration(machine: Machine, encoders: str, route: str) -> Config:
    """What a user would write; the paper's route with the paper's filters."""
    joint = "  joint_position: {source: q, unit: rad}\n" if encoders == "two_encoders" else ""
    text = (
        "version: 1\n"
        "axis: {name: axis, gear_ratio: 1}\n"
        "signals:\n"
        "  joint_torque: {source: u, unit: N.m, hold: sample}\n"
        "  motor_position: {source: qm, unit: rad}\n"
        f"{joint}"
        "  reference_position: {source: ref, unit: rad}\n"
        f"controller: {{kp: {machine.kp}, kv: {machine.kv}, ki: {machine.ki}, velocity_feedforward: 0.0}}\n"
        f"models: [{encoders}]\n"
    )
    if route == "paper":
        order, cutoff = (4, 181.04) if encoders == "two_encoders" else (6, 168.91)
        # The paper's cutoffs are for 3.9 Hz.
        cutoff_hz = cutoff / TURN * machine.f1_hz / 3.9
        text = text.replace("gear_ratio: 1}", f"gear_ratio: 1, f1_hz: {machine.f1_hz}}}")
        text += (
            f"pipeline: {{derivative: central, decimation: {machine.nd},"
            f" lowpass: {{order: {order}, cutoff_hz: {cutoff_hz}}}}}\n"
            "estimate: {route: paper}\n"
        )
    return parse_config(text)


# --- one record ------------------------------------------------------------


def measure(setting: Setting, seed: int, encoders: Sequence[str]) -> list[dict[str, Any]]:
    """Simulate one run and identify it; one line for each of ``encoders``."""
    machine = BY_NAME[setting.machine]
    run = simulated(machine, setting, seed)
    lines = []
    for which in encoders:
        line: dict[str, Any] = {"cell": setting.cell(which), "seed": seed}
        start = time.perf_counter()
        # Filters are set by route; the recording before them is the same.
        recording = recording_of(run, configuration(machine, which, "direct"), joint=which == "two_encoders")
        for route in ROUTES:
            line[route] = outcome(recording, configuration(machine, which, route))
            if route == "direct":
                line["seconds"] = round(time.perf_counter() - start, 3)
        lines.append(line)
    return lines


def outcome(recording: Recording, config: Config) -> dict[str, Any]:
    """Estimate, standard error, interval and verdict of each parameter."""
    try:
        model = identify(recording, config).models[0]
    except FlexidError as error:
        return {"error": error.message}
    found: dict[str, Any] = {
        e.symbol: [e.value, e.stderr, e.interval.low, e.interval.high, e.verdict]
        for e in model.parameters
        if e.symbol in SYMBOLS and e.value is not None and e.interval is not None
    }
    return {**found, "id": model.id, "method": model.method, "band": model.pipeline.effective_band_hz[1]}


@lru_cache(maxsize=16)
def sizes(name: str, trajectory: str) -> tuple[float, float]:
    """RMS of torque and torsion of a run without noise, to which the noise is stated."""
    run = BY_NAME[name].run(reference(BY_NAME[name], trajectory), Sensors(), 0)
    return run.truth.torque_rms, run.truth.torsion_rms


def simulated(machine: Machine, setting: Setting, seed: int) -> Record:
    """One closed-loop run. Its set point differs from the others' by up to a tenth in size, and in its middle."""
    rng = np.random.default_rng([seed, *map(ord, setting.cell("run"))])
    torque, torsion = sizes(machine.name, setting.trajectory)
    corner = COLOUR_OVER_F1 * machine.f1_hz if setting.colour == "coloured" else 0.0
    sensors = Sensors(torque_noise=TORQUE_NOISE * torque, torque_noise_corner_hz=corner)
    if setting.noise == "counts":
        sensors = replace(
            sensors, motor_counts=MOTOR_COUNTS, gear_ratio=GEAR_RATIO, joint_counts=JOINT_COUNTS
        )
    else:
        sigma = 0.01 * float(setting.noise.rstrip("%")) * torsion
        sensors = replace(sensors, motor_noise=sigma, joint_noise=sigma)
    path = rng.uniform(0.9, 1.1) * reference(machine, setting.trajectory) + rng.uniform(-0.3, 0.3)
    return machine.run(path, sensors, int(rng.integers(2**31)))


# --- many records -----------------------------------------------------------


def _work(task: tuple[Setting, int, tuple[str, ...]]) -> list[dict[str, Any]]:
    return measure(*task)


def pending(pattern: str, records: int, results: Path) -> list[tuple[Setting, int, tuple[str, ...]]]:
    """Runs that ``results`` lacks, and the models that are wanted of each; all cells grow together."""
    done = {(line["cell"], line["seed"]) for line in read(results)}
    tasks = []
    for seed in range(records):
        for setting in settings():
            cells = {e: setting.cell(e) for e in ENCODERS if fnmatch.fnmatch(setting.cell(e), pattern)}
            wanted = tuple(e for e, cell in cells.items() if (cell, seed) not in done)
            if wanted:
                tasks.append((setting, seed, wanted))
    return tasks


def run_all(pattern: str, records: int, results: Path, jobs: int) -> None:
    """Measure what is not in ``results`` yet, and append it."""
    tasks = pending(pattern, records, results)
    if results.exists() and not results.read_bytes().endswith(b"\n"):
        with results.open("a", encoding="utf-8") as file:
            file.write("\n")
    # One thread a process: the cores are taken already.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    with (
        results.open("a", encoding="utf-8") as file,
        multiprocessing.get_context("spawn").Pool(jobs) as pool,
    ):
        for lines in pool.imap_unordered(_work, tasks):
            file.writelines(json.dumps(line) + "\n" for line in lines)
            file.flush()


def read(results: Path) -> list[dict[str, Any]]:
    """Lines of earlier runs; a last line that was cut off is left out."""
    lines = []
    if results.exists():
        for text in results.read_text(encoding="utf-8").splitlines():
            try:
                lines.append(json.loads(text))
            except json.JSONDecodeError:
                continue
    return lines


# --- the table -----------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One parameter in one cell by one method. All but counts in per cent of the truth."""

    cell: str
    route: str
    symbol: str
    records: int
    estimated: int
    identified: int
    held: int
    bias: float
    bias_error: float
    spread: float
    claimed: float
    bias_over_claimed: float

    @property
    def coverage(self) -> float:
        """Share of identified records whose interval holds the truth; NaN where none is identified."""
        return self.held / self.identified if self.identified else math.nan


def table(lines: Iterable[dict[str, Any]]) -> list[Row]:
    """Rows of all cells, methods and parameters."""
    cells: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for line in lines:
        cells[line["cell"]].append(line)
    return [
        _row(cell, route, symbol, getattr(BY_NAME[cell.split("/", 1)[0]], symbol), [x[route] for x in found])
        for cell, found in sorted(cells.items())
        for route in ROUTES
        for symbol in SYMBOLS
    ]


def _row(cell: str, route: str, symbol: str, truth: float, outcomes: Sequence[dict[str, Any]]) -> Row:
    values = np.array([o[symbol][:4] for o in outcomes if symbol in o], dtype=float).reshape(-1, 4)
    sure = np.array([o[symbol][4] == "identified" for o in outcomes if symbol in o], dtype=bool)
    held = (values[:, 2] <= truth) & (truth <= values[:, 3])
    errors = 100.0 * (values[:, 0] / truth - 1.0)
    claimed = 100.0 * values[:, 1] / abs(truth)
    n = errors.size
    # Median and median deviation: a single divergent fit of the paper's route would be all that one sees.
    spread = 1.4826 * float(np.median(np.abs(errors - np.median(errors)))) if n > 1 else math.nan
    bias = float(np.median(errors)) if n else math.nan
    return Row(
        cell, route, symbol, len(outcomes), n, int(sure.sum()), int((held & sure).sum()),
        bias, 1.2533 * spread / math.sqrt(max(n, 1)), spread,
        float(np.median(claimed)) if n else math.nan,
        abs(bias) / float(np.median(claimed)) if n else math.nan,
    )  # fmt: skip


def merged(rows: Sequence[Row], path: Path) -> list[Row]:
    """The rows, and those that a table of CSV holds of other cells."""
    fresh = {r.cell for r in rows}
    kept = []
    if path.exists():
        with path.open(encoding="utf-8", newline="") as file:
            for line in csv.DictReader(file):
                typed = {f.name: _TYPES[str(f.type)](line[f.name]) for f in fields(Row)}
                kept.append(Row(**typed))
    return sorted(
        [*rows, *(r for r in kept if r.cell not in fresh)],
        key=lambda r: (r.cell, ROUTES.index(r.route), SYMBOLS.index(r.symbol)),
    )


_TYPES: dict[str, Callable[[str], Any]] = {"str": str, "int": int, "float": float}


def keep(rows: Sequence[Row], path: Path) -> None:
    """Write the rows of the judged parameters as CSV."""
    names = [f.name for f in fields(Row)]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(names)
        for row in rows:
            values = [getattr(row, name) for name in names]
            writer.writerow([format(v, ".6g") if isinstance(v, float) else v for v in values])


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's adjusted p values, in the given order."""
    order = np.argsort(p_values)
    adjusted, largest = [0.0] * len(p_values), 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[k]))
        adjusted[k] = largest
    return adjusted


HEAD = ("cell", "", "records", "identified", "bias", "+-", "spread", "claimed", "coverage")


def cells_of(row: Row) -> tuple[str, ...]:
    """A row as text; bias, its standard error, spread and claimed standard error in per cent of the truth."""
    sizes = [format(x, ".3g") for x in (row.bias, row.bias_error, row.spread, row.claimed)]
    share = f"{100.0 * row.coverage:.1f} %" if row.identified else "-"
    return (row.cell, row.symbol, str(row.records), str(row.identified), *sizes, share)


def show(rows: Sequence[Row], route: str, symbols: Sequence[str]) -> str:
    """The table of one method as text."""
    lines = [HEAD, *(cells_of(r) for r in rows if r.route == route and r.symbol in symbols)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(HEAD))]
    return "\n".join(
        "  ".join(
            x.ljust(w) if k < 2 else x.rjust(w) for k, (x, w) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    )


def pooled(rows: Sequence[Row], route: str) -> str:
    """Coverage of K, Jm and JL over all cells together, in a sentence."""
    sure = [r for r in rows if r.route == route and r.symbol in JUDGED]
    held, count = sum(r.held for r in sure), sum(r.identified for r in sure)
    name = "this tool" if route == "direct" else "the paper's method"
    return (
        f"Over all cells {held} of {count} intervals hold with {name}: {100.0 * held / max(count, 1):.1f} %."
    )


def markdown(rows: Sequence[Row], found: Sequence[tuple[str, bool, str]], records: int, figure: str) -> str:
    """The page of the documentation."""
    command = (
        f"`python benchmarks/coverage.py --records {records} --jobs 2 --results coverage.jsonl"
        " --markdown docs/coverage.md`"
    )
    lines = [
        "# Do the intervals hold?",
        "",
        f"Made by {command}; every line of the results is one simulated record. The records come from",
        "`benchmarks/machine`, which shares no code with flexid. What a cell is, the axes, the amplitudes and the",
        "noise stand at the top of `benchmarks/coverage.py`.",
        "",
        "Bias and spread are median and scaled median deviation of the estimates' errors, `claimed` is the median",
        "standard error, all in per cent of the truth; coverage is the share of the 95 % intervals that hold the",
        "truth, among the records in which the parameter's verdict is `identified`. The rows stand in",
        "`coverage.csv`, too, where cells that are measured anew replace theirs (docs/method.md says which were).",
        "",
        "## Targets",
        "",
        *(pooled(rows, route) for route in ROUTES),
        "",
        "With few records a cell's coverage is one of few fractions, and the median cell says little.",
        "",
        "| target | met | measured |",
        "|---|---|---|",
        *(f"| {name} | {'yes' if ok else '**no**'} | {number} |" for name, ok, number in found),
        "",
        f"![Coverage and bias of every cell]({figure})",
    ]
    for route, title in (("direct", "This tool"), ("paper", "The paper's method (`estimate.route: paper`)")):
        lines += ["", f"## {title}", "", "| " + " | ".join(HEAD) + " |", "|" + "---|" * len(HEAD)]
        chosen = [r for r in rows if r.route == route and r.symbol in JUDGED]
        lines += ["| " + " | ".join(cells_of(r)) + " |" for r in chosen]
    return "\n".join(lines) + "\n"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Coverage of every cell, and bias over claimed standard error, of this tool and of the paper's method."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "flexid"
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(9.0, 4.0), constrained_layout=True)
    for route, label, color in (("direct", "this tool", "C0"), ("paper", "the paper's method", "C3")):
        chosen = [r for r in rows if r.route == route and r.symbol in JUDGED and r.estimated]
        share = sorted(100.0 * r.coverage for r in chosen if r.identified)
        ratio = sorted(r.bias_over_claimed for r in chosen)
        left.plot(share, np.linspace(0.0, 1.0, len(share)), color=color, label=label)
        right.plot(ratio, np.linspace(0.0, 1.0, len(ratio)), color=color, label=label)
    left.axvline(95.0, color="0.6", linewidth=0.8)
    left.set(xlabel="coverage of the 95 % intervals, %", ylabel="share of cells and parameters below")
    right.axvline(1.0 / 3.0, color="0.6", linewidth=0.8)
    right.set(xlabel="|bias| / claimed standard error", xscale="log")
    left.legend(loc="upper left")
    figure.savefig(path, format="svg", metadata={"Date": None})
    plt.close(figure)


def publish(rows: Sequence[Row], found: Sequence[tuple[str, bool, str]], page: Path) -> None:
    """Write the page, its figure and the table beside it."""
    keep([r for r in rows if r.symbol in JUDGED], page.with_suffix(".csv"))
    draw(rows, page.with_suffix(".svg"))
    text = markdown(rows, found, min(r.records for r in rows), page.with_suffix(".svg").name)
    page.write_text(text, encoding="utf-8")


def targets(rows: Sequence[Row]) -> list[tuple[str, bool, str]]:
    """Every target of the benchmark: name, met or not, and the number."""
    from scipy.stats import binom

    judged = [r for r in rows if r.route == "direct" and r.symbol in JUDGED]
    sure = [r for r in judged if r.identified]
    p = [float(binom.cdf(r.held, r.identified, 0.90)) for r in sure]
    low = [r for r, q in zip(sure, holm(p), strict=True) if q < 0.05]
    found = [
        (
            "coverage of K, Jm, JL not significantly below 90 % in any cell (Holm)",
            not low,
            ", ".join(f"{r.cell} {r.symbol} {100 * r.coverage:.0f} %" for r in low) or f"{len(sure)} cells",
        )
    ]
    median = float(np.median([100 * r.coverage for r in sure])) if sure else math.nan
    found.append(("coverage 93 to 98 % in the median cell", 93.0 <= median <= 98.0, f"{median:.1f} %"))
    quiet = [r for r in judged if "/two_encoders/" in r.cell and "/1%/" not in r.cell]
    missing = [r for r in quiet if r.identified < r.records]
    found.append(
        (
            "identified in all cells with both encoders and noise up to 0.1 %",
            not missing,
            ", ".join(f"{r.cell} {r.symbol} {r.identified}/{r.records}" for r in missing) or "all",
        )
    )
    stiffness = [r for r in judged if r.symbol == "K" and r.estimated]
    ratio = float(np.median([r.bias_over_claimed for r in stiffness])) if stiffness else math.nan
    found.append(
        ("median |bias| of K below a third of its claimed standard error", ratio < 1 / 3, f"{ratio:.2f}")
    )
    alone = [r for r in stiffness if "/motor_only/" in r.cell and "/1%/" not in r.cell]
    off = [r for r in alone if not abs(r.bias) <= 3.0]
    found.append(
        (
            "motor alone: K within 3 % in the cells up to 0.1 %",
            not off,
            ", ".join(f"{r.cell} {r.bias:.1f} %" for r in off) or "all",
        )
    )
    return found


def main() -> int:
    """Measure, print the table, check the targets."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--records", type=int, default=0, help="records a cell (200 for the published table)")
    parser.add_argument("--cells", default="*", help="pattern of machine/encoders/noise/colour/trajectory")
    parser.add_argument("--results", type=Path, default=Path("coverage.jsonl"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--symbols", default=",".join(JUDGED), help="parameters of the printed table")
    parser.add_argument("--route", choices=ROUTES, default="direct", help="method of the printed table")
    parser.add_argument(
        "--markdown", type=Path, help="write the page with both tables, and its figure beside it"
    )
    arguments = parser.parse_args()
    if arguments.records:
        run_all(arguments.cells, arguments.records, arguments.results, arguments.jobs)
    lines = [x for x in read(arguments.results) if fnmatch.fnmatch(x["cell"], arguments.cells)]
    rows = table(lines)
    if arguments.markdown:
        rows = merged(rows, arguments.markdown.with_suffix(".csv"))
    print(show(rows, arguments.route, arguments.symbols.split(",")))
    print(f"median time of one identification {np.median([x['seconds'] for x in lines]):.2f} s")
    found = targets(rows)
    for name, ok, number in found:
        print(f"{'met   ' if ok else 'MISSED'} {name}: {number}")
    if arguments.markdown:
        publish(rows, found, arguments.markdown)
    return 0 if all(ok for _, ok, _ in found) else 1


if __name__ == "__main__":
    raise SystemExit(main())
