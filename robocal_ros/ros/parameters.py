# SPDX-License-Identifier: Apache-2.0
"""Node parameters as a table: what each means, its unit, its bounds, when it may change."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import nearest
from robocal_ros.ground.samples import StandstillRule

QOS_OVERRIDES = "qos_overrides."  # of topics, which are declared with their endpoints
# Parameters that several nodes have, and what a launch file gives to all of its nodes: below /** of
# a parameter file they reach nodes that have no use for them.
SHARED = frozenset({
    "autostart", "base_frame", "beams", "deviation_deg", "deviation_mm", "edge_noise_mm",
    "flange_frame", "flange_radius_mm", "follow_joint_trajectory", "gap_bool", "gap_stale_s",
    "hard_stop_service",
    "housing_depth_mm", "housing_reach_mm", "housing_top_mm", "input_jitter_ms",
    "input_period_ms", "joint_acceleration_deg_s2", "joint_error_urad", "joint_gap_s",
    "joint_velocity_deg_s",
    "laser", "mandrel_length_mm", "mandrel_quat_xyzw", "mandrel_radius_mm", "mandrel_xyz_mm",
    "method", "motion_late_s", "motion_silence_s", "opening_radius_mm", "profile_frame",
    "repeatability_mm", "retract_mm", "robot", "security_dir", "seed", "sensor_frame", "serial",
    "standstill_after_s", "standstill_before_s", "standstill_tolerance_deg", "state_dir", "station",
    "stop_deceleration_deg_s2", "target", "taught_quat_xyzw", "taught_xyz_mm",
    "tcp_acceleration_mm_s2", "tcp_speed_mm_s", "tolerance_mm", "tool_frame", "tool_length_mm",
    "tool_radius_mm", "topics",
})  # fmt: skip
LAUNCH_WIDE = frozenset({"robot_description", "robot_description_semantic"})


Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]


@dataclass(frozen=True)
class Setting:
    """One parameter."""

    # name, default, description: the type is the default's. An optional list of strings has the
    # default ``[""]`` (ROS has no typed empty list); empty strings are dropped when read.
    name: str
    default: Value
    description: str
    unit: str = ""  # "" when it has none
    # low, high: inclusive bounds of a number, or of each number of a list
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()  # the allowed strings
    # says what is wrong with a value of the right type and within the bounds, or None
    check: Callable[[Any], str | None] | None = None
    live: bool = False  # may change at any time; others only while the node is unconfigured
    advanced: bool = False  # a constant of the method: not in the node's file, but on its page

    def accept(self, value: object) -> Value:
        """Return ``value`` as this parameter's type.

        Raises `InputError` when the type is wrong, a number is out of bounds or not finite, or a
        check fails.
        """
        typed = _typed(value, self.default)
        if typed is None:
            names = {bool: "true or false", int: "a whole number", float: "a number", str: "text"}
            many = isinstance(self.default, list)
            wanted = names[
                type(self.default[0] if isinstance(self.default, list) else self.default)
            ]
            raise InputError(f"{self.name} = {value!r} is not {'a list, each ' * many}{wanted}")
        for item in typed if isinstance(typed, list) else [typed]:
            if isinstance(item, float) and not math.isfinite(item):
                raise InputError(f"{self.name} = {item} is not finite")
            if isinstance(item, str):
                if self.choices and item not in self.choices:
                    raise InputError(
                        f"{self.name} = '{item}' is not one of {', '.join(self.choices)}"
                    )
            elif (self.low is not None and item < self.low) or (
                self.high is not None and item > self.high
            ):
                raise InputError(f"{self.name} = {item:g} is out of bounds: {self.bounds}")
        fault = self.check(typed) if self.check else None
        if fault:
            raise InputError(f"{self.name} = {value!r}: {fault}")
        return typed

    @property
    def bounds(self) -> str:
        """The allowed values in words."""
        if self.choices:
            return "one of " + ", ".join(choice or "nothing" for choice in self.choices)
        low = "" if self.low is None else f"at least {self.low:g}"
        high = "" if self.high is None else f"at most {self.high:g}"
        limits = " and ".join(part for part in (low, high) if part)
        return f"{limits} {self.unit}".strip() if limits else ""

    def descriptor(self) -> ParameterDescriptor:
        """Describe the parameter to ``ros2 param describe`` and to graphical tools."""
        when = "may change at any time" if self.live else "may change while unconfigured"
        unit = f" [{self.unit}]" if self.unit else ""
        descriptor = ParameterDescriptor(
            description="advanced: " * self.advanced + self.description + unit,
            additional_constraints="; ".join(part for part in (self.bounds, when) if part),
        )
        if self.low is not None and self.high is not None:
            if isinstance(self.default, float):
                limits = FloatingPointRange(from_value=float(self.low), to_value=float(self.high))
                descriptor.floating_point_range = [limits]
            elif isinstance(self.default, int):
                whole = IntegerRange(from_value=int(self.low), to_value=int(self.high), step=1)
                descriptor.integer_range = [whole]
        return descriptor


def _typed(value: object, like: Value) -> Value | None:
    """Return value in the type of ``like``; a whole number may stand for a float."""
    if isinstance(like, list):
        if isinstance(value, str | bytes) or not hasattr(value, "__iter__"):
            return None
        items = [_typed(item, like[0]) for item in value]
        return None if any(item is None for item in items) else items  # type: ignore[return-value]
    if isinstance(like, float) and type(value) is int:
        return float(value)
    return value if type(value) is type(like) else None


UNITS = {
    "deg_s2": "deg/s^2", "mm_s2": "mm/s^2", "deg_s": "deg/s", "mm_s": "mm/s", "deg": "deg",
    "mm": "mm", "ms": "ms", "hz": "Hz", "mb": "MB", "s": "s",
}  # fmt: skip


def number(name: str, default: Value, what: str, low: float, high: float, **more: Any) -> Setting:
    """A number, or a list of them, within bounds; the end of its name says its unit."""
    unit = next((unit for end, unit in UNITS.items() if name.endswith(f"_{end}")), "")
    return Setting(name, default, what, unit, low, high, **more)


def advanced(*settings: Setting) -> tuple[Setting, ...]:
    """Constants of a method, which a cell need not think about."""
    return tuple(replace(setting, advanced=True) for setting in settings)


class ParameterTable:
    """The declared parameters of one node.

    A bad value given at the start does not stop the process: the default is declared in its
    place, and `read` names the fault until the parameter is set to something valid. A name that is
    given and is none of the node's is a fault too, which only a new start mends: rclpy itself drops
    it unsaid, and a misspelt limit would be the default.
    """

    def __init__(self, node: Node, settings: Sequence[Setting]) -> None:
        self._node = node
        self._settings = {setting.name: setting for setting in settings}
        self._faults: dict[str, str] = {}
        self.locked = False
        self.changed: Callable[[], None] | None = None
        for setting in settings:
            self._declare(setting)
        self._unknown = [
            f"{name} is no parameter of this node{nearest(name, self._settings)}: correct it, or "
            "give it in the section of the node that has it, and start the node anew"
            for name in node._parameter_overrides
            if not (name.startswith(QOS_OVERRIDES) or node.has_parameter(name))
            and name not in SHARED | LAUNCH_WIDE
        ]
        node.add_on_set_parameters_callback(self._validate)
        node.add_post_set_parameters_callback(self._after_set)

    def _declare(self, setting: Setting) -> None:
        # Declared without a type first, to see what was given before rclpy judges it.
        given = self._node.declare_parameter(
            setting.name, setting.default, ParameterDescriptor(dynamic_typing=True)
        ).value
        self._node.undeclare_parameter(setting.name)
        try:
            value = setting.accept(given)
        except InputError as error:
            self._faults[setting.name] = str(error)
            value = setting.default
        self._node.declare_parameter(
            setting.name, value, setting.descriptor(), ignore_override=True
        )

    def read(self) -> dict[str, Any]:
        """Return every value by name.

        Raises `InputError` when a parameter was given a bad value at the start, or is none of this
        node; names all of them.
        """
        faults = [*self._faults.values(), *self._unknown]
        if faults:
            raise InputError("; ".join(faults))
        values = {name: self._node.get_parameter(name).value for name in self._settings}
        for name, value in values.items():
            if hasattr(value, "__iter__") and not isinstance(value, str):
                values[name] = [item for item in value if item != ""]
        return values

    def _validate(self, parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            setting = self._settings.get(parameter.name)
            if setting is None:
                continue
            if self.locked and not setting.live:
                reason = f"{setting.name} may change only while the node is unconfigured"
                return SetParametersResult(successful=False, reason=reason)
            try:
                setting.accept(parameter.value)
            except InputError as error:
                return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _after_set(self, parameters: list[Parameter]) -> None:
        ours = [parameter.name for parameter in parameters if parameter.name in self._settings]
        for name in ours:
            self._faults.pop(name, None)
        if ours and self.locked and self.changed is not None:
            self.changed()


ROBOT = Setting(
    "robot",
    "",
    "Robot type (config/robots) or path of a robot file; empty: that of robot_description on the "
    "graph, which is waited for",
)
BASE_FRAME = Setting(
    "base_frame",
    "base",
    "Name of the robot's base frame; not in robot_description: its root",
)
FLANGE_FRAME = Setting(
    "flange_frame",
    "tool0",
    "Name of the flange frame, which is never modified; where robot_description has none, its "
    "'flange' or only last link",
)
ROBOT_SETTINGS = (ROBOT, BASE_FRAME, FLANGE_FRAME)
ORIGIN, UNTURNED = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]


def count_fault(length: int) -> Callable[[list[float]], str | None]:
    """A check that a list has so many numbers."""
    return lambda values: None if len(values) == length else f"{length} numbers are wanted"


def pose_settings(name: str, place: str, turn: str) -> tuple[Setting, Setting]:
    """``<name>_xyz_mm`` and ``<name>_quat_xyzw`` with their descriptions."""
    return (
        Setting(f"{name}_xyz_mm", ORIGIN, place, "mm", -5000.0, 5000.0, check=count_fault(3)),
        Setting(f"{name}_quat_xyzw", UNTURNED, turn, low=-1.0, high=1.0, check=count_fault(4)),
    )


def given_pose(settings: Mapping[str, Any], name: str) -> NDArray[np.float64] | None:
    """The pose (4, 4), m; None where both parameters are at their default.

    Raises `InputError` when the quaternion is not of unit length.
    """
    xyz_mm, quat = settings[f"{name}_xyz_mm"], settings[f"{name}_quat_xyzw"]
    if xyz_mm == ORIGIN and quat == UNTURNED:
        return None
    norm = float(np.linalg.norm(quat))
    if abs(norm - 1.0) > 1e-3:
        raise InputError(f"{name}_quat_xyzw has length {norm:.6g}, not 1")
    return frames.transform_from_quat(1e-3 * np.array(xyz_mm), np.array(quat) / norm)


STANDSTILL = (
    number(
        "standstill_before_s",
        0.3,
        "The robot stands still so long before a measurement's stamp",
        0.0,
        10.0,
    ),
    number("standstill_after_s", 0.1, "It stands still so long after the stamp", 0.0, 10.0),
    number(
        "standstill_tolerance_deg", 0.02, "Largest range of a joint that stands still", 1e-4, 5.0
    ),
    number(
        "joint_gap_s",
        0.25,
        "Longest pause between two joint readings about a measurement",
        1e-3,
        10.0,
    ),
)


def standstill_rule(settings: Mapping[str, Any]) -> StandstillRule:
    """The rule that they say."""
    return StandstillRule(
        before_s=settings["standstill_before_s"],
        after_s=settings["standstill_after_s"],
        tolerance_rad=float(np.radians(settings["standstill_tolerance_deg"])),
        gap_s=settings["joint_gap_s"],
    )
