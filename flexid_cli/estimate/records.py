"""Several records of one axis to one result: each solved alone, then joined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError, UsageError
from flexid_cli.estimate import band, summary
from flexid_cli.estimate.identify import model_ids, solve_direct
from flexid_cli.estimate.joint import FEW, Evidence, Joint, combine
from flexid_cli.estimate.result import (
    Estimate,
    Fit,
    Identification,
    ModelResult,
    RecordResult,
    Skipped,
    Trace,
)
from flexid_cli.estimate.verdict import correlated_with, demoted, judge, model_doubt, undetermined
from flexid_cli.models.base import Parameter, unit_of
from flexid_cli.signals.records import notes_of

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.estimate.solution import Solution
    from flexid_cli.signals.records import Record

Array = NDArray[np.float64]

# What belongs to a record whatever the configuration says: an incremental encoder's zero, and the gravity about the
# middle of a small motion.
OWN = frozenset({"z", "Q0", "kg"})
# Parameters in which a model is not linear.
NONLINEAR = {"two_encoders": ("K",), "motor_only": ("Jm", "K", "JL"), "rigid": ()}
# Of a unit vector: what a parameter does not contribute.
ROUNDING = 1e-10
# With fewer rows the residuals are too much the parameters' own doing to tell their size.
ROWS_A_PARAMETER = 3
# What a payload or a posture changes.
LOAD = ("JL", "MX", "MY")
# The p value (Bonferroni over the shared parameters) below which a difference between records is told.
TOLD = 0.05
METHOD = "Student's t over the records jointly: random parts independent, systematic parts common to all"
BETWEEN = ", variance between records included"
NOT_BETWEEN = ", no variance between records, of which two do not tell"
DIFFERENT = "the difference between the records"


@dataclass(frozen=True)
class _Solved:
    """A model solved on one record."""

    name: str
    solution: Solution
    result: ModelResult
    evidence: Evidence
    parameters: tuple[Parameter, ...]

    @property
    def symbols(self) -> tuple[str, ...]:
        """Of the parameters, as this record alone names them."""
        return tuple(p.symbol for p in self.parameters)


def identify_records(records: Sequence[Record], config: Config) -> Identification:
    """Solve the models on several records of one axis together.

    Parameters
    ----------
    records : sequence of Record
        Two or more.
    config : Config
        ``estimate.per_record`` names what differs between them.

    Returns
    -------
    Identification
        A record on which a model cannot be solved is named in its warnings and left out.

    Raises
    ------
    DataError
        No model can be solved on any record.
    UsageError
        The configuration asks for what is defined for one record only.
    """
    _check(config)
    ids = tuple(dict.fromkeys(i for record in records for i in model_ids(record.recording, config)))
    hints: dict[str, float | None] = {}
    models: list[ModelResult] = []
    skipped: list[Skipped] = []
    for model_id in ids:
        _append(model_id, records, hints, config, models, skipped)
    if config.models is None and not models and "rigid" not in ids:
        _append("rigid", records, hints, config, models, skipped)
    if not models:
        reasons = "; ".join(f"{s.id}: {s.reason}" for s in skipped)
        raise DataError(f"no model can be solved on these records: {reasons}", "record what the reasons name")
    return Identification(tuple(models), tuple(skipped), notes_of(records))


def _check(config: Config) -> None:
    hint = "leave it out, or take the files one by one (--records one: files of one run)"
    if config.estimate.route == "paper":
        raise UsageError("route paper reproduces the tables of one record; several are given", hint)
    if config.estimate.essential:
        raise UsageError("essential parameters are selected on one record; several are given", hint)
    if config.estimate.replay:
        raise UsageError("the fitted axis is replayed on one record; several are given", hint)
    if config.estimate.effects:
        raise UsageError("effects join the models of one record; several are given", hint)


def _resonance(record: Record, config: Config, model_id: str, found: dict[str, float | None]) -> float | None:
    """Resonance that the record shows; ``found`` remembers it for the next model."""
    if config.axis.f1_hz is not None or model_id == "rigid":
        return None
    if record.name not in found:
        found[record.name] = band.find_resonance(record.recording, config.axis.gravity_m_per_s2)
    return found[record.name]


def _append(
    model_id: str,
    records: Sequence[Record],
    hints: dict[str, float | None],
    config: Config,
    models: list[ModelResult],
    skipped: list[Skipped],
) -> None:
    """Solve one model on all records, and add the joint result, or why there is none."""
    solved: list[_Solved] = []
    failed: dict[str, RecordResult] = {}
    for record in records:
        try:
            one = _solve(record, config, model_id, _resonance(record, config, model_id, hints))
        except DataError as error:
            failed[record.name] = RecordResult(record.name, reason=error.message)
            continue
        reason = _unusable(one)
        if reason:
            failed[one.name] = replace(_alone(one), reason=reason)
        else:
            solved.append(one)
    if solved:
        models.append(_model(records, solved, failed, config))
    else:
        skipped.append(Skipped(model_id, "; ".join(f"{one.name}: {one.reason}" for one in failed.values())))


def _unusable(one: _Solved) -> str:
    """Why a record's estimates cannot be joined with others', or nothing.

    Joining takes the equations as linear about each record's own estimates, which holds near them only.
    """
    if not one.solution.result.converged:
        return "the fit did not settle"
    far = [e.symbol for e in one.result.parameters if e.symbol in NONLINEAR[one.result.id] and _is_far(e)]
    if far:
        return f"alone it does not determine {', '.join(far)}, about which the joint fit would be linearised"
    rows, size = sum(one.solution.columns.lengths), one.evidence.theta.size
    if rows < ROWS_A_PARAMETER * size:
        return f"too short: {rows} rows after filtering and decimation for {size} parameters"
    return ""


def _is_far(estimate: Estimate) -> bool:
    return estimate.value is None or estimate.verdict == "not_identifiable"


def _solve(record: Record, config: Config, model_id: str, f1: float | None) -> _Solved:
    if model_id not in model_ids(record.recording, config) and model_id != "rigid":
        raise DataError("the record lacks the signals of this model", "record the joint position")
    solution = solve_direct(record.recording, config, model_id, f1)
    result, uncertainty = summary.analyse(solution, config)
    parameters, theta, G = summary.report_form(solution.model, solution.reported.theta)
    dependent = solution.result.dependent
    evidence = Evidence(
        symbols=tuple(_symbol(p.symbol, record.name, config) for p in parameters),
        theta=theta,
        covariance=G @ uncertainty.random @ G.T,
        degrees_of_freedom=solution.reported.degrees_of_freedom,
        shifts={name: G @ shift for name, shift in uncertainty.shifts.items()},
        directions=_directions(solution, G) if dependent else None,
        dependent=frozenset(_symbol(parameters[k].symbol, record.name, config) for k in dependent),
    )
    if not evidence.is_long_enough:
        white = G @ _white(solution, uncertainty.random) @ G.T
        evidence = replace(evidence, covariance=white, whole=False)
    return _Solved(record.name, solution, result, evidence, parameters)


def _white(solution: Solution, covariance: Array) -> Array:
    """The covariance with the correlations that residuals without memory would leave.

    A short record has too few independent residuals for the correlations of all its parameters.
    """
    white = solution.reported.bread @ (solution.reported.instruments.T @ solution.reported.instruments)
    white = white @ solution.reported.bread.T
    size = np.sqrt(np.maximum(np.diag(white), np.finfo(float).tiny))
    wanted = np.sqrt(np.diag(covariance)) / size
    return np.asarray(white * np.outer(wanted, wanted), dtype=np.float64)


def _symbol(symbol: str, record: str, config: Config) -> str:
    """Name of a parameter in the joint estimate: ``K``, and ``JL[payload]`` where it is the record's own."""
    named = set(config.estimate.per_record or ())
    own = symbol in OWN or bool(named & set(symbol.split("+")))
    return f"{symbol}[{record}]" if own else symbol


def _directions(solution: Solution, G: Array) -> Array:
    """Combinations of the reported parameters that the columns determine, shape (rank, p)."""
    J = solution.result.jacobian
    scale = np.linalg.norm(J, axis=0)
    scale[scale == 0.0] = 1.0
    _, _, Vt = np.linalg.svd(J / scale, full_matrices=False)
    known = np.where(np.abs(Vt) < ROUNDING, 0.0, Vt)[: solution.result.rank]
    return np.asarray((known * scale) @ np.linalg.inv(G), dtype=np.float64)


# --- the joint result ---------------------------------------------------------


def _model(
    records: Sequence[Record], solved: Sequence[_Solved], failed: Mapping[str, RecordResult], config: Config
) -> ModelResult:
    first = solved[0]
    by_name = {one.name: _alone(one) for one in solved} | dict(failed)
    alone = tuple(by_name[record.name] for record in records)
    left_out = tuple(
        f"{first.result.id}: record {one.name} was left out: {one.reason}" for one in failed.values()
    )
    if len(solved) == 1:
        reason = f"{first.result.method_reason}; of the records, only {first.name} could be solved"
        warnings = (*left_out, *first.result.warnings)
        return replace(first.result, method_reason=reason, records=alone, warnings=warnings)
    joint = combine([one.evidence for one in solved])
    build = _Builder(joint, solved, config)
    estimates, derived = build.estimates(), build.derived()
    fitted = build.fit()
    doubt = _doubt(solved) or model_doubt(estimates, fitted.fit_percent)
    if not doubt and joint.widened > 1.0 and len(solved) < FEW:
        doubt = "the two records contradict each other"
    return replace(
        first.result,
        method=f"joint fit of {len(solved)} records",
        method_reason=_reason(solved, config),
        parameters=tuple(demoted(e, doubt) for e in estimates),
        regression=(),
        derived=tuple(demoted(e, doubt) for e in derived),
        correlation_names=joint.symbols,
        correlation=summary.correlation_of(joint.covariance),
        condition_number=joint.condition_number,
        rank=joint.rank,
        columns=len(joint.symbols),
        fit=fitted,
        trace=build.trace(),
        added_terms=tuple(dict.fromkeys(t for one in solved for t in one.result.added_terms)),
        tests={"consistency": _consistency(joint), "bias_budget": _budget(joint)},
        warnings=(*left_out, *_told(joint, first.result.id), *_warnings(solved, doubt)),
        records=alone,
    )


def _alone(one: _Solved) -> RecordResult:
    return RecordResult(one.name, one.result.parameters, one.result.fit, one.result.tests)


def _reason(solved: Sequence[_Solved], config: Config) -> str:
    methods = ", ".join(dict.fromkeys(one.result.method for one in solved))
    named = ", ".join(config.estimate.per_record or ())
    text = f"each record solved alone ({methods}), then generalised least squares over them"
    return f"{text}; {named} estimated for each record" if named else text


def _doubt(solved: Sequence[_Solved]) -> str:
    """Why one of the records makes the joint estimate doubtful, or nothing."""
    for one in solved:
        doubt = model_doubt(one.result.parameters, one.result.fit.fit_percent)
        if doubt:
            return f"record {one.name}: {doubt}"
    return ""


def _warnings(solved: Sequence[_Solved], doubt: str) -> list[str]:
    """What stands against each record, its name first, and the doubt about all of them."""
    model = solved[0].result.id
    told = [f"{model}: {doubt}; no parameter counts as identified"] if doubt else []
    for one in solved:
        told += [f"{model}: {one.name}: {text.removeprefix(f'{model}: ')}" for text in one.result.warnings]
    return told


def _told_differences(joint: Joint) -> dict[str, float]:
    """P value of each shared parameter in which the records surely differ."""
    many = len(joint.differences)
    found = {s: d.p_value for s, d in joint.differences.items() if d.p_value is not None}
    return {s: p for s, p in found.items() if p * many < TOLD}


def _told(joint: Joint, model: str) -> list[str]:
    """Sentences about what differs between the records."""
    told = []
    for symbol in _told_differences(joint):
        one = joint.differences[symbol]
        value = abs(float(joint.theta[joint.symbols.index(symbol)]))
        size = f" ({100.0 * one.stderr / value:.2g} % standard deviation)" if value and one.stderr else ""
        cure = ""
        if symbol in LOAD:
            cure = "; where payload or posture differ, name it in estimate.per_record"
        told.append(
            f"{model}: {symbol} differs between the records by more than their own uncertainty{size}{cure}"
        )
    if joint.widened > 1.0:
        told.append(
            f"{model}: the records contradict each other in combinations of parameters; all intervals were widened"
            f" {np.sqrt(joint.widened):.2g} times"
        )
    return told


def _consistency(joint: Joint) -> dict[str, Any]:
    found = joint.consistency
    return {
        "statistic": found.statistic,
        "scaled_statistic": found.scaled,
        "restrictions": found.restrictions,
        "p_value": found.p_value,
        "widened": float(np.sqrt(joint.widened)),
        "parameters": {
            symbol: {
                "records": one.records,
                "statistic": one.statistic,
                "p_value": one.p_value,
                "between_records_stderr": one.stderr,
            }
            for symbol, one in joint.differences.items()
        },
        "meaning": "J test that the records agree in what they share; the JSON holds each parameter's differences",
    }


def _budget(joint: Joint) -> dict[str, Any]:
    """Shares of each parameter's standard error, in per cent of its value."""
    budget: dict[str, Any] = {}
    for k, symbol in enumerate(joint.symbols):
        if k in joint.dependent or symbol.startswith("z[") or joint.theta[k] == 0.0:
            continue
        percent = 100.0 / abs(float(joint.theta[k]))
        budget[symbol] = {
            "random_percent": percent * float(np.sqrt(joint.random[k, k])),
            "between_records_percent": percent * float(np.sqrt(joint.between[k, k])),
            "systematic_percent": {n: percent * abs(float(s[k])) for n, s in joint.shifts.items()},
        }
    return {
        "parameters": budget,
        "meaning": "the JSON holds each parameter's random, between-record and systematic parts",
    }


class _Builder:
    """Report of a joint estimate.

    Parameters
    ----------
    joint : Joint
    solved : sequence of _Solved
        What it was made from.
    config : Config
    """

    def __init__(self, joint: Joint, solved: Sequence[_Solved], config: Config) -> None:
        self.joint, self.solved, self.config = joint, solved, config
        self.covariance = joint.covariance
        self.place = {symbol: k for k, symbol in enumerate(joint.symbols)}
        self.differing = _told_differences(joint)
        method = METHOD if config.estimate.covariance == "hac" else summary.IID
        self.method = method + (BETWEEN if len(solved) >= FEW else NOT_BETWEEN)

    def estimates(self) -> tuple[Estimate, ...]:
        """One for each parameter, the shared ones first."""
        found: dict[str, Estimate] = {}
        for one in self.solved:
            for parameter, symbol in zip(one.parameters, one.evidence.symbols, strict=True):
                if symbol not in found:
                    found[symbol] = self._estimate(replace(parameter, symbol=symbol), one)
        return tuple(sorted(found.values(), key=lambda e: "[" in e.symbol))

    def _estimate(self, parameter: Parameter, one: _Solved) -> Estimate:
        joint, k = self.joint, self.place[parameter.symbol]
        unit = self._unit(parameter)
        if k in joint.dependent:
            return undetermined(parameter, unit, self._undetermined(k))
        doubts = [
            self._contradiction([parameter.symbol]),
            correlated_with(summary.correlation_of(self.covariance), joint.symbols, k),
            self._largest(k),
        ]
        found = judge(
            parameter,
            unit,
            float(joint.theta[k]),
            float(np.sqrt(self.covariance[k, k])),
            float(joint.degrees_of_freedom[k]),
            level=self.config.estimate.confidence_level,
            method=self.method,
            doubt="; ".join(d for d in doubts if d),
        )
        alone = {e.symbol: e for e in one.result.parameters}[parameter.symbol.partition("[")[0]]
        return demoted(replace(found, advice=alone.advice), self._contradiction([parameter.symbol]))

    def _undetermined(self, k: int) -> str:
        """Why no record determines a parameter."""
        if not self._is_seen(k):
            return "its column is zero in every record"
        others = [self.joint.symbols[j] for j in self.joint.dependent if j != k and self._is_seen(j)]
        return f"no record tells it from {', '.join(others)}"

    def _is_seen(self, k: int) -> bool:
        """Whether a parameter takes part in anything that a record determines."""
        symbol = self.joint.symbols[k]
        found = [one.evidence for one in self.solved if symbol in one.evidence.symbols]
        return any(bool(np.any(e.combinations[:, e.symbols.index(symbol)])) for e in found)

    def _contradiction(self, symbols: Sequence[str]) -> str:
        """In which of the parameters the only two records that determine them contradict each other, or nothing."""
        differing = [s for s in symbols if s in self.differing and self.joint.differences[s].records < FEW]
        return f"the two records contradict each other in {', '.join(differing)}" if differing else ""

    def _largest(self, k: int) -> str:
        sizes = {name: abs(float(s[k])) for name, s in self.joint.shifts.items()}
        sizes[DIFFERENT] = float(np.sqrt(self.joint.between[k, k]))
        name = max(sizes, key=sizes.__getitem__)
        return f"limited by {name}" if sizes[name] ** 2 > self.joint.random[k, k] else ""

    def _unit(self, parameter: Parameter) -> str:
        recording = self.solved[0].solution.columns.recording
        return unit_of(parameter.quantity, linear=recording.linear, torque_unit=recording.torque_unit)

    def derived(self) -> tuple[Estimate, ...]:
        """Quantities that follow; one for each record where they rest on parameters of its own."""
        found: dict[str, Estimate] = {}
        for one in self.solved:
            names = dict(zip(one.symbols, one.evidence.symbols, strict=True))
            index = {s: self.place[name] for s, name in names.items()}
            strong = [index.get(s) for s in ("Jm", "K", "JL")]
            if any(k is None or k in self.joint.dependent for k in strong):
                continue
            values = {s: float(self.joint.theta[k]) for s, k in index.items()}
            for parameter, value, slopes in (
                *summary.resonances(values),
                *summary.sums(one.solution.model, values),
            ):
                used = [index[s] for s in slopes]
                own = any("[" in names[s] for s, slope in slopes.items() if slope)
                symbol = f"{parameter.symbol}[{one.name}]" if own else parameter.symbol
                if symbol in found or set(used) & set(self.joint.dependent):
                    continue
                doubt = self._contradiction([names[s] for s, slope in slopes.items() if slope])
                gradient = np.array([*slopes.values()])
                named = replace(parameter, symbol=symbol)
                found[symbol] = demoted(self._derived(named, value, used, gradient, doubt), doubt)
        return tuple(sorted(found.values(), key=lambda e: "[" in e.symbol))

    def _derived(
        self, parameter: Parameter, value: float, used: list[int], slopes: Array, doubt: str
    ) -> Estimate:
        stderr = float(np.sqrt(slopes @ self.covariance[np.ix_(used, used)] @ slopes))
        return judge(
            parameter,
            self._unit(parameter),
            value,
            stderr,
            float(np.min(self.joint.degrees_of_freedom[used])),
            level=self.config.estimate.confidence_level,
            method=self.method,
            doubt=doubt,
        )

    def _residual(self, one: _Solved) -> Array:
        """What the joint estimate leaves of the record's torque."""
        values = {
            s: self.joint.theta[self.place[n]] for s, n in zip(one.symbols, one.evidence.symbols, strict=True)
        }
        own = [p.symbol for p in one.solution.model.parameters]
        theta = np.array([values["z"] * values["K"] if s == "c" else values[s] for s in own])
        return np.asarray(
            one.solution.matrices[0] @ one.solution.model.coefficients(theta)[0], dtype=np.float64
        )

    def fit(self) -> Fit:
        """How well the joint estimate predicts the torque of all records."""
        torques = [one.solution.columns("torque", 0) for one in self.solved]
        residuals = [self._residual(one) for one in self.solved]
        rows = sum(t.size for t in torques)
        energy = sum(float(t @ t) for t in torques)
        spread = sum(float(np.sum((t - t.mean()) ** 2)) for t in torques)
        left = sum(float(e @ e) for e in residuals)
        return Fit(
            torque_rms=float(np.sqrt(energy / rows)),
            residual_rms=float(np.sqrt(left / rows)),
            fit_percent=100.0 * (1.0 - float(np.sqrt(left / spread))) if spread else 0.0,
            unit=self.solved[0].result.fit.unit,
        )

    def trace(self) -> Trace:
        """Measured torque of the first record, and what the joint estimate predicts."""
        one = self.solved[0]
        torque = one.solution.columns("torque", 0)
        return Trace(one.solution.columns.times, torque, torque - self._residual(one), one.result.fit.unit)
