"""The demo: a simulated shift through the live nodes; prints what it brought and writes a report.

``make demo`` runs it. thermal_node, joint_correction_node and replay_node run as processes of their
own; this script is the cell controller. At the end of each measuring cycle it lets the
replay pause, asks for a new model, accepts it where the verdict says so, and sends taught poses
through the correction. The simulated robot then executes the corrected joints, so that the true
error is known, at poses that were never measured.
"""

import argparse
import json
import shutil
import sys
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from demo_graph import READINGS, ROOT, CellController, DemoError
from demo_output import commit, show, write
from make_demo_shift import BAG, ROBOT, SERIAL, DemoCell, build
from make_demo_shift import write as write_bag
from numpy.typing import NDArray
from robocal_msgs.srv import CaptureReference, Decide, Identify
from std_srvs.srv import SetBool

from robocal_ros.core.codes import Code
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.report.drift import Decided, DriftReport, Origin
from robocal_ros.sim import kr150
from robocal_ros.sim.robot import Effects
from robocal_ros.sim.shift import REFERENCE
from robocal_ros.storage.robots import load_robot

Array = NDArray[np.float64]

OUT = ROOT / "out"
INPUTS = ("joint_states", "measured_point")
RATE = 600.0  # recorded seconds per second


@dataclass
class Shift:
    """What the cell controller saw, cycle by cycle."""

    hours: list[float] = field(default_factory=list)
    decided: list[Decided] = field(default_factory=list)
    before: list[Array] = field(default_factory=list)
    after: list[Array] = field(default_factory=list)
    held: list[Array] = field(default_factory=list)
    drift: list[Array] = field(default_factory=list)
    sigma: list[Array] = field(default_factory=list)


class Demo:
    """One run of the shift."""

    def __init__(self, cell: DemoCell, bag: Path, controller: CellController) -> None:
        self._cell, self._bag, self._controller = cell, bag, controller
        self._arm: SerialArm = load_robot(ROBOT)
        self._cycles = {cycle.name: cycle for cycle in cell.shift.cycles}
        self._cold = cell.shift.cycles[0]
        self.shift = Shift()

    def start(self, folder: Path, rate: float) -> None:
        """Start the three nodes; the replay waits."""
        common = {"robot": ROBOT, "serial": SERIAL}
        controller = self._controller
        # At this speed nothing may be lost on the way. The cell controller's mark comes after the
        # last measurement: nothing is under way then.
        reliable = {
            f"qos_overrides./{topic}.subscription.reliability": "reliable" for topic in INPUTS
        }
        controller.start(folder, "thermal_node", lateness_s=0.0, **common, **reliable)
        controller.start(
            folder,
            "joint_correction_node",
            {"kinematic_model": "/thermal_node/model", "joint_states": READINGS},
            taught_tool=f"[{', '.join(map(str, kr150.TOOL))}, 0.0, 0.0, 0.0, 1.0]",
            **common,
        )
        controller.start(
            folder,
            "replay_node",
            bag=self._bag,
            rate=rate,
            start_paused=True,
            wait_for_subscribers="[joint_states, measured_point, cycle_done]",
        )
        controller.wait(lambda: controller.model, "the model in force")
        answer = controller.call(SetBool, "/joint_correction_node/enable", data=True)
        if not answer.success:
            raise DemoError(f"the correction cannot be enabled: {answer.message}")

    def run(self) -> None:
        """Play the bag; act at each mark of the end of a cycle."""
        controller = self._controller
        for _ in self._cycles:
            controller.trigger("/replay_node/play")
            controller.wait(lambda: controller.done and controller.truth, "the end of a cycle")
            controller.pause("thermal_node", INPUTS)
            name = controller.done.popleft().data
            truth = json.loads(controller.truth.popleft().data)
            if truth["cycle"] != name:
                raise DemoError(f"the truth of {truth['cycle']} came with {name}")
            if name == REFERENCE:
                self._reference()
            else:
                self._cycle(name, np.array(truth["q_rad"]), np.array(truth["position_m"]))

    def _reference(self) -> None:
        answer = self._controller.call(CaptureReference, "/thermal_node/capture_reference")
        if not answer.success:
            raise DemoError(f"no cold reference: {answer.message}")
        require_all(answer.samples, len(self._cell.plan.reference))

    def _cycle(self, name: str, taught: Array, uncorrected: Array) -> None:
        controller, shift = self._controller, self.shift
        hours = (self._cycles[name].time_s - self._cold.time_s) / 3600.0
        shift.hours.append(hours)
        shift.before.append(uncorrected - self._cold.check)
        shift.held.append(self._error(name, taught))
        controller.quality.clear()
        answer = controller.call(Identify, "/thermal_node/identify", cycle_id=name)
        if answer.candidate_id:
            controller.wait(lambda: controller.quality, "the candidate's quality")
            require_all(controller.quality[-1].samples, len(self._cell.plan.cycle))
        if answer.status == Code.ACCEPT:
            self._accept(answer.candidate_id)
        shift.after.append(self._error(name, taught))
        shift.decided.append(self._decided(name, answer.status, answer.message))
        self._note_model()

    def _accept(self, candidate: int) -> None:
        controller = self._controller
        answer = controller.call(
            Decide, "/thermal_node/accept", id=candidate, by="cell controller",
            reason="the verdict accepts",
        )  # fmt: skip
        if not answer.success:
            raise DemoError(f"candidate {candidate} was not accepted: {answer.message}")
        controller.wait(
            lambda: controller.model[-1].revision == answer.revision, "the accepted model"
        )

    def _decided(self, name: str, status: int, message: str) -> Decided:
        quality = self._controller.quality[-1] if self._controller.quality else None
        return Decided(
            cycle=name,
            code=Code(status).name,
            reason=message,
            revision=self._controller.model[-1].revision,
            rejected=tuple(quality.rejected) if quality else (),
            predicted_mm=self._predicted_mm(),
        )

    def _error(self, name: str, taught: Array) -> Array:
        """True error (m, 3) of the tool when the corrected joints are executed, m."""
        q = self._controller.correct(list(self._arm.joint_names), taught)
        robot, warmth = self._cell.robot, self._cycles[name].warmth
        return robot.point(q, warmth, kr150.TOOL) - self._cold.check

    def _covariance(self) -> Array | None:
        """Covariance (k, k), SI, of the model in force; None where it is the nominal one."""
        model = self._controller.model[-1]
        if not model.covariance:
            return None
        given = list(model.parameter_names)
        place = [given.index(name.rpartition("_")[0]) for name in self._arm.parameters.names]
        return np.reshape(model.covariance, (len(given), -1))[np.ix_(place, place)]

    def _predicted_mm(self) -> float | None:
        """Rms error of the tool at the check poses, expected from the model's covariance."""
        covariance = self._covariance()
        if covariance is None:
            return None
        J = self._arm.parameter_jacobian(self._cell.plan.check, kr150.TOOL)[:, :3]
        return float(np.sqrt(np.mean(np.einsum("mik,kl,mil->m", J, covariance, J)))) * 1e3

    def _note_model(self) -> None:
        """Keep drift and standard deviation of the model in force, in the units people read."""
        model, parameters = self._controller.model[-1], self._arm.parameters
        mdh = np.column_stack([model.d, model.theta, model.a, model.alpha, model.beta])
        self.shift.drift.append(parameters.read(mdh - self._arm.mdh) * parameters.to_display)
        covariance = self._covariance()
        variance = np.zeros(len(parameters)) if covariance is None else np.diag(covariance)
        self.shift.sigma.append(np.sqrt(variance) * parameters.to_display)

    def report(self) -> DriftReport:
        """The run as a report."""
        shift = self.shift
        return DriftReport(
            title="A shift of a KR 150, kept accurate while it warms up",
            origin=Origin(
                simulated=True,
                data=f"{self._bag.name}: a simulated robot, sensor and shift; nothing was measured",
                robot=self._arm.name,
                serial=SERIAL,
                model_hash=self._arm.model_hash,
                commit=commit(),
                created=datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
            ),
            hours=np.array(shift.hours),
            decisions=shift.decided,
            before=np.array(shift.before),
            after=np.array(shift.after),
            held=np.array(shift.held),
            parameter_names=self._arm.parameters.names,
            drift=np.array(shift.drift),
            sigma=np.array(shift.sigma),
        )


def require_all(samples: int, poses: int) -> None:
    """The replay must not have run on into the next cycle before it was told to pause."""
    if samples != poses:
        raise DemoError(
            f"{samples} samples of {poses} poses: this machine is too busy for the replay's speed; "
            "try --rate 100"
        )


def main() -> int:
    """Run the demo."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=OUT, help="folder of the report")
    parser.add_argument(
        "--only-modelled", action="store_true", help="without what no estimator knows of"
    )
    parser.add_argument("--rate", type=float, default=RATE, help="speed of the replay")
    options = parser.parse_args()
    begin = time.monotonic()
    folder = options.out.resolve()
    shutil.rmtree(folder / "state", ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    controller = CellController()
    try:
        bag, cell = BAG, build()
        if options.only_modelled:
            bag, cell = folder / "only_modelled.mcap", build(Effects.modelled())
            write_bag(cell, bag)
        demo = Demo(cell, bag, controller)
        demo.start(folder, options.rate)
        demo.run()
    except DemoError as error:
        print(f"demo: {error}", file=sys.stderr)
        return 1
    finally:
        controller.close()
    report = demo.report()
    write(report, folder)
    show(report, folder, time.monotonic() - begin)
    return 0


if __name__ == "__main__":
    sys.exit(main())
