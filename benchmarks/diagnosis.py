"""Is what was hidden found, and is nothing found where nothing was hidden? Counts, bounds, and what was missed.

    python benchmarks/diagnosis.py --list singles --seeds test --jobs 2
    python benchmarks/diagnosis.py --seeds calibration --limit 40
    python benchmarks/diagnosis.py --list paper --seeds calibration --limit 10
    python benchmarks/diagnosis.py --small --jobs 2
    python benchmarks/diagnosis.py --labelled FOLDER

``benchmarks/machine`` draws the cases and simulates them; it shares no code with flexid. Every case goes through the
same steps as a log: stamps, units, `diagnose` with the other record for validation. One JSON line a case is appended
to the results, and a case that stands there already is not run again. The sizes of the effects, which take a search,
are kept beside the results (``--recipes``) and spare it the next time.

The list ``paper`` has what the paper leaves out of its own eqs. (18) to (20): gravity about the rest position, an
offset, and the friction's terms that pass the spring (FSm (X2 S' + X1 S'') and FS sgn q'). The first two are effects
beyond the baseline `motor_only`, which is asked for by leaving out the joint encoder. The friction's terms are part
of that baseline, with no parameter of their own: the right answer to them is `adequate`, and a name is a wrong one.
How far the paper's own route is led astray stands beside the result.

A target holds where its Wilson bound (95 %, two-sided) holds; over labelled cases it holds by count. A handful of
cases proves nothing by its bound; ``--limit 6 --judge unless_refuted`` fails only where it refutes a target.
``--small`` is the gate of the continuous integration: a few short cases of the calibration's seeds, in which nothing
may be clearly wrong; nothing is kept of it.
Exit codes: 0 all targets judged hold; 1 some do not; 2 nothing to judge.

How a case is judged: the tool's set for an effect is its name and the alternatives. A single effect is named where
exactly one effect is reported and its set holds the name. In a pair, two effects at most are reported, and each
hidden one needs a set of its own. A confident wrong name is a set of one that is not among what was hidden.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import math
import multiprocessing
import os
import resource
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
# Python puts this folder first, where a file's name would hide the package `coverage` from numba.
sys.path[:] = [str(ROOT), *(p for p in sys.path if Path(p or ".").resolve() != ROOT / "benchmarks")]

import numpy as np  # noqa: E402
import yaml  # noqa: E402

from benchmarks.machine.cases import (  # noqa: E402
    FIRST_SEED,
    LISTS,
    NONE,
    Case,
    CaseError,
    Task,
    columns,
    configuration,
    make,
    tasks,
)
from benchmarks.machine.effects import DROPPED_FRICTION  # noqa: E402

TOOL = "flexid_cli.diagnose.diagnose:diagnose"
Z = 1.959964  # two-sided 95 %
REPAIRED = 1.15  # held-out residual over the noise floor
SECONDS_45 = 10.0  # for 45 s at 1 kHz
SAMPLES_45 = 45_000
MEMORY_MB = 1000.0
SETS = {"singles": 2, "pairs": 2, "motor_only": 3, "outside": 1, "nulls": 1, "paper": 3}
# The small version: which cases (the first of their kinds among the calibration's), how long, and how many of those
# with an effect must be named.
SMALL = (
    ("nulls", (NONE,)),
    ("singles", ("cogging",)),
    ("singles", ("joint_damping",)),
    ("singles", ("backlash",)),
    ("singles", ("torque_offset",)),
    ("singles", ("hardening_stiffness",)),
    ("motor_only", ("load_dependent_friction",)),
    ("motor_only", ("torque_offset",)),
    ("outside", ("position_stiffness",)),
    ("paper", ("gravity",)),
)
SMALL_SECONDS = (18.0, 22.0)
SMALL_NAMED = 6
JUDGES = {
    "bound": "by the Wilson bound, 95 % two-sided",
    "count": "by count",
    "unless_refuted": "failed only where the Wilson interval excludes them",
}
Result = dict[str, Any]


# --- running ---


@dataclass(frozen=True)
class Job:
    """One case for a worker: a task to simulate, or a folder to read."""

    group: str
    name: str
    tool: str
    task: Task | None = None
    recipe: Mapping[str, Any] | None = None
    folder: Path | None = None
    truth: Mapping[str, Any] | None = None


def run(job: Job) -> tuple[Result, dict[str, Any] | None]:
    """Diagnose one case; what goes wrong becomes part of the result.

    Returns
    -------
    result : dict
        One line of the results.
    recipe : dict or None
        What spares the search for the effects' sizes next time.
    """
    recipe: dict[str, Any] | None = None
    result: Result = {"group": job.group, "name": job.name}
    try:
        if job.task is not None:
            case = make(job.task, dict(job.recipe) if job.recipe else None)
            recipe, truth = case.recipe, case.truth
            config, recordings = generated_recordings(case)
        else:
            truth = dict(job.truth or {})
            config, recordings = labelled_recordings(job)
        result |= {key: truth[key] for key in ("kinds", "where", "share", "shapes", "extra")}
        result |= {"visible": truth.get("visible")}
        result |= {"K": truth["base"]["K"], "samples": recordings[0].samples}
        result |= _diagnosed(job.tool, config, recordings)
        if job.group == "paper":
            result |= {"K_paper": paper_stiffness(config, recordings[0])}
    except CaseError as error:
        result |= {"skipped": str(error)}
    except Exception as error:  # noqa: BLE001 - a crash is a result, and the other cases go on
        result |= {"verdict": "error", "error": f"{type(error).__name__}: {error}"}
        result["traceback"] = traceback.format_exc().splitlines()[-6:]
    result["memory_mb"] = round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0, 1)
    return result, recipe


def generated_recordings(case: Case) -> tuple[Any, list[Any]]:
    """Configuration and recordings of a simulated case, by the functions that the command line uses."""
    from flexid_cli.config.load import parse_config
    from flexid_cli.readers.base import RawChannel, RawLog
    from flexid_cli.signals.build import recording_from_raw

    config = parse_config(yaml.safe_dump(configuration(case), sort_keys=False), case.task.name)
    recordings = []
    for record in (case.a, case.b):
        table = columns(case, record)
        stamps = {"header_stamp": np.round(table.pop("time") * 1e9).astype(np.int64)}
        channels = {name: RawChannel(name, np.asarray(v, dtype=float), stamps) for name, v in table.items()}
        recordings.append(recording_from_raw(RawLog("memory", (), channels), config))
    return config, recordings


def labelled_recordings(job: Job) -> tuple[Any, list[Any]]:
    """Configuration and recordings of a labelled case, from its facts and its files."""
    from flexid_cli.config.load import parse_config
    from flexid_cli.signals.build import build_recording

    folder = Path(job.folder or "")
    facts = json.loads((folder / "facts.json").read_text())
    config = parse_config(yaml.safe_dump(labelled_configuration(facts, job.name), sort_keys=False), job.name)
    return config, [build_recording([folder / f"{which}.csv.gz"], config)[0] for which in "ab"]


def labelled_configuration(facts: Mapping[str, Any], name: str) -> dict[str, Any]:
    """A configuration from what a user would know of a labelled case."""
    axis: dict[str, Any] = {"name": name, "gear_ratio": facts["gear_ratio"]}
    axis["gravity_m_per_s2"] = facts["gravity"]
    torque, unit = ("motor_current", "A") if "motor_current" in facts["units"] else ("motor_torque", "N.m")
    if facts.get("torque_constant_nm_per_a") is not None:
        axis["torque_constant_nm_per_a"] = facts["torque_constant_nm_per_a"]
    signals: dict[str, Any] = {torque: {"source": torque, "unit": unit}}
    for role in ("motor_position", "reference_position", "joint_position"):
        if role in facts["units"]:
            side = "joint" if role == "joint_position" else "motor"
            signals[role] = {"source": role, "unit": "rad", "side": side}
    gains = {key: facts["controller"][key] for key in ("kp", "kv", "ki")}
    return {"version": 1, "axis": axis, "signals": signals, "controller": gains}


def _diagnosed(tool: str, config: Any, recordings: Sequence[Any]) -> Result:
    """The tool's answer as plain data, and how long it took."""
    from flexid_cli.errors import FlexidError

    module, function = tool.split(":")
    diagnose: Callable[..., Any] = getattr(importlib.import_module(module), function)
    start = time.perf_counter()
    try:
        answer = diagnose(recordings[0], config, validation=recordings[1])
    except FlexidError as error:
        words = str(error).splitlines()[0]
        return {"verdict": "refused", "error": words, "seconds": round(time.perf_counter() - start, 3)}
    return {"seconds": round(time.perf_counter() - start, 3), **summary(answer)}


def paper_stiffness(config: Any, recording: Any) -> float | None:
    """K by the paper's own route (Table 3), which leaves out what the list hides; None where it gives none."""
    from flexid_cli.errors import DataError
    from flexid_cli.estimate.identify import identify

    estimate = config.estimate.model_copy(update={"route": "paper"})
    try:
        found = identify(
            recording, config.model_copy(update={"estimate": estimate, "models": ("motor_only",)})
        )
    except DataError:
        return None
    return next((e.value for e in found.models[0].parameters if e.symbol == "K"), None)


def summary(answer: Any) -> Result:
    """What the judgement needs of a diagnosis (an object or a dictionary with the report's field names)."""
    effects = [
        {
            "name": _get(effect, "name"),
            "alternatives": list(_get(effect, "alternatives") or ()),
            "equation": _get(_get(effect, "where"), "equation"),
        }
        for effect in _get(answer, "effects") or ()
    ]
    location = _get(answer, "location")
    held_out = _get(answer, "held_out") or _get(_get(answer, "fit"), "held_out")
    return {
        "verdict": _get(answer, "verdict"),
        "effects": effects,
        "location": _get(location, "equation") or _get(_get(location, "where"), "equation"),
        "residual_over_floor": _worst_ratio(_get(held_out, "after"), _get(held_out, "noise_floor")),
        "K_interval": _interval(_get(answer, "parameters_after") or ()),
        "K_after": _value(_get(answer, "parameters_after") or ()),
    }


def _get(thing: Any, name: str) -> Any:
    return thing.get(name) if isinstance(thing, Mapping) else getattr(thing, name, None)


def _worst_ratio(after: Any, floor: Any) -> float | None:
    """Largest ratio over the equations; None where none is reported."""
    if after is None or floor is None:
        return None
    if not isinstance(after, Mapping):
        return float(after) / float(floor)
    ratios = [after[k] / floor[k] for k in after if after[k] is not None and floor.get(k)]
    return float(max(ratios)) if ratios else None


def _interval(parameters: Iterable[Any]) -> list[float] | None:
    """The interval of K, where its verdict is `identified`."""
    for parameter in parameters:
        if _get(parameter, "symbol") == "K" and _get(parameter, "verdict") == "identified":
            interval = _get(parameter, "interval") or _get(parameter, "ci")
            return None if interval is None else [_get(interval, "low"), _get(interval, "high")]
    return None


def _value(parameters: Iterable[Any]) -> float | None:
    """K, whatever its verdict."""
    for parameter in parameters:
        if _get(parameter, "symbol") == "K":
            value = _get(parameter, "value")
            return _get(parameter, "estimate") if value is None else value
    return None


# --- judging ---


def sets(result: Result) -> list[set[str]]:
    """The tool's set for each effect that it reports."""
    return [{e["name"], *e["alternatives"]} for e in result.get("effects") or ()]


def hidden(result: Result) -> set[str]:
    """What was hidden from the baseline; empty for nothing."""
    return set(result["kinds"]) - {NONE, DROPPED_FRICTION}


def named(result: Result, largest: int) -> int:
    """How many of the hidden effects are named, each in a set of its own of at most ``largest`` names.

    0 where more effects are reported than were hidden: then at least one name is wrong.
    """
    found, truth = [s for s in sets(result) if len(s) <= largest], sorted(hidden(result))
    if len(sets(result)) > len(truth):
        return 0
    return _matched(found, truth)


def _matched(found: Sequence[set[str]], truth: Sequence[str]) -> int:
    """Largest number of names that have a set each."""
    if not truth:
        return 0
    first, rest = truth[0], truth[1:]
    best = _matched(found, rest)
    for k, names in enumerate(found):
        if first in names:
            best = max(best, 1 + _matched([*found[:k], *found[k + 1 :]], rest))
    return best


def wrong_alone(result: Result) -> bool:
    """Whether some effect is named alone, and wrongly."""
    return any(len(s) == 1 and not s & hidden(result) for s in sets(result))


def wilson(hits: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    if trials == 0:
        return 0.0, 1.0
    p, w = hits / trials, Z * Z / trials
    half = Z * math.sqrt(p * (1.0 - p) / trials + w / (4.0 * trials))
    low, high = (p + w / 2.0 - half) / (1.0 + w), (p + w / 2.0 + half) / (1.0 + w)
    return max(0.0, low), min(1.0, high)


@dataclass(frozen=True)
class Score:
    """A target of the issue and how it stands; ``at_most`` turns it round."""

    group: str
    text: str
    target: float
    hits: int
    trials: int
    at_most: bool = False

    def holds(self, judge: str) -> bool:
        """Whether the target holds: by its Wilson bound, by count, or (few cases) unless the interval excludes it."""
        low, high = wilson(self.hits, self.trials)
        if judge == "count":
            low = high = self.hits / self.trials
        if judge == "unless_refuted":
            low, high = high, low
        return high <= self.target if self.at_most else low >= self.target

    def line(self, judge: str) -> str:
        """One line of the table."""
        low, high = wilson(self.hits, self.trials)
        bound, sign = (high, "<=") if self.at_most else (low, ">=")
        word = "pass" if self.holds(judge) else "FAIL"
        share = 100.0 * self.hits / self.trials
        return (
            f"{self.group:<12}{self.text:<52}{self.hits:>4}/{self.trials:<4}{share:>6.1f} %"
            f"  bound {100.0 * bound:5.1f} %  target {sign} {100.0 * self.target:.0f} %  {word}"
        )


def scores(results: Sequence[Result]) -> list[Score]:
    """Every target for which there are cases."""
    groups = {g: [r for r in results if r["group"] == g and "skipped" not in r] for g in SETS}
    table: list[Score] = []

    def add(
        group: str, text: str, target: float, hit: Callable[[Result], bool], at_most: bool = False
    ) -> None:
        table.append(Score(group, text, target, sum(map(hit, groups[group])), len(groups[group]), at_most))

    add("singles", "right name, alone or in a set of two", 0.95, lambda r: named(r, 2) == 1)
    add("singles", "right name alone", 0.85, lambda r: named(r, 1) == 1)
    add("nulls", "adequate", 0.98, lambda r: r.get("verdict") == "adequate")
    add("pairs", "both named", 0.80, lambda r: named(r, 2) == 2)
    add("pairs", "at least one named", 0.97, lambda r: named(r, 2) >= 1)
    groups["motor_only"], motor_nulls = (
        [r for r in groups["motor_only"] if hidden(r)],
        [r for r in groups["motor_only"] if not hidden(r)],
    )
    add("motor_only", "right name in a set of three", 0.85, lambda r: named(r, 3) == 1)
    groups["motor_only"] += motor_nulls
    add("motor_only", "wrong name alone", 0.03, wrong_alone, at_most=True)
    add("outside", "unexplained", 0.90, lambda r: r.get("verdict") == "unexplained")
    add("outside", "located in the right equation", 0.90, lambda r: r.get("location") in r["where"])
    add("outside", "confident wrong name", 0.05, wrong_alone, at_most=True)
    _paper_scores(groups, add)
    right = [r for g in ("singles", "pairs", "motor_only") for r in groups[g] if right_name(r)]
    groups["named right"] = right
    add("named right", "held-out residual within 1.15 of the noise", 0.90, _repaired)
    add("named right", "K's interval holds the truth", 0.90, _holds_stiffness)
    return [s for s in table if s.trials]


def _paper_scores(groups: dict[str, list[Result]], add: Callable[..., None]) -> None:
    """What the paper leaves out of its model: targets as for the motor alone, and for nothing hidden."""
    every = groups["paper"]
    groups["paper"] = [r for r in every if hidden(r)]
    add("paper", "all that the baseline lacks named, in sets of three", 0.85, right_name)
    groups["paper"] = [r for r in every if not hidden(r)]
    add("paper", "friction that the baseline holds: adequate", 0.98, lambda r: r.get("verdict") == "adequate")
    groups["paper"] = every
    add("paper", "wrong name alone", 0.03, wrong_alone, at_most=True)


def right_name(result: Result) -> bool:
    """Whether all that was hidden, and nothing else, is named within the group's size of set."""
    return bool(hidden(result)) and named(result, SETS[result["group"]]) == len(hidden(result))


def _repaired(result: Result) -> bool:
    ratio = result.get("residual_over_floor")
    return ratio is not None and bool(ratio <= REPAIRED)


def _holds_stiffness(result: Result) -> bool:
    interval = result.get("K_interval")
    return interval is not None and bool(interval[0] <= result["K"] <= interval[1])


# --- printing ---


def print_all(results: Sequence[Result], judge: str = "bound") -> bool:
    """Print targets, cost, confusion and misses; return whether every target holds."""
    table = scores(results)
    print(f"\nTargets ({JUDGES[judge]})")
    for score in table:
        print(score.line(judge))
    cheap = _print_cost(results)
    _print_confusion(results)
    _print_paper(results)
    _print_misses(results)
    for skipped in (r for r in results if "skipped" in r):
        print(f"not made: {skipped['name']}: {skipped['skipped']}")
    return cheap and all(score.holds(judge) for score in table)


def _print_cost(results: Sequence[Result]) -> bool:
    timed = [r for r in results if "seconds" in r and r.get("samples")]
    if not timed:
        return True
    per_45 = sorted(r["seconds"] * SAMPLES_45 / r["samples"] for r in timed)
    memory = max(r["memory_mb"] for r in timed)
    worst = max(r["seconds"] for r in timed)
    good = bool(worst <= SECONDS_45 and memory <= MEMORY_MB)
    print(
        f"\nseconds a record: median {per_45[len(per_45) // 2]:.1f} scaled to 45 s at 1 kHz, largest {worst:.1f} as"
        f" run (limit {SECONDS_45:g}); memory with the simulator's: {memory:.0f} MB (limit {MEMORY_MB:g})"
        f"  {'pass' if good else 'FAIL'}"
    )
    return good


def answer(result: Result) -> str:
    """The tool's answer in a few words, as the column of the confusion matrix."""
    if result.get("verdict") in ("error", "refused"):
        return str(result["verdict"])
    names = ["|".join([e["name"], *sorted(e["alternatives"])]) for e in result.get("effects") or ()]
    return " + ".join(sorted(names)) or str(result.get("verdict"))


def _print_confusion(results: Sequence[Result]) -> None:
    """One row for each kind that was hidden: how often which answer."""
    print("\nConfusion: hidden, cases, answers (most frequent first)")
    for group in SETS:
        rows: dict[str, Counter[str]] = {}
        for r in results:
            if r["group"] == group and "skipped" not in r:
                rows.setdefault(" + ".join(sorted(r["kinds"])), Counter())[answer(r)] += 1
        for kinds, answers in sorted(rows.items()):
            text = ", ".join(f"{name} {count}" for name, count in answers.most_common())
            print(f"{group:<11} {kinds:<46} {answers.total():>3}  {text}")


def _print_paper(results: Sequence[Result]) -> None:
    """Error of the stiffness by the paper's own route and by the diagnosis, where both gave one."""
    for kinds in dict.fromkeys(" + ".join(r["kinds"]) for r in results if r["group"] == "paper" and "K" in r):
        rows = [r for r in results if r["group"] == "paper" and " + ".join(r["kinds"]) == kinds]
        errors = {
            name: sorted(abs(r[key] / r["K"] - 1.0) for r in rows if r.get(key) is not None)
            for name, key in (("the paper's route", "K_paper"), ("the diagnosis", "K_after"))
        }
        text = ", ".join(f"{100.0 * e[len(e) // 2]:.3g} % by {name}" for name, e in errors.items() if e)
        print(f"K with {kinds} left out, median error of {len(rows)}: {text}")


def missed(result: Result) -> str:
    """Why a case counts as missed; empty where it does not."""
    if result.get("verdict") in ("error", "refused"):
        return f"{result['verdict']}: {result.get('error')}"
    if result["group"] == "outside":
        reasons = [
            "a confident wrong name" if wrong_alone(result) else "",
            "" if result.get("location") in result["where"] else f"located in {result.get('location')}",
        ]
        return ", ".join(filter(None, reasons))
    if not hidden(result):
        return "" if result.get("verdict") == "adequate" else "an alarm where nothing is hidden"
    if right_name(result):
        return ""
    if result.get("verdict") == "adequate":
        return "not noticed"
    if len(sets(result)) > len(hidden(result)):
        return "more names than effects"
    if any(hidden(result) & s for s in sets(result)):
        return "only some named" if len(hidden(result)) > 1 else "named in too large a set"
    return "a wrong name" if sets(result) else "located, not named"


def _print_misses(results: Sequence[Result]) -> None:
    rows = [(r, missed(r)) for r in results if "skipped" not in r]
    rows = [(r, why) for r, why in rows if why]
    if not rows:
        return
    print(
        "\nMissed: case, share, what of it the plain model leaves (both over the torque), record, answer, why"
    )
    for r, why in sorted(rows, key=lambda row: (row[0]["group"], row[0]["name"])):
        share = r.get("share") or []
        shares = "/".join(f"{100.0 * s:.1f}" for s in (share if isinstance(share, list) else [share]))
        shape = (r.get("shapes") or ["?"])[0]
        seen = "   ?" if r.get("visible") is None else f"{100.0 * r['visible']:4.1f}"
        print(f"  {r['name']:<54} {shares:>10} %  {seen} %  {shape:<9} {answer(r)}: {why}")


# --- cases and files ---


def generated_jobs(options: argparse.Namespace, recipes: Mapping[str, Any]) -> Iterator[Job]:
    """Jobs of the chosen lists."""
    for group in options.list or LISTS:
        for task in tasks(group, options.seeds)[: options.limit]:
            yield Job(group, task.name, options.tool, task=task, recipe=recipes.get(task.name))


def small_jobs(tool: str) -> Iterator[Job]:
    """Jobs of the small version."""
    for group, kinds in SMALL:
        task = next(t for t in tasks(group, "calibration") if t.kinds == kinds)
        task = replace(task, seconds=SMALL_SECONDS)
        yield Job(group, task.name, tool, task=task)


def small_faults(results: Sequence[Result]) -> list[str]:
    """What is clearly wrong in the results of the small version."""
    faults = []
    for r in results:
        if "skipped" in r or r.get("verdict") in ("error", "refused"):
            faults.append(f"{r['name']}: {r.get('skipped') or r.get('error')}")
        elif wrong_alone(r):
            faults.append(f"{r['name']}: a confident wrong name: {answer(r)}")
        elif not hidden(r) and r["verdict"] != "adequate":
            faults.append(f"{r['name']}: an alarm where nothing is hidden: {answer(r)}")
        elif r["group"] == "outside" and r["verdict"] != "unexplained":
            faults.append(f"{r['name']}: {r['verdict']}, but the library does not have it")
    named_right = sum(right_name(r) for r in results if "skipped" not in r and r["group"] != "outside")
    if named_right < SMALL_NAMED:
        faults.append(f"{named_right} cases named right, {SMALL_NAMED} are wanted")
    return faults


def run_small(options: argparse.Namespace) -> int:
    """Run the small version and say what is wrong."""
    start = time.perf_counter()
    done = run_all(list(small_jobs(options.tool)), None, None, options.jobs)
    faults = small_faults(done)
    _print_confusion(done)
    seconds = time.perf_counter() - start
    print(f"\n{len(done)} cases in {seconds:.0f} s: {'FAIL' if faults else 'pass'}")
    for fault in faults:
        print(f"  {fault}")
    return 1 if faults else 0


def labelled_jobs(folder: Path, tool: str) -> Iterator[Job]:
    """Jobs of a folder of labelled cases: single, motor_only, pairs, each with a truth.json."""
    for sub in ("single", "motor_only", "pairs"):
        truths = json.loads((folder / sub / "truth.json").read_text())
        for name, truth in sorted(truths.items()):
            group = {"single": "singles", "motor_only": "motor_only", "pairs": "pairs"}[sub]
            if group == "singles" and truth["kinds"] == [NONE]:
                group = "nulls"
            yield Job(group, f"{sub}/{name}", tool, folder=folder / sub / name, truth=truth)


def machine_digest() -> str:
    """Of the machine's source: what an older one found is no recipe for this one."""
    digest = hashlib.sha256()
    for path in sorted((ROOT / "benchmarks" / "machine").glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def read_lines(path: Path | None) -> list[dict[str, Any]]:
    """JSON lines; a last line that was cut off is left out."""
    lines = []
    for line in path.read_text().splitlines() if path is not None and path.exists() else ():
        try:
            lines.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return lines


def append_line(path: Path | None, line: Mapping[str, Any]) -> None:
    """Append one JSON line."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as file:
        file.seek(max(0, file.seek(0, os.SEEK_END) - 1))
        cut_off = file.read(1) not in (b"", b"\n")  # by an earlier run that was stopped
        file.write((b"\n" if cut_off else b"") + json.dumps(line).encode() + b"\n")


def run_all(jobs: Sequence[Job], results: Path | None, recipes: Path | None, workers: int) -> list[Result]:
    """Run what the results do not hold yet; return all results that belong to the jobs."""
    wanted = {job.name for job in jobs}
    done = {r["name"]: r for r in read_lines(results) if r["name"] in wanted}
    digest = machine_digest()
    left = [job for job in jobs if job.name not in done]
    for count, (result, recipe) in enumerate(_results(left, workers), 1):
        append_line(results, result)
        done[result["name"]] = result
        if recipe is not None:
            append_line(recipes, {"name": result["name"], "machine": digest, "recipe": recipe})
        said = result.get("skipped") or answer(result)
        print(f"{count}/{len(left)} {result['name']}: {said}", file=sys.stderr, flush=True)
    return [done[job.name] for job in jobs]


def _results(jobs: Sequence[Job], workers: int) -> Iterator[tuple[Result, dict[str, Any] | None]]:
    if workers <= 1:
        yield from map(run, jobs)
        return
    # One thread a process: the cores are taken already. Fresh processes now and then, lest memory be a sum of cases.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    with multiprocessing.get_context("spawn").Pool(workers, maxtasksperchild=50) as pool:
        yield from pool.imap_unordered(run, jobs)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    made.add_argument("--list", action="append", choices=LISTS, help="which cases; repeatable (default: all)")
    made.add_argument("--limit", type=int, help="only so many cases of each list, a fair sample")
    made.add_argument("--seeds", choices=tuple(FIRST_SEED), default="test")
    made.add_argument("--jobs", type=int, default=1, help="processes")
    made.add_argument("--results", type=Path, help="JSON lines (default: out/diagnosis-SEEDS.jsonl)")
    made.add_argument(
        "--recipes", type=Path, default=ROOT / "out" / "recipes.jsonl", help="sizes found before"
    )
    made.add_argument(
        "--small", action="store_true", help="the gate: a few short cases, 1 where clearly wrong"
    )
    made.add_argument("--labelled", type=Path, help="folder with single, motor_only and pairs")
    made.add_argument(
        "--judge", choices=tuple(JUDGES), help="when a target holds (default: bound; labelled: count)"
    )
    made.add_argument("--tool", default=TOOL, help="module:function that diagnoses")
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run and judge."""
    options = parser().parse_args(arguments)
    if options.small:
        return run_small(options)
    name = "labelled" if options.labelled else options.seeds
    results = options.results or ROOT / "out" / f"diagnosis-{name}.jsonl"
    if options.labelled:
        jobs = list(labelled_jobs(options.labelled, options.tool))
    else:
        digest = machine_digest()
        known = {r["name"]: r["recipe"] for r in read_lines(options.recipes) if r["machine"] == digest}
        jobs = list(generated_jobs(options, known))
    done = run_all(jobs, results, options.recipes, options.jobs)
    if not scores(done):
        return 2
    judge = options.judge or ("count" if options.labelled else "bound")
    return 0 if print_all(done, judge) else 1


if __name__ == "__main__":
    sys.exit(main())
