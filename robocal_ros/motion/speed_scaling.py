"""How fast a controller's clock runs, by who tells it: it slows down with the robot, and pauses."""

import math

TOLD_S = 1.0  # what was not told again for so long is not known
PERCENT = 0.01
CONTROLLER, SLIDER = "controller", "slider"


class SpeedScaling:
    """The newest of each source, by a steady clock; the controller knows better than the slider.

    A controller that fills no scaling leaves it at 0, and a broadcaster says 0 before it knows
    any: so a 0 counts only after another number of the same source. What is negative or not
    finite tells nothing, and what is faster than planned counts as 1. A robot that pauses goes on
    to tell so; a source that is silent has died, and says nothing of the robot now.
    """

    def __init__(self) -> None:
        self._told: dict[str, tuple[float, float]] = {}

    def controller(self, factor: float, now_s: float) -> None:
        """Take ``speed_scaling_factor`` of a controller's state, 1 as planned."""
        self._tell(CONTROLLER, factor, now_s)

    def slider(self, percent: float, now_s: float) -> None:
        """Take what ur_robot_driver's speed_scaling_state_broadcaster publishes, 100 as planned."""
        self._tell(SLIDER, percent * PERCENT, now_s)

    def _tell(self, source: str, factor: float, now_s: float) -> None:
        if math.isfinite(factor) and (factor > 0.0 or (factor == 0.0 and source in self._told)):
            self._told[source] = min(factor, 1.0), now_s

    def at(self, now_s: float) -> float | None:
        """The scaling, 0 to 1; None where nobody told it lately."""
        for source in (CONTROLLER, SLIDER):
            factor, told_s = self._told.get(source, (0.0, -math.inf))
            if now_s - told_s <= TOLD_S:
                return factor
        return None
