"""The named QoS profiles of all nodes, and the policies that a user may override."""

from copy import copy

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions


def _profile(
    depth: int,
    reliability: ReliabilityPolicy,
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=reliability,
        durability=durability,
    )


LATCHED = _profile(1, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
"""Results and states: a late subscriber gets the last one."""

SENSOR = _profile(100, ReliabilityPolicy.BEST_EFFORT)
"""Sensor streams. Deep enough for stalls of 10 to 30 ms at 1 kHz."""

RELIABLE = _profile(100, ReliabilityPolicy.RELIABLE)
"""Commands and events, where none may be lost."""

HEARTBEAT = _profile(1, ReliabilityPolicy.RELIABLE)
"""What holds for a short time only: an older one that still waits says nothing."""

NEWEST = _profile(1, ReliabilityPolicy.BEST_EFFORT)
"""States of others of which only the newest says something."""

STREAM = _profile(1000, ReliabilityPolicy.BEST_EFFORT)
"""What a session is computed from: deep enough for the seconds that a large solution takes."""


def own(profile: QoSProfile) -> QoSProfile:
    """Return a copy, because overrides are written into the profile that an entity is given."""
    return copy(profile)


def overridable() -> QoSOverridingOptions:
    """Let a user set history, depth and reliability (parameters ``qos_overrides.<topic>.…``)."""
    return QoSOverridingOptions.with_default_policies()
