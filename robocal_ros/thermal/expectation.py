"""How a robot is expected to drift, as the shifts in its own history teach."""

from collections import defaultdict
from contextlib import suppress

import numpy as np

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.proposals import THERMAL, CalibrationState, Entry
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.history import History
from robocal_ros.thermal.in_force import REFERENCE
from robocal_ros.thermal.process_learning import (
    EarlierShift,
    LearnedProcess,
    learn_gains,
    learn_process,
)
from robocal_ros.thermal.reference import reference_of

LEARN_FROM = 2000
MOST_SHIFTS = 5  # the newest; learning takes half a second each
FEWEST_WITH_TEMPERATURES = 2  # shifts, so that what one motor does is not what all of them do
WRONG = (CalibrationState.REJECTED, CalibrationState.ROLLED_BACK)  # somebody did not believe it


def expected_drift(nominal: SerialArm, history: History) -> tuple[LearnedProcess | None, str]:
    """What every cold reference in the history with its cycles teaches, and the same in words.

    With the motors' temperatures where all cycles have them. None: too little.
    """
    shifts = earlier_shifts(nominal, history)
    warm = [shift for shift in shifts if shift.temperature is not None]
    if len(warm) >= FEWEST_WITH_TEMPERATURES:
        with suppress(RobocalError, np.linalg.LinAlgError):  # then without temperatures
            return learn_gains(warm), f"learned with temperatures from {len(warm)} shifts"
    try:
        return learn_process(shifts), f"learned from {len(shifts)} shifts"
    except (RobocalError, np.linalg.LinAlgError) as error:
        return None, f"default, because {error}"


def earlier_shifts(nominal: SerialArm, history: History) -> list[EarlierShift]:
    """Every cold reference of the history with its cycles, those apart that nobody believed."""
    entries = history.list(LEARN_FROM)
    cycles: dict[int, list[Entry]] = defaultdict(list)
    for entry in entries:
        sound = entry.state not in WRONG and entry.code is not Code.SENSOR_OR_ROBOT_MOVED
        if entry.kind == THERMAL and sound:
            cycles[int(history.model(entry.id).get("reference_stamp_ns", 0))].append(entry)
    shifts: list[EarlierShift] = []
    for entry in entries:
        if entry.kind != REFERENCE or len(shifts) == MOST_SHIFTS:
            continue
        reference = reference_of(history.model(entry.id), nominal)
        cold_ns = reference.data.middle_ns
        arrays = [history.inputs(e.id) for e in cycles[cold_ns]]
        arrays = [a for a in arrays if "q" in a and "stamp_ns" in a]
        data = [Measurements.of_arrays(a) for a in arrays]
        order = np.argsort([d.middle_ns for d in data], kind="stable").tolist()
        times = [1e-9 * (data[i].middle_ns - cold_ns) for i in order]
        if not order or times[0] <= 0.0 or np.any(np.diff(times) <= 0.0):
            continue  # the clock jumped within it
        cold = reference.temperature
        known = cold is not None and all("motor_temperature" in a for a in arrays)
        rise = [arrays[i]["motor_temperature"] - cold for i in order] if known else None
        shifts.append(
            EarlierShift(
                reference.spots,
                [data[i] for i in order],
                np.array(times),
                None if rise is None else np.array(rise),
            )
        )
    return shifts[::-1]
