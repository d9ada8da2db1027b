"""The closed loop's tool driver hears the gap's beat itself, as its node does."""

import numpy as np
import pytest

from bench.closed_loop.plant import BEAT_S, STEP_S, equipped
from bench.closed_loop.setting import LIMITS
from robocal_ros.cell_sim.cell import SimulatedCell, kr150_cell
from robocal_ros.cell_sim.trajectory_controller import LAG_S
from robocal_ros.ground.errors import ConflictError
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.motion.plan import JointPlan
from robocal_ros.session import events
from robocal_ros.session.events import Command
from robocal_ros.tool.driving import DrivePhase


@pytest.fixture
def cell():
    """The robot at home, and its sessions, a second after they began."""
    nominal = load_robot("kr150_r3100")
    simulated = SimulatedCell(kr150_cell(nominal, 3, points=0))
    with equipped(nominal, simulated) as (plant, suite):
        plant.listen(1.0)
        yield plant, suite


def test_nothing_is_armed_in_a_closed_gap(cell):
    plant, suite = cell
    with pytest.raises(ConflictError, match="gap_open is false"):
        suite.driver.arm(plant.now_s)


def test_a_gap_that_closes_stops_the_tools_driver(cell):
    plant, suite = cell
    plant.is_open = True
    plant.listen(plant.now_s + 2.0 * BEAT_S)
    suite.driver.arm(plant.now_s)
    suite.tool_command(Command(events.MEASURE_TOOL, {"mode": "reference", "cycle_id": "one"}))
    while suite.driver.phase is not DrivePhase.APPROACH:
        plant.step()
    plant.listen(plant.now_s + 0.5)
    assert plant.cell.moving
    plant.is_open = False
    plant.listen(plant.now_s + BEAT_S + STEP_S)
    assert not suite.driver.armed
    assert suite.driver.told == "gap_open is false"
    assert suite.tool.run is None
    hardest_s = float(np.max(np.asarray(LIMITS.joint_velocity) / LIMITS.stop_deceleration))
    plant.listen(plant.now_s + hardest_s + 3.0 * LAG_S)
    assert not plant.cell.moving
    assert plant.cell.motion.faults == 0


def test_a_jump_that_is_sent_is_counted(cell):
    plant, _ = cell
    q = plant.cell.motion.at([plant.now_s])[0]
    plant.send(JointPlan(np.array([0.0, 0.008]), np.vstack([q, q + 1.0]), *np.zeros((2, 2, 6))))
    plant.listen(plant.now_s + 1.0)
    assert plant.cell.motion.faults == 1
    assert plant.cell.motion.at([plant.now_s])[0] == pytest.approx(q, abs=1e-12)


@pytest.mark.parametrize("seed", [51, 65, 73])
def test_a_healthy_tool_is_found_where_noisy_readings_bend_its_path(seed):
    """Joint readings whose noise lets whole steps of the search overshoot for ever."""
    nominal = load_robot("kr150_r3100")
    with equipped(nominal, SimulatedCell(kr150_cell(nominal, seed, points=0))) as (plant, suite):
        plant.commission()
        assert suite.tool.current.measured_healthy is not None
