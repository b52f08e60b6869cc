"""Joint estimate of several records of one axis: generalised least squares over what each record says alone.

Every record r gives estimates theta_r of its own parameters, with the covariance C_r of their random part. Records
share parameters; the joint estimate is the one nearest to all of them (optimal minimum distance, Chamberlain,
Handbook of Econometrics 2 (1984) 1247), in information form: a record counts with the combinations of parameters
that it determines, and only with these. A systematic source (timing, doubt about the noise, width of the reversal)
acts on all records of one axis alike, so its shifts are summed with the records' weights and do not average out;
random parts are independent.

Where records differ by more than that, the variance between records of each shared parameter joins (Paule and
Mandel, J. Res. Natl. Bur. Stand. 87 (1982) 377), with the degrees of freedom of the number of records (Knapp and
Hartung, Stat. Med. 22 (2003) 2693).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# The p value below which two records count as different.
CONTRADICTED = 0.05
# Records from which on the variance between them is estimated whether it is significant or not.
FEW = 3
# An F statistic with fewer degrees of freedom below has no mean.
FEWEST_LEFT = 3.0
# Directions of a covariance below this share of the largest (variables scaled) are rounding.
SMALLEST_SHARE = 1e-12
# Singular values of the whitened, scaled system below this share of the largest determine nothing.
RANK_TOLERANCE = 1e-10
IN_NULL_SPACE = 1e-6


@dataclass(frozen=True)
class Evidence:
    """What one record says, all by itself.

    Attributes
    ----------
    symbols : tuple of str
        Its p parameters; what two records both name is shared.
    theta : ndarray, shape (p,)
        Estimates.
    covariance : ndarray, shape (p, p)
        Of their random part.
    degrees_of_freedom : ndarray, shape (p,)
        Of the random part's standard errors.
    shifts : mapping of str to ndarray, shape (p,)
        Standard error that each systematic source adds, signed as it moves the parameters.
    directions : ndarray, shape (m, p), or None
        Combinations of the parameters that the record determines; None: all p.
    dependent : frozenset of str
        Parameters that it does not determine.
    whole : bool
        Whether the correlations in the covariance were estimated from the residuals as its variances were.
    """

    symbols: tuple[str, ...]
    theta: Array
    covariance: Array
    degrees_of_freedom: Array
    shifts: Mapping[str, Array] = field(default_factory=dict)
    directions: Array | None = None
    dependent: frozenset[str] = frozenset()
    whole: bool = True

    @property
    def combinations(self) -> Array:
        """What it determines, shape (m, p)."""
        return np.eye(self.theta.size) if self.directions is None else self.directions

    @property
    def systematic(self) -> Array:
        """Outer products of the shifts, shape (p, p)."""
        return sum((np.outer(s, s) for s in self.shifts.values()), np.zeros(self.covariance.shape))

    @property
    def series(self) -> float:
        """Independent contrasts that the covariance was estimated from, at most."""
        return float(np.max(self.degrees_of_freedom))

    @property
    def inflation(self) -> float:
        """Mean of the inverse of the estimated covariance over that of the true one (Wishart).

        By as much an estimated covariance makes a record weigh too much, the more so the shorter it is.
        """
        if not self.whole:
            return 1.0
        return self.series / max(self.series - float(self.combinations.shape[0]) - 1.0, 1.0)

    @property
    def is_long_enough(self) -> bool:
        """Whether the inverse of the covariance has a variance: that takes more than p + 2 contrasts (Wishart)."""
        return self.series >= float(self.combinations.shape[0]) + FEWEST_LEFT

    @property
    def independent_rows(self) -> float:
        """Degrees of freedom of the covariance as a whole: harmonic mean of those of its parameters."""
        return float(1.0 / np.mean(1.0 / np.maximum(self.degrees_of_freedom, 1.0)))


@dataclass(frozen=True)
class Difference:
    """How one shared parameter differs between the records.

    Attributes
    ----------
    records : int
        Records that determine it.
    statistic : float
        Cochran's Q: squared distances from the weighted mean over their variances.
    p_value : float or None
        Welch's test that all records have the same value (Biometrika 38 (1951) 330), which allows for the
        variances' being estimates; None where it cannot be made.
    stderr : float
        Standard deviation between records that the joint estimate allows for.
    """

    records: int
    statistic: float
    p_value: float | None
    stderr: float


@dataclass(frozen=True)
class Consistency:
    """J test that the records agree in all that they share.

    Attributes
    ----------
    statistic, restrictions : float, int
        Squared distance of the records' estimates from joint ones, and how many of them are free to differ.
    scaled, p_value : float or None
        F statistic (one where random errors explain the distance) and its p value; None where the records are too
        short, or share nothing that two of them determine.
    """

    statistic: float
    restrictions: int
    scaled: float | None
    p_value: float | None


@dataclass(frozen=True)
class Joint:
    """The joint estimate of P parameters.

    Attributes
    ----------
    symbols : tuple of str
        In the order in which the records name them.
    theta : ndarray, shape (P,)
    random, between, systematic : ndarray, shape (P, P)
        Parts of the covariance: the records' random errors, differences between records, systematic shifts.
    degrees_of_freedom : ndarray, shape (P,)
        Of the total.
    shifts : mapping of str to ndarray, shape (P,)
        Standard error that each systematic source leaves.
    dependent : tuple of int
        Parameters that all records together do not determine.
    differences : mapping of str to Difference
        Of each parameter that two or more records determine.
    consistency : Consistency
        Before any variance between records was allowed for.
    widened : float
        Factor on the random covariance (Birge, Phys. Rev. 40 (1932) 207) for what the variances between records
        do not explain.
    condition_number, rank : float, int
        Of the whitened system after column scaling.
    """

    symbols: tuple[str, ...]
    theta: Array
    random: Array
    between: Array
    systematic: Array
    degrees_of_freedom: Array
    shifts: Mapping[str, Array]
    dependent: tuple[int, ...]
    differences: Mapping[str, Difference]
    consistency: Consistency
    widened: float
    condition_number: float
    rank: int

    @property
    def covariance(self) -> Array:
        """Total, shape (P, P)."""
        return self.random + self.between + self.systematic


def combine(records: Sequence[Evidence]) -> Joint:
    """Joint estimate of one or more records.

    Parameters
    ----------
    records : sequence of Evidence
        Their order does not matter but for that of the parameters.

    Returns
    -------
    Joint
    """
    symbols = tuple(dict.fromkeys(s for record in records for s in record.symbols))
    none = np.zeros(len(symbols))
    first = _System(records, symbols, none)
    consistency = first.consistency()
    differences = {s: d for s in symbols if (d := _difference(records, s)) is not None}
    spread = np.array([differences[s].stderr if s in differences else 0.0 for s in symbols])
    system, rest = first, consistency
    if spread.any():
        system = _System(records, symbols, spread)
        rest = system.consistency()
    widened = 1.0
    if rest.scaled is not None and rest.p_value is not None and rest.p_value < CONTRADICTED:
        widened = max(1.0, rest.scaled)
    return _joint(system, differences, consistency, widened)


class _System:
    """The records' determined combinations, whitened and stacked: z = X theta + noise of unit covariance.

    Parameters
    ----------
    records, symbols
        As `combine`; all P parameters.
    spread : ndarray, shape (P,)
        Standard deviation of each parameter between records.
    """

    def __init__(self, records: Sequence[Evidence], symbols: tuple[str, ...], spread: Array) -> None:
        self.records, self.symbols = records, symbols
        self.places = [np.array([symbols.index(s) for s in record.symbols]) for record in records]
        self.spreads = [np.diag(spread[place] ** 2) for place in self.places]
        self.whiteners = [
            _whitener(r, r.inflation * r.covariance + r.systematic + T)
            for r, T in zip(records, self.spreads, strict=True)
        ]
        self.blocks = [
            _placed(white, place, len(symbols))
            for white, place in zip(self.whiteners, self.places, strict=True)
        ]
        self.z = np.concatenate([w @ r.theta for w, r in zip(self.whiteners, records, strict=True)])
        ends = np.cumsum([0, *(w.shape[0] for w in self.whiteners)])
        self.rows = [slice(a, b) for a, b in pairwise(ends)]
        self._decompose(np.vstack(self.blocks))

    def _decompose(self, X: Array) -> None:
        """Inverse of X, what it leaves open, and what it leaves over."""
        size = np.linalg.norm(X, axis=0)
        size[size == 0.0] = 1.0
        U, s, Vt = np.linalg.svd(X / size)
        self.rank = int(np.sum(s > RANK_TOLERANCE * s[0]))
        self.condition_number = float(s[0] / s[-1]) if s[-1] > 0.0 else float("inf")
        self.inverse = (Vt[: self.rank].T / s[: self.rank]) @ U[:, : self.rank].T / size[:, None]
        null = np.abs(Vt[self.rank :]) > IN_NULL_SPACE
        self.dependent = tuple(int(k) for k in np.flatnonzero(np.any(null, axis=0)))
        self.remainder = U[:, self.rank :]

    @property
    def theta(self) -> Array:
        """Joint estimate, shape (P,)."""
        return np.asarray(self.inverse @ self.z, dtype=np.float64)

    def gains(self) -> list[Array]:
        """Change of the joint estimate with each record's, shapes (P, p)."""
        return [self.inverse[:, rows] @ w for rows, w in zip(self.rows, self.whiteners, strict=True)]

    def shift(self, name: str) -> list[Array]:
        """Each record's share of a systematic shift of the joint estimate, shapes (P,)."""
        return [
            g @ r.shifts[name] for g, r in zip(self.gains(), self.records, strict=True) if name in r.shifts
        ]

    def consistency(self) -> Consistency:
        """Distance of the records from each other in the covariance that independent random parts leave."""
        restrictions = self.remainder.shape[1]
        if restrictions == 0:
            return Consistency(0.0, 0, None, None)
        parts = []
        for rows, w, r, T in zip(self.rows, self.whiteners, self.records, self.spreads, strict=True):
            half = w.T @ self.remainder[rows]
            parts.append(half.T @ (r.covariance + T) @ half)
        common = np.zeros((restrictions, restrictions))
        for name in _sources(self.records):
            moved = np.concatenate(
                [
                    w @ r.shifts.get(name, np.zeros(r.theta.size))
                    for w, r in zip(self.whiteners, self.records, strict=True)
                ]
            )
            common += np.outer(self.remainder.T @ moved, self.remainder.T @ moved)
        gap = self.remainder.T @ self.z
        inverse = np.linalg.pinv(sum(parts) + common, rcond=SMALLEST_SHARE, hermitian=True)
        statistic = float(gap @ inverse @ gap)
        scaled, p_value = _f_test(statistic, restrictions, parts, inverse, self.records)
        return Consistency(statistic, restrictions, scaled, p_value)

    def weight_noise(self) -> Array:
        """Covariance that the weights' own errors add, shape (P, P).

        The weights rest on estimated covariances. To first order in their errors (Wishart) the estimate is worse
        than the formula by this, and the formula finds it better by as much again (Meier, Biometrics 9 (1953) 59,
        for one parameter).
        """
        total = np.zeros((len(self.symbols), len(self.symbols)))
        for rows, w, X, r in zip(self.rows, self.whiteners, self.blocks, self.records, strict=True):
            gain = self.inverse[:, rows]
            random = w @ r.covariance @ w.T
            others = np.eye(w.shape[0]) - X @ self.inverse[:, rows]
            others = 0.5 * (others + others.T)
            inner = random @ others @ random + np.trace(others @ random) * random
            total += 2.0 * r.inflation / r.independent_rows * gain @ inner @ gain.T
        return total


def _placed(block: Array, place: NDArray[np.intp], columns: int) -> Array:
    """Columns of a block at their places among all."""
    placed = np.zeros((block.shape[0], columns))
    placed[:, place] = block
    return placed


def _whitener(record: Evidence, covariance: Array) -> Array:
    """Rows that turn the record's parameters into determined combinations of unit covariance, shape (m, p)."""
    P = record.combinations
    C = P @ covariance @ P.T
    size = np.sqrt(np.maximum(np.diag(C), 0.0))
    floor = np.sqrt(SMALLEST_SHARE) * np.abs(P @ record.theta)
    size = np.maximum(size, np.maximum(floor, np.finfo(float).tiny ** 0.5))
    values, vectors = np.linalg.eigh(C / np.outer(size, size))
    values = np.maximum(values, SMALLEST_SHARE * max(float(values[-1]), 1.0))
    return np.asarray((vectors / np.sqrt(values)).T / size @ P, dtype=np.float64)


def _f_test(
    statistic: float, restrictions: int, parts: Sequence[Array], inverse: Array, records: Sequence[Evidence]
) -> tuple[float | None, float | None]:
    """Hotelling's statistic as F, its degrees of freedom pooled over records of unequal covariance.

    After Nel and van der Merwe in the form that units do not change (Krishnamoorthy and Yu, Stat. Probab. Lett. 66
    (2004) 161).
    """
    from scipy.special import fdtrc

    pooled = 0.0
    for part, record in zip(parts, records, strict=True):
        share = inverse @ part
        trace = float(np.trace(share))
        pooled += (float(np.trace(share @ share)) + trace**2) / record.independent_rows
    series = (restrictions + restrictions**2) / pooled if pooled > 0.0 else np.inf
    remaining = min(series, 1e6) - restrictions + 1.0
    if remaining < FEWEST_LEFT:
        return None, None
    scaled = statistic / restrictions * remaining / (remaining + restrictions - 1.0)
    return float(scaled), float(fdtrc(restrictions, remaining, scaled))


def _sources(records: Sequence[Evidence]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for record in records for name in record.shifts))


def _difference(records: Sequence[Evidence], symbol: str) -> Difference | None:
    """How a parameter differs between the records that determine it; None where less than two do."""
    holders = [r for r in records if symbol in r.symbols and symbol not in r.dependent]
    if len(holders) < 2:
        return None
    place = [r.symbols.index(symbol) for r in holders]
    values = np.array([r.theta[k] for r, k in zip(holders, place, strict=True)])
    variances = np.array([r.covariance[k, k] for r, k in zip(holders, place, strict=True)])
    dof = np.array([r.degrees_of_freedom[k] for r, k in zip(holders, place, strict=True)])
    for name in _sources(holders):
        # A common source moves the records apart only by as much as they feel it differently.
        moved = np.array(
            [r.shifts[name][k] if name in r.shifts else 0.0 for r, k in zip(holders, place, strict=True)]
        )
        variances = variances + (moved - moved.mean()) ** 2
    smallest = (np.sqrt(SMALLEST_SHARE) * np.abs(values)) ** 2 + np.finfo(float).tiny
    variances = np.maximum(variances, smallest)
    statistic = _cochran(values, variances, 0.0)
    p_value = _welch(statistic, variances, dof)
    allowed = len(holders) >= FEW or p_value < CONTRADICTED
    stderr = float(np.sqrt(paule_mandel(values, variances, _wanted(len(holders))))) if allowed else 0.0
    return Difference(len(holders), statistic, p_value, stderr)


def _cochran(values: Array, variances: Array, between: float) -> float:
    """Squared distances from the weighted mean over their variances."""
    weights = 1.0 / (variances + between)
    mean = float(weights @ values / weights.sum())
    return float(weights @ (values - mean) ** 2)


def _welch(statistic: float, variances: Array, degrees_of_freedom: Array) -> float:
    """P value of Cochran's Q where the variances are estimates."""
    from scipy.special import fdtrc

    records = variances.size
    weights = 1.0 / variances
    doubt = float(np.sum((1.0 - weights / weights.sum()) ** 2 / np.maximum(degrees_of_freedom, 1.0)))
    scaled = statistic / (records - 1) / (1.0 + 2.0 * (records - 2) / (records**2 - 1) * doubt)
    return float(fdtrc(records - 1, (records**2 - 1) / (3.0 * doubt), scaled))


def _wanted(records: int) -> float:
    """Cochran's Q that a variance between records should leave.

    The median of its distribution: as often too large as too small. With the mean, a few records of unequal weight
    show no variance too often, and the interval is too narrow then (measured in the tests). Two records that
    contradict each other get Birge's factor, which is the mean.
    """
    from scipy.special import chdtri

    return float(chdtri(records - 1, 0.5)) if records >= FEW else 1.0


def paule_mandel(values: Array, variances: Array, wanted: float) -> float:
    """Variance between records with which Cochran's Q is as large as wanted, or zero.

    Parameters
    ----------
    values, variances : ndarray, shape (n,)
        Estimates of n records, and the variances of their errors, above zero.
    wanted : float
        Paule and Mandel's choice is the mean n - 1.
    """
    if _cochran(values, variances, 0.0) <= wanted:
        return 0.0
    from scipy.optimize import brentq

    # With it all records weigh nearly alike, and Q lies below the sum of squares over it.
    high = float(np.sum((values - values.mean()) ** 2)) / wanted
    unit = max(high, float(np.max(variances)))
    found = brentq(lambda b: _cochran(values / unit**0.5, variances / unit, b) - wanted, 0.0, high / unit)
    return float(found) * unit


def _joint(
    system: _System,
    differences: Mapping[str, Difference],
    consistency: Consistency,
    widened: float,
) -> Joint:
    records, size = system.records, len(system.symbols)
    gains = system.gains()
    randoms = [widened * g @ r.covariance @ g.T for g, r in zip(gains, records, strict=True)]
    random = sum(randoms) + widened * system.weight_noise()
    between = np.asarray(sum(g @ T @ g.T for g, T in zip(gains, system.spreads, strict=True)))
    shifts: dict[str, Array] = {}
    systematic = np.zeros((size, size))
    for name in _sources(records):
        shares = system.shift(name)
        common = np.sum(shares, axis=0)
        # A source need not act with the same sign in every record: no less than if it were independent.
        least = np.sqrt(np.sum(np.square(shares), axis=0))
        systematic += np.outer(common, common) + np.diag(np.maximum(least**2 - common**2, 0.0))
        shifts[name] = np.where(np.abs(common) >= least, common, least)
    dof = _degrees_of_freedom(system, differences, randoms, random, between, systematic)
    return Joint(
        symbols=system.symbols,
        theta=system.theta,
        random=random,
        between=between,
        systematic=systematic,
        degrees_of_freedom=dof,
        shifts=shifts,
        dependent=system.dependent,
        differences=differences,
        consistency=consistency,
        widened=widened,
        condition_number=system.condition_number,
        rank=system.rank,
    )


def _degrees_of_freedom(
    system: _System,
    differences: Mapping[str, Difference],
    randoms: Sequence[Array],
    random: Array,
    between: Array,
    systematic: Array,
) -> Array:
    """Of the total standard errors (Satterthwaite): random, between records, systematic as known.

    Where records differ by more than their own errors, the spread of n records is all that is known of it: n - 1.
    Two records that contradict each other have Birge's factor, and the verdict says so.
    """
    records = len(system.records)
    found = np.empty(len(system.symbols))
    for k, symbol in enumerate(system.symbols):
        doubt = 0.0
        for part, record in zip(randoms, system.records, strict=True):
            own = record.degrees_of_freedom
            dof = own[record.symbols.index(symbol)] if symbol in record.symbols else own.min()
            doubt += part[k, k] ** 2 / max(float(dof), 1.0)
        summed = sum(float(part[k, k]) for part in randoms)
        series = summed**2 / doubt if doubt > 0.0 else 1e6
        statistical = float(random[k, k] + between[k, k])
        if between[k, k] > 0.0 and records >= FEW:
            one = differences.get(symbol)
            if one is not None and one.stderr > 0.0 and one.records >= FEW:
                series = min(series, one.records - 1.0)
            else:
                parts = random[k, k] ** 2 / series + between[k, k] ** 2 / (records - 1.0)
                series = statistical**2 / parts
        share = (statistical + float(systematic[k, k])) / max(statistical, np.finfo(float).tiny)
        found[k] = min(series * share**2, 1e6)
    return found
