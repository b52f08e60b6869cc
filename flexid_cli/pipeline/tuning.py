"""Tuning of the band-limited derivative from the first resonance and the order of derivative.

Source: M. T. Pham, M. Gautier, P. Poignet, "Identification of joint stiffness with bandpass filtering", ICRA
2001, doi:10.1109/ROBOT.2001.933056, eqs. (24)-(29). Where the paper's text and its formulae disagree, the
formulae hold: inside the band the distortion stays *above* ``Ac``, and eq. (25) is the magnitude of the
forward and the backward pass together, so ``m`` is the order of a single pass and the gain at ``wn`` is one
half (-6 dB).

Nothing here needs numpy: the command starts at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flexid_cli.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

DEFAULT_AC = math.sqrt(0.5)
DEFAULT_RC = 1.0
DEFAULT_WC_RATIO = 6.0
MAX_DERIVATIVE = 4
MAX_ORDER = 12
# The paper chooses wc between 2 w1 and 10 w1.
USUAL_WC_RATIO = (2.0, 10.0)
# MATLAB's decimate: Chebyshev type I low-pass with its pass-band edge at 0.8 of the new Nyquist frequency.
DECIMATION_EDGE = 0.8
# Above this multiple of f1 encoder noise, multiplied by the derivatives, starts to bias the estimates: in
# simulations of the paper's axis from the motor alone X1..X7 lost a third at 2.8 f1 and nearly all at 4.5 f1.
WIDE_BAND_RATIO = 2.5


@dataclass(frozen=True)
class FilterTuning:
    """A low-pass and a rate of sampling for the derivatives up to one order.

    Attributes
    ----------
    f1_hz : float
        First resonance of the axis with both sides free, ``sqrt(K (1/Jm + 1/JL)) / 2 pi``.
    nd : int
        Order of the derivative; 0 is the low-pass alone.
    m : int
        Order of one pass of the Butterworth filter, which runs forward and backward.
    ac : float
        Distortion at ``wc``; inside the band A(w) >= Ac.
    rc : float or None
        Gain of the low-pass over gain of the derivative at ``wc``, eq. (27); None where ``nd`` is 0.
    wc_ratio : float
        ``wc`` over the angular frequency of the first resonance.
    wc_rad_s : float
        Upper edge of the band in which the derivative is trusted.
    wn_rad_s : float
        Cutoff of the Butterworth filter, eq. (28).
    xc : float or None
        Root of eq. (29): ``wc`` over the Nyquist frequency of ``fs_hz``; None where ``nd`` is 0.
    fs_hz : float or None
        Lowest rate of sampling that keeps A(wc) >= Ac, eq. (29); None where ``nd`` is 0, for then no central
        difference asks for any.
    """

    f1_hz: float
    nd: int
    m: int
    ac: float
    rc: float | None
    wc_ratio: float
    wc_rad_s: float
    wn_rad_s: float
    xc: float | None
    fs_hz: float | None

    @property
    def w1_rad_s(self) -> float:
        """First resonance in rad/s."""
        return 2.0 * math.pi * self.f1_hz

    @property
    def wc_hz(self) -> float:
        """Upper edge of the band in Hz."""
        return self.wc_rad_s / (2.0 * math.pi)

    @property
    def wn_hz(self) -> float:
        """Cutoff of the Butterworth filter in Hz."""
        return self.wn_rad_s / (2.0 * math.pi)

    @property
    def ts_s(self) -> float | None:
        """Longest sampling period in s; None where ``nd`` is 0."""
        return None if self.fs_hz is None else 1.0 / self.fs_hz

    def distortion(self, w_rad_s: float, ts_s: float | None = None) -> float:
        """A(w) of eq. (26), at the tuned sampling period unless another is given."""
        period = self.ts_s if ts_s is None else ts_s
        return distortion(w_rad_s, self.wn_rad_s, self.m, self.nd, period or 0.0)


@dataclass(frozen=True)
class SampledFilter:
    """What becomes of a tuned filter at the rate that a log really has.

    Attributes
    ----------
    fs_hz : float
        Rate of the log.
    fs_ratio : float or None
        That rate over the lowest one asked for; None where ``nd`` is 0.
    distortion_at_wc : float or None
        A(wc) by eq. (26); None where ``wc`` is not below the Nyquist frequency.
    digital_distortion_at_wc : float or None
        A(wc) of the digital filter, with the warp of the bilinear transform; None too where its cutoff is not
        below the Nyquist frequency.
    band_hz : float
        Where A(w) of eq. (26) falls to Ac, at most ``wc``.
    """

    fs_hz: float
    fs_ratio: float | None
    distortion_at_wc: float | None
    digital_distortion_at_wc: float | None
    band_hz: float


@dataclass(frozen=True)
class DecimatedBand:
    """What parallel decimation leaves of the band.

    Attributes
    ----------
    factor : int
        One sample in so many is kept (the paper's Nd).
    fs_hz : float
        Rate after decimation.
    band_hz : float
        Pass-band edge of the decimation's low-pass.
    f1_ratio : float
        That edge over the first resonance.
    is_limit : bool
        Whether the decimation, and not the derivative filter, ends the band.
    """

    factor: int
    fs_hz: float
    band_hz: float
    f1_ratio: float
    is_limit: bool


@dataclass(frozen=True)
class BandPoint:
    """A(w) at one frequency: as tuned, and at the log's rate where one is given."""

    w_rad_s: float
    label: str
    tuned: float
    sampled: float | None
    digital: float | None

    @property
    def frequency_hz(self) -> float:
        """The frequency in Hz."""
        return self.w_rad_s / (2.0 * math.pi)


@dataclass(frozen=True)
class TuningWarning:
    """A doubt about the tuning: a stable code, and a sentence with its cure."""

    code: str
    message: str


@dataclass(frozen=True)
class TuningAssessment:
    """A tuned filter, seen at a log's rate and after decimation.

    Attributes
    ----------
    tuning : FilterTuning
        The filter.
    sampled : SampledFilter or None
        At the log's rate, where one is given.
    decimated : DecimatedBand or None
        After decimation, where a factor is given.
    effective_band_hz : float
        Upper edge of the band that reaches the estimation.
    factors : tuple of int or None
        Smallest and largest decimation factor that keep f1 inside the band and the band below 2.5 f1; None
        without a rate, or where no factor does.
    points : tuple of BandPoint
        A(w) over the band.
    warnings : tuple of TuningWarning
        Doubts, the gravest first.
    """

    tuning: FilterTuning
    sampled: SampledFilter | None
    decimated: DecimatedBand | None
    effective_band_hz: float
    factors: tuple[int, int] | None
    points: tuple[BandPoint, ...]
    warnings: tuple[TuningWarning, ...]


@dataclass(frozen=True)
class MagnitudeCurves:
    """Magnitudes over frequency for the paper's figure 1; all tuples have the same length.

    Attributes
    ----------
    w_rad_s : tuple of float
        Frequencies, evenly spaced on a logarithmic axis, up to the Nyquist frequency.
    lowpass : tuple of float
        The Butterworth filter, forward and backward, eq. (25).
    ideal : tuple of float
        The derivative w**nd, in (rad/s)**nd.
    difference : tuple of float
        The cascade of ``nd`` central differences, eq. (24), same unit.
    product : tuple of float
        Low-pass times central differences: the band-limited derivative.
    """

    w_rad_s: tuple[float, ...]
    lowpass: tuple[float, ...]
    ideal: tuple[float, ...]
    difference: tuple[float, ...]
    product: tuple[float, ...]


def default_order(nd: int) -> int:
    """Order of one Butterworth pass that the paper takes for derivatives up to order ``nd``."""
    return 4 if nd <= 2 else 6


def tune_filter(
    f1_hz: float,
    nd: int,
    m: int | None = None,
    ac: float = DEFAULT_AC,
    rc: float | None = None,
    wc_ratio: float = DEFAULT_WC_RATIO,
) -> FilterTuning:
    """Cutoff and lowest rate of sampling of the band-limited derivative, eqs. (28) and (29).

    Parameters
    ----------
    f1_hz : float
        First resonance with both sides free (Hz).
    nd : int
        Highest order of derivative, 0 to 4: 2 with both encoders, 4 from the motor alone.
    m : int, optional
        Order of one Butterworth pass; 4 up to ``nd`` = 2, else 6.
    ac : float
        Distortion allowed at the edge of the band, in (0, 1); sqrt(1/2) is -3 dB.
    rc : float, optional
        Low-pass gain over derivative gain at the edge, in (Ac, 1/Ac); 1 shares the distortion equally. It has
        no meaning where ``nd`` is 0: then the low-pass takes all of it.
    wc_ratio : float
        Edge of the band over the first resonance; the paper takes 2 to 10.

    Returns
    -------
    FilterTuning
        With A(wc) = Ac at the rate ``fs_hz``.

    Raises
    ------
    UsageError
        A value with which the equations have no solution.
    """
    _check_whole("the order of derivative nd", nd, 0, MAX_DERIVATIVE, "--nd")
    order = default_order(nd) if m is None else m
    _check_whole("the filter's order m", order, 1, MAX_ORDER, "--m")
    _check_positive("the first resonance f1", f1_hz, "--f1", "Hz")
    _check_positive("the ratio wc/w1", wc_ratio, "--wc-ratio")
    if not 0.0 < ac < 1.0:
        raise UsageError(
            f"the distortion at the edge of the band is Ac = {ac:g}, which is not between 0 and 1",
            f"give --ac a gain below 1, for example {DEFAULT_AC:.4f} (-3 dB)",
        )
    share = _check_share(nd, ac, rc)
    gain = ac if share is None else math.sqrt(share) * math.sqrt(ac)
    wc = 2.0 * math.pi * f1_hz * wc_ratio
    wn = wc * (1.0 / gain - 1.0) ** (-0.5 / order)
    xc = None if share is None else _invert_sinc((ac / share) ** (0.5 / nd))
    fs = None if xc is None else wc / (math.pi * xc)
    if not all(0.0 < value < math.inf for value in (wc, wn, 1.0 if fs is None else fs)):
        raise UsageError(f"f1 = {f1_hz:g} Hz is too extreme to compute with", "give --f1 in Hz")
    return FilterTuning(
        f1_hz=float(f1_hz),
        nd=nd,
        m=order,
        ac=float(ac),
        rc=share,
        wc_ratio=float(wc_ratio),
        wc_rad_s=wc,
        wn_rad_s=wn,
        xc=xc,
        fs_hz=fs,
    )


def lowpass_gain(w: float, wn: float, m: int) -> float:
    """Gain of the Butterworth filter, forward and backward, eq. (25).

    Parameters
    ----------
    w, wn : float
        Frequency and cutoff, in the same unit.
    m : int
        Order of one pass.

    Returns
    -------
    float
        1 at rest, 1/2 at ``wn``.
    """
    ratio = w / wn
    if ratio <= 1.0:
        return 1.0 / (1.0 + ratio ** (2 * m))
    inverse = (1.0 / ratio) ** (2 * m)
    return inverse / (1.0 + inverse)


def difference_gain(w: float, nd: int, ts: float) -> float:
    """Gain of ``nd`` central differences over that of the true derivative, eq. (24).

    Parameters
    ----------
    w : float
        Frequency (rad/s).
    nd : int
        Number of central differences in a row.
    ts : float
        Sampling period (s); 0 is the limit of an infinite rate.

    Returns
    -------
    float
        ``|sin(w Ts) / (w Ts)|**nd``.
    """
    angle = w * ts
    return abs(math.sin(angle) / angle) ** nd if angle else 1.0


def distortion(w: float, wn: float, m: int, nd: int, ts: float) -> float:
    """Gain of the band-limited derivative over that of the true one, A(w) of eq. (26).

    Parameters
    ----------
    w, wn : float
        Frequency and cutoff of the low-pass (rad/s).
    m : int
        Order of one Butterworth pass.
    nd : int
        Order of the derivative.
    ts : float
        Sampling period (s).

    Returns
    -------
    float
        1 at rest, falling to 0 at the Nyquist frequency.
    """
    return lowpass_gain(w, wn, m) * difference_gain(w, nd, ts)


def digital_distortion(w: float, wn: float, m: int, nd: int, ts: float) -> float:
    """Like ``distortion``, for the digital Butterworth filter that a log is filtered with.

    The bilinear transform, matched at ``wn``, maps w to tan(w Ts / 2); eq. (25) is its limit at high rates.

    Raises
    ------
    ValueError
        ``w`` or ``wn`` is not below the Nyquist frequency.
    """
    nyquist = math.pi / ts
    if not (w < nyquist and wn < nyquist):
        raise ValueError("a digital filter has no gain at or above the Nyquist frequency")
    lowpass = lowpass_gain(math.tan(0.5 * w * ts), math.tan(0.5 * wn * ts), m)
    return lowpass * difference_gain(w, nd, ts)


def decimated_rate_hz(fs_hz: float, factor: int) -> float:
    """Rate after one sample in ``factor`` is kept (Hz)."""
    _check_positive("the sampling rate", fs_hz, "--fs", "Hz")
    _check_whole("the decimation factor", factor, 1, None, "--decimate")
    return fs_hz / factor


def decimated_band_hz(fs_hz: float, factor: int) -> float:
    """Pass-band edge that parallel decimation leaves, 0.8 of the new Nyquist frequency.

    Parameters
    ----------
    fs_hz : float
        Rate before decimation (Hz).
    factor : int
        One sample in so many is kept (the paper's Nd).

    Returns
    -------
    float
        Edge of the Chebyshev filter's pass-band (Hz): 5.398 for 350.87 Hz and a factor of 26. A factor of 1
        filters nothing: then it is the Nyquist frequency.

    Raises
    ------
    UsageError
        A rate that is not positive, or a factor below 1.
    """
    nyquist = decimated_rate_hz(fs_hz, factor) / 2.0
    return nyquist if factor == 1 else DECIMATION_EDGE * nyquist


def band_edge_rad_s(tuning: FilterTuning, ts_s: float) -> float:
    """Frequency at which A(w) of eq. (26) falls to Ac at another sampling period.

    Parameters
    ----------
    tuning : FilterTuning
        Gives ``wn``, ``m``, ``nd`` and Ac.
    ts_s : float
        Sampling period (s).

    Returns
    -------
    float
        The edge (rad/s); the Nyquist frequency where A(w) does not fall so far.
    """
    nyquist = math.pi / ts_s
    if tuning.distortion(nyquist, ts_s) >= tuning.ac:
        return nyquist
    return _bisect(lambda w: tuning.distortion(w, ts_s) >= tuning.ac, 0.0, nyquist)


def assess(tuning: FilterTuning, fs_hz: float | None = None, factor: int | None = None) -> TuningAssessment:
    """Look at a tuned filter at the rate of a log and after parallel decimation.

    Parameters
    ----------
    tuning : FilterTuning
        The filter.
    fs_hz : float, optional
        Rate of the log (Hz).
    factor : int, optional
        Decimation factor; needs ``fs_hz``.

    Returns
    -------
    TuningAssessment
        Distortion over the band, the effective band, and what to doubt.

    Raises
    ------
    UsageError
        A rate that is not positive, a factor below 1, or a factor without a rate.
    """
    if factor is not None and fs_hz is None:
        raise UsageError(
            "the band after decimation depends on the log's rate, and none is given",
            "add --fs with the rate of the log in Hz",
        )
    sampled = None if fs_hz is None else _sample(tuning, fs_hz)
    filter_band = tuning.wc_hz if sampled is None else sampled.band_hz
    decimated = None if fs_hz is None or factor is None else _decimate(tuning, fs_hz, factor, filter_band)
    band = filter_band if decimated is None else min(filter_band, decimated.band_hz)
    factors = None if fs_hz is None else _useful_factors(tuning.f1_hz, fs_hz)
    return TuningAssessment(
        tuning=tuning,
        sampled=sampled,
        decimated=decimated,
        effective_band_hz=band,
        factors=factors,
        points=_points(tuning, fs_hz),
        warnings=_warnings(tuning, sampled, decimated, factors),
    )


def magnitude_curves(tuning: FilterTuning, fs_hz: float | None = None, count: int = 400) -> MagnitudeCurves:
    """Magnitudes of the low-pass, the derivatives and their product (the paper's figure 1).

    Parameters
    ----------
    tuning : FilterTuning
        The filter.
    fs_hz : float, optional
        Rate of sampling (Hz); the tuned one unless given, and ten times ``wn`` where ``nd`` is 0.
    count : int
        Number of frequencies, from a tenth of the first resonance to the Nyquist frequency.

    Returns
    -------
    MagnitudeCurves
        The curves.
    """
    rate = fs_hz or tuning.fs_hz or 10.0 * tuning.wn_hz
    ts = 1.0 / rate
    # At the Nyquist frequency itself a central difference is blind, and a logarithm has no zero.
    high = 0.999 * math.pi * rate
    low = min(0.1 * tuning.w1_rad_s, 0.1 * high)
    frequencies = tuple(low * (high / low) ** (i / (count - 1)) for i in range(count))
    lowpass = tuple(lowpass_gain(w, tuning.wn_rad_s, tuning.m) for w in frequencies)
    ideal = tuple(w**tuning.nd for w in frequencies)
    difference = tuple(
        gain * difference_gain(w, tuning.nd, ts) for w, gain in zip(frequencies, ideal, strict=True)
    )
    product = tuple(a * b for a, b in zip(lowpass, difference, strict=True))
    return MagnitudeCurves(frequencies, lowpass, ideal, difference, product)


def _check_whole(what: str, value: int, low: int, high: int | None, option: str) -> None:
    if isinstance(value, int) and not isinstance(value, bool) and low <= value <= (high or value):
        return
    span = f"{low} or more" if high is None else f"{low} to {high}"
    raise UsageError(f"{what} is {value!r}, which is not a whole number of {span}", f"give {option} {span}")


def _check_positive(what: str, value: float, option: str, unit: str = "") -> None:
    if 0.0 < value < math.inf:
        return
    hint = f"give {option} a number greater than 0" + (f" in {unit}" if unit else "")
    raise UsageError(f"{what} is {f'{value:g} {unit}'.rstrip()}, which is not positive and finite", hint)


def _check_share(nd: int, ac: float, rc: float | None) -> float | None:
    """Return rc where a derivative shares the distortion with the low-pass, else None."""
    if nd == 0:
        if rc is not None:
            raise UsageError(
                "rc divides the distortion between low-pass and derivative, and nd = 0 has no derivative",
                "leave --rc away",
            )
        return None
    share = DEFAULT_RC if rc is None else float(rc)
    if ac < share < 1.0 / ac:
        # Both gains have to stay below 1 after rounding too, or eqs. (28) and (29) have no root.
        lowpass, derivative = math.sqrt(share) * math.sqrt(ac), (ac / share) ** (0.5 / nd)
        if 1.0 / lowpass > 1.0 > derivative > 0.0:
            return share
    raise UsageError(
        f"rc = {share:g} lies outside ({ac:.6g}, {1.0 / ac:.6g}), the open interval (Ac, 1/Ac): "
        "one of the two filters would have to amplify",
        "choose --rc inside it; 1 shares the distortion equally",
    )


def _invert_sinc(gain: float) -> float:
    """Root x in (0, 1) of sin(pi x) / (pi x) = gain, eq. (29), which falls from 1 to 0 there."""
    return _bisect(lambda x: difference_gain(math.pi * x, 1, 1.0) >= gain, 0.0, 1.0)


def _bisect(is_below_root: Callable[[float], bool], low: float, high: float) -> float:
    """Halve the bracket until no double lies inside it; returns its lower end."""
    middle = 0.5 * (low + high)
    while low < middle < high:
        if is_below_root(middle):
            low = middle
        else:
            high = middle
        middle = 0.5 * (low + high)
    return low


def _sample(tuning: FilterTuning, fs_hz: float) -> SampledFilter:
    _check_positive("the sampling rate", fs_hz, "--fs", "Hz")
    ts, nyquist = 1.0 / fs_hz, math.pi * fs_hz
    sampled, digital = _at_rate(tuning, tuning.wc_rad_s, fs_hz)
    edge = min(tuning.wc_rad_s, nyquist)
    if sampled is None or sampled < tuning.ac:
        edge = min(edge, band_edge_rad_s(tuning, ts))
    return SampledFilter(
        fs_hz=float(fs_hz),
        fs_ratio=None if tuning.fs_hz is None else fs_hz / tuning.fs_hz,
        distortion_at_wc=sampled,
        digital_distortion_at_wc=digital,
        band_hz=edge / (2.0 * math.pi),
    )


def _at_rate(tuning: FilterTuning, w: float, fs_hz: float | None) -> tuple[float | None, float | None]:
    """A(w) at a log's rate, by eq. (26) and of the digital filter; None where there is none."""
    if fs_hz is None or w >= math.pi * fs_hz:
        return None, None
    ts = 1.0 / fs_hz
    by_equation = tuning.distortion(w, ts)
    if tuning.wn_rad_s >= math.pi * fs_hz:
        return by_equation, None
    return by_equation, digital_distortion(w, tuning.wn_rad_s, tuning.m, tuning.nd, ts)


def _decimate(tuning: FilterTuning, fs_hz: float, factor: int, filter_band_hz: float) -> DecimatedBand:
    band = decimated_band_hz(fs_hz, factor)
    return DecimatedBand(
        factor=factor,
        fs_hz=decimated_rate_hz(fs_hz, factor),
        band_hz=band,
        f1_ratio=band / tuning.f1_hz,
        is_limit=band < filter_band_hz,
    )


def _useful_factors(f1_hz: float, fs_hz: float) -> tuple[int, int] | None:
    widest = DECIMATION_EDGE * fs_hz / 2.0
    if widest < f1_hz or not math.isfinite(widest / f1_hz):
        return None
    return max(1, math.ceil(widest / (WIDE_BAND_RATIO * f1_hz))), math.floor(widest / f1_hz)


def _points(tuning: FilterTuning, fs_hz: float | None) -> tuple[BandPoint, ...]:
    """A(w) at multiples of the resonance, at quarters of the band, and at the cutoff."""
    wanted = [(tuning.wn_rad_s, "wn")]
    wanted += [(0.25 * k * tuning.wc_rad_s, "wc" if k == 4 else f"{0.25 * k:g} wc") for k in range(1, 5)]
    wanted += [(k * tuning.w1_rad_s, "f1" if k == 1 else f"{k} f1") for k in (1, 2, 4)]
    labels: dict[float, list[str]] = {}
    for w, label in wanted:
        same = next((known for known in labels if math.isclose(known, w, rel_tol=1e-9)), w)
        labels.setdefault(same, []).insert(0, label)
    highest = max(tuning.wc_rad_s, tuning.wn_rad_s)
    return tuple(
        BandPoint(w, " = ".join(names), tuning.distortion(w), *_at_rate(tuning, w, fs_hz))
        for w, names in sorted(labels.items())
        if w <= highest
    )


def _warnings(
    tuning: FilterTuning,
    sampled: SampledFilter | None,
    decimated: DecimatedBand | None,
    factors: tuple[int, int] | None,
) -> tuple[TuningWarning, ...]:
    found = _rate_warnings(tuning, sampled) if sampled else []
    if decimated:
        found += _decimation_warnings(tuning, decimated, factors)
    low, high = USUAL_WC_RATIO
    if not low <= tuning.wc_ratio <= high:
        problem = (
            "the resonance is at the edge of the band or outside it"
            if tuning.wc_ratio < low
            else "the derivatives carry noise from far above the resonance"
        )
        found.append(
            TuningWarning(
                "wc_ratio",
                f"wc = {tuning.wc_ratio:g} w1 is outside the usual {low:g} to {high:g} w1: {problem}.",
            )
        )
    return tuple(found)


def _rate_warnings(tuning: FilterTuning, sampled: SampledFilter) -> list[TuningWarning]:
    found = []
    if tuning.wn_rad_s >= math.pi * sampled.fs_hz:
        found.append(
            TuningWarning(
                "cutoff_above_nyquist",
                f"the cutoff wn = {tuning.wn_hz:.5g} Hz is not below the Nyquist frequency of the log, "
                f"{0.5 * sampled.fs_hz:.5g} Hz: the filter cannot be built; log faster or lower --wc-ratio.",
            )
        )
    if tuning.fs_hz is not None and sampled.fs_hz < tuning.fs_hz:
        actual = (
            "wc is not even below the Nyquist frequency"
            if sampled.distortion_at_wc is None
            else f"A(wc) is {sampled.distortion_at_wc:.4f} instead of Ac = {tuning.ac:.4f}"
        )
        found.append(
            TuningWarning(
                "rate_too_low",
                f"the log's {sampled.fs_hz:.5g} Hz are below the needed Fs = {tuning.fs_hz:.5g} Hz: "
                f"{actual}, and A(w) >= Ac holds up to {sampled.band_hz:.5g} Hz only; log faster, "
                "lower --wc-ratio, or take the exact derivative.",
            )
        )
    return found


def _decimation_warnings(
    tuning: FilterTuning, decimated: DecimatedBand, factors: tuple[int, int] | None
) -> list[TuningWarning]:
    cure = (
        "" if factors is None else f"; --decimate {factors[0]} to {factors[1]} keeps f1 and little above it"
    )
    if factors is not None and factors[0] > factors[1]:
        cure = f"; --decimate {factors[1]} is the nearest"
    band = f"{decimated.band_hz:.5g} Hz ({decimated.f1_ratio:.3g} f1)"
    found = []
    if decimated.f1_ratio < 1.0:
        found.append(
            TuningWarning(
                "resonance_removed",
                f"the band after decimation, {band}, ends below f1 = {tuning.f1_hz:g} Hz: the resonance is "
                f"filtered out, and the stiffness with it{cure or '; log faster'}.",
            )
        )
    elif tuning.nd and min(decimated.band_hz, tuning.wn_hz) > WIDE_BAND_RATIO * tuning.f1_hz:
        found.append(
            TuningWarning(
                "band_too_wide",
                f"the band after decimation, {band}, reaches far above f1 = {tuning.f1_hz:g} Hz: encoder "
                "noise in the derivatives biases the estimates (errors in variables) while the intervals "
                f"stay small{cure}.",
            )
        )
    if decimated.is_limit:
        found.append(
            TuningWarning(
                "decimation_limits",
                f"decimation by {decimated.factor}, not wc = {tuning.wc_hz:.5g} Hz, limits the band: "
                f"it ends at {band}.",
            )
        )
    return found
