"""Which parameters a robot's drift needs: backward elimination by what it leaves at check points.

Off line, from a shift that was recorded with many poses; see ``drift_history`` for lambda.
"""

from dataclasses import dataclass
from typing import Literal

from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.thermal.drift_history import THRESHOLD_M, DriftHistory, share_within
from robocal_ros.thermal.stationarity import stationarity
from robocal_ros.thermal.subset import entangled, open_directions, subset_drift

Removal = Literal["best", "classic"]
Test = Literal["autocorrelation", "ljung-box"]

WANTED = 8
CLASSIC_ORDER = ("theta", "alpha", "d", "a", "beta")  # in which the source lists its set S
UNDETERMINED = -1.0  # orders a set that the poses do not determine below any share


@dataclass(frozen=True)
class Round:
    """One round: the parameters left at its beginning.

    Attributes
    ----------
    names : the parameters left.
    share : lambda with these identified; None where the poses do not determine them.
    undetermined : the directions that the poses leave open, in words.
    stationary : the set S, in the order of ``names``.
    candidates : those of which one is removed: S; all, if S is empty; where a direction is
        open those in it, because their series mean nothing.
    removed : the one that is; None in the last round.
    """

    names: tuple[str, ...]
    share: float | None
    undetermined: tuple[str, ...]
    stationary: tuple[str, ...]
    candidates: tuple[str, ...]
    removed: str | None

    @property
    def note(self) -> str:
        """Why the candidates are not S; empty where they are."""
        if self.undetermined:
            return f"not determined by these poses: {'; '.join(self.undetermined)}"
        return "" if self.stationary else "no parameter is stationary: all are candidates"


@dataclass(frozen=True)
class Screening:
    """All rounds, from all parameters to the wanted number."""

    removal: Removal
    test: Test
    threshold_m: float
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

    def rows(self) -> list[dict[str, object]]:
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

    Parameters
    ----------
    wanted : how many parameters to stop at.

    Raises
    ------
    TooFewSamplesError
        With fewer equations than parameters, or too few cycles to test their series.
    ValueError
        When the wanted number is not between 1 and the number of parameters.
    """
    if not 1 <= wanted <= len(history.names):
        raise ValueError(f"wanted must be 1 to {len(history.names)}, not {wanted}")
    if len(history.rows) < len(history.names):
        raise TooFewSamplesError(
            f"{len(history.rows) // 3} poses give {len(history.rows)} equations for "
            f"{len(history.names)} parameters: screening starts from all of them, so measure more"
        )
    rounds = []
    left = tuple(range(len(history.names)))
    while True:
        state = _State.of(history, left, test, threshold_m)
        if len(left) == wanted:
            rounds.append(state.round(history.names, None))
            break
        gone = _removed(history, state, removal, threshold_m)
        rounds.append(state.round(history.names, gone))
        left = tuple(column for column in left if column != gone)
    uncompensated = share_within(history.check, threshold_m)
    return Screening(removal, test, threshold_m, uncompensated, tuple(rounds))


@dataclass(frozen=True)
class _State:
    """A round before its removal; parameters by their columns."""

    left: tuple[int, ...]
    share: float | None
    undetermined: tuple[str, ...]
    stationary: tuple[int, ...]
    candidates: tuple[int, ...]
    size: dict[int, float]  # of each candidate's drift, in units of its sigma

    @classmethod
    def of(
        cls, history: DriftHistory, left: tuple[int, ...], test: Test, threshold_m: float
    ) -> "_State":
        open_ones = entangled(history.rows, left)
        if open_ones:
            words = open_directions(history.rows, left, history.names)
            return cls(left, None, words, (), open_ones, dict.fromkeys(open_ones, 0.0))
        found = subset_drift(history.displacement, history.rows, left, history.names)
        tests = stationarity(found.drift)
        passed = tests.by_count if test == "autocorrelation" else tests.by_ljung_box
        still = tuple(column for column, calm in zip(left, passed, strict=True) if calm)
        return cls(
            left=left,
            share=_share(history, left, threshold_m),
            undetermined=(),
            stationary=still,
            candidates=still or left,
            size=dict(zip(left, found.size.tolist(), strict=True)),
        )

    def round(self, names: tuple[str, ...], removed: int | None) -> Round:
        def named(columns: tuple[int, ...]) -> tuple[str, ...]:
            return tuple(names[column] for column in columns)

        return Round(
            names=named(self.left),
            share=self.share,
            undetermined=self.undetermined,
            stationary=named(self.stationary),
            candidates=named(self.candidates),
            removed=None if removed is None else names[removed],
        )


def _removed(history: DriftHistory, state: _State, removal: Removal, threshold_m: float) -> int:
    """The candidate to remove."""

    def after(column: int) -> float:
        rest = tuple(c for c in state.left if c != column)
        return _order(_share(history, rest, threshold_m))

    if removal == "best":
        return max(state.candidates, key=lambda column: (after(column), -state.size[column]))
    shares: dict[int, float] = {}
    for column in sorted(state.candidates, key=lambda c: _classic_place(history.names[c])):
        shares[column] = after(column)
        if shares[column] >= _order(state.share):
            return column
    return max(shares, key=lambda column: shares[column])


def _share(history: DriftHistory, chosen: tuple[int, ...], threshold_m: float) -> float | None:
    """Lambda of a subset; None where the poses do not determine it."""
    try:
        return share_within(history.residual(chosen), threshold_m)
    except RankDeficientError:
        return None


def _order(share: float | None) -> float:
    return UNDETERMINED if share is None else share


def _classic_place(name: str) -> int:
    """Place of a name such as theta4_deg in the source's order."""
    kind = name.split("_")[0].rstrip("0123456789")
    return CLASSIC_ORDER.index(kind) if kind in CLASSIC_ORDER else len(CLASSIC_ORDER)
