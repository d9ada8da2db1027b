# SPDX-License-Identifier: Apache-2.0
"""A small simulated shift: a robot moves from pose to pose, a ball on it is measured at rest.

And the thermal session of such a robot.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from robocal_ros.ground import frames
from robocal_ros.ground.samples import REFERENCE_SPHERE, JointSample, PointSample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import ThermalSession

NS = 1_000_000_000
PERIOD_NS = 10_000_000
MOVE_S, STILL_S = 0.3, 0.6
NOISE_M = 2e-5
BALL = np.array([0.10, 0.05, 0.20, 1.0])
T_SENSOR_BASE = frames.transform(frames.exp_rotation([0.3, -0.2, 1.0]), [2.0, 1.0, -0.5])

Sample = JointSample | PointSample


@pytest.fixture(scope="session")
def nominal() -> SerialArm:
    """The type of the robots here."""
    return load_robot("kr150_r3100")


@pytest.fixture(scope="session")
def arm(nominal: SerialArm) -> SerialArm:
    return nominal


def postures(arm: SerialArm, count: int, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.uniform(np.maximum(arm.lower, -1.6), np.minimum(arm.upper, 1.6), (count, arm.n))


def built(nominal: SerialArm, seed: int = 5) -> SerialArm:
    """The robot as built: off its nominal model by tenths of a millimetre."""
    rng = np.random.default_rng(seed)
    size = np.where(nominal.parameters.is_length, 3e-4, np.radians(0.01))
    return nominal.with_mdh(nominal.parameters.add(nominal.mdh, size * rng.normal(size=len(size))))


def warmed(cold: SerialArm, kelvin: float = 15.0) -> SerialArm:
    """The same robot with grown links."""
    chosen = cold.parameters
    length = np.where(chosen.is_length, chosen.read(cold.mdh), 0.0)
    return cold.with_mdh(chosen.add(cold.mdh, length * 12e-6 * kelvin))


@dataclass
class Shift:
    """Makes samples of one visit after the other; stamps run on from ``start_ns``."""

    names: tuple[str, ...]
    start_ns: int = 1_000 * NS
    frame: str = "sensor/ball"
    seed: int = 1
    now_ns: int = field(init=False)
    at: np.ndarray | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.now_ns = self.start_ns
        self.rng = np.random.default_rng(self.seed)

    def visit(self, arm: SerialArm, q: np.ndarray, after_h: float = 0.0) -> Iterator[Sample]:
        """Go through the poses and measure once at each; a robot takes hours to warm up."""
        self.now_ns += round(after_h * 3600.0 * NS)
        for target in q:
            yield from self._move(target)
            yield from self._rest(arm, target)

    def _move(self, target: np.ndarray) -> Iterator[Sample]:
        start = target if self.at is None else self.at
        steps = round(MOVE_S * NS / PERIOD_NS)
        for step in range(1, steps + 1):
            yield self._joints(start + (target - start) * step / steps)
        self.at = target

    def _rest(self, arm: SerialArm, target: np.ndarray) -> Iterator[Sample]:
        steps = round(STILL_S * NS / PERIOD_NS)
        for step in range(steps):
            yield self._joints(target)
            if step == 2 * steps // 3:
                frame, _, name = self.frame.partition("/")
                for sphere, ball in self.seen(arm, target, name or "tool").items():
                    measured = ball + NOISE_M * self.rng.normal(size=3)
                    yield PointSample(self.now_ns - 3_000_000, frame, sphere, measured)

    def seen(self, arm: SerialArm, q: np.ndarray, name: str) -> dict[str, np.ndarray]:
        """Targets (3,) in the sensor's frame, m."""
        return {name: (T_SENSOR_BASE @ arm.fk(q) @ BALL)[:3]}

    def _joints(self, q: np.ndarray) -> JointSample:
        self.now_ns += PERIOD_NS
        noisy = q + 1e-7 * self.rng.normal(size=len(q))
        return JointSample(self.now_ns, self.names, noisy)


T_FLANGE_SENSOR = frames.transform(frames.exp_rotation([0.1, -0.4, 0.8]), [0.08, -0.05, 0.22])
SPHERES = {"a": np.array([1.6, 0.2, 0.6]), "b": np.array([1.2, -0.8, 0.9])}


@dataclass
class MeasuringShift(Shift):
    """The sensor rides on the flange and sees the spheres of the cell."""

    frame: str = "scanner"
    spheres: dict[str, np.ndarray] = field(default_factory=lambda: dict(SPHERES))
    T_flange_sensor: np.ndarray = field(default_factory=lambda: T_FLANGE_SENSOR)

    def seen(self, arm: SerialArm, q: np.ndarray, name: str) -> dict[str, np.ndarray]:
        T = frames.invert(arm.fk(q) @ self.T_flange_sensor)
        return {sphere: T[:3, :3] @ c + T[:3, 3] for sphere, c in self.spheres.items()}


def looking(count: int, seed: int = 3) -> np.ndarray:
    """Postures about one from which the sensor looks at the spheres."""
    middle = np.radians([0.0, -70.0, 110.0, 0.0, -40.0, 0.0])
    reach = np.radians([60.0, 25.0, 30.0, 150.0, 60.0, 170.0])
    return middle + reach * np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 6))


def of_kind(samples: Sequence[Sample], kind: type) -> list[Sample]:
    return [sample for sample in samples if isinstance(sample, kind)]


KNOCK = frames.transform(frames.exp_rotation([0.0, 1e-3, 0.0]), [8e-4, 0.0, 5e-4])


def knocked(samples: Iterable[Sample], T: np.ndarray = KNOCK) -> list[Sample]:
    """The sensor was moved, by a millimetre: every point it measures is off the same way."""
    return [
        replace(s, position_m=T[:3, :3] @ s.position_m + T[:3, 3])
        if isinstance(s, PointSample)
        else s
        for s in samples
    ]


def fixed_points(samples: Sequence[Sample], moved: bool) -> list[Sample]:
    """A sphere on the floor is measured together with the one on the flange."""
    centre = (T_SENSOR_BASE @ [1.0, -1.0, 0.0, 1.0])[:3]
    rng = np.random.default_rng(4)
    found: list[Sample] = []
    for sample in samples:
        found.append(sample)
        if isinstance(sample, PointSample):
            at = centre + 2e-5 * rng.normal(size=3)
            found.append(PointSample(sample.stamp_ns, sample.frame, "floor", at, REFERENCE_SPHERE))
    return knocked(found) if moved else found


class DriftingRobot:
    """A robot that visits the same poses at any warmth, and its session; time runs on in a shift.

    A session that starts anew knows the history alone.
    """

    def __init__(self, folder: Path, config: ThermalConfig | None = None, poses: int = 8) -> None:
        self.nominal, self.folder = load_robot("kr150_r3100"), folder
        self.config = config or ThermalConfig(sigma_m=NOISE_M)
        self.shift = Shift(self.nominal.joint_names)
        self.cold, self.q = built(self.nominal), postures(self.nominal, poses)
        self.start()

    def start(self) -> ThermalSession:
        self.history = CalibrationHistory.open(
            "s1", model_hash=self.nominal.model_hash, state_dir=self.folder
        )
        self.session = ThermalSession(self.nominal, self.history, self.config, "test")
        return self.session

    def feed(self, samples: Iterable[Sample]) -> None:
        for sample in samples:
            self.session.add(sample)

    def ask(self, name: str, **arguments: object) -> Outcome:
        self.session.submit(Command(name, arguments))
        return self.session.advance(wall_ns=self.shift.now_ns, force=True)[-1]
