"""Circles and plunges of a recorded run, told apart by the names of their edges' steps."""

from collections.abc import Sequence

from robocal_ros.ground.errors import InputError
from robocal_ros.tool.beam_edges import BeamEdge, debounced
from robocal_ros.tool.crossed_model import BeamStep, StepKind

CIRCLES = ("low", "high", "upright")  # as a measuring plan calls them
STEP_NAMES = f"circles are called {', '.join(CIRCLES)} or circle…, plunges plunge…"


def step_kind(name: str) -> StepKind | None:
    """What a step's name says it is; None where it says nothing."""
    if name in CIRCLES or name.startswith("circle"):
        return "circle"
    return "plunge" if name.startswith("plunge") else None


def named_steps(
    edges: Sequence[BeamEdge], names: Sequence[str], debounce_s: float
) -> list[BeamStep]:
    """Steps in order of time, their edges debounced; ``names`` says the step of each edge.

    Raises
    ------
    InputError
        When a name says neither circle nor plunge, or comes again after another step.
    BeamError
        When a beam chatters.
    """
    inside: dict[str, list[BeamEdge]] = {}
    before = None
    for edge, name in sorted(zip(edges, names, strict=True), key=lambda pair: pair[0].time_s):
        if name in inside and name != before:
            raise InputError(
                f"step '{name}' comes again at {edge.time_s:.4f} s, after step '{before}': give "
                "each motion a name of its own"
            )
        inside.setdefault(name, []).append(edge)
        before = name
    steps = []
    for name, own in inside.items():
        kind = step_kind(name)
        if kind is None:
            raise InputError(f"step '{name}' is neither: {STEP_NAMES}")
        steps.append(BeamStep(name, kind, debounced(own, debounce_s)))
    return steps
