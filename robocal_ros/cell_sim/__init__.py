# SPDX-License-Identifier: Apache-2.0
"""The simulated cell: a true robot that drifts, and the sensor that watches it.

The truth here is another code path than the estimators' model (``kinematics``), and holds
effects that no estimator knows of; each can be switched off. All that comes from here is simulated
and must be labelled so.
"""
