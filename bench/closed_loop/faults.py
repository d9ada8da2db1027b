# SPDX-License-Identifier: Apache-2.0
"""What each fault costs, who reports it, and from which size on. Simulated."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile

from bench.closed_loop.judging import Harm, harm
from bench.closed_loop.plant import FIXTURE_GAP_S, GapReport
from bench.closed_loop.shift import Incident, ShiftPlan, ShiftRecord
from robocal_ros.cell_sim.faults import FAULTS, SIZES, Fault
from robocal_ros.ground.errors import Code

EVERY_S = 160.0  # a gap, then one pass of the programme
CLEAN, AFTER = 1, 2  # gaps before and after the fault
LONG_AFTER = 12  # of a knock that nobody sees: what is learned from it may add up
WARM_S = 1800.0  # of work before those, so that there is a drift to be learned
POWER, CONFIDENCE = 0.9, 0.95
ALARM = "a false alarm before it"
WELL = (Code.NONE, Code.ACCEPT, Code.NO_SIGNIFICANT_GAIN, Code.WORSE_THAN_CURRENT)
RIGHT: Mapping[Fault, Code] = {
    "collision": Code.LIMIT_EXCEEDED,
    "wrong_tool": Code.WRONG_TOOL,
    "sensor_knocked": Code.SENSOR_OR_ROBOT_MOVED,
    "sphere_knocked": Code.SENSOR_OR_ROBOT_MOVED,
    "moved_by_hand": Code.SENSOR_OR_ROBOT_MOVED,
    "station_knocked": Code.STATION_MOVED,
    "station_knocked_shift": Code.STATION_MOVED,
    "beam_dirty": Code.BEAM_EDGES_WRONG,
    "beam_x_dead": Code.BEAM_EDGES_WRONG,
    "beam_y_dead": Code.BEAM_EDGES_WRONG,
    "beams_dead": Code.BEAM_EDGES_WRONG,
    "chatter": Code.BEAM_EDGES_WRONG,
    "lost_edge": Code.BEAM_EDGES_WRONG,
    "double_edge": Code.BEAM_EDGES_WRONG,
    "swapped_cables": Code.BEAM_EDGES_WRONG,
    "wrong_station": Code.BEAM_EDGES_WRONG,
    "input_latency": Code.CLOCK_WRONG,
    "clock_jump": Code.CLOCK_WRONG,
    "lost_messages": Code.TOO_FEW_SAMPLES,
    "joints_silent": Code.TOO_FEW_SAMPLES,
    "frozen_clock": Code.TOO_FEW_SAMPLES,
    "frozen_encoder": Code.LIMIT_EXCEEDED,
    "fixture_moved": Code.ACCEPT,
}
"""What a PLC must read (docs/simulation.md). Exchanged motor temperatures need none: they are only
used where the drift was learned with them. Nor does a jump of the sensor's clock: the robot stands
until the joint readings have passed a measurement's stamp, so it is taken at the same joints; one
that is too large for that leaves poses unmeasured. Nor does a station that turns about the crossing
of its beams: neither tip nor axis of the tool change with it."""

ONLY_BY: Mapping[Fault, str] = {"collision": "tool", "fixture_moved": "fixture"}
"""Who must give the right code, where it means something else of others."""

STATION_MM = (0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2, 2.0)
SWEEP: Mapping[Fault, tuple[float, ...]] = {
    "collision": (0.1, 0.2, 0.3, 0.5, 2.0),
    "wrong_tool": (0.2, 0.6, 1.0, 2.0, 10.0),
    "sensor_knocked": (0.05, 0.1, 0.15, 0.2, 1.0),
    "sphere_knocked": (0.02, 0.05, 0.1, 0.15, 0.2, 1.0),
    "beam_dirty": (0.1, 0.15, 0.2, 0.4, 0.6),
    "input_latency": (1.0, 4.0, 6.0, 20.0),
    "lost_messages": (0.02, 0.05, 0.1, 0.2),
    "clock_jump": (0.002, 0.004, 0.006, 0.02, 1.0, 10.0),
    "sensor_clock_jump": (0.01, 0.1, 1.0, 10.0),
    "frozen_encoder": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
    "moved_by_hand": (0.05, 0.1, 0.15, 0.2, 1.0),
    "station_knocked": STATION_MM,
    "station_knocked_shift": STATION_MM,
    "station_knocked_turn": (0.05, 0.2, 0.5, 1.0),
    "fixture_moved": (0.1, 0.2, 0.5, 1.0, 2.0),
}
"""Sizes in the faults' own units; a fault that is not here is tried at its usual one."""


UNSEEN: Mapping[Fault, tuple[float, ...]] = {
    "sensor_knocked": (0.05, 0.1),
    "sphere_knocked": (0.05, 0.1),
    "moved_by_hand": (0.05, 0.1),
}
"""Knocks at which a thermal cycle may go on."""

ENUMERATED: Collection[Fault] = ("frozen_encoder",)
"""Faults whose size is a number of something: none is the smallest."""


@dataclass(frozen=True)
class Trial:
    """A fault of a size in the cell of a seed; 0: the usual size, or none."""

    fault: Fault
    size: float
    seed: int
    gaps: int = AFTER

    @property
    def plan(self) -> ShiftPlan:
        """A short shift with the fault after its first gap."""
        fixture = self.fault == "fixture_moved"
        gap_s, every_s = (FIXTURE_GAP_S, FIXTURE_GAP_S + EVERY_S) if fixture else (90.0, EVERY_S)
        return ShiftPlan(
            hours=(CLEAN + self.gaps) * every_s / 3600.0,
            work_s=WARM_S if self.gaps > AFTER else 0.0,
            every_s=every_s,
            gap_s=gap_s,
            incidents=(Incident(CLEAN * every_s, self.fault, self.size),),
            fixture=fixture,
            # Exchanged temperatures matter to nobody else.
            prior="learned" if self.fault == "swapped_temperatures" else "default",
        )

    @property
    def amount(self) -> float:
        """Its size, by which trials are put in order; 0 where that is a number of something."""
        return 0.0 if self.fault in ENUMERATED else self.size

    @property
    def must_be_told(self) -> bool:
        """Whether the right code is wanted in every cell: a usual size, or one of a count."""
        usual = (0.0, *SIZES.get(self.fault, ())[:1])
        told = self.size in usual or self.fault in ENUMERATED
        return told and self.fault in RIGHT and self.gaps == AFTER


@dataclass(frozen=True)
class Report:
    """What a trial showed.

    Attributes
    ----------
    who, code : who reported it first, and how; empty and NONE where nobody did. `ALARM`: somebody
        said something before there was a fault.
    gaps : after the fault until somebody gave the right code; one more than there were where
        nobody did.
    over_s : the longest overrun of a gap.
    drive_faults : trajectories that the robot's drives did not take.
    """

    trial: Trial
    who: str
    code: Code
    gaps: float
    harm: Harm
    over_s: float
    drive_faults: int

    @property
    def in_time(self) -> bool:
        """Whether it was reported within one cycle, with the right code."""
        return self.gaps <= 1


def report_of(trial: Trial, with_suite: ShiftRecord, without: ShiftRecord) -> Report:
    """Read the records of a trial."""
    who, code, gaps = "", Code.NONE, trial.gaps + 1.0
    for number, gap in enumerate(with_suite.gaps[CLEAN:], start=1):
        for name, found in _told(gap):
            if not who:
                who, code = name, found
            right = found is RIGHT.get(trial.fault) and name == ONLY_BY.get(trial.fault, name)
            if right:
                gaps = min(gaps, float(number))
    for gap in with_suite.gaps[:CLEAN]:
        for _, found in _told(gap):
            who, code, gaps = ALARM, found, trial.gaps + 1.0
    over_s = max(gap.over_s for gap in with_suite.gaps)
    worse = harm(with_suite, without, after=CLEAN)
    return Report(trial, who, code, gaps, worse, over_s, with_suite.drive_faults)


def _told(gap: GapReport) -> list[tuple[str, Code]]:
    result = gap.result
    if result is None:
        return [("run refused", gap.fault_code or Code.CONFLICT)]
    told = [("thermal", result.thermal_code)]
    told += [("tool", result.tool_found_code), ("tool", result.tool_code)]
    told += [("maintenance", gap.fault_code), ("maintenance", result.code)]
    told = [(name, code) for name, code in told if code not in WELL]
    found = result.fixture_code  # ACCEPT: it has moved, and nothing else has
    return told + [("fixture", found)] * (found not in (Code.NONE, Code.NO_SIGNIFICANT_GAIN))


def unseen(seeds: Sequence[int]) -> list[Trial]:
    """Small knocks of a warm cell that is kept up through many gaps."""
    return [
        Trial(fault, size, seed, LONG_AFTER)
        for fault, sizes in UNSEEN.items()
        for size in sizes
        for seed in seeds
    ]


def sweep(seeds: Sequence[int]) -> list[Trial]:
    """Each fault at all of its sizes."""
    return [
        Trial(fault, size, seed)
        for fault in FAULTS
        if fault != "none"
        for size in SWEEP.get(fault, (0.0,))
        for seed in seeds
    ]


Held = Callable[[Sequence[bool]], bool]


def shown(rights: Sequence[bool]) -> bool:
    """Whether trials of one size, right or not, are right with the wanted power."""
    return sum(rights) >= POWER * len(rights)


def proven(rights: Sequence[bool]) -> bool:
    """Whether so many trials also prove it."""
    return least_power(rights) >= POWER


def least_power(rights: Sequence[bool]) -> float:
    """The lower confidence bound of the power, one-sided, from trials that were right or not.

    Clopper and Pearson, "The use of confidence or fiducial limits", Biometrika 26 (1934): exact
    for a count.
    """
    from scipy.stats import binomtest

    counted = binomtest(sum(rights), len(rights), alternative="greater")
    return float(counted.proportion_ci(CONFIDENCE, method="exact").low)


def rights_by_size(found: Iterable[tuple[float, bool]]) -> dict[float, list[bool]]:
    """Trials of one fault by their size, the largest first."""
    by_size: dict[float, list[bool]] = {}
    for size, right in found:
        by_size.setdefault(size, []).append(right)
    return dict(sorted(by_size.items(), reverse=True))


def smallest_held(found: Mapping[float, Sequence[bool]], held: Held) -> float | None:
    """The smallest size of `rights_by_size` from which on it held; None where no size does."""
    sizes = list(takewhile(lambda size: held(found[size]), found))
    return sizes[-1] if sizes else None


def named_smallest(fault: Fault, amount: float | None) -> str:
    """What `smallest_held` found, in words."""
    if amount is None:
        return "none"
    return "" if fault in ENUMERATED else named_size(Trial(fault, amount, 0))


def named_size(trial: Trial) -> str:
    """The size with its unit."""
    usual_size, _, unit = SIZES.get(trial.fault, (0.0, 1.0, ""))
    size = trial.size or usual_size
    return f"{size:g} {unit}".strip() if size else ""
