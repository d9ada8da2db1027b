"""Decisions of a run without a person; while another process holds the history, tick by tick."""

from collections.abc import Callable

from robocal_ros.ground.errors import Code, StorageError
from robocal_ros.maintenance.asking import Script
from robocal_ros.maintenance.deciding import BY, Decider, withholding
from robocal_ros.maintenance.hands import Hands
from robocal_ros.session.events import ACCEPT, Outcome

HELD_S = 2.0  # another process's change is a matter of milliseconds
WITHIN = "within the configured bounds"


def patiently(hands: Hands, act: Callable[[], Outcome]) -> Script[Outcome]:
    """What ``act`` gives; where the storage refuses, at the next ticks again while time allows.

    Raises
    ------
    StorageError
        The last refusal, where it raised.
    """
    until_s = hands.now_s + HELD_S
    while True:
        last = hands.now_s >= until_s or not hands.fits(0.0)
        try:
            outcome = act()
        except StorageError:
            if last:
                raise
        else:
            if last or outcome.status is not Code.STORAGE_FAILED:
                return outcome
        yield


def settled(
    hands: Hands,
    decider: Decider,
    kind: str,
    calibration_id: int,
    unsure: Callable[[], str],
    wall_ns: int,
) -> Script[Outcome]:
    """Accept a candidate that lies inside the bounds, or leave it to a person.

    ``unsure`` says why it waits although it lies inside them; empty: it need not.
    """

    def act() -> Outcome:
        mine = decider.accepted_here(calibration_id)  # by a try whose answer was lost
        if not mine and (why := decider.withheld(calibration_id) or unsure()):
            return withholding(kind, calibration_id, why)
        return decider.decide(ACCEPT, calibration_id, BY, WITHIN, wall_ns)

    return (yield from patiently(hands, act))


def is_accepted(outcome: Outcome) -> bool:
    """Whether what was settled is in force now."""
    return outcome.done and outcome.command.name == ACCEPT
