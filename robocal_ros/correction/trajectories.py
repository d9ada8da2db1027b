"""Whole trajectories, corrected along their time: one offset function from where the robot is."""

from dataclasses import replace

import numpy as np

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import CORRECTED
from robocal_ros.correction.bounds import CorrectionConfig, require_limits
from robocal_ros.correction.desired import DesiredOffset
from robocal_ros.correction.inputs import (
    Array,
    Index,
    TrajectoryCommand,
    require_few,
    require_finite,
)
from robocal_ros.correction.limiter import DESIRED, OFFSET, OFFSET_RATE, STILL
from robocal_ros.correction.output import Output, SentPath, hold_speeds
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.robot_state import RobotState
from robocal_ros.correction.staged import StagedResult

# A cubic from rest to rest is so many times faster than its mean (a quintic: 1.875).
SPLINE_PEAK = 1.875
SETTLED = 1e-9  # rad, m: of an offset that is the desired one
LONGEST_WAIT_S = 60.0  # for which it is worked out how long an offset takes
STOP_POINTS = 10


class TrajectoryCorrector:
    """Corrects whole trajectories, and plans stops on the way of what was put out."""

    def __init__(
        self,
        arm: SerialArm,
        config: CorrectionConfig,
        state: RobotState,
        desired: DesiredOffset,
        output: Output,
    ) -> None:
        self._arm, self._config, self._state = arm, config, state
        self._desired, self._output = desired, output
        self._fastest = config.velocity_limits

    def correct(
        self, command: TrajectoryCommand, index: Index, q: Array, now_s: float, starts_in_s: float
    ) -> tuple[TrajectoryCommand, SentPath]:
        """Correct a trajectory of taught joints ``q`` (m, n), of which ``index`` go out.

        Raises `RefusedError` when it cannot be corrected, its begin is elsewhere, its end would not
        be reached with the correction that belongs there, or a limit is exceeded. Nothing has
        changed then.
        """
        output, limiter = self._output, self._output.limiter
        kept = limiter.state.copy()
        times = command.time_from_start_s + starts_in_s
        desired, result = self._desired.at(q)
        output.take_up(now_s)
        try:
            led_from = self._begin(index, q, desired, times, now_s)
            begin = limiter.state.copy()
            way = np.abs(np.diff(q, axis=0))[:, index].max(axis=1, initial=0.0)
            speed = np.append(2.0 * STILL, way / np.diff(times))  # a lead-in is a motion
            speed[1:-1] = np.maximum(speed[1:-1], speed[2:])  # so is what begins to move
            active = np.zeros(self._arm.n)
            active[index] = 1.0
            offsets, rates = limiter.follow(desired, np.maximum(times, 0.0), speed, active)
            self._require_end(limiter.withheld[index], active)
            out = q + offsets
            velocity, acceleration = self._rates(
                command, index, q, result, offsets - desired, rates, times
            )
            require_limits(out, self._arm)
            self._require_speeds(command, index, out, velocity, times, led_from)
        finally:
            limiter.state[:] = kept
        known_times, withheld = command.time_from_start_s, offsets - desired
        sent, sent_rates, sent_withheld = offsets, rates, withheld
        if led_from is not None:  # until its first point: from the offset that there is now
            known_times = np.append(-starts_in_s, known_times)
            sent = np.vstack([begin[OFFSET], offsets])
            sent_rates = np.vstack([begin[OFFSET_RATE], rates])
            sent_withheld = np.vstack([begin[OFFSET] - begin[DESIRED], withheld])
        path = SentPath(
            index=index,
            begin_s=now_s + starts_in_s,
            times=command.time_from_start_s,
            out=out[:, index],
            velocity=velocity,
            known_times=known_times,
            offsets=sent,
            rates=sent_rates,
            withheld=sent_withheld,
            stage=self._desired.stage if result is not None else None,
            led_from=out[0, index] if led_from is None else led_from,
            put_s=now_s,
            at_once=starts_in_s == 0.0,
        )
        if not offsets[:, index].any():
            return command, path
        corrected = replace(
            command,
            position=out[:, index],
            velocity=velocity,
            acceleration=acceleration,
            mark=CORRECTED,
        )
        return corrected, path

    def _begin(
        self, index: Index, q: Array, desired: Array, times: Array, now_s: float
    ) -> Array | None:
        """The offset that it begins with; returns where it leads in from (k,), None at once."""
        output, limiter = self._output, self._output.limiter
        if times[0] <= 0.0:  # the controller goes there in one cycle
            here, wanted = (
                np.array([np.interp(0.0, times, column) for column in rows.T])
                for rows in (q, desired)
            )
            offset = output.begin_at(index, here, self._desired.begins(here), now_s)
            limiter.state[OFFSET, index] = offset
            limiter.state[DESIRED] = wanted
            return None
        self._state.require_fresh(index, now_s)
        found = output.lead_in(index, q[0], self._desired.begins(q[0]), now_s)
        if found is None:  # the controller leads in from wherever it is
            limiter.state[OFFSET], limiter.state[DESIRED] = desired[0], desired[0]
            limiter.state[OFFSET_RATE] = 0.0
            return self._state.measured[index].copy()
        taught, offset = found
        limiter.state[OFFSET] = offset
        if taught is None:
            limiter.state[DESIRED] = desired[0]
            return np.asarray((q[0] + offset)[index])
        limiter.state[DESIRED] = self._desired.begins(taught)[0]
        return np.asarray((taught + offset)[index])

    def _require_end(self, withheld: Array, active: Array) -> None:
        """Refuse a path at whose last point the offset is not the desired one."""
        if np.all(np.abs(withheld) <= SETTLED):
            return
        limiter, more_s, dt = self._output.limiter, 0.0, 0.02
        target, state = limiter.state[DESIRED].copy(), limiter.state.copy()
        while more_s < LONGEST_WAIT_S and np.any(np.abs(limiter.withheld * active) > SETTLED):
            limiter.step(target, dt, active)
            more_s += dt
        limiter.state[:] = state
        raise RefusedError(
            Reason.TOO_SHORT,
            f"the offset would still be {np.max(np.abs(withheld)):.6f} away at its last point; "
            f"let it last {more_s:.2f} s longer",
        )

    def _rates(
        self,
        command: TrajectoryCommand,
        index: Index,
        q: Array,
        result: StagedResult | None,
        withheld: Array,
        rates: Array,
        times: Array,
    ) -> tuple[Array | None, Array | None]:
        """Velocities and accelerations (m, k), where the command has any.

        By the chain rule where the offset is the desired one, else by the limiter's rates.
        """
        if command.velocity is None:
            return None, None
        zero = np.zeros_like(q)
        speed, bend = zero.copy(), zero.copy()
        speed[:, index] = command.velocity
        if command.acceleration is not None:
            bend[:, index] = command.acceleration
        velocity, acceleration = speed, bend
        if result is not None and self._desired.stage is not None:
            velocity, acceleration = self._desired.stage.rates(q, speed, bend, result)
        apart = np.abs(withheld[:, index]).max(axis=1) > 0.0
        if np.any(apart):
            velocity[apart] = (speed + rates)[apart]
            if len(times) > 1:
                acceleration[apart] = (bend + np.gradient(rates, times, axis=0))[apart]
        return velocity[:, index], None if command.acceleration is None else acceleration[:, index]

    def _require_speeds(
        self,
        command: TrajectoryCommand,
        index: Index,
        out: Array,
        velocity: Array | None,
        times: Array,
        led_from: Array | None,
    ) -> None:
        """Refuse what is too fast: between the points, as it says, or on the way to the first."""
        fastest, names = self._fastest[index], command.names
        hold_speeds(names, np.diff(out[:, index], axis=0), np.diff(times), fastest)
        if velocity is not None:
            hold_speeds(names, velocity, np.ones(len(velocity)), fastest)
        if led_from is None:
            return
        lead_s = float(times[0])
        if velocity is not None and not (self._output.path and not self._state.scaling):
            lead_s /= SPLINE_PEAK
        way = np.abs(out[0, index] - led_from) - self._config.start_near(self._arm)[index]
        hold_speeds(
            names, np.maximum(way, 0.0)[None], np.array([lead_s]), fastest, "would be led in"
        )

    def stop(self, now_s: float, ahead_s: float) -> TrajectoryCommand | None:
        """A trajectory that slows down what was put out last; None where nothing moves by it.

        All joints slow down together. Its first point lies ``ahead_s`` ahead, where the controller
        is by then; velocities are given, so that it enters without a step.
        """
        path = self._output.path
        if path is None or not path.live(now_s):
            return None
        then_s = now_s + ahead_s
        h = 1e-3
        begin = path.place(then_s)
        speed = (path.place(then_s) - path.place(then_s - h)) / h
        lasts = float(np.max(np.abs(speed) / self._config.acceleration_limits[path.index]))
        if not 0.0 < lasts < np.inf:
            lasts = ahead_s
        t = np.linspace(0.0, lasts, STOP_POINTS)[:, None]
        position = begin + speed * (t - 0.5 * t * t / lasts)
        velocity = speed * (1.0 - t / lasts)
        times, rows = ahead_s + t[:, 0], (STOP_POINTS, self._arm.n)
        self._output.path = SentPath(
            index=path.index,
            begin_s=now_s,
            times=times,
            out=position,
            velocity=velocity,
            known_times=times,
            offsets=np.broadcast_to(path.at(path.offsets, now_s), rows),
            rates=np.zeros(rows),
            withheld=np.broadcast_to(path.at(path.withheld, now_s), rows),
            stage=path.stage,
            led_from=path.place(now_s),
            put_s=now_s,
            at_once=True,
        )
        names = tuple(self._arm.joint_names[i] for i in path.index)
        return TrajectoryCommand(names, position, times, velocity, mark=CORRECTED)


def require_times(command: TrajectoryCommand) -> None:
    """Refuse a trajectory without points, with too many, or whose times do not increase."""
    require_few(len(command))
    times = command.time_from_start_s
    if not len(times):
        raise RefusedError(Reason.NO_POINTS, "a controller drops it and drives on")
    if not np.all(np.isfinite(times)) or times[0] < 0.0 or np.any(np.diff(times) <= 0.0):
        raise RefusedError(Reason.TIME_BACKWARDS, "time_from_start does not increase")
    require_finite(command.names, command.velocity)
    require_finite(command.names, command.acceleration)
