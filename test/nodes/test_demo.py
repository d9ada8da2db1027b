"""The whole demo: a PLC bridge drives a cell of six processes by service calls alone."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from robocal_ros.storage.bags import BagReader

ROOT = Path(__file__).parent.parent.parent
LONGEST_S = 170.0
WITHIN_MM = 0.3  # recovered: docs/cell.md
BENT_MM = 2.0
DRIFTED_MM = 0.08  # three hours of work: the published drift, 0.1 mm in half of all coordinates
