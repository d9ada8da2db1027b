# SPDX-License-Identifier: Apache-2.0
"""The maintenance of a cell in its production gaps.

session          what is driven: heartbeats, readings, calls and answers in, requests out
cycle            the script of a run: thermal measurement, tool, decisions, fixture
thermal_part,
fixture_part     the poses that these visit, over several gaps
robot_interface  what a script does with robot and nodes, and the requests to them
mover            the ways that the robot may take, one supervised motion at a time
deciding         accept, reject, roll back; what needs no person
accuracy         settings, what outlives a restart, the accuracy of the cell
services, node   parameters, services and messages; the node and its clients
"""
