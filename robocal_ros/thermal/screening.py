# SPDX-License-Identifier: Apache-2.0
"""What drift to expect of one robot, learned from cycles that it has measured."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations, islice
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import Measurements
from robocal_ros.thermal.identification import entangled, open_directions, subset_drift
from robocal_ros.thermal.reference import ColdSpots

if TYPE_CHECKING:
    from robocal_ros.thermal.documents import ScreenRoundDocument

THRESHOLD_M = 1e-4
FEWEST_KNOWN = 21  # as many as the test of stationarity needs


@dataclass(frozen=True, eq=False)
class DriftHistory:
    """Displacements since the cold visit in t cycles, in order of time.

    ``names`` (k,): parameters. ``displacement``, ``rows``: (t, 3m) at the spots, m, and (3m, k) the
    same by each parameter, in measuring axes. They identify. ``check``, ``check_rows``: (t, 3c) and
    (3c, k) at the check points, in axes of their own if need be. They judge.
    """

    names: tuple[str, ...]
    displacement: Array
    rows: Array
    check: Array
    check_rows: Array

    def __post_init__(self) -> None:
        k, t = len(self.names), len(self.displacement)
        shapes = ((self.displacement, self.rows), (self.check, self.check_rows))
        if any(y.shape != (t, len(A)) or A.shape[1] != k for y, A in shapes):
            raise ValueError("displacements must be (t, n) with rows (n, k) of the k names")

    @classmethod
    def of(
        cls, spots: ColdSpots, cycles: Sequence[Measurements], checks: Sequence[Measurements]
    ) -> "DriftHistory":
        """Collect cycles: what each measured to identify, and what to judge by.

        A cycle without one of the poses is left out. Visits of a spot in one cycle are averaged.

        Raises `InputError` when a sample has no cold counterpart, or serves both ends;
        `TooFewSamplesError` with fewer than 21 complete cycles.
        """
        seen = [_by_spot(spots, cycle) for cycle in cycles]
        told = [_by_spot(spots, cycle) for cycle in checks]
        own, other = (tuple(sorted(set().union(*group))) for group in (seen, told))
        if set(own) & set(other):
            raise InputError("a pose that identifies cannot judge: name check poses apart")
        complete = [
            i
            for i, (a, b) in enumerate(zip(seen, told, strict=True))
            if len(a) == len(own) and len(b) == len(other)
        ]
        if len(complete) < FEWEST_KNOWN or not own or not other:
            raise TooFewSamplesError(
                f"{len(complete)} of {len(seen)} cycles visited all {len(own)} poses and "
                f"{len(other)} check poses: screening needs {FEWEST_KNOWN} such cycles"
            )
        return cls(
            spots.cell.arm.parameters.names,
            np.array([np.concatenate([seen[i][spot] for spot in own]) for i in complete]),
            _rows(spots, own),
            np.array([np.concatenate([told[i][spot] for spot in other]) for i in complete]),
            _rows(spots, other),
        )

    def columns(self, names: Sequence[str]) -> tuple[int, ...]:
        """Of some parameters."""
        return tuple(self.names.index(name) for name in names)

    def residual(self, chosen: Sequence[int]) -> Array:
        """What is left (t, 3c) at the check points with some parameters (columns) identified."""
        if not len(chosen):
            return self.check
        found = subset_drift(self.displacement, self.rows, chosen, self.names)
        return np.asarray(self.check - found.drift @ self.check_rows[:, found.chosen].T)


def share_within(residual: Array, threshold_m: float = THRESHOLD_M) -> float:
    """The share lambda of residual coordinates (any shape), m, below a threshold.

    Each cycle, check point and axis (x, y, z apart) counts once. The source counts each axis of
    each point once for all cycles (7.95 % is 7 of its 88 directions) and does not say how it
    sums the cycles up; counted apart, none hides behind the others.
    """
    return float(np.mean(np.abs(residual) < threshold_m))


def _by_spot(spots: ColdSpots, cycle: Measurements) -> dict[int, Array]:
    """Mean displacement (3,) at each spot that a cycle visited."""
    spot, drift = spots.match(cycle), spots.drift(cycle)
    return {int(s): drift[spot == s].mean(axis=0) for s in np.unique(spot)}


def _rows(spots: ColdSpots, own: tuple[int, ...]) -> Array:
    index = np.array(own, dtype=np.int64)
    return spots.rows(spots.q[index], spots.target[index])[0].reshape(3 * len(own), -1)


LEVEL = 0.05  # chance that white noise passes for a drift
LAGS = 7  # a drift shows in the first lags; with 7 the count's own chance is 4.4 %, next to LEVEL
BOUND = 1.96  # of a white series' autocorrelation, times the root of its length
FEWEST = 3 * LAGS


@dataclass(frozen=True, eq=False)
class Stationarity:
    """Tests of k series, each against white noise about a level.

    ``autocorrelation`` (LAGS, k): at lags 1 ... LAGS. ``bound``: half width of the interval that
    holds 95 % of a white series' autocorrelations. ``outside`` (k,): how many lags lie outside it;
    chance exceeds ``allowed`` of them in no more than 5 % of white series. ``p_value`` (k,): of
    Ljung and Box's test.
    """

    autocorrelation: Array
    bound: float
    outside: NDArray[np.int64]
    allowed: int
    p_value: Array

    @property
    def by_count(self) -> NDArray[np.bool_]:
        """(k,) stationary, because no more lags lie outside than chance allows."""
        return np.asarray(self.outside <= self.allowed)

    @property
    def by_ljung_box(self) -> NDArray[np.bool_]:
        """(k,) stationary, because white noise has such autocorrelations often enough."""
        return np.asarray(self.p_value >= LEVEL)


def stationarity(series: Array) -> Stationarity:
    """Test the columns of equally spaced series (t, k), in whatever unit.

    The lags of a white series are nearly independent and each is outside with chance 5 %, so
    that their number is binomial. Ljung and Box (1978) sum their squares instead, which is
    chi-square with as many degrees of freedom as there are lags. Either finds a white series
    drifting in about 5 % of cases (the count, being whole, in a little less).

    Raises `TooFewSamplesError` with fewer than 21 times.
    """
    from scipy.special import bdtrc, gammaincc

    n = len(series)
    if n < FEWEST:
        raise TooFewSamplesError(
            f"{n} cycles are too few to tell a drift from chance: at least {FEWEST}"
        )
    r = autocorrelation(series)
    bound = BOUND / float(np.sqrt(n))
    left = n - np.arange(1, LAGS + 1)
    squared = n * (n + 2.0) * np.sum(r**2 / left[:, None], axis=0)
    return Stationarity(
        autocorrelation=r,
        bound=bound,
        outside=np.sum(np.abs(r) > bound, axis=0),
        allowed=next(count for count in range(LAGS + 1) if bdtrc(count, LAGS, LEVEL) <= LEVEL),
        p_value=np.asarray(gammaincc(0.5 * LAGS, 0.5 * squared)),
    )


def autocorrelation(series: Array) -> Array:
    """Sample autocorrelation (LAGS, k) of the columns of (t, k); zero for a constant column."""
    x = series - series.mean(axis=0)
    power = np.sum(x**2, axis=0)
    power = np.where(power > 0.0, power, 1.0)
    return np.array([np.sum(x[lag:] * x[:-lag], axis=0) / power for lag in range(1, LAGS + 1)])


Removal = Literal["best", "classic"]
Test = Literal["autocorrelation", "ljung-box"]
WANTED = 8
CLASSIC_ORDER = ("theta", "alpha", "d", "a", "beta")  # in which the source lists its set S
UNDETERMINED = -1.0  # orders a set that the poses do not determine below any share


@dataclass(frozen=True)
class Round:
    """One round: the parameters left at its beginning.

    ``names``: the parameters left. ``share``: lambda with these identified; None where the poses do
    not determine them. ``undetermined``: the directions that the poses leave open, in words.
    ``stationary``: the set S, in the order of ``names``. ``candidates``: those of which one is
    removed: S; all, if S is empty; where a direction is open those in it, because their series mean
    nothing. ``size``: of each candidate's drift, in units of its sigma. ``removed``: the one that
    is; None in the last round.
    """

    names: tuple[str, ...]
    share: float | None
    undetermined: tuple[str, ...]
    stationary: tuple[str, ...]
    candidates: tuple[str, ...]
    size: Mapping[str, float]
    removed: str | None = None

    @classmethod
    def of(
        cls, history: DriftHistory, names: tuple[str, ...], test: Test, threshold_m: float
    ) -> "Round":
        """The round of these parameters, before one is removed."""
        left = history.columns(names)
        if inside := entangled(history.rows, left):
            words = open_directions(history.rows, left, history.names)
            loose = tuple(history.names[column] for column in inside)
            return cls(names, None, words, (), loose, dict.fromkeys(loose, 0.0))
        found = subset_drift(history.displacement, history.rows, left, history.names)
        tests = stationarity(found.drift)
        passed = tests.by_count if test == "autocorrelation" else tests.by_ljung_box
        still = tuple(name for name, calm in zip(names, passed, strict=True) if calm)
        size = dict(zip(names, found.size.tolist(), strict=True))
        return cls(names, _share(history, names, threshold_m), (), still, still or names, size)

    @property
    def note(self) -> str:
        """Why the candidates are not S; empty where they are."""
        if self.undetermined:
            return f"not determined by these poses: {'; '.join(self.undetermined)}"
        return "" if self.stationary else "no parameter is stationary: all are candidates"


@dataclass(frozen=True)
class Screening:
    """All rounds, from all parameters to the wanted number."""

    uncompensated: float
    rounds: tuple[Round, ...]

    @property
    def chosen(self) -> Round:
        """The last round: the wanted number."""
        return self.rounds[-1]

    @property
    def highest(self) -> Round:
        """The round of the highest share; of several the one with the fewest parameters."""
        return max(reversed(self.rounds), key=lambda r: _order(r.share))

    def rows(self) -> "list[ScreenRoundDocument]":
        """The rounds as plain values, for JSON and tables."""
        return [
            {
                "parameters": len(r.names),
                "names": list(r.names),
                "share": r.share,
                "stationary": list(r.stationary),
                "removed": r.removed,
                "note": r.note,
            }
            for r in self.rounds
        ]


def screen(
    history: DriftHistory,
    *,
    wanted: int = WANTED,
    removal: Removal = "best",
    test: Test = "autocorrelation",
    threshold_m: float = THRESHOLD_M,
) -> Screening:
    """Remove one parameter after the other, of those whose series is stationary.

    ``classic`` (thesis 3.2): goes through S in the source's order and removes the first whose
    removal does not lower the share; if all lower it, the one that lowers it least. ``best``:
    the one whose removal gives the highest share, of several the one of the smaller drift in
    units of its sigma.

    ``wanted``: how many parameters to stop at.

    Raises `TooFewSamplesError` with fewer equations than parameters, or too few cycles to test
    their series; `ValueError` when the wanted number is not between 1 and the number of parameters.
    """
    if not 1 <= wanted <= len(history.names):
        raise ValueError(f"wanted must be 1 to {len(history.names)}, not {wanted}")
    if len(history.rows) < len(history.names):
        raise TooFewSamplesError(
            f"{len(history.rows) // 3} poses give {len(history.rows)} equations for "
            f"{len(history.names)} parameters: screening starts from all of them, so measure more"
        )
    rounds, names = [], history.names
    while len(names) > wanted:
        found = Round.of(history, names, test, threshold_m)
        gone = _removed(history, found, removal, threshold_m)
        rounds.append(replace(found, removed=gone))
        names = tuple(name for name in names if name != gone)
    rounds.append(Round.of(history, names, test, threshold_m))
    uncompensated = share_within(history.check, threshold_m)
    return Screening(uncompensated, tuple(rounds))


def _removed(history: DriftHistory, found: Round, removal: Removal, threshold_m: float) -> str:
    def after(gone: str) -> float:
        rest = tuple(name for name in found.names if name != gone)
        return _order(_share(history, rest, threshold_m))

    if removal == "best":
        return max(found.candidates, key=lambda name: (after(name), -found.size[name]))
    shares: dict[str, float] = {}
    for name in sorted(found.candidates, key=_classic_place):
        shares[name] = after(name)
        if shares[name] >= _order(found.share):
            return name
    return max(shares, key=lambda name: shares[name])


def _share(history: DriftHistory, names: tuple[str, ...], threshold_m: float) -> float | None:
    """Lambda of a subset; None where the poses do not determine it."""
    try:
        return share_within(history.residual(history.columns(names)), threshold_m)
    except RankDeficientError:
        return None


def _order(share: float | None) -> float:
    return UNDETERMINED if share is None else share


def _classic_place(name: str) -> int:
    """Place of a name such as theta4_deg in the source's order."""
    kind = name.split("_")[0].rstrip("0123456789")
    return CLASSIC_ORDER.index(kind) if kind in CLASSIC_ORDER else len(CLASSIC_ORDER)


# C_p weighs the sum of all squared residuals against the number of parameters, so that a few bad
# points can hide in it. The search goes through every subset of the size, a million for 8 or 9 of
# 24: the many that explain about the same would leave a branch-and-bound search little to skip.
Branch = tuple[tuple[int, ...], tuple[int, ...]]
_AT_ONCE = 20_000


@dataclass(frozen=True)
class BestSubset:
    """The subset of its size that explains most.

    ``names``: its parameters.
    ``cp``: Mallows' C_p per cycle; a subset without bias has about as much as it has parameters.
    """

    names: tuple[str, ...]
    cp: float


def best_subset(history: DriftHistory, size: int) -> BestSubset:
    """Find the subset of a size with the smallest C_p, exactly (8 of 24: some seconds).

    With the same parameters in all t cycles, C_p = RSS / (t s^2) - 3m + 2p; s^2 is what all
    parameters together leave, per degree of freedom. Only the spots' displacements are used.

    Raises `TooFewSamplesError` when no equations are left over that could show the noise;
    `ValueError` when the size is not between 1 and the number that the poses determine.
    """
    Y, A = history.displacement, history.rows
    branches = tuple(_determined(A, tuple(range(A.shape[1])), ()))
    everything = sum(branches[0], start=())
    freedom = len(A) - len(everything)
    if freedom < 1:
        raise TooFewSamplesError(
            f"{len(A)} equations for {len(everything)} parameters leave none to show the noise: "
            "measure more"
        )
    if not 1 <= size <= len(everything):
        raise ValueError(f"size must be 1 to the {len(everything)} that the poses determine")
    chosen = _most_explaining(A, Y, branches, size)
    noise = _rss(A, Y, everything) / (len(Y) * freedom)
    cp = _rss(A, Y, chosen) / (len(Y) * noise) - len(A) + 2 * size
    return BestSubset(tuple(history.names[i] for i in sorted(chosen)), cp)


def _determined(A: Array, left: tuple[int, ...], kept: tuple[int, ...]) -> Iterator[Branch]:
    """Split the subsets of columns that the equations determine: free columns, and kept ones.

    Every such subset misses a member of an open direction, and by the first that it misses it
    belongs to one branch.
    """
    members = entangled(A, kept + left)
    if not members:
        yield left, kept
        return
    options = tuple(member for member in members if member in left)
    for i, member in enumerate(options):
        before = options[:i]
        rest = tuple(c for c in left if c != member and c not in before)
        yield from _determined(A, rest, kept + before)


def _most_explaining(
    A: Array, Y: Array, branches: tuple[Branch, ...], size: int
) -> tuple[int, ...]:
    """The columns that explain most of Y: the trace of (A_s^T A_s)^-1 A_s^T Y Y^T A_s."""
    length = np.linalg.norm(A, axis=0)
    scaled = A / np.where(length > 0.0, length, 1.0)
    normal, cross = scaled.T @ scaled, scaled.T @ Y.T
    power = cross @ cross.T
    best: tuple[int, ...] = ()
    most = -np.inf
    for subsets in _subsets(branches, size):
        index = subsets[:, :, None], subsets[:, None, :]
        explained = np.einsum("nij,nij->n", np.linalg.inv(normal[index]), power[index])
        i = int(np.argmax(explained))
        if explained[i] > most:
            most, best = float(explained[i]), tuple(int(c) for c in subsets[i])
    return best


def _subsets(branches: tuple[Branch, ...], size: int) -> Iterator[NDArray[np.int64]]:
    """All determined subsets of a size, some thousands (n, size) at once."""
    for left, kept in branches:
        if len(kept) > size:
            continue
        more = (kept + chosen for chosen in combinations(left, size - len(kept)))
        while part := list(islice(more, _AT_ONCE)):
            flat = np.fromiter(chain.from_iterable(part), dtype=np.int64, count=len(part) * size)
            yield flat.reshape(-1, size)


def _rss(A: Array, Y: Array, chosen: tuple[int, ...]) -> float:
    """Sum of the squared residuals of all cycles."""
    Q = np.linalg.qr(A[:, list(chosen)])[0]
    return float(np.sum((Y - Y @ Q @ Q.T) ** 2))
