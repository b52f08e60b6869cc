"""The compiled integrator: axis, sampled controller and any effects, with located events.

Runge-Kutta 5(4) of Dormand and Prince (J. R. Dormand, P. J. Prince, J. Comp. Appl. Math. 6, 1980), between
instants at which the input may jump. Wherever a switching function changes its sign (a mass stops or breaks loose, a
flank makes contact, a limit is reached) the step ends there, so that no step runs across a kink.

Effects come in as machine addresses of compiled laws (`compiled.law_table`), called in the order of their stages: the
kernel is compiled once, whatever effects there are. All compiled functions stand in this one file, because the cache
of compiled code knows changes of its own file only.
"""

from __future__ import annotations

import math

import numpy as np

from flexid_cli.effects import slots
from flexid_cli.jit import compiled
from flexid_cli.simulate.compiled import call_law, pointer, shifted

# Status of a run
DONE, UNSTABLE, TOO_MANY_STEPS, TOO_MANY_EVENTS = 0, 1, 2, 3
# Stages, as in effects.base.Stage, by their number
LIMIT, LAG, KINEMATICS, CONTACT, TRANSMISSION, MOTOR, LOAD, MEASUREMENT = 0, 1, 2, 3, 4, 5, 6, 7
# Columns of the record, before the effects' states
(
    COMMAND, TORQUE, MOTOR_POSITION, MOTOR_VELOCITY, MOTOR_ACCELERATION, JOINT_POSITION, JOINT_VELOCITY,
    JOINT_ACCELERATION, TORSION, JOINT_TORQUE, MEASURED_MOTOR, MEASURED_JOINT, MEASURED_JOINT_RATE, JOINT_DELAY,
) = range(14)  # fmt: skip
COLUMNS = 14
# What the error of a state is measured by
BY_TORSION, BY_VELOCITY, BY_ITSELF = 0, 1, 2
MAX_STEPS = 20_000
MAX_EVENTS = 2_000
SMALLEST_STEP = 1e-9  # of the interval

_A = np.array(
    [
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1 / 5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [3 / 40, 9 / 40, 0.0, 0.0, 0.0, 0.0],
        [44 / 45, -56 / 15, 32 / 9, 0.0, 0.0, 0.0],
        [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729, 0.0, 0.0],
        [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656, 0.0],
        [35 / 384, 0.0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84],
    ]
)
_C = np.array([0.0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
_E = np.array([71 / 57600, 0.0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])


@compiled
def _run_stage(stage, w, p, x, dx, g, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    for i in range(stages[stage], stages[stage + 1]):
        row = 4 * i
        state = laws[row + 2]
        call_law(
            laws[row],
            w,
            shifted(p, laws[row + 1]),
            shifted(x, state),
            shifted(dx, state),
            shifted(g, laws[row + 3]),
        )


@compiled
def _input(t, x, w):  # type: ignore[no-untyped-def] # pragma: no cover
    """Evaluate the input's polynomial: a torque, or the motor's position with two derivatives."""
    s = t - w[slots.INTERVAL_START]
    c = slots.INPUT
    value = w[c] + s * (w[c + 1] + s * (w[c + 2] + s * (w[c + 3] + s * (w[c + 4] + s * w[c + 5]))))
    if w[slots.DRIVEN] == 0.0:
        w[slots.COMMAND] = value
        return
    x[0] = value
    x[2] = w[c + 1] + s * (2.0 * w[c + 2] + s * (3.0 * w[c + 3] + s * (4.0 * w[c + 4] + s * 5.0 * w[c + 5])))
    w[slots.MOTOR_ACCELERATION] = 2.0 * w[c + 2] + s * (
        6.0 * w[c + 3] + s * (12.0 * w[c + 4] + s * 20.0 * w[c + 5])
    )


@compiled
def _sign(velocity, width):  # type: ignore[no-untyped-def] # pragma: no cover
    """Tanh(velocity / width), which is 1 to the last bit from 20 widths on; the sign itself without a width."""
    if abs(velocity) >= 20.0 * width:
        return float(np.sign(velocity))
    return math.tanh(velocity / width)


@compiled
def _joint_law(x, dx, g, w, p, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    """Torsion and joint torque."""
    w[slots.TORSION] = x[0] - x[1]
    w[slots.TORSION_RATE] = x[2] - x[3]
    w[slots.GEAR] = 1.0
    _run_stage(KINEMATICS, w, p, x, dx, g, laws, stages)
    w[slots.SPRING_TORSION] = w[slots.TORSION]
    _run_stage(CONTACT, w, p, x, dx, g, laws, stages)
    w[slots.JOINT_TORQUE] = w[slots.K] * w[slots.SPRING_TORSION]
    _run_stage(TRANSMISSION, w, p, x, dx, g, laws, stages)


@compiled
def _motor(x, dx, g, w, p, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    """Motor equation: acceleration, or in the driven case the torque that it needs."""
    velocity = x[2]
    w[slots.MOTOR_TORQUE] = w[slots.OFFSET] + w[slots.FVM] * velocity
    w[slots.MOTOR_COULOMB] = w[slots.FSM]
    w[slots.MOTOR_INERTIA] = w[slots.JM]
    _run_stage(MOTOR, w, p, x, dx, g, laws, stages)
    level = w[slots.MOTOR_COULOMB]
    width = w[slots.MOTOR_WIDTH]
    held = w[slots.MOTOR_TORQUE] + w[slots.GEAR] * w[slots.JOINT_TORQUE]
    g[0] = 1.0
    if w[slots.DRIVEN] != 0.0:
        w[slots.TORQUE] = (
            w[slots.MOTOR_INERTIA] * w[slots.MOTOR_ACCELERATION] + held + level * _sign(velocity, width)
        )
        w[slots.COMMAND] = w[slots.TORQUE]
        dx[0] = 0.0
        dx[2] = 0.0
        return
    net = w[slots.TORQUE] - held
    w[slots.MOTOR_NET] = net
    dx[0] = velocity
    if width > 0.0:
        dx[2] = (net - level * _sign(velocity, width)) / w[slots.MOTOR_INERTIA]
    else:
        mode = w[slots.MOTOR_MODE]
        level = max(level, 0.0)
        if mode == 0.0:
            dx[0] = 0.0
            dx[2] = 0.0
            g[0] = level - abs(net)
        else:
            dx[2] = (net - mode * level) / w[slots.MOTOR_INERTIA]
            g[0] = mode * velocity
    w[slots.MOTOR_ACCELERATION] = dx[2]


@compiled
def _load(x, dx, g, w, p, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    """Load equation."""
    position = x[1]
    velocity = x[3]
    weight = w[slots.MX] * math.cos(position) + w[slots.MY] * math.sin(position)
    w[slots.LOAD_TORQUE] = w[slots.FV] * velocity + w[slots.GRAVITY] * weight
    w[slots.LOAD_COULOMB] = w[slots.FS]
    w[slots.LOAD_INERTIA] = w[slots.JL]
    _run_stage(LOAD, w, p, x, dx, g, laws, stages)
    level = w[slots.LOAD_COULOMB]
    width = w[slots.LOAD_WIDTH]
    net = w[slots.JOINT_TORQUE] - w[slots.LOAD_TORQUE]
    w[slots.LOAD_NET] = net
    g[1] = 1.0
    dx[1] = velocity
    if width > 0.0:
        dx[3] = (net - level * _sign(velocity, width)) / w[slots.LOAD_INERTIA]
    else:
        mode = w[slots.LOAD_MODE]
        level = max(level, 0.0)
        if mode == 0.0:
            dx[1] = 0.0
            dx[3] = 0.0
            g[1] = level - abs(net)
        else:
            dx[3] = (net - mode * level) / w[slots.LOAD_INERTIA]
            g[1] = mode * velocity
    w[slots.JOINT_ACCELERATION] = dx[3]


@compiled
def _evaluate(t, x, dx, g, w, p, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    """Derivatives and switching functions at one instant; the workspace is left as the laws filled it."""
    _input(t, x, w)
    w[slots.TIME] = t
    w[slots.TORQUE] = w[slots.COMMAND]
    w[slots.MOTOR_POSITION] = x[0]
    w[slots.MOTOR_VELOCITY] = x[2]
    w[slots.JOINT_POSITION] = x[1]
    w[slots.JOINT_VELOCITY] = x[3]
    _run_stage(LIMIT, w, p, x, dx, g, laws, stages)
    _run_stage(LAG, w, p, x, dx, g, laws, stages)
    _joint_law(x, dx, g, w, p, laws, stages)
    _motor(x, dx, g, w, p, laws, stages)
    _load(x, dx, g, w, p, laws, stages)
    w[slots.MEASURED_MOTOR] = x[0]
    w[slots.MEASURED_MOTOR_RATE] = x[2]
    w[slots.MEASURED_JOINT] = x[1]
    w[slots.MEASURED_JOINT_RATE] = x[3]
    w[slots.MOTOR_DELAY] = 0.0
    w[slots.JOINT_DELAY] = 0.0
    _run_stage(MEASUREMENT, w, p, x, dx, g, laws, stages)


@compiled
def _crossed(i, start, now):  # type: ignore[no-untyped-def] # pragma: no cover
    """Whether switching function i has left its side; those of the friction modes are positive on theirs."""
    return now < 0.0 if i < 2 else start * now < 0.0


@compiled
def _any_crossed(guards, start, now):  # type: ignore[no-untyped-def] # pragma: no cover
    crossed = False
    for i in range(guards):
        crossed = crossed or _crossed(i, start[i], now[i])
    return crossed


@compiled
def _step(t, h, sizes, x, y, k, g, w, p, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    """One step from x to y; first rows of k and g: the start. Returns whether a stage has crossed a switch."""
    states, guards = sizes[0], sizes[1]
    inside = False
    for stage in range(1, 7):
        for i in range(states):
            total = 0.0
            for j in range(stage):
                total += _A[stage, j] * k[j * states + i]
            y[i] = x[i] + h * total
        now = shifted(g, stage * guards)
        _evaluate(t + _C[stage] * h, y, shifted(k, stage * states), now, w, p, laws, stages)
        inside = inside or _any_crossed(guards, g, now)
    return inside


@compiled
def _locate(t, h, sizes, x, y, k, g, w, p, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    """Length of the step that ends just behind the first switch within h (regula falsi, Illinois)."""
    guards = sizes[1]
    low, high, side = 0.0, h, 0
    end, g_low, g_high, scale = (
        shifted(g, 6 * guards), shifted(g, 7 * guards), shifted(g, 8 * guards), shifted(g, 9 * guards),
    )  # fmt: skip
    for i in range(guards):
        g_low[i], g_high[i] = g[i], end[i]
        scale[i] = 1e-13 * max(abs(g[i]), abs(end[i]))
    for iteration in range(80):
        first, best = 0, 2.0
        for i in range(guards):
            if _crossed(i, g[i], g_high[i]):
                fraction = abs(g_low[i]) / (abs(g_low[i]) + abs(g_high[i]))
                if fraction < best:
                    first, best = i, fraction
        if high - low <= 1e-14 * h + 2e-16 * t or (side == 1 and abs(g_high[first]) <= scale[first]):
            break
        if best < 1e-3 or best > 0.999 or iteration % 8 == 7:
            best = min(max(best, 1e-3), 0.999) if iteration % 2 == 0 else 0.5
        trial = low + best * (high - low)
        _step(t, trial, sizes, x, y, k, g, w, p, laws, stages)
        crossed = _any_crossed(guards, g, end)
        for i in range(guards):
            if crossed:
                g_high[i] = end[i]
                g_low[i] *= 0.5 if side == 1 else 1.0
            else:
                g_low[i] = end[i]
                g_high[i] *= 0.5 if side == -1 else 1.0
        if crossed:
            high, side = trial, 1
        else:
            low, side = trial, -1
    return high


@compiled
def _error(h, states, k, y, kinds, peaks, torsion, frequency):  # type: ignore[no-untyped-def] # pragma: no cover
    """Largest estimated error of the step over the states, relative to their scales."""
    worst = 0.0
    for i in range(states):
        total = 0.0
        for j in range(7):
            total += _E[j] * k[j * states + i]
        if kinds[i] == BY_TORSION:
            scale = torsion
        elif kinds[i] == BY_VELOCITY:
            scale = torsion * frequency
        else:
            scale = max(peaks[i], abs(y[i]), 1e-300)
        error = abs(h * total) / scale
        if not error <= worst:  # also where it is no number
            worst = error
    return worst


@compiled
def _switch(t, x, dx, g, motor, load, w, p, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    """Set the friction modes anew where they ended; given are their switching functions at the event."""
    if w[slots.MOTOR_WIDTH] == 0.0 and w[slots.DRIVEN] == 0.0 and motor < 0.0:
        stopped = w[slots.MOTOR_MODE] != 0.0
        if stopped:
            x[2] = 0.0
            w[slots.MOTOR_MODE] = 0.0
        _evaluate(t, x, dx, g, w, p, laws, stages)
        if g[0] < 0.0:
            w[slots.MOTOR_MODE] = 1.0 if w[slots.MOTOR_NET] > 0.0 else -1.0
    if w[slots.LOAD_WIDTH] == 0.0 and load < 0.0:
        if w[slots.LOAD_MODE] != 0.0:
            x[3] = 0.0
            w[slots.LOAD_MODE] = 0.0
        _evaluate(t, x, dx, g, w, p, laws, stages)
        if g[1] < 0.0:
            w[slots.LOAD_MODE] = 1.0 if w[slots.LOAD_NET] > 0.0 else -1.0
    _evaluate(t, x, dx, g, w, p, laws, stages)


@compiled
def _interval(t0, t1, sizes, x, y, k, g, w, p, laws, stages, kinds, peaks, control):  # type: ignore[no-untyped-def] # pragma: no cover
    """Integrate over an interval in which the input is smooth; the first rows of k, g hold its start.

    ``control``: tolerance (0: fixed steps), steps per interval, proposed step, sum of errors, peak torsion,
    frequency, number of steps.
    """
    states, guards = sizes[0], sizes[1]
    end = shifted(g, 6 * guards)
    t = t0
    length = t1 - t0
    adaptive = control[0] > 0.0
    largest = length / control[1]
    steps = 0
    events = 0
    while t < t1:
        h = min(control[2], largest) if adaptive else largest
        if t + 1.001 * h >= t1:
            h = t1 - t
        while True:
            inside = _step(t, h, sizes, x, y, k, g, w, p, laws, stages)
            steps += 1
            if steps > MAX_STEPS:
                return TOO_MANY_STEPS
            event = _any_crossed(guards, g, end)
            if event:
                h = _locate(t, h, sizes, x, y, k, g, w, p, laws, stages)
                _step(t, h, sizes, x, y, k, g, w, p, laws, stages)
            elif inside and h > 1e-3 * largest:
                h *= 0.5
                continue
            torsion = max(control[4], abs(w[slots.TORSION]))
            error = _error(h, states, k, y, kinds, peaks, torsion, control[5])
            if not math.isfinite(error):
                return UNSTABLE
            if adaptive and error > control[0] and h > SMALLEST_STEP * length:
                h *= max(0.2, 0.9 * (control[0] / error) ** 0.2)
                continue
            break
        if adaptive:
            growth = 5.0 if error == 0.0 else min(5.0, max(0.2, 0.9 * (control[0] / error) ** 0.2))
            cut_short = event or h < 0.5 * min(control[2], largest)
            control[2] = max(h * growth, control[2]) if cut_short else h * growth
        control[3] += error
        control[4] = torsion
        t = min(t1, t + h)
        for i in range(states):
            x[i] = y[i]
            peaks[i] = max(peaks[i], abs(y[i]))
            k[i] = k[6 * states + i]
        if event:
            events += 1
            if events > MAX_EVENTS:
                return TOO_MANY_EVENTS
            _switch(t, x, k, g, end[0], end[1], w, p, laws, stages)
        else:
            for i in range(guards):
                g[i] = end[i]
    control[6] += steps
    return DONE


@compiled
def _rest(t, count, x, dx, g, w, p, laws, stages, starts):  # type: ignore[no-untyped-def] # pragma: no cover
    """Torsion at which the spring carries the load, by damped iteration; states follow their starts."""
    for _ in range(200):
        _start_states(count, x, starts)
        _evaluate(t, x, dx, g, w, p, laws, stages)
        need = w[slots.LOAD_TORQUE] - w[slots.JOINT_TORQUE]
        if w[slots.DRIVEN] != 0.0:
            need += w[slots.LOAD_INERTIA] * w[slots.MOTOR_ACCELERATION]
        x[1] -= 0.5 * need / w[slots.K]
    _start_states(count, x, starts)


@compiled
def _start_states(count, x, starts):  # type: ignore[no-untyped-def] # pragma: no cover
    for i in range(count):
        if starts[i] >= 0:
            x[4 + i] = x[starts[i]]


@compiled
def _first_modes(t, x, dx, g, w, p, laws, stages):  # type: ignore[no-untyped-def] # pragma: no cover
    w[slots.MOTOR_MODE] = np.sign(x[2])
    w[slots.LOAD_MODE] = np.sign(x[3])
    _evaluate(t, x, dx, g, w, p, laws, stages)
    _switch(t, x, dx, g, g[0], g[1], w, p, laws, stages)


@compiled
def _delayed(times, values, rates, k, delay):  # type: ignore[no-untyped-def] # pragma: no cover
    """Value at times[k] - delay by Hermite's cubic; at rest before the start."""
    if delay <= 0.0:
        return values[k]
    t = times[k] - delay
    if t <= times[0]:
        return values[0]
    j = k - 1
    while times[j] > t:
        j -= 1
    h = times[j + 1] - times[j]
    s = (t - times[j]) / h
    a = (1.0 + 2.0 * s) * values[j] + s * h * rates[j]
    b = (3.0 - 2.0 * s) * values[j + 1] - (1.0 - s) * h * rates[j + 1]
    return (1.0 - s) ** 2 * a + s * s * b


@compiled
def _record(row, states, x, w, measured):  # type: ignore[no-untyped-def] # pragma: no cover
    row[COMMAND] = w[slots.COMMAND]
    row[TORQUE] = w[slots.TORQUE]
    row[MOTOR_POSITION] = x[0]
    row[MOTOR_VELOCITY] = x[2]
    row[MOTOR_ACCELERATION] = w[slots.MOTOR_ACCELERATION]
    row[JOINT_POSITION] = x[1]
    row[JOINT_VELOCITY] = x[3]
    row[JOINT_ACCELERATION] = w[slots.JOINT_ACCELERATION]
    row[TORSION] = w[slots.TORSION]
    row[JOINT_TORQUE] = w[slots.JOINT_TORQUE]
    row[MEASURED_MOTOR] = measured
    row[MEASURED_JOINT] = w[slots.MEASURED_JOINT]
    row[MEASURED_JOINT_RATE] = w[slots.MEASURED_JOINT_RATE]
    row[JOINT_DELAY] = w[slots.JOINT_DELAY]
    for i in range(4, states):
        row[COLUMNS + i - 4] = x[i]


@compiled
def run(  # type: ignore[no-untyped-def] # pragma: no cover
    workspace, parameters, law_rows, stage_rows, work, sizes, state_kinds, state_starts, rest,
    times, controls, rows, inputs, gains, reference, motor_sensor, motor_noise, control, out,
):  # fmt: skip
    """Integrate over all breakpoints.

    All arrays belong to the caller, for the kernel works on their bare addresses.

    Parameters
    ----------
    workspace, parameters, law_rows, stage_rows
        Workspace with the axis, parameters, table of laws, first law of each stage.
    work, sizes
        Room of `work_size` values, the first state at its beginning; number of states and of guards.
    state_kinds, state_starts, rest
        Scale of each state's error; where the effects' states start from; 1: let the joint come to rest first.
    times, controls, rows
        Breakpoints, and at each the index of the reference and of the record's row (-1: none).
    inputs
        Polynomials of the input, shape (breakpoints, 6); without rows: closed loop.
    gains, reference
        kp, kv, ki, velocity feed-forward, period, and at the start integral and velocity of the reference; the
        reference at the controller's instants.
    motor_sensor, motor_noise
        Resolution and delay; noise at each breakpoint.
    control
        As in `_interval`.
    out
        The record, shape (COLUMNS + states, rows): each column contiguous, so that nothing has to be copied later.

    Returns
    -------
    (int, float)
        Status, and the time at which it came about.
    """
    n = times.size
    states = sizes[0]
    w, p, laws, stages = pointer(workspace), pointer(parameters), pointer(law_rows), pointer(stage_rows)
    size, kinds, starts, steering = (
        pointer(sizes),
        pointer(state_kinds),
        pointer(state_starts),
        pointer(control),
    )
    x = pointer(work)
    y, peaks, k = shifted(x, states), shifted(x, 2 * states), shifted(x, 3 * states)
    g = shifted(x, 10 * states)
    for i in range(states):
        peaks[i] = abs(x[i])
    seen = np.empty(n)
    rates = np.empty(n)
    closed = inputs.shape[0] == 0
    integral, before, before_reference = gains[5], 0.0, 0.0
    for b in range(n):
        t = times[b]
        if not closed:
            w[slots.INTERVAL_START] = t
            for j in range(6):
                w[slots.INPUT + j] = inputs[b, j]
        if b == 0:
            _evaluate(t, x, k, g, w, p, laws, stages)
            if rest == 1:
                _rest(t, states - 4, x, k, g, w, p, laws, stages, starts)
            else:
                _start_states(states - 4, x, starts)
            _first_modes(t, x, k, g, w, p, laws, stages)
            control[4] = max(control[4], abs(w[slots.TORSION]))
        seen[b] = w[slots.MEASURED_MOTOR]
        rates[b] = w[slots.MEASURED_MOTOR_RATE]
        measured = _delayed(times, seen, rates, b, motor_sensor[1] + w[slots.MOTOR_DELAY]) + motor_noise[b]
        if motor_sensor[0] > 0.0:
            measured = np.floor(measured / motor_sensor[0] + 0.5) * motor_sensor[0]
        if closed and controls[b] >= 0:
            wanted = reference[controls[b]]
            if controls[b] == 0:
                # Moving at the start, it did so before.
                before, before_reference = measured - x[2] * gains[4], wanted - gains[6] * gains[4]
            period = gains[4]
            error = gains[0] * (wanted - measured) + gains[3] * (wanted - before_reference) / period
            error -= (measured - before) / period
            integral += error * period
            before, before_reference = measured, wanted
            w[slots.INPUT] = gains[1] * error + gains[2] * integral
            w[slots.INTERVAL_START] = t
        _evaluate(t, x, k, g, w, p, laws, stages)
        if g[0] < 0.0 or g[1] < 0.0:
            _switch(t, x, k, g, g[0], g[1], w, p, laws, stages)
        if rows[b] >= 0:
            _record(out[:, rows[b]], states, x, w, measured)
        if b + 1 < n:
            status = _interval(t, times[b + 1], size, x, y, k, g, w, p, laws, stages, kinds, peaks, steering)
            if status != DONE:
                return status, t
    return DONE, times[n - 1]


def work_size(states: int, guards: int) -> int:
    """Room that `run` needs: state, new state, peaks, seven derivatives; ten rows of guards."""
    return 10 * states + 10 * guards


@compiled
def markov(white, decay):  # type: ignore[no-untyped-def] # pragma: no cover
    """Turn white noise of unit variance into first-order Markov noise of unit variance."""
    out = white.copy()
    for i in range(1, white.size):
        out[i] = decay[i - 1] * out[i - 1] + math.sqrt(1.0 - decay[i - 1] ** 2) * white[i]
    return out
