# SPDX-License-Identifier: Apache-2.0
"""Two robots do not share a serial: the second node of a kind refuses to work."""

import os

import pytest
from diagnostic_msgs.msg import DiagnosticArray

from robocal_ros.maintenance.node import MaintenanceNode
from robocal_ros.thermal.node import ThermalNode


@pytest.mark.parametrize("node_class", [ThermalNode, MaintenanceNode])
def test_the_second_of_a_kind_is_refused(graph, node_class):
    values = {} if node_class is ThermalNode else {"home_deg": [0.0, -90.0, 90.0, 0.0, 90.0, 0.0]}
    left = graph.add(node_class, values, namespace="left")
    assert left.is_active
    said = graph.collect(DiagnosticArray, "/diagnostics")
    right = graph.add(node_class, values, namespace="right")
    assert not right.is_active
    why = (
        f"another {node_class.NAME} (process {os.getpid()}) keeps the calibrations of robot 'unset'"
    )
    graph.spin_until(
        lambda: any(why in status.message for array in said for status in array.status),
        "it says why",
    )
    other = graph.add(node_class, values | {"serial": "K8"}, namespace="other")
    assert other.is_active
    left.trigger_deactivate()
    left.trigger_cleanup()
    right.autostart()
    assert right.is_active
