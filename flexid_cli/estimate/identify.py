"""From a recording to parameters: the main job."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flexid_cli.errors import DataError
from flexid_cli.estimate import band, band_choice, budget, methods, paper_route, replay, summary
from flexid_cli.estimate.fit import FitResult, block_matrices, block_matrix, fit
from flexid_cli.estimate.least_squares import solve, triangle
from flexid_cli.estimate.result import Identification, ModelResult, Skipped
from flexid_cli.estimate.reversal import COARSE_GRID, FINE_GRID, fit_reversal_velocity
from flexid_cli.estimate.solution import Solution
from flexid_cli.models import motor_only
from flexid_cli.models.motor_only import MotorOnly
from flexid_cli.models.rigid import Rigid
from flexid_cli.models.two_encoders import TOTAL, TwoEncoders, TwoEncodersStructured
from flexid_cli.pipeline.chain import Chain
from flexid_cli.pipeline.columns import Columns
from flexid_cli.threads import side_by_side

if TYPE_CHECKING:
    from flexid_cli.config.schema import Config
    from flexid_cli.signals.recording import Recording

Array = NDArray[np.float64]

# Over a smaller motion cos q and sin q are a constant and a slope to 1.5 % of the gravity moment.
SMALL_MOTION_RAD = 0.35
MAX_REBUILDS = 8
SETTLED = 1e-6
RETUNE_TOLERANCE = 0.15
RIGID_BIAS_OVER_STDERR = 0.3
# A spring is passive: only a clearly positive JL^2/K is one, and worth a narrower band.
CLEAR_FLEXIBILITY = 3.0


def identify(recording: Recording, config: Config) -> Identification:
    """Solve the models that the configuration asks for, or all that the signals allow.

    Parameters
    ----------
    recording : Recording
        Joint side, SI.
    config : Config
        Axis, pipeline and estimate options.

    Returns
    -------
    Identification

    Raises
    ------
    DataError
        No model can be solved on this recording.
    """
    ids = model_ids(recording, config)
    flexible = [i for i in ids if i != "rigid"]
    f1 = None
    if flexible and config.axis.f1_hz is None:
        f1 = band.find_resonance(recording, config.axis.gravity_m_per_s2)
    results = side_by_side(lambda model_id: _solved(recording, config, model_id, f1), ids)
    models = [found for found in results if isinstance(found, ModelResult)]
    skipped = [found for found in results if isinstance(found, Skipped)]
    if config.models is None and not models and "rigid" not in ids:
        models.append(_solve(recording, config, "rigid", None))
    if not models:
        reasons = "; ".join(f"{s.id}: {s.reason}" for s in skipped)
        raise DataError(
            f"no model can be solved on this recording: {reasons}", "record what the reasons name"
        )
    return Identification(tuple(models), tuple(skipped), tuple(recording.notes))


def model_ids(recording: Recording, config: Config) -> tuple[str, ...]:
    """Models that the configuration asks for, or all that the signals allow.

    Raises
    ------
    DataError
        One needs a joint encoder that the configuration does not name.
    """
    ids = config.models or (("two_encoders",) if recording.has_joint_position else ()) + ("motor_only",)
    if "two_encoders" in ids and not recording.has_joint_position:
        raise DataError(
            "the model two_encoders needs joint_position, which the configuration does not name",
            "add signals.joint_position, or take `two_encoders` out of `models`",
        )
    return tuple(ids)


def _solved(recording: Recording, config: Config, model_id: str, f1: float | None) -> ModelResult | Skipped:
    try:
        return _solve(recording, config, model_id, f1)
    except DataError as error:
        return Skipped(model_id, str(error.message) + (f" ({error.hint})" if error.hint else ""))


def _solve(recording: Recording, config: Config, model_id: str, f1: float | None) -> ModelResult:
    if config.estimate.route == "paper" and model_id != "rigid":
        tuning = band.choose_tuning(recording, config, model_id, f1)
        return paper_route.solve_paper(make_columns(recording, config, tuning), config, model_id, tuning)

    def estimate(record: Recording, resonance: float | None) -> Solution:
        solution = solve_direct(record, config, model_id, resonance)
        return summary.reduced(solution, config) if config.estimate.essential else solution

    solution = estimate(recording, f1)
    found, uncertainty = summary.analyse(solution, config)
    if config.estimate.replay:
        found = replay.with_replays(found, solution, uncertainty, config.estimate.replay, estimate)
    return found


def solve_direct(recording: Recording, config: Config, model_id: str, f1: float | None) -> Solution:
    """Fit one model by the configured method, tuned to the resonance that the fit itself finds.

    Parameters
    ----------
    f1 : float or None
        Resonance that the data show, Hz, where the configuration names none.

    Raises
    ------
    DataError
        It cannot be solved on this recording.
    """
    solver = {"two_encoders": _two_encoders, "motor_only": _motor_only, "rigid": _rigid}[model_id]
    solution = solver(recording, config, f1)
    fitted = summary.fitted_resonance(solution.model, solution.result.theta)
    off = abs(fitted / solution.tuning.f1_hz - 1.0) if fitted and solution.tuning.f1_hz else 0.0
    if solution.tuning.f1_source == "data" and fitted and off > RETUNE_TOLERANCE:
        # The scan's resonance came from a simpler fit; tune once more to the one that the full fit finds.
        solution = solver(recording, config, fitted)
    return solution


def make_columns(recording: Recording, config: Config, tuning: band.Tuning) -> Columns:
    """Columns of the recording through the chosen chain.

    Raises
    ------
    DataError
        No segment is long enough for the filters.
    """
    columns = Columns(recording, Chain(tuning.chain), tuning.sign_cutoff_hz, config.axis.gravity_m_per_s2)
    if not columns.segments:
        longest = max(s.samples for s in recording.segments) / recording.sample_rate_hz
        raise DataError(
            f"the longest gap-free stretch, {longest:.3g} s, is too short for a band of"
            f" {columns.chain.band_hz:.3g} Hz",
            "record longer, raise pipeline.band_hz, or permit longer gaps with signals.time.max_gap_s",
        )
    return columns


def _two_encoders(recording: Recording, config: Config, f1: float | None) -> Solution:
    return methods.two_encoders(
        _in_best_band(_two_encoders_plain, recording, config, "two_encoders", f1), config
    )


def _two_encoders_plain(recording: Recording, config: Config, tuning: band.Tuning) -> Solution:
    """The weighted fit in one band, with the width of the reversal that fits best there."""
    columns = make_columns(recording, config, tuning)

    def cost() -> float:
        return _log_residual(columns, TOTAL.columns)

    columns.set_reversal_velocity(fit_reversal_velocity(columns, cost))
    method = config.estimate.method
    model: TwoEncoders | TwoEncodersStructured = TwoEncoders()
    if method not in {"ols", "wls"}:
        model = TwoEncodersStructured()
    matrices = block_matrices(model, columns)
    start, weighted = _two_encoders_start(columns), method != "ols"
    covariance = config.estimate.covariance
    result = fit(model, matrices, start, columns.lengths, weighted=weighted, covariance=covariance)
    return Solution(model, columns, matrices, result, tuning, method, "configured")


def _in_best_band(
    solve_in: Callable[[Recording, Config, band.Tuning], Solution],
    recording: Recording,
    config: Config,
    model_id: str,
    f1: float | None,
) -> Solution:
    """The plain fit in the usual band, or in another one where that leaves a clearly smaller error."""
    plain = solve_in(recording, config, band.choose_tuning(recording, config, model_id, f1))
    f1_hz = plain.tuning.f1_hz
    if f1_hz is None or not band_choice.is_automatic(config):
        return plain
    bands = band_choice.weigh(
        model_id,
        lambda over_f1: band.choose_tuning(recording, config, model_id, f1, over_f1),
        lambda tuning: _outcome(plain, config, tuning),
    )
    if bands is not None and bands.moved:
        plain = solve_in(recording, config, bands.tuning)
    return replace(plain, bands=bands)


def _outcome(plain: Solution, config: Config, tuning: band.Tuning) -> band_choice.Outcome:
    """Jm, K and JL by a fit in another band from where the plain one stands, with what makes up their errors."""
    columns = plain.columns
    if tuning != plain.tuning:
        columns = make_columns(columns.recording, config, tuning)
        columns.set_reversal_velocity(plain.columns.reversal_velocity)
    symbols = [p.symbol for p in plain.model.parameters]
    if plain.model.id == "motor_only":
        columns.rebuild_joint(*(plain.result.theta[symbols.index(s)] for s in ("Jm", "FVm", "FSm", "K")))
    matrices, weighted = block_matrices(plain.model, columns), len(plain.model.blocks) > 1
    result = fit(plain.model, matrices, plain.result.theta, columns.lengths, weighted=weighted)
    solution = replace(plain, columns=columns, matrices=matrices, result=result, tuning=tuning)
    if methods.takes_noise_out(config):
        solution = methods.subtracted(solution)
    uncertainty = summary.total_uncertainty(solution, config)
    strong = [symbols.index(s) for s in ("Jm", "K", "JL")]
    noise, systematic = np.zeros(3), np.zeros(3)
    for name, shift in uncertainty.shifts.items():
        if name in summary.NOISES:
            noise += shift[strong] ** 2
        elif name != summary.GEAR_DOUBT:  # there or not: a band that hides it is none the better
            systematic += shift[strong] ** 2
    return band_choice.Outcome(
        solution.result.theta[strong],
        np.sqrt(np.diag(uncertainty.random)[strong]),
        np.sqrt(noise),
        np.sqrt(systematic),
        float(np.min(solution.result.degrees_of_freedom[strong])),
    )


def _two_encoders_start(columns: Columns) -> Array:
    """Motor equation and torsion equation, each by linear least squares of its own."""
    motor, torsion = (block_matrix(block, columns) for block in TwoEncodersStructured.blocks)
    Jm, FVm, FSm, K, minus_c = _regress(motor)
    _, JL, MX, MY, FV, FS = _regress(torsion) * K
    return np.array([Jm, FVm, FSm, K, JL, MX, MY, FV, FS, -minus_c])


def _regress(M: Array) -> Array:
    """First column on the others; the shortest solution in scaled units where columns are dependent."""
    scale = np.linalg.norm(M[:, 1:], axis=0)
    scale[scale == 0.0] = 1.0
    return np.asarray(np.linalg.lstsq(M[:, 1:] / scale, M[:, 0], rcond=None)[0] / scale, dtype=np.float64)


def _motor_only(recording: Recording, config: Config, f1: float | None) -> Solution:
    recording = without_joint(recording)
    return methods.motor_only(_in_best_band(_motor_only_plain, recording, config, "motor_only", f1), config)


def _motor_only_plain(recording: Recording, config: Config, tuning: band.Tuning) -> Solution:
    """The structured fit in one band, with the width of the reversal that fits best there."""
    columns = make_columns(recording, config, tuning)
    model = MotorOnly(gravity_form(recording))
    start = _motor_start(columns, model)

    # Instruments bring a width of their own, free of the noise that draws this one.
    grid = COARSE_GRID if methods.takes_noise_out(config) else FINE_GRID

    def cost() -> float:
        # The linear fit's free coefficients would hide a wrong width: only the physical ones feel it.
        return float(np.log(_motor_fit(columns, model, start, "iid", rebuilds=1)[1].sigmas[0]))

    columns.set_reversal_velocity(fit_reversal_velocity(columns, cost, grid=grid))
    matrices, result = _motor_fit(columns, model, start, config.estimate.covariance, rebuilds=MAX_REBUILDS)
    reason = "direct fit of the physical parameters to the exact equation (18), all terms kept"
    return Solution(model, columns, matrices, result, tuning, "structured", reason)


def _motor_fit(
    columns: Columns, model: MotorOnly, theta: Array, covariance: str, *, rebuilds: int
) -> tuple[tuple[Array, ...], FitResult]:
    """Fit, rebuild the joint's motion from the parameters, and fit again until they settle."""
    for _ in range(rebuilds):
        Jm, K, _, FVm, _, FSm = theta[:6]
        columns.rebuild_joint(Jm, FVm, FSm, K)
        matrices = block_matrices(model, columns)
        result = fit(model, matrices, theta, columns.lengths, weighted=False, covariance=covariance)
        moved = np.max(np.abs(result.theta[:3] / theta[:3] - 1.0))
        theta = result.theta
        if moved < SETTLED:
            break
    return matrices, result


def _log_residual(columns: Columns, names: Sequence[tuple[str, int]]) -> float:
    """Logarithm of the residual's size when the first column is regressed on the others."""
    W = np.column_stack([columns(*c) for c in names])
    size = np.linalg.norm(W, axis=0)
    size[size == 0.0] = 1.0
    R = triangle(W / size)
    rest = R[:, 0] - R[:, 1:] @ np.linalg.lstsq(R[:, 1:], R[:, 0], rcond=None)[0]
    return float(np.log(max(float(np.linalg.norm(rest)), 1e-300)))


def _motor_start(columns: Columns, model: MotorOnly) -> Array:
    names = [("torque", 2), ("torque", 1), ("motor", 4), ("motor", 3), ("motor", 2), ("motor", 1)]
    names += [("sign_motor", 0), ("one", 0), ("motor", 0)]
    W = np.column_stack([columns(*c) for c in names])
    W[:, :2] *= -1.0
    X = solve(W, columns("torque", 0)).estimate
    start = motor_only.starting_point(X)
    if not np.all(start[:3] > 0.0):
        raise DataError(
            "the motor's own motion shows no resonance in the band used: the regression gives a negative"
            " stiffness or inertia",
            "excite the axis around its first resonance, give axis.f1_hz, or record the joint encoder",
        )
    return np.concatenate([start, np.zeros(len(model.parameters) - start.size)])


def _rigid(recording: Recording, config: Config, f1: float | None) -> Solution:
    recording = without_joint(recording)
    tuning = band.choose_tuning(recording, config, "rigid", f1)
    fixed = config.pipeline.band_hz is not None or config.pipeline.decimation is not None
    levels = budget.noise_levels(recording)
    model = Rigid(gravity_form(recording))
    start = np.zeros(len(model.parameters))
    while True:
        columns = make_columns(recording, config, tuning)

        def cost(columns: Columns = columns) -> float:
            return _log_residual(columns, model.blocks[0].columns)

        columns.set_reversal_velocity(fit_reversal_velocity(columns, cost))
        matrices = block_matrices(model, columns)
        result = fit(
            model, matrices, start, columns.lengths, weighted=False, covariance=config.estimate.covariance
        )
        bias = abs(budget.noise_bias(model, result, columns, levels)[0])
        flexibility = budget.left_out_flexibility(result, columns)
        if flexibility.value > CLEAR_FLEXIBILITY * flexibility.stderr:
            bias = max(bias, abs(flexibility.per_unit[0] * flexibility.value))
        narrower = band.narrower(tuning, config, recording)
        if fixed or narrower is None or bias < RIGID_BIAS_OVER_STDERR * result.stderr[0]:
            break
        tuning = narrower
    return Solution(model, columns, matrices, result, tuning, "ols", "one equation, linear in its parameters")


def without_joint(recording: Recording) -> Recording:
    """The recording as a drive without joint encoder would have it."""
    segments = tuple(replace(segment, joint_position=None) for segment in recording.segments)
    return replace(recording, segments=segments)


def gravity_form(recording: Recording) -> str:
    """How gravity enters a model without joint encoder: none, a spring, or its two moments."""
    if recording.linear:
        return "none"
    low = min(float(s.motor_position.min()) for s in recording.segments)
    high = max(float(s.motor_position.max()) for s in recording.segments)
    return "spring" if high - low < SMALL_MOTION_RAD else "moments"
