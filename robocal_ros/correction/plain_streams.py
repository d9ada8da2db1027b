"""Settled streams past the session's objects: bytes in, bytes out, one compiled call for each.

Here it is only found out when that may be tried; see `correction.plain`.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.correction import plain, plainness
from robocal_ros.correction.bounds import CorrectionConfig, Policy
from robocal_ros.correction.commands import Commands
from robocal_ros.correction.corrector import Corrector
from robocal_ros.correction.incoming import READING, TARGET, CorrectionGuard
from robocal_ros.correction.inputs import JointCommand
from robocal_ros.correction.joint_lanes import BEGIN, COUNT, VELOCITY
from robocal_ros.correction.readings import Readings
from robocal_ros.correction.wire import JointWire, Lanes

Array = NDArray[np.float64]


class Limits:
    """What plain messages keep away from, as the kernels take it; ``doubtful`` (n,): no radians."""

    def __init__(self, arm: SerialArm, config: CorrectionConfig, doubtful: Array) -> None:
        self.names = arm.joint_names
        self.free_axis, self.clamped = config.free_axis, config.policy is not Policy.REFUSE
        fastest, thermal, rows = config.velocity_limits, config.thermal, np.empty((6, arm.n))
        rows[plainness.LOWER], rows[plainness.UPPER], rows[plainness.DOUBTFUL] = (
            arm.lower,
            arm.upper,
            doubtful,
        )
        rows[plainness.FASTEST] = np.inf if fastest is None else fastest
        rows[plainness.ARM], rows[plainness.TOOL] = (
            thermal.of_joints(arm),
            config.tool.of_joints(arm),
        )
        self.rows, self.bounds = rows, np.empty(4)
        self.bounds[[plainness.TCP_M, plainness.TCP_RAD]] = thermal.tcp_m, thermal.tcp_rad
        self.bounds[plainness.LONGEST_STEP_S] = config.longest_step_s
        self.bounds[plainness.LEAST_GAP_S] = config.stream_gap_s


class PlainStream:
    """Messages of a topic that are laid out alike, and corrected with a model that stays.

    Parameters
    ----------
    block : of the session's `Memory`.
    wire : reads the topic's messages for the session.
    """

    kind = mark = ""  # of what comes in; of what goes out

    def __init__(
        self,
        limits: Limits,
        block: Array,
        guard: CorrectionGuard,
        corrector: Corrector,
        wire: JointWire,
    ) -> None:
        self._limits, self._block, self._wire = limits, block, wire
        self._guard, self._corrector = guard, corrector
        self._last: JointCommand | None = None
        self._lanes: Lanes | None = None
        self._model: Array | None = None
        self._moves, self._has_rates, self._passes = False, False, True

    def _is_ready(self, data: bytes, last: JointCommand | None, now_s: float) -> bool:
        """Whether a message may be tried, like the ``last`` one that the session has taken."""
        if last is None or (model := self._corrector.settled_on(now_s)) is None:
            return False
        if last is not self._last:
            self._last = last
            self._lay_out(last, self._wire.lanes(self.mark))
        if self._lanes is None or len(data) != self._lanes.sizes[0]:
            return False
        if model is not self._model:
            self._model = model
            self._take_model(model)
        if self._moves and not self._has_rates:
            return False
        self._came[:] = data
        return True

    def _lay_out(self, last: JointCommand, lanes: Lanes | None) -> None:
        """Take over the layout of the ``last`` message."""
        if lanes is None or lanes.names != last.names or lanes.frame_id in (CORRECTED, TAUGHT):
            self._lanes = None
            return
        self._stamp = self._guard.last_stamp(self.kind, last.names)
        if lanes is self._lanes:
            return
        came, goes = np.zeros_like(lanes.form[0]), lanes.goes.copy()
        self._came = came.data.cast("B")[BEGIN : BEGIN + lanes.sizes[0]]
        self._goes = goes.data.cast("B")[BEGIN : BEGIN + lanes.sizes[1]]
        place = np.array([lanes.names.index(name) for name in self._limits.names])
        self._message = came, lanes.form, lanes.layout, place, goes
        self._moves, self._lanes = bool(lanes.layout[COUNT + VELOCITY]), lanes

    def _take_model(self, model: Array) -> None:
        stage, n = self._corrector.stage(model), len(self._limits.names)
        self._passes = stage is None
        if stage is None:
            models, largest = np.zeros((1, 4, *model.shape)), np.zeros((0, n))
        else:
            models, largest = stage.stacked()
            models = np.concatenate([models, self._together(stage.models)[None]])
        self._has_rates = stage is None or stage.analytic
        work = np.empty(plain.work_size(n, len(largest) // 2))
        limits = self._limits
        self._correction: tuple[Any, ...] = (
            self._block, limits.rows, limits.bounds, models, largest,
            limits.free_axis, limits.clamped, work
        )  # fmt: skip

    def _together(self, models: Array) -> Array:
        """Models (4, n + 2, 9) of all stages, for rates."""
        return models


class PlainTargets(PlainStream):
    """Targets of a settled stream."""

    kind, mark = TARGET, CORRECTED

    def __init__(self, commands: Commands, *common: Any) -> None:
        super().__init__(*common)
        self._commands = commands

    def take(self, data: bytes, now_s: float) -> bytes | None:
        """What to put out for a serialized target; None where the session must look at it."""
        if not self._is_ready(data, self._commands.settled, now_s):
            return None
        if plain.pass_plainly(False, *self._message, self._stamp, now_s, 0, *self._correction):
            return data if self._passes else bytes(self._goes)
        return None


class PlainReadings(PlainStream):
    """Readings of all joints, while one model is commanded."""

    kind, mark = READING, TAUGHT

    def __init__(self, readings: Readings, *common: Any) -> None:
        super().__init__(*common)
        self._readings = readings

    def take(self, data: bytes, now_s: float, now_ns: int) -> bytes | None:
        """What to put out for a serialized reading; None where the session must look at it.

        ``now_ns`` : the clock that stamps the readings.
        """
        if not self._is_ready(data, self._readings.whole, now_s):
            return None
        when = now_s, now_ns
        done = plain.pass_plainly(True, *self._message, self._stamp, *when, *self._correction)
        return bytes(self._goes) if done else None

    def _together(self, models: Array) -> Array:
        return models[[2, 3, 0, 1]]
