# SPDX-License-Identifier: Apache-2.0
"""A recorder hears more than the session, or less, or in another order: the results are the same.

What the recording lacks is told.
"""

import json
from dataclasses import replace

import pytest
from joint_blocks import in_blocks
from tool_driver import TRUTH, Driver, config_of, noisy_cell

from robocal_ros.bags.replay import One, replay
from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.samples import JOINTS, JointBlock, JointSample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session.events import arguments_text, outcome_text, read_command
from robocal_ros.tool.edges import EDGES
from robocal_ros.tool.session import ToolSession

EVERY = 40  # of so many joint readings one is lost: fewer than TraitLimits allows
LOST_NS = 3_000_000_000


def take(session, kind, sample):
    try:
        session.add(sample)
    except RobocalError as error:
        session.refuse(kind, error)


def session_in(folder, cell):
    history = CalibrationHistory.open("K1", model_hash=cell.arm.model_hash, state_dir=folder)
    return ToolSession(cell.arm, history, config_of(cell), "test")


class LossyDriver(Driver):
    """Some joint readings never come to the session; it is told so, as a node tells it."""

    lost, given_ns, missing = 0, 0, False

    def give(self, sample):
        if not isinstance(sample, JointSample):
            return super().give(sample)
        if (len(self.samples) + 1) % EVERY == 0:
            self.samples.append(sample)
            self.lost, self.missing = self.lost + 1, True
            return None
        if self.missing:
            self.session.lose(JOINTS, self.given_ns, sample.stamp_ns)
        self.given_ns, self.missing = sample.stamp_ns, False
        return super().give(sample)


def run(driver_class, folder):
    """A live run: its driver, and what the node recorded of it."""
    cell = noisy_cell()
    driver = driver_class(session_in(folder, cell), cell, RoundTool.cylinder(TRUTH, 0.0025))
    assert driver.measure().done
    return driver, commands_of(driver)


def commands_of(driver):
    found = []
    for outcome in driver.outcomes:
        command = outcome.command
        text = arguments_text(command)
        again = read_command(command.name, command.stamp_ns, text)
        found.append((again, json.loads(outcome_text(outcome))))
    return found


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    return run(Driver, tmp_path_factory.mktemp("live"))


@pytest.fixture(scope="module")
def lossy(tmp_path_factory):
    return run(LossyDriver, tmp_path_factory.mktemp("lossy"))


def replayed(folder, samples, commands):
    session = session_in(folder, noisy_cell())
    stream = [One(JOINTS if isinstance(s, JointSample | JointBlock) else EDGES, s) for s in samples]
    return replay(session, stream, commands, None, take)


@pytest.mark.parametrize("sizes", [[1], [10_000], [3, 50, 8]])
def test_what_never_came_to_the_session_is_left_out(lossy, tmp_path, sizes):
    driver, commands = lossy
    report = replayed(tmp_path, in_blocks(driver.samples, sizes), commands)
    assert report.differs == []
    assert 0 < report.unheard[JOINTS] <= driver.lost
    assert report.lacking == 0
    assert report.warnings[0].startswith(f"{report.unheard[JOINTS]} recorded messages of {JOINTS}")


def test_with_it_the_results_would_be_others(lossy, tmp_path):
    driver, commands = lossy
    deaf = [(replace(command, heard=None), outcome) for command, outcome in commands]
    assert replayed(tmp_path, driver.samples, deaf).differs


def test_what_the_recording_lacks_is_told(live, tmp_path):
    driver, commands = live
    joints = [sample for sample in driver.samples if isinstance(sample, JointSample)]
    lacking = {sample.stamp_ns for sample in joints[EVERY::EVERY]}
    kept = [
        one
        for one in driver.samples
        if not (isinstance(one, JointSample) and one.stamp_ns in lacking)
    ]
    report = replayed(tmp_path, kept, commands)
    last_ns = commands[-1][0].marks[JOINTS]
    first_ns = commands[0][0].marks[JOINTS]
    assert report.lacking == sum(first_ns < at_ns <= last_ns for at_ns in lacking)
    assert f"lacks {report.lacking} joint states" in report.warnings[0]
    assert any("joint states that the node had" in words for words in report.differs)


@pytest.mark.parametrize("sizes", [[1], [3, 50, 8]])
@pytest.mark.parametrize("later", [JOINTS, EDGES])
def test_the_order_of_the_topics_changes_nothing(live, tmp_path, later, sizes):
    """A recorder that stood still for seconds may write one topic far behind the other."""
    driver, commands = live

    def written_ns(sample):
        is_later = isinstance(sample, JointSample) == (later == JOINTS)
        return sample.stamp_ns + LOST_NS * is_later

    samples = sorted(driver.samples, key=written_ns)
    assert samples != driver.samples
    assert replayed(tmp_path, in_blocks(samples, sizes), commands).differs == []
