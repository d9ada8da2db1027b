# SPDX-License-Identifier: Apache-2.0
"""The cell that most tests of the maintenance begin with."""

import pytest
from maintenance_cell import Cell, opened


@pytest.fixture
def cell(history) -> Cell:
    """In an open gap, after what every start does."""
    return opened(history)
