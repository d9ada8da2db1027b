# SPDX-License-Identifier: Apache-2.0
"""joint_correction_node for hours: a stream at 250 Hz, and another model every ten seconds.

``tools/with_ros python -m bench.soak_correction --seconds 60`` for a look; an hour is the default.
With ``--keep`` it writes docs/figures/soak_correction.md too.
"""

import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from robocal_msgs.msg import CorrectionStatus, KinematicModel

from bench.soaking import soak_main
from bench.startup import EXECUTABLES
from bench.stream_probe import STATES, TARGETS, Probe, Stream, Subject, drifted, offered
from bench.tables import Goal, Table
from robocal_ros.correction.bounds import CorrectionConfig, correction_between
from robocal_ros.correction.joint_correction import pack_model
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot

Array = NDArray[np.float64]

RATE_HZ = 250
CHANGE_S = 10.0  # between two models
SETTLED_S = 4.0  # after this a model is in force: twice 0.3 deg at 2 deg/s, and stalls
# A longer silence of the node is a stall, which is caught up with in 20 times as long (5 % faster
# than the stream), and some more: what lags is no correction.
SILENCE_S, LAGS = 2.0 / RATE_HZ, 25.0
LARGEST_M = 0.5e-3
WARM = 2  # models until caches are full
MOST_GROWTH_MB = 5.0
EXACT_RAD = 1e-9


class Watch:
    """Judges each corrected target by the models that were offered last.

    When the node put one out is not known, but that it was between its way there and back: so the
    time since the one before is at most that from sending that one to this one's coming back.

    Attributes
    ----------
    worst : largest step of a joint's correction from one message to the next, in units of what the
        limiter lets it do in at most the time between them.
    stale : targets that the last model did not make, `SETTLED_S` after it was offered.
    checked : targets that were compared with it.
    """

    def __init__(self, arm: SerialArm) -> None:
        self._arm, self._rate_rad_s = arm, CorrectionConfig().turning.motion
        self.change(arm)
        self._last: tuple[float, Array] | None = None
        self._since_s = self._clear_s = time.perf_counter()
        self.worst, self.stale, self.checked = 0.0, 0, 0

    def change(self, model: SerialArm) -> None:
        """From now on another model is wanted."""
        models = pack_model(self._arm), pack_model(model)
        self._model = correction_between(*models, self._arm, CorrectionConfig())
        self._since_s = time.perf_counter()

    def look(self, sent_s: float, now_s: float, taught: Array, corrected: Array) -> None:
        """Judge one target that came back."""
        last, shift = self._last, corrected - taught
        self._last = sent_s, shift
        if last is not None and now_s - last[0] > SILENCE_S:
            self._clear_s = max(self._clear_s, now_s + LAGS * (now_s - last[0]))
        if now_s < self._clear_s:
            return
        if last is not None:
            allowed = self._rate_rad_s * (now_s - last[0])
            self.worst = max(self.worst, float(np.max(np.abs(shift - last[1]))) / allowed)
        if now_s - self._since_s > SETTLED_S:
            self.checked += 1
            wanted = self._model.correct(taught[None]).q[0] - taught
            self.stale += bool(np.max(np.abs(wanted - shift)) > EXACT_RAD)


def soak(seconds: float) -> Table:
    """Stream, change models, and judge all that comes back."""
    arm = load_robot("kr150_r3100")
    probe = Probe()
    with tempfile.TemporaryDirectory() as folder:
        robot = ("--ros-args", "-p", "robot:=kr150_r3100")
        command = [EXECUTABLES / "joint_correction_node", *robot]
        subject = Subject("corrected", "joint_correction_node", command, Path(folder))
        try:
            stream, watch = Stream(probe, subject, arm.joint_names), Watch(arm)
            stream.watch = watch.look
            probe.wait(lambda: stream.connected, subject.name)
            told = probe.latest(CorrectionStatus, subject.topic(f"{subject.node}/status"))
            memory_mb = _run(probe, stream, watch, arm, seconds)
            refused = dict(zip(told[-1].refused_reasons, told[-1].refused, strict=True))
        finally:
            probe.close(subject)
    return _judged(stream, watch, memory_mb, refused, seconds)


def _run(probe: Probe, stream: Stream, watch: Watch, arm: SerialArm, seconds: float) -> list[float]:
    """Resident memory of the node, MB, at each change of the model, without the first ones."""
    models = probe.model_publisher(stream.subject)
    revision, memory_mb = 0, []

    def change() -> None:
        nonlocal revision
        revision += 1
        model = drifted(arm, LARGEST_M * (revision % 5 + 1) / 5, revision)
        models.publish(offered(arm, model, revision, KinematicModel.ACCEPTED))
        watch.change(model)
        if revision > WARM:
            memory_mb.append(stream.subject.memory_mb())

    change()
    probe.enable(stream.subject)
    timer = probe.node.create_timer(CHANGE_S, change)
    probe.stream(stream, RATE_HZ, WARM * CHANGE_S + seconds)
    probe.node.destroy_timer(timer)
    probe.drain()
    return memory_mb


def _judged(
    stream: Stream, watch: Watch, memory_mb: list[float], refused: dict[str, int], seconds: float
) -> Table:
    table = Table(
        "soak_correction",
        f"joint_correction_node for {seconds:.0f} s at {RATE_HZ} Hz, another model every "
        f"{CHANGE_S:g} s",
        ("what", "value", "goal"),
        "Steps: of a joint's correction from one message to the next, in units of what the "
        "limiter lets it do in that time. Stale: targets that the last model did not make, "
        f"{SETTLED_S:g} s after it was offered, and later than a stall of the node is caught up "
        f"with. Memory: resident, after the first {WARM} models. "
        f"Load of the machine in the last minute: {os.getloadavg()[0]:.2f}; {os.cpu_count()} CPUs.",
    )
    ms = np.array(stream.took[TARGETS]) * 1e3
    grew = memory_mb[-1] - memory_mb[0]
    lost = stream.missing
    table.add("targets", stream.sent[TARGETS], None)
    table.add("joint states", stream.sent[STATES], None)
    table.add("models", WARM + len(memory_mb), None)
    table.add("overwritten by newer ones", lost, None)
    count = sum(refused.values())
    table.add("refused or ended: " + (str(refused) if refused else "none"), count, Goal(count, 0))
    table.add("largest step", watch.worst, Goal(watch.worst, 1.0))
    table.add("targets compared with the model in force", watch.checked, None)
    table.add("of them stale", watch.stale, Goal(watch.stale, 0))
    table.add("memory grew, MB", grew, Goal(grew, MOST_GROWTH_MB))
    for words, q in (("median", 0.5), ("99 %", 0.99), ("99.9 %", 0.999), ("longest", 1.0)):
        table.add(f"there and back, {words}, ms", float(np.quantile(ms, q)), None)
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """1 when a goal is missed."""
    return soak_main("soak_correction", soak, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
