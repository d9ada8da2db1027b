# SPDX-License-Identifier: Apache-2.0
"""Play the golden thermal bag live: ``tools/with_ros python bags/play_thermal_shift.py``.

This script is the cell controller: at the mark after each cycle it pauses the replay, ends the
cycle, accepts its model where the verdict says so, and begins the next one. What the node recorded
of its session is written beside the measurements, so that ``robocal replay`` can do it again.
"""

import argparse
import json
import sys
from collections import deque
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray
from make_demo_shift import ROBOT
from make_thermal_shift import BAG, PERIOD_S
from robocal_msgs.msg import AccuracyState, SessionEvent
from robocal_msgs.srv import BeginCycle, CaptureReference, Decide, EndCycle
from std_msgs.msg import String

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for the bench

from bench.live.graph import CellController, LiveError
from bench.measured_shifts import REFERENCE
from bench.startup import ROOT
from robocal_ros.bags.bags import BagReader, BagWriter
from robocal_ros.ground.errors import Code
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS

SERIAL = "SIM-KR150-2"
INPUTS = ("joint_states", "sphere_cloud", "reference_sphere_center", "motor_temperatures")
EVENT_TOPIC = "/thermal_node/session_events"
RECORDED = "recorded.mcap"
RATE = 1000.0  # recorded seconds per second


class Player:
    """The cell controller of one run."""

    def __init__(self, controller: CellController) -> None:
        self._controller = controller
        self.events: deque[SessionEvent] = deque()
        self.accuracy: deque[AccuracyState] = deque(maxlen=1)
        controller.listen(SessionEvent, EVENT_TOPIC, self.events, EVENTS)
        controller.listen(AccuracyState, "/thermal_node/accuracy", self.accuracy, endpoints.LATCHED)
        self._done: deque[String] = deque()
        self._status: deque[String] = deque(maxlen=1)
        self._diagnostics: deque[DiagnosticArray] = deque(maxlen=30)
        controller.listen(String, "cycle_done", self._done, endpoints.RELIABLE)
        controller.listen(String, "/replay_node/status", self._status, endpoints.LATCHED)
        controller.listen(DiagnosticArray, "/diagnostics", self._diagnostics, endpoints.RELIABLE)

    def start(self, folder: Path) -> None:
        """Start thermal_node and replay_node; the replay waits."""
        reliable: dict[str, object] = {
            f"qos_overrides./{topic}.subscription.{policy}": value
            for topic in INPUTS
            for policy, value in (("reliability", "reliable"), ("history", "keep_all"))
        }
        settings: dict[str, object] = {"robot": ROBOT, "serial": SERIAL, "use_sim_time": True}
        settings |= {"lateness_s": 0.0, "cycle_timeout_s": 1.5 * PERIOD_S}
        self._controller.start(folder, "thermal_node", settings | reliable)
        replayed = {
            "bag": BAG,
            "rate": RATE,
            "start_paused": True,
            "wait_for_subscribers": f"[{', '.join((*INPUTS, 'cycle_done'))}]",
        }
        self._controller.start(folder, "replay_node", replayed)

    def run(self) -> None:
        """Play the bag; act at each mark."""
        controller = self._controller
        cycles = marks()
        for number, expected in enumerate(cycles):
            controller.trigger("/replay_node/play")
            controller.wait(lambda: self._done, "the end of a cycle")
            self._pause()
            if (name := self._done.popleft().data) != expected:
                raise LiveError(f"the mark of {name} came, not that of {expected}")
            if name == REFERENCE:
                self._capture()
            else:
                self._end(name)
            if number + 1 < len(cycles):
                self._begin(cycles[number + 1])

    def _pause(self) -> None:
        """Pause the replay and wait until thermal_node has taken in all that was played.

        A cell that runs in real time needs no such wait: here an hour passes in seconds.
        """
        controller = self._controller
        self._status.clear()
        controller.trigger("/replay_node/pause")
        controller.wait(lambda: self._status, "the replay's status")
        sent = json.loads(self._status[-1].data)["sent"]
        controller.wait(
            lambda: all(self._taken(topic) >= sent[topic] for topic in INPUTS),
            "thermal_node to take in what was played",
        )

    def _taken(self, topic: str) -> int:
        """How many messages thermal_node says it has received or lost."""
        for array in reversed(self._diagnostics):
            for status in array.status:
                if status.name == "thermal_node":
                    values = {pair.key: pair.value for pair in status.values}
                    return int(values[f"{topic} received"]) + int(values[f"{topic} lost"])
        return -1

    def _capture(self) -> None:
        answer = self._controller.call(CaptureReference, "/thermal_node/capture_reference")
        if not answer.success:
            raise LiveError(f"no cold reference: {answer.message}")
        print(answer.message)

    def _begin(self, name: str) -> None:
        answer = self._controller.call(BeginCycle, "/thermal_node/begin_cycle", cycle_id=name)
        if not answer.success:
            raise LiveError(f"{name} cannot begin: {answer.message}")

    def _end(self, name: str) -> None:
        answer = self._controller.call(EndCycle, "/thermal_node/end_cycle", cycle_id=name)
        if not answer.candidate_id:
            raise LiveError(f"{name}: {answer.message}")
        print(f"{name}: {Code(answer.status).name} {answer.message}")
        if answer.status == Code.ACCEPT:
            who = {"by": "cell controller", "reason": "its verdict"}
            self._controller.call(Decide, "/thermal_node/accept", id=answer.candidate_id, **who)


def marks() -> list[str]:
    """The cycles of the bag in their order."""
    with BagReader(BAG) as reader:
        return [m.message.data for m in reader.messages(["cycle_done"])]


def write_recorded(events: deque[SessionEvent], path: Path) -> None:
    """The bag as a recorder would have kept it that listened to the node too."""
    with BagReader(BAG) as reader, BagWriter(path, latched=[EVENT_TOPIC]) as writer:
        for m in reader.messages():
            kind = reader.info.topics[m.topic].msgtype
            writer.write(f"/{m.topic.lstrip('/')}", kind, m.message, m.log_time_ns)
            last_ns = m.log_time_ns
        for event in events:
            writer.write(EVENT_TOPIC, "robocal_msgs/msg/SessionEvent", event, last_ns)


def main() -> int:
    """Play, and write the recording."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "thermal_shift")
    folder: Path = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    controller = CellController()
    try:
        player = Player(controller)
        player.start(folder)
        player.run()
        controller.wait(lambda: player.accuracy, "the accuracy")
        controller.wait(lambda: player.events[-1].command == "configure", "the last event")
    except LiveError as error:
        print(error, file=sys.stderr)
        return 1
    finally:
        controller.close()
    write_recorded(player.events, folder / RECORDED)
    print(f"accuracy: {player.accuracy[-1].reason}\nwritten: {folder / RECORDED}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
