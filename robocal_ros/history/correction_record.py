"""What a robot's commands were corrected with, from when on: records that never change."""

from dataclasses import dataclass

NOMINAL, CALIBRATED = "nominal", "calibrated"


@dataclass(frozen=True, kw_only=True)
class CorrectionRecord:
    """What the joint correction did from an instant on.

    Attributes
    ----------
    wall_ns : when this began.
    software : version of this software.
    model_hash : of the nominal model.
    enabled : whether the correction was asked for.
    shadow : whether it was only shown.
    model_revision, tool_revision : in force for it; 0 for none, and for the taught tool.
    reference : NOMINAL or CALIBRATED: which model the program was made with, as it was chosen.
    reference_source : where that came from: a robot type, or the path of a robot file.
    reference_name, reference_hash : of that model.
    taught_tool : the tool that the program was made with: x, y, z in m, qx, qy, qz, qw.
    """

    wall_ns: int
    software: str
    model_hash: str
    enabled: bool
    shadow: bool
    model_revision: int
    tool_revision: int
    reference: str
    reference_source: str
    reference_name: str
    reference_hash: str
    taught_tool: tuple[float, ...]
