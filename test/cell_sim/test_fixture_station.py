# SPDX-License-Identifier: Apache-2.0
"""Where a scan of the simulated cell meets a feature: by its shape, whatever an estimator reads."""

from dataclasses import replace

import numpy as np
import pytest

from robocal_ros.cell_sim.faults import Faults
from robocal_ros.cell_sim.fixture import ASIDE_M, PLATE, T_FLANGE_SENSOR, FixtureStation
from robocal_ros.cell_sim.robot import Draws
from robocal_ros.fixture.features import Feature
from robocal_ros.ground import frames


class Misread(Feature):
    """As an estimator would have it to which no feature tells anything."""

    components = np.zeros((0, 3))


@pytest.mark.parametrize(("name", "free"), [("A1", 2), ("C1", 2), ("E1", 1), ("H1", 1), ("S1", 0)])
def test_a_scan_goes_astray_where_the_feature_does_not_show_it(name, free):
    features = tuple(Misread(f.name, f.kind, f.at, f.direction) for f in PLATE.features)
    station = FixtureStation(replace(PLATE, features=features), noise_m=0.0)
    T_base_flange, seen = station.pose(name), []
    for tick in range(40):
        shot = station.shoot(T_base_flange, tick, 0.0, Faults(seed=1), Draws(1))
        seen.append(frames.apply(T_base_flange @ T_FLANGE_SENSOR, shot.point))
    feature = PLATE.by_name[name]
    aside = frames.apply(frames.invert(PLATE.T_base_fixture), np.array(seen)) - feature.at
    spread_m = np.linalg.svd(aside / np.sqrt(len(aside)), compute_uv=False)
    assert np.all(spread_m[:free] > 0.3 * ASIDE_M)
    assert np.all(spread_m[free:] < 1e-9)
    if free:  # a plane's normal is where it does not go, an edge's or a hole's way where it does
        lengthwise_m = np.max(np.abs(aside @ feature.direction))
        assert (lengthwise_m < 1e-9) == (feature.kind == "plane")
