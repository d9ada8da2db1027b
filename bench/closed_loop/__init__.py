# SPDX-License-Identifier: Apache-2.0
"""A cell that keeps itself accurate for a shift: simulated cell and sessions in one process.

setting      settings of the sessions, as a configured cell has them
suite        the sessions, joined as the nodes join them
carrying     what the maintenance asks of them
words        what they tell each other
plant        robot, PLC and suite on one clock: commissioning, gaps, production
shift        the golden shift and shorter ones, and what came of them
trials       many shifts on all cores; those that begin alike begin once
judging      how accurate that was, against the same shift without the suite
earlier      shifts at the pace of the cycles, and what they teach
drift_bound  what the stated bound of the drift is made of
faults       what each fault costs, and from which size on it is reported
checks       the tool's check alone, with faults of many sizes
knocks       what a knock of station, sensor or sphere costs, in many cells
tables       all of it as the tables of the bench
"""
