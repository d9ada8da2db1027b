"""What the line reads of an accuracy."""

import math

import pytest

from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel, ToolError


def test_the_document_is_in_millimetres():
    found = Accuracy(AccuracyLevel.DUE, "soon", ToolError(3e-5, 8e-5), 12.0)
    assert found.document(1e-4) == {
        "state": 2,
        "predicted_error_mm": pytest.approx(0.03),
        "bound_mm": pytest.approx(0.08),
        "tolerance_mm": pytest.approx(0.1),
        "due_in_s": 12.0,
        "reason": "soon",
    }


def test_an_error_that_is_not_known_is_minus_one():
    told = Accuracy(AccuracyLevel.EXPIRED, "no reference").document(1e-4)
    assert (told["predicted_error_mm"], told["bound_mm"]) == (-1.0, -1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", ["rms", "bound", "due"])
def test_a_figure_that_is_not_finite_is_a_fault(bad, which):
    values = {"rms": 3e-5, "bound": 8e-5, "due": 12.0} | {which: bad}
    error = ToolError(values["rms"], values["bound"])
    told = Accuracy(AccuracyLevel.OK, "fine", error, values["due"]).document(1e-4)
    assert told["state"] == AccuracyLevel.FAULT
    assert all(math.isfinite(value) for name, value in told.items() if name != "reason")
