"""What a gap found of the tool is told, also where the same gap mends it."""

from dataclasses import replace

import pytest
from maintenance_cell import bent, passed
from maintenance_tools import automatic, measured_in_full, until_verified

from robocal_ros.ground.errors import Code

UNSURE = replace(bent(), code=Code.TOO_FEW_SAMPLES, answer="cannot tell")


def test_a_bent_tool_that_the_same_gap_mends_is_told(history):
    cell = automatic(history)
    number = measured_in_full(cell)
    until_verified(cell)
    cell.check = passed()
    result = cell.finish()
    assert (result.accepted, result.complete) == ((number,), True)
    assert (result.tool_found_code, result.tool_code) == (Code.LIMIT_EXCEEDED, Code.ACCEPT)
    assert f"tool: {bent().message}; tool: {passed().message}" in result.message
    cell.restart()
    assert cell.session.result(result.cycle_id) == result


@pytest.mark.parametrize("first", ["cannot tell", "a gap before"])
def test_a_bent_tool_that_only_the_full_measurement_finds_is_told(history, first):
    cell = automatic(history)
    if first == "a gap before":  # which was too short for more
        assert cell.run("c0", 30.0) is Code.ACCEPT
        assert cell.finish().left == ("tool measurement (full)",)
        cell.open_gap()
    else:
        cell.check = UNSURE
    number = measured_in_full(cell)
    until_verified(cell)
    cell.check = passed()
    result = cell.finish()
    assert result.accepted == (number,)
    assert (result.tool_found_code, result.tool_code) == (Code.LIMIT_EXCEEDED, Code.ACCEPT)


def test_another_tool_that_a_check_lets_pass_is_no_alarm(history):
    cell = automatic(history, full_every_s=1.0)
    cell.check = passed()
    number = measured_in_full(cell)
    result = cell.finish()
    assert result.tool_id == number
    assert result.tool_found_code is Code.ACCEPT
