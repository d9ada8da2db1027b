"""What our nodes send, judged by what a trajectory controller, real or simulated, commands by it."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from own_motions import __file__ as SCRIPT
from std_msgs.msg import String
from trajectory_controllers import CONTROLLERS, HOME, NAMES, NODE, Controlled, trajectory
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.nodes import qos

REST = np.zeros(6)
STEP = np.array([1.0, 0.3, -0.2, 0.5, -0.4, 0.1])
ACTION = f"/{NODE}/follow_joint_trajectory"
KINDS = [(kind, velocities) for kind in CONTROLLERS for velocities in (False, True)]


@pytest.fixture(params=KINDS, ids=lambda kind: f"{kind[0]}-{'velocities' if kind[1] else 'positions'}")
def controller(request: Any, graph: Any, tmp_path: Path) -> Controlled:
    kind, velocities = request.param
    controlled = CONTROLLERS[kind](graph, tmp_path, velocities)
    controlled.velocities = velocities
    controlled.wait()
    return controlled


class Own:
    """The node of `own_motions`."""

    def __init__(self, controller: Controlled, remap: dict[str, str] | None = None, **parameters: Any):
        self.controller, self.graph = controller, controller.graph
        self.reports: list[dict[str, Any]] = []
        take = lambda message: self.reports.append(json.loads(message.data))  # noqa: E731
        self.graph.probe.create_subscription(String, "own/reports", take, qos.LATCHED)
        given = {"follow_joint_trajectory": ACTION} | parameters
        topics = {"controller_state": f"{NODE}/controller_state"} | (remap or {})
        self.process = self.graph.start(Path(SCRIPT), given, topics)
        self.orders = self.graph.publisher(String, "own/orders")
        self.wait("ready")
        self.graph.spin_for(0.3)

    def wait(self, what: str, within_s: float = 6.0) -> dict[str, Any]:
        self.graph.spin_until(lambda: any(r["what"] == what for r in self.reports), what, within_s)
        return next(r for r in self.reports if r["what"] == what)

    def order(self, **order: Any) -> None:
        self.orders.publish(String(data=json.dumps(order)))

    def moving(self, away: float = 0.3) -> float:
        """On its way at speed; the controller's stamp."""
        self.order(go=(HOME + STEP).tolist())
        self.controller.moved(away)
        return self.controller.now_s


def changes(controller: Controlled, since_s: float) -> dict[str, float]:
    time, speed = controller.speeds(since_s)
    step = np.abs(np.diff(speed, axis=0)).max(axis=1) / np.maximum(np.diff(time) / 0.004, 1.0)
    return {
        "fastest": float(np.abs(speed).max()),
        "most_change": float(step.max()),
        "back": float(-(speed * np.sign(STEP)).min()),
    }


def test_a_stop_is_smooth_and_stands_in_time(controller):
    own = Own(controller)
    begin_s = own.moving() - 0.1
    own.order(stop=True)
    stood = own.wait("stood")
    stops = own.wait("stops")
    controller.stands()
    time, sent = controller.sent(begin_s)
    moved = np.abs(np.diff(sent, axis=0)).max(axis=1) > 1e-9
    last_s = time[1:][moved][-1]
    found = changes(controller, begin_s)
    print(f"\nMEASURED stop {controller.velocities} {stood['sent']} sent, planned {stood['planned_s']:.3f}, "
          f"took {last_s - stops['unix_s']:.3f} {found}")
    t, v = controller.speeds(stops["unix_s"] - 0.03)
    for a, b in zip(t, v): (a - stops["unix_s"] < 0.16) and print(f"{a - stops['unix_s']:.3f} {b[0]:.3f}", end="; ")
