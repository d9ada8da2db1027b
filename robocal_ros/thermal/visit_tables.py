"""Tables of visits of named measuring poses (docs/csv.md)."""

from pathlib import Path

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import measurements_of, read_table
from robocal_ros.thermal.visits import ONLY_CYCLE, Visits


def read_visits(path: str | Path, arm: SerialArm) -> Visits:
    """Read a table of visits of named poses: as ``read_measurements``, with a column ``pose``.

    Raises
    ------
    InputError
        As ``read_measurements``, and when the column ``pose`` is missing.
    """
    table, layout = read_table(Path(path), arm)
    if "pose" not in layout.place:
        raise InputError(
            "column pose is missing: it names each measuring pose, the same name cold and warm",
            file=table.file,
            row=1,
        )
    data = measurements_of(table, layout, arm)
    cycle = table.words("cycle") or (ONLY_CYCLE,) * len(data)
    return Visits(data, table.words("pose"), cycle)
