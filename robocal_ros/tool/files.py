# SPDX-License-Identifier: Apache-2.0
"""Files of measured tools: the JSON that ``robocal tool`` and ``robocal history show`` print."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.files import quoted
from robocal_ros.ground.frames import Array, Document, urdf_joint, urdf_origin
from robocal_ros.history.history_records import why_void
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import QUATERNION_TOLERANCE, read_fields
from robocal_ros.kinematics.tables import (
    ORIENTATIONS,
    Cells,
    check_plain,
    orientation_columns,
    read_cells,
    read_joint_columns,
    read_rotations,
    read_stamps,
)
from robocal_ros.programs.conventions import Load, Maker, tool_text
from robocal_ros.tool.circle import CircleFit
from robocal_ros.tool.crossed_model import BeamStep, ToolEstimate
from robocal_ros.tool.edges import BEAMS, Beam, BeamEdge, StepKind, debounced
from robocal_ros.tool.judging import KnownTool, QuickCheck
from robocal_ros.tool.laser_frame import JointPath, LaserFrame, first_rotation
from robocal_ros.tool.touch_points import HEIGHTS, SWEEPS, Height, TouchFit

if TYPE_CHECKING:
    from robocal_ros.tool.documents import (
        CircleDocument,
        FoundToolDocument,
        LaserDocument,
        ParallelBeamsDocument,
        ToolFrameDocument,
        TouchedToolDocument,
    )


def read_tool(path: Path, rotation: Array | None = None) -> Array:
    """T_flange_tool (4, 4) from ``tcp_mm`` and ``quat_xyzw``.

    ``rotation``: R_flange_tool (3, 3) for a document of touches, which tell the tip alone; another
    one takes none. As the history shows it the tool has the one that it comes into force with.

    Raises `InputError`, naming file and key, when one of them is missing, null or no measurement,
    and when the document's verdict does not accept the tool, or it is void (`why_void`).
    """
    top = read_fields(path, "tool file")
    kept = top.below("model") if {"document", "model"} <= top.values.keys() else None
    if "document" in top.values:  # as the history shows it
        if words := why_void(top.values):
            top.fail(words, "calibration")
        top = top.below("document")
    if "error" in top.values:
        top.fail("tells why no tool was found: measure again", "error")
    if "verdict" in top.values:
        verdict = top.below("verdict")
        if verdict.values.get("accept") is not True:
            top.fail(f"is {verdict.text('code')}: this tool was not accepted", "verdict")
    xyz = np.array(top.numbers("tcp_mm", 3)) * 1e-3
    if top.values.get("quat_xyzw") is not None:
        if rotation is not None:
            top.fail("is in the file: leave out roll, pitch and yaw", "quat_xyzw")
        quat = np.array(top.numbers("quat_xyzw", 4))
        length = float(np.linalg.norm(quat))
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            top.fail(f"has length {length:.6g}, not 1", "quat_xyzw")
        return frames.transform_from_quat(xyz, quat)
    if rotation is None and kept is not None:
        rotation = np.array(kept.rows("T_flange_tool", 4, 4))[:3, :3]
    if rotation is None:
        top.fail("is missing or null: give the tool's roll, pitch and yaw too", "quat_xyzw")
    return frames.transform(rotation, xyz)


def exported(
    T_flange_tool: Array, format: Maker | Literal["urdf"], load: Load | None = None
) -> str:
    """Text for URDF or a controller, with 1e-4 mm and 1e-5 deg; ``load`` is for ABB."""
    if format == "urdf":
        return urdf_joint("tool0", "tcp", *urdf_origin(T_flange_tool))
    return tool_text(format, T_flange_tool, load=load)


POSITION = ("x_mm", "y_mm", "z_mm")
STATES = {"1": True, "true": True, "0": False, "false": False}


def read_beam_points(path: Path) -> dict[str, Array]:
    """Flange positions (3,), base, m, by the name of their edge; of one measured often the mean."""
    table = read_cells(path, lambda header, file: check_plain(header, file, ("point", *POSITION)))
    positions = _positions(table)
    names = np.array(table.words("point"))
    return {str(name): positions[names == name].mean(axis=0) for name in dict.fromkeys(names)}


def read_edges(path: Path, sigma_s: float) -> list[BeamEdge]:
    """Edges of one motion, with ``sigma_s`` where the table has none of its own.

    Raises `InputError` as `read_beam_points`; when the table names several steps.
    """
    table = _edge_table(path)
    steps = dict.fromkeys(table.words("step"))
    if len(steps) > 1:
        raise InputError(
            f"holds the steps {', '.join(steps)}: give --joints, --robot and --laser for a whole "
            "run, or one circle alone",
            file=table.file,
            column="step",
        )
    return _edges(table, sigma_s, 0)


def read_step_edges(
    path: Path, sigma_s: float, origin_ns: int
) -> tuple[list[BeamEdge], tuple[str, ...]]:
    """Edges of a whole run, their times counted from ``origin_ns``, and the step of each.

    Raises `InputError` as `read_beam_points`; when a name says neither circle nor plunge.
    """
    table = _edge_table(path)
    steps = table.words("step")
    if not steps:
        raise InputError(
            f"column step is missing: it names the motion of each edge; {STEP_NAMES}",
            file=table.file,
            row=1,
        )
    for index, step in enumerate(steps):
        if step_kind(step) is None:
            table.fail(f"{quoted(step)} is no step; {STEP_NAMES}", index, "step")
    return _edges(table, sigma_s, origin_ns), steps


def _edge_table(path: Path) -> Cells:
    required, optional = ("stamp_s", "beam", "blocked"), ("sigma_s", "step")
    return read_cells(path, lambda header, file: check_plain(header, file, required, optional))


def _edges(table: Cells, sigma_s: float, origin_ns: int) -> list[BeamEdge]:
    beams, states = table.words("beam"), table.words("blocked")
    for index, (beam, state) in enumerate(zip(beams, states, strict=True)):
        if beam not in BEAMS:
            table.fail(f"'{beam}' is not one of {', '.join(BEAMS)}", index, "beam")
        if state.lower() not in STATES:
            table.fail(f"'{state}' is neither 1 (blocked) nor 0", index, "blocked")
    names: dict[str, Beam] = {name: name for name in BEAMS}
    times = (read_stamps(table) - origin_ns) * 1e-9
    sigma = np.full(len(times), sigma_s)
    if "sigma_s" in table.columns:
        sigma = table.numbers("sigma_s")
        if np.any(sigma <= 0.0):
            table.fail("no stamp is exact", int(np.argmax(sigma <= 0.0)), "sigma_s")
    return [
        BeamEdge(names[beam], STATES[state.lower()], time, spread)
        for beam, state, time, spread in zip(
            beams, states, times.tolist(), sigma.tolist(), strict=True
        )
    ]


def read_joint_path(path: Path, arm: SerialArm) -> tuple[JointPath, int]:
    """The flange over time from a table of joint readings, and the origin of its times, ns.

    Raises `InputError` as `read_beam_points`; when stamps do not increase; `TooFewSamplesError`:
    fewer than four readings.
    """
    found: list[tuple[tuple[str, ...], Array]] = []
    table = read_cells(
        path, lambda header, file: found.append(read_joint_columns(header, arm, file))
    )
    columns, factors = found[0]
    q = np.column_stack([table.numbers(name) for name in columns]) * factors
    stamps = read_stamps(table)
    late = np.flatnonzero(np.diff(stamps) <= 0)
    if len(late):
        table.fail("is not after the row before it", int(late[0]) + 1, "stamp_s")
    origin_ns = int(stamps[0])
    return JointPath(arm, np.asarray((stamps - origin_ns) * 1e-9, dtype=np.float64), q), origin_ns


def read_flange_poses(path: Path) -> Array:
    """T_base_flange (m, 4, 4)."""
    return _poses(path)[1]


def read_sweeps(path: Path) -> dict[tuple[str, Height], Array]:
    """T_base_flange (m, 4, 4) at the edges of parallel beams, by sweep and beam.

    Raises `InputError` as `read_flange_poses`; when a sweep or a beam has another name than
    docs/tool.md says.
    """
    table, T = _poses(path, ("sweep", "beam"))
    sweeps, beams = table.words("sweep"), table.words("beam")
    found: dict[tuple[str, Height], list[int]] = {}
    heights: dict[str, Height] = {name: name for name in HEIGHTS}
    for index, (sweep, beam) in enumerate(zip(sweeps, beams, strict=True)):
        for column, name, known in (("sweep", sweep, SWEEPS), ("beam", beam, HEIGHTS)):
            if name not in known:
                table.fail(f"{quoted(name)} is not one of {', '.join(known)}", index, column)
        found.setdefault((sweep, heights[beam]), []).append(index)
    return {key: T[rows] for key, rows in found.items()}


def _poses(path: Path, words: tuple[str, ...] = ()) -> tuple[Cells, Array]:
    """A table of flange poses with further columns of words, and T_base_flange (m, 4, 4)."""
    every = [name for names in ORIENTATIONS for name in names]
    required = (*words, *POSITION)

    def check(header: list[str], file: str) -> None:
        check_plain(header, file, required, every)
        if orientation_columns([name.strip() for name in header], file) is None:
            check_plain(header, file, (*required, *ORIENTATIONS[-1]), every)

    table = read_cells(path, check)
    kind = orientation_columns(list(table.columns), table.file)
    R = read_rotations(table, kind or ORIENTATIONS[-1])
    return table, frames.transform(R, _positions(table))


def _positions(table: Cells) -> Array:
    return 1e-3 * np.column_stack([table.numbers(name) for name in POSITION])


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

    Raises `InputError` when a name says neither circle nor plunge, or comes again after another
    step; `BeamError` when a beam chatters.
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


COVARIANCE_UNITS = ("m", "m", "m", "rad", "rad")


def laser_document(laser: LaserFrame) -> "LaserDocument":
    """Where two beams cross: origin, gap and angle; ``axes`` has x, y, z as rows, base."""
    T_base_laser = laser.T_base_laser
    return {
        "origin_mm": (T_base_laser[:3, 3] * 1e3).tolist(),
        "gap_mm": laser.gap_m * 1e3,
        "axes": T_base_laser[:3, :3].T.tolist(),
        "beam_angle_deg": float(np.degrees(laser.beam_angle_rad)),
    }


def circle_document(fit: CircleFit) -> "CircleDocument":
    """The tool's axis on one circle; what the method does not tell is null."""
    sigma = None if fit.covariance is None else np.sqrt(np.diag(fit.covariance)) * 1e3
    rho = None if fit.rho is None else fit.rho * 1e3
    words = f"the axis is at ({fit.centre[0] * 1e3:.3f}, {fit.centre[1] * 1e3:.3f}) mm"
    if sigma is not None:
        words += f", known to {float(sigma.max()):.4f} mm; edges within {fit.misfit_m * 1e3:.4f} mm"
    return {
        "method": fit.method,
        "center_mm": (fit.centre * 1e3).tolist(),
        "sigma_mm": None if sigma is None else sigma.tolist(),
        "tool_radius_mm": None if rho is None else {"x": float(rho[0]), "y": float(rho[1])},
        "latency_s": fit.latency_s,
        "misfit_mm": None if sigma is None else fit.misfit_m * 1e3,
        "verdict": verdict_document(Verdict(Code.ACCEPT, words)),
    }


def run_document(
    found: KnownTool, estimate: ToolEstimate, circles: Sequence[str], verdict: Verdict
) -> "FoundToolDocument":
    """A tool ``found`` by a whole run; ``circles``: names in the order of their radii.

    ``covariance`` (5, 5), SI: of the tip along the flange's x, y, z and of the axis' tilt along the
    tool's x and y; ``sigma_mm`` and ``sigma_deg`` are the roots of its diagonal.
    """
    covariance = estimate.covariance if found.covariance is None else found.covariance
    sigma = np.sqrt(np.diag(covariance))
    radii = zip(circles, (estimate.radius * 1e3).tolist(), strict=True)
    return {
        "method": "best",
        **_tool_part(found.T_flange_tool),
        "covariance": covariance.tolist(),
        "covariance_units": list(COVARIANCE_UNITS),
        "sigma_mm": (sigma[:3] * 1e3).tolist(),
        "sigma_deg": np.degrees(sigma[3:]).tolist(),
        "tool_radius_mm": [{"circle": name, "x": x, "y": y} for name, (x, y) in radii],
        "latency_s": estimate.latency_s,
        "latency_sigma_s": estimate.latency_sigma_s,
        "misfit_mm": estimate.misfit_m * 1e3,
        "shift_mm": estimate.shift_m * 1e3,
        "verdict": verdict_document(verdict),
    }


def classic_run_document(T_flange_tool: Array) -> "FoundToolDocument":
    """A tool by the classic method; what it does not tell is null."""
    words = "mid-times: no covariance, and biased for a thick tool; compare with method best"
    return {
        "method": "classic",
        **_tool_part(T_flange_tool),
        "covariance": None,
        "covariance_units": None,
        "sigma_mm": None,
        "sigma_deg": None,
        "tool_radius_mm": None,
        "latency_s": None,
        "latency_sigma_s": None,
        "misfit_mm": None,
        "shift_mm": None,
        "verdict": verdict_document(Verdict(Code.ACCEPT, words)),
    }


def parallel_document(axis: Array, tip: Array | None) -> "ParallelBeamsDocument":
    """A tool by parallel beams: turned from the flange's by the smallest angle; SI in, mm out."""
    words = "the straightened tool stands upright" if tip is not None else "the axis alone"
    T = frames.transform(first_rotation(axis), np.zeros(3) if tip is None else tip)
    return {
        **_tool_part(T),
        "tcp_mm": None if tip is None else (tip * 1e3).tolist(),
        "verdict": verdict_document(Verdict(Code.ACCEPT, words)),
    }


def _tool_part(T_flange_tool: Array) -> "ToolFrameDocument":
    return {
        "tcp_mm": (T_flange_tool[:3, 3] * 1e3).tolist(),
        "quat_xyzw": frames.quat_xyzw(T_flange_tool).tolist(),
        "axis": T_flange_tool[:3, 2].tolist(),
    }


def touch_document(fit: TouchFit) -> "TouchedToolDocument":
    """A touched tool; without an orientation its quaternion is null."""
    far = np.linalg.norm(fit.residual, axis=1)
    turn = None if fit.rotation is None else frames.transform(fit.rotation, np.zeros(3))
    return {
        "tcp_mm": (fit.tip * 1e3).tolist(),
        "quat_xyzw": None if turn is None else frames.quat_xyzw(turn).tolist(),
        "sigma_mm": (np.sqrt(np.diag(fit.covariance)) * 1e3).tolist(),
        "point_mm": (fit.point * 1e3).tolist(),
        "residual_mm": {"rms": fit.rms_m * 1e3, "max": float(far.max()) * 1e3},
        "touches": len(far),
        "verdict": verdict_document(fit.verdict),
    }


def check_document(check: QuickCheck, verdict: Verdict) -> Document:
    """The answer of a quick check; ``deviation_mm`` along the tool's axes."""
    tilt_deg = float(np.degrees(check.tilt_rad))
    return {
        "answer": check.answer,
        "deviation_mm": (check.deviation * 1e3).tolist(),
        "change": {"tip_mm": check.deviation_m * 1e3, "axis_deg": tilt_deg},
        "sigma_mm": check.sigma_m * 1e3,
        "misfit_mm": check.measured.misfit_m * 1e3,
        "verdict": verdict_document(verdict),
    }
