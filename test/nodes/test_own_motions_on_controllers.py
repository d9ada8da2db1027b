"""What our nodes send, judged by what a trajectory controller, real or simulated, commands by it."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from own_motions import DEEP
from own_motions import __file__ as SCRIPT
from std_msgs.msg import String
from trajectory_controllers import CONTROLLERS, HOME, NODE, Controlled

REST = np.zeros(6)
STEP = np.array([1.0, 0.3, -0.2, 0.5, -0.4, 0.1])
ACTION = f"/{NODE}/follow_joint_trajectory"
KINDS = [(kind, velocities) for kind in CONTROLLERS for velocities in (False, True)]


@pytest.fixture(params=KINDS, ids=lambda kind: f"{kind[0]}-{'velocities' if kind[1] else 'positions'}")
def controller(request: Any, graph: Any, tmp_path: Path) -> Controlled:
    kind, velocities = request.param
    more = {"lag_ms": float(os.environ["LAG"])} if kind == "simulated" and "LAG" in os.environ else {}
    controlled = CONTROLLERS[kind](graph, tmp_path, velocities, **more)
    controlled.velocities = velocities
    controlled.wait()
    return controlled


class Own:
    """The node of `own_motions`."""

    def __init__(self, controller: Controlled, remap: dict[str, str] | None = None, **parameters: Any):
        self.controller, self.graph = controller, controller.graph
        self.reports: list[dict[str, Any]] = []
        take = lambda message: self.reports.append(json.loads(message.data))  # noqa: E731
        self.graph.probe.create_subscription(String, "own/reports", take, DEEP)
        given = {"follow_joint_trajectory": ACTION} | parameters
        topics = {"controller_state": f"{NODE}/controller_state"} | (remap or {})
        self.process = self.graph.start(Path(SCRIPT), given, topics)
        self.orders = self.graph.publisher(String, "own/orders")
        self.wait("ready")
        self.graph.spin_for(0.3)
        self.side = 1

    def wait(self, what: str, within_s: float = 6.0) -> dict[str, Any]:
        self.graph.spin_until(lambda: any(r["what"] == what for r in self.reports), what, within_s)
        return next(r for r in self.reports if r["what"] == what)

    def order(self, **order: Any) -> None:
        self.reports.clear()
        self.orders.publish(String(data=json.dumps(order)))

    def moving(self, away: float = 0.45, **order: Any) -> None:
        """On its way at speed; there and back alternately."""
        start = self.controller.q
        ends = HOME if abs(start[0] - HOME[0]) > 0.3 else HOME + STEP
        self.side = np.sign(ends[0] - start[0])
        self.order(go=ends.tolist(), **order)
        try:
            self.controller.moved(away, start)
        except BaseException:
            print("REPORTS", self.reports, start, ends, self.controller.q)
            raise


def test_measure(controller):
    own = Own(controller, {"controller_state": "nowhere"} if "NOREF" in os.environ else None)
    rows = []
    which = os.environ.get("WHICH", "late lost").split()
    cases = [(d, {"late_s": l}) for d in (10.0, 3.3) for l in (0.0, 0.03, 0.1)] * ("late" in which)
    cases += [(d, {"lost": n}) for d in (10.0, 3.3) for n in (0,)] * ("lost" in which)
    cases += [(d, {"rejected": n}) for d in (10.0, 3.3) for n in (1, 2)] * ("rej" in which)
    for slow, case in cases:
        away = 0.3 if slow < 1.5 else 0.45
        own.moving(away, slow=slow)
        begin_s = controller.now_s - 0.05
        t = np.array(own.wait("moves")["t"])
        tt, ss = controller.sent(t[0])
        first = tt[1:][np.abs(np.diff(ss, axis=0)).max(axis=1) > 1e-6][0]
        print("SEND", np.round((t - t[2]) * 1e3, 1), "first", round((first - t[2]) * 1e3, 1))
        own.order(stop=True, slow=slow, **case)
        stood = own.wait("stood")
        stops = own.wait("stops")
        controller.stands()
        time, sent = controller.sent(begin_s)
        moved = np.abs(np.diff(sent, axis=0)).max(axis=1) > 1e-6
        last_s = time[1:][moved][-1]
        t, speed = controller.speeds(begin_s)
        after = t > stops["unix_s"]
        speed = speed * own.side * np.sign(STEP)
        step = np.abs(np.diff(speed, axis=0)).max(axis=1) / np.maximum(np.diff(t) / 0.004, 1.0)
        took = last_s - stops["unix_s"]
        print(f"MEASURED slow {slow} {case} sent {stood['sent']} planned {stood['planned_s']:.3f} took {took:.3f} "
              f"ratio {took / stood['planned_s']:.2f} fastest {speed.max():.3f} change/4ms {step.max():.3f} "
              f"back {max(-speed.min(), 0.0):.4f} slowest_before_end {speed[t < last_s - 0.3 * took][:, 0].min():.3f} {stood['failed']}")
        if os.environ.get("TRACE"):
            print("; ".join(f"{(a - stops['unix_s'])*1e3:.0f} {b[0]:.2f}" for a, b in zip(t, speed) if a - stops["unix_s"] < 0.3))
        # back to an end
        print("LATE", stops["late"])
        own.order(go=(HOME + STEP if own.side > 0 else HOME).tolist())
        own.wait("arrived")
        own.graph.spin_for(0.2)
