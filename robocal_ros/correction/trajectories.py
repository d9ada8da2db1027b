# SPDX-License-Identifier: Apache-2.0
"""Whole trajectories, corrected along their time, and stops of what moves.

A controller has no order for "stop": one that is sent nothing, or a trajectory without points, goes
on to where it was sent, and the cancel of a goal is a dead stop from any speed. What stops it
smoothly is a motion from where it is to rest, some tenths of a second ahead.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.bounds import require_limits
from robocal_ros.correction.interface import (
    Reason,
    RefusedError,
    TrajectoryCommand,
    require_few,
    require_finite,
)
from robocal_ros.correction.joint_correction import StagedResult
from robocal_ros.correction.limiter import (
    ACCELERATION,
    DESIRED,
    LONGEST_STEP_S,
    OFFSET,
    OFFSET_RATE,
    RATE,
    REST_ACCELERATION,
    REST_RATE,
    STILL,
)
from robocal_ros.correction.robot_state import Output, hold_speeds
from robocal_ros.correction.sent_path import SentPath, driven, spline_terms
from robocal_ros.ground.frames import Array, Index
from robocal_ros.ground.samples import CORRECTED
from robocal_ros.motion.plan import JointPlan

# A cubic from rest to rest is so many times faster than its mean (a quintic: 1.875).
SPLINE_PEAK = 1.875
SETTLED = 1e-9  # rad, m: of an offset that is the desired one
LONGEST_WAIT_S, STEP_S = 60.0, 0.02  # for which it is worked out how long an offset takes
TRIES = 12
LOOKED_AT = 33  # speeds of a spline, from point to point
STOP_SPACING_S = 0.025  # of the points of a stop
SHORTEST_SLOWDOWN_S = 0.1
OWN = 1.25  # of a path's own accelerations, where they are larger than the limits: a stop's


class TrajectoryCorrector:
    """Corrects whole trajectories, and plans stops on the way of what was put out."""

    def __init__(self, output: Output) -> None:
        self._arm, self._config, self._robot = output.arm, output.config, output.robot
        self._output, self._desired = output, output.desired

    def correct(
        self, command: TrajectoryCommand, index: Index, q: Array, now_s: float, starts_in_s: float
    ) -> tuple[TrajectoryCommand, SentPath]:
        """Correct a trajectory of taught joints ``q`` (m, n), of which ``index`` go out.

        Raises `RefusedError` when it cannot be corrected, its begin is elsewhere, its end would not
        be reached with the correction that belongs there, or a limit is exceeded. Nothing has
        changed then.
        """
        output, limiter = self._output, self._output.limiter
        kept, limits = limiter.state.copy(), limiter.limits
        times = command.time_from_start_s + starts_in_s
        desired, result = self._desired.at(q)
        output.take_up(now_s)
        try:
            led_from, withheld = self._begin(command, index, q, desired, times, now_s)
            begin = limiter.state.copy()
            active = np.zeros(self._arm.n)
            active[index] = 1.0
            follows = self._settled(command, index, q, result)
            speed = _speeds(q[:, index], times)
            offsets, rates, bends = self._follow(desired, follows, times, speed, active)
            self._require_end(limiter.withheld[index], active)
            out = q + offsets
            rates_of = (command.velocity, rates), (command.acceleration, bends)
            velocity, acceleration = (
                None if given is None else given + of[:, index] for given, of in rates_of
            )
            require_limits(out, self._arm)
            self._require_speeds(command, index, out, (velocity, acceleration), times, led_from)
        finally:
            limiter.state[:], limiter.limits = kept, limits
        self._desired.count()
        known_times = command.time_from_start_s
        sent = np.stack([offsets, rates, bends, offsets - desired])
        if led_from is not None:  # until its first point: from the offset that there is now
            known_times = np.append(-starts_in_s, known_times)
            offset, rate = begin[OFFSET], begin[OFFSET_RATE]
            first = np.stack([offset, rate, 0.0 * rate, withheld])
            sent = np.concatenate([first[:, None], sent], axis=1)
        corrected = command
        if offsets[:, index].any():
            corrected = TrajectoryCommand(
                command.names, out[:, index], command.time_from_start_s, velocity, acceleration,
                command.stamp_ns, CORRECTED,
            )  # fmt: skip
        return corrected, SentPath(
            command=corrected,
            index=index,
            begin_s=now_s + starts_in_s,
            known_times=known_times,
            known=sent,
            stage=self._desired.stage if result is not None else None,
            led_from=out[0, index] if led_from is None else led_from,
            led_rate=self._rate(index, now_s),
            put_s=now_s,
            at_once=starts_in_s == 0.0,
        )

    def _begin(
        self,
        command: TrajectoryCommand,
        index: Index,
        q: Array,
        desired: Array,
        times: Array,
        now_s: float,
    ) -> tuple[Array | None, Array]:
        """The offset that it begins with; where it leads in from (k,), None at once.

        And what is withheld then (n,): where a path with this correction is left on its way, what
        was on its way in there. That it went straight between its points is none of that.
        """
        output, limiter = self._output, self._output.limiter
        left, withheld = output.path, limiter.withheld
        if output.path is None and self._robot.stands(index, now_s):  # what has come in stays so
            limiter.state[OFFSET_RATE, withheld == 0.0] = 0.0
        if times[0] <= 0.0:  # the controller goes there in one cycle
            here, rates = q[0].copy(), (command.velocity, command.acceleration)
            here[index] = driven(times, q[:, index], *rates, 0.0)
            begins = self._desired.begins(here)
            limiter.state[OFFSET, index] = output.begin_at(index, here, begins, now_s)
            limiter.state[DESIRED] = begins[0]
            return None, limiter.withheld
        self._robot.require_fresh(index, now_s)
        taught, offset = output.lead_in(index, q[0], self._desired.begins(q[0]), now_s)
        limiter.state[OFFSET] = offset
        if taught is None:
            limiter.state[DESIRED] = desired[0]
            return np.asarray((q[0] + offset)[index]), limiter.withheld
        limiter.state[DESIRED] = self._desired.begins(taught)[0]
        if left is None or not left.live(now_s) or left.stage is not self._desired.stage:
            withheld = limiter.withheld
        return np.asarray((taught + offset)[index]), withheld

    def _require_end(self, withheld: Array, active: Array) -> None:
        """Refuse a path at whose last point the offset is not the desired one."""
        if np.all(np.abs(withheld) <= SETTLED):
            return
        limiter, times = self._output.limiter, np.arange(STEP_S, LONGEST_WAIT_S, STEP_S)
        target = np.tile(limiter.state[DESIRED], (len(times), 1))
        offsets, _ = limiter.follow(target, times, np.zeros(len(times)), active)
        away = np.abs((offsets - target) * active).max(axis=1) > SETTLED
        more_s = (np.count_nonzero(away) + 1) * STEP_S
        raise RefusedError(
            Reason.TOO_SHORT,
            f"the offset would still be {np.max(np.abs(withheld)):.6f} away at its last point; "
            f"let it last {more_s:.2f} s longer",
        )

    def _settled(
        self, command: TrajectoryCommand, index: Index, q: Array, result: StagedResult | None
    ) -> Array | None:
        """Derivatives (1 or 2, m, n) of the desired offset, as many as the command has."""
        if command.velocity is None:
            return None
        bends = command.acceleration is not None
        given = np.zeros((1 + bends, *q.shape))
        for rows, of_command in zip(given, (command.velocity, command.acceleration), strict=False):
            rows[:, index] = of_command
        rates = np.zeros_like(given)
        if result is not None and self._desired.stage is not None:
            out = self._desired.stage.rates(q, given[0], given[1] if bends else None, result)
            rates = np.array(out[: len(given)]) - given
        return rates

    def _follow(
        self, desired: Array, follows: Array | None, times: Array, speed: Array, active: Array
    ) -> tuple[Array, Array, Array]:
        """Offsets, rates, accelerations (m, n), whose spline keeps the limits.

        A controller makes cubics of points with velocities, quintics of those with accelerations
        too: they bend more than the limiter's steps do, which get a smaller share of the limits
        until the splines are within them.
        """
        limiter = self._output.limiter
        begin, limits, share = limiter.state.copy(), limiter.limits, np.ones(2)
        later = times > 0.0
        for _ in range(TRIES):
            limiter.state[:] = begin
            limiter.limits = limits * np.tile(share[::-1], 2)[:, None]
            offsets, rates = limiter.follow(desired, np.maximum(times, 0.0), speed, active)
            if follows is None:
                return offsets, rates, rates
            withheld = np.vstack([begin[OFFSET] - begin[DESIRED], (offsets - desired)[later]])
            rows = np.zeros((1 + len(follows), *withheld.shape))
            rows[:2, 0], rows[0, 1:] = begin[[OFFSET, OFFSET_RATE]], offsets[later]
            rows[1:, 1:] = follows[:, later]
            h = np.diff(times[later], prepend=0.0)[:, None]
            _add_derivatives(rows, withheld, h)
            rows[1:], withheld = rows[1:] * active, withheld * active
            moves = speed[later] > STILL
            over = _over(rows, withheld, h, moves, limits)
            # a controller without accelerations of its own comes in by a cubic
            lead = _over(rows[:2, :2], withheld[:2], h[:1], moves[:1], limits)
            over = np.maximum(over, lead)
            if np.all(over <= 1.0 + SETTLED):
                break
            # an offset that comes in within one step bends alike until the share is small enough
            share *= np.where(over > 1.0, np.clip(0.9 / np.maximum(over, 1.0), 0.25, 0.7), 1.0)
        else:
            raise RefusedError(
                Reason.TOO_SHORT, "between its points the offset would change too fast"
            )
        derivatives = np.repeat(rows[1:, :1], len(times), axis=1)
        derivatives[:, later] = rows[1:, 1:]
        return offsets, derivatives[0], derivatives[-1]

    def _require_speeds(
        self,
        command: TrajectoryCommand,
        index: Index,
        out: Array,
        rates: tuple[Array | None, Array | None],
        times: Array,
        led_from: Array | None,
    ) -> None:
        """Refuse what is too fast: between the points, as it says, or on the way to the first."""
        fastest, names = self._config.velocity_limits[index], command.names
        velocity, acceleration = rates
        if velocity is None:
            hold_speeds(names, np.diff(out[:, index], axis=0) / np.diff(times)[:, None], fastest)
        else:
            hold_speeds(names, velocity, fastest)
            peaks = _peaks(out[:, index], velocity, acceleration, times, fastest)
            hold_speeds(names, peaks, fastest)
        if led_from is None:
            return
        lead_s = float(times[0])
        if velocity is not None and not (self._output.path and not self._robot.scaling):
            lead_s /= SPLINE_PEAK
        way = np.abs(out[0, index] - led_from) - self._output.near[index]
        hold_speeds(names, np.maximum(way, 0.0)[None] / lead_s, fastest, "would be led in")

    def stop(self, now_s: float, ahead_s: float) -> tuple[TrajectoryCommand, SentPath] | None:
        """Slow down on the way of what was put out last; None where nothing moves by it.

        From ``ahead_s`` ahead on the path's own clock slows down until it stands, so that no joint
        leaves its path, or goes on beyond its end. Where the controller's clock stands it is held.
        """
        path = self._output.path
        if path is None or not path.live(now_s):
            return None
        clock = path.time(now_s)
        rate = (path.time(now_s + ahead_s) - clock) / ahead_s
        left = path.lasts_s - clock - ahead_s
        t, slow, on = np.zeros(1), np.zeros(1), np.zeros(1)
        if rate > 0.0 and left > 0.0:
            lasts, share = self._slow_down(path, now_s + ahead_s / rate, rate, left)
            t = np.linspace(0.0, lasts, max(int(np.ceil(lasts / STOP_SPACING_S)), 2) + 1)
            slow, on = 1.0 - share * t / lasts, t - 0.5 * share * t * t / lasts
        at_s = now_s + (ahead_s + on) / rate if rate > 0.0 else np.array([now_s])
        position, speed = _motion(path, at_s, rate)
        velocity = speed * slow[:, None]
        velocity[-1] = 0.0
        offsets, rates = np.array([path.offset(at) for at in at_s]).transpose(1, 0, 2)
        withheld = np.array([path.withheld(at) for at in at_s])
        names = tuple(self._arm.joint_names[i] for i in path.index)
        command = TrajectoryCommand(names, position, ahead_s + t, velocity, mark=CORRECTED)
        return command, SentPath(
            command=command,
            index=path.index,
            begin_s=now_s,
            known_times=command.time_from_start_s,
            known=np.stack([offsets, rates * slow[:, None], 0.0 * rates, withheld]),
            stage=path.stage,
            led_from=path.place(now_s),
            led_rate=self._rate(path.index, now_s),
            put_s=now_s,
            at_once=True,
        )

    def _rate(self, index: Index, now_s: float) -> Array | None:
        """How fast the controller moves joints (k,); None where it follows targets."""
        path, rate = self._output.path, np.zeros(self._arm.n)
        if path is None:
            return rate[index] if self._robot.stands(index, now_s) else None
        rate[path.index] = _motion(path, np.array([now_s]), 1.0)[1][0]
        return rate[index]

    def _slow_down(
        self, path: SentPath, begin_s: float, rate: float, left: float
    ) -> tuple[float, float]:
        """How long to slow down on the ``left`` seconds of a path, and by what share of its speed.

        With c(t) = t - t^2 / 2T, and c' = 1 - t/T = r, a path q(c) has the acceleration
        q'' r^2 - q' / T: the shortest T is taken with which it is neither above the limit nor
        much above the path's own. Where there is none, the path itself ends soon (share 0).
        """
        limits = self._config.acceleration_limits[path.index]
        here = _motion(path, np.array([begin_s]), rate)[1][0]
        least = max(float(np.max(np.abs(here) / limits)), SHORTEST_SLOWDOWN_S)
        spans = np.maximum(least * np.geomspace(0.25, 4.0, 33), SHORTEST_SLOWDOWN_S)
        spans = np.minimum(spans, 2.0 * left)
        c = np.linspace(0.0, 0.5 * spans[-1], 101)
        speed = _motion(path, begin_s + c / rate, rate)[1]
        bend = np.gradient(speed, c, axis=0)
        most = np.maximum(limits, OWN * np.abs(bend).max(axis=0))
        slow = np.maximum(1.0 - 2.0 * c / spans[:, None], 0.0)[..., None]  # (spans, c, 1): r^2
        over = np.abs(bend * slow - speed / spans[:, None, None]) / most
        taken = np.max(np.where(slow > 0.0, over, 0.0), axis=(1, 2))
        if np.any(taken <= 1.0):
            return float(spans[np.argmax(taken <= 1.0)]), 1.0
        if spans[-1] >= 2.0 * left:
            return left, 0.0
        return float(spans[-1]), 1.0


def _motion(path: SentPath, at_s: Array, rate: float) -> tuple[Array, Array]:
    """Places and speeds (m, k) on a path at instants (m,), the speeds by the path's own clock."""
    h = 1e-4
    places = np.array([[path.place(at + d) for at in at_s] for d in (-h, 0.0, h)])
    return places[1], (places[2] - places[0]) / (2.0 * h * rate) if rate > 0.0 else 0.0 * places[1]


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


def _add_derivatives(rows: Array, withheld: Array, h: Array) -> None:
    """Add those of what is withheld (r, n) to the derivatives in rows (2 or 3, r, n).

    By the parabola through each three points, ``h`` (r - 1, 1) apart; what has come in stays.
    """
    slope = np.diff(withheld, axis=0) / h
    both = h[:-1] + h[1:]
    comes = (withheld[1:-1] != 0.0) | (slope[1:] != 0.0)
    rows[1, 1:-1] += np.where(comes, (slope[:-1] * h[1:] + slope[1:] * h[:-1]) / both, 0.0)
    if len(rows) > 2:
        rows[2, 1:-1] += np.where(comes, 2.0 * np.diff(slope, axis=0) / both, 0.0)


def _over(rows: Array, withheld: Array, h: Array, moves: NDArray[np.bool_], limits: Array) -> Array:
    """Acceleration and rate (2,) of a spline, in units of the limits, where not all has come in.

    ``rows`` (2 or 3, r, n) are offsets and derivatives, ``moves`` (r - 1,) of the ways between.
    """
    some = (withheld[:-1] != 0.0).any(axis=1) | (withheld[1:] != 0.0).any(axis=1)
    if not some.any():
        return np.zeros(2)
    h, (p0, v0), (p1, v1) = h[some], rows[:2, :-1][:, some], rows[:2, 1:][:, some]
    bends = np.stack([rows[2, :-1][some], rows[2, 1:][some]]) * h if len(rows) > 2 else None
    c = spline_terms((p1 - p0) / h, v0, v1, bends)
    u = np.linspace(0.0, 1.0, 9)[:, None, None]
    rate = v0 + u * (2.0 * c[0] + u * (3.0 * c[1] + u * (4.0 * c[2] + u * 5.0 * c[3])))
    bend = (2.0 * c[0] + u * (6.0 * c[1] + u * (12.0 * c[2] + u * 20.0 * c[3]))) / h
    fast = moves[some][:, None] | (np.abs(v0) > limits[REST_RATE])
    most = np.where(
        fast[None], limits[[ACCELERATION, RATE], None], limits[[REST_ACCELERATION, REST_RATE], None]
    )
    return np.array([np.max(np.abs(x) / m) for x, m in zip((bend, rate), most, strict=True)])


def _peaks(
    out: Array, velocity: Array, acceleration: Array | None, times: Array, fastest: Array
) -> Array:
    """Fastest (m - 1, k) between the points, of the cubics or quintics that are driven there.

    These are no faster than the control points of their speed, which do where none is faster than
    ``fastest`` (k,); elsewhere the spline itself is looked at.
    """
    h, v0, v1 = np.diff(times)[:, None], velocity[:-1], velocity[1:]
    way = np.diff(out, axis=0)
    bends = None
    if acceleration is None:
        control = [v0, 3.0 * way / h - v0 - v1, v1]
    else:
        bends = np.stack([acceleration[:-1], acceleration[1:]]) * h**2
        middle = (5.0 * way + 0.25 * (bends[1] - bends[0])) / h - 2.0 * (v0 + v1)
        control = [v0, v0 + 0.25 * bends[0] / h, middle, v1 - 0.25 * bends[1] / h, v1]
    peaks = np.max(np.abs(control), axis=0)
    over = np.flatnonzero((peaks > fastest).any(axis=1))
    if len(over):
        h, v0, v1 = h[over], v0[over] * h[over], v1[over] * h[over]
        terms = spline_terms(way[over], v0, v1, None if bends is None else bends[:, over])
        u = np.linspace(0.0, 1.0, LOOKED_AT)[:, None, None]
        speed = v0 + sum(i * c * u ** (i - 1) for i, c in enumerate(terms, start=2))
        peaks[over] = np.max(np.abs(speed), axis=0) / h
    return np.asarray(peaks)


def _speeds(q: Array, times: Array) -> Array:
    """Fastest joint (m,) on the way to each point; what leads in, or soon moves, is a motion."""
    way = np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0)
    speed = np.append(2.0 * STILL, way / np.diff(times))
    soon = np.searchsorted(times, times[1:-1] + LONGEST_STEP_S).clip(max=len(times) - 1)
    speed[1:-1] = np.maximum(speed[1:-1], speed[soon])
    return speed


AHEAD_S = 0.06  # where the controller is by then a stop on its path begins to slow down
SPACING_S = 0.01  # of the points until then


def on_its_path(path: SentPath, planned: TrajectoryCommand, now_s: float) -> JointPlan:
    """A stop ``planned`` on a path, with its way since `AHEAD_S` before now: so far it is now."""
    at_s = now_s + np.arange(-AHEAD_S, AHEAD_S - 1e-9, SPACING_S)
    q, qd = _motion(path, at_s, 1.0)
    assert planned.velocity is not None
    return JointPlan(
        np.concatenate([at_s - at_s[0], AHEAD_S + planned.time_from_start_s]),
        np.concatenate([q, planned.position]),
        np.concatenate([qd, planned.velocity]),
        np.zeros((len(at_s) + len(planned.position), q.shape[1])),
    )
