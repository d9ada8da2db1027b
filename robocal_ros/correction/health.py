"""What the joint correction's diagnostics say."""

import numpy as np

from robocal_ros.correction.messages import in_words
from robocal_ros.correction.refusals import Reason
from robocal_ros.correction.status import CorrectionStatus
from robocal_ros.nodes.diagnostics import ERROR, WARN, Health


class CorrectionHealth:
    """Judges a status; a refusal warns once."""

    def __init__(self) -> None:
        self._refusals = 0

    def of(self, status: CorrectionStatus, faults: list[str], rivals: list[str]) -> Health:
        """Tell what is corrected, and what was refused and why.

        ``faults``: inputs that must not be used; ``rivals``: what is wrong with who sends commands.
        """
        health = Health()
        refusals = sum(status.refused.values())
        if refusals > self._refusals:
            health.worsen(WARN, status.last_refusal)
        self._refusals = refusals
        for fault in faults:
            health.worsen(ERROR, fault)
        if status.mismatch:
            health.worsen(ERROR, f"{Reason.START_MISMATCH.value}: {status.mismatch}")
        for warning in [*rivals, *_warnings(status)]:
            health.worsen(WARN, warning)
        health.values = _figures(status)
        return health


def _warnings(status: CorrectionStatus) -> list[str]:
    """What an operator should look at."""
    said = [status.stale]
    if status.waits:
        said.append(f"the blend waits, {status.waits}")
    if status.survey.beyond:
        said.append(f"model revision {status.revision}: {status.survey}")
    if status.waiting_revision is not None:
        said.append(
            f"model revision {status.waiting_revision} was refused, ~/enable looks at it again"
        )
    if status.enabled and status.revision is None and not status.new_tool:
        said.append("enabled, but neither a model nor a tool was taken over")
    return [text for text in said if text]


def _figures(status: CorrectionStatus) -> dict[str, object]:
    counts = {"refused": status.refused, "clamped": status.clamped, "passed": status.passed}
    figures: dict[str, object] = {
        "correction": in_words(status),
        "reference": status.reference,
        "policy": status.policy.value,
        "tool waits": "" if status.waiting_tool is None else f"revision {status.waiting_tool}",
        "shift at the tool mm": f"{status.tcp_shift_m * 1e3:.4f}",
        "largest joint shift deg": f"{np.degrees(status.largest_shift):.4f}",
        "remaining error mm": f"{status.remaining_m * 1e3:.6f}",
        "over the joint range": status.survey,
        "start mismatch": status.mismatch,
        "blend waits": status.waits,
        "blend held": status.held,
        "points corrected in part": status.reduced,
    }
    for what, found in counts.items():
        figures |= {f"{what}, {reason.value}": count for reason, count in found.items()}
    return figures
