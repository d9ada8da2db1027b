# SPDX-License-Identifier: Apache-2.0
"""Kinematics against the definition, against numeric derivatives and against known poses."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_arms import arms, twist
from hypothesis import given, settings
from hypothesis import strategies as st

from robocal_ros.ground import frames
from robocal_ros.kinematics import ParameterSet, SerialArm, kernels
from robocal_ros.kinematics.arm import ALPHA, BETA, random_postures
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.universal_robots import (
    factory_arm,
    factory_dh,
    hayati_from_dh,
    nominal_arm,
    parse_settings,
)

# the sliding arm's limits depend on what was bought
pytestmark = pytest.mark.filterwarnings("ignore:.*joint limits not given")

SHIPPED = ("bx200l", "kr150_r3100", "ur10", "p1r2p3")
SIX_AXES = ("bx200l", "kr150_r3100", "ur10")
EXACT_M = 1e-12  # 1e-9 mm

STANDARD = ("d", "theta", "a", "alpha")
PARALLEL = ("beta", "theta", "a", "alpha")


def names_of(rows: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    unit = {"d": "mm", "a": "mm", "theta": "deg", "alpha": "deg", "beta": "deg"}
    return tuple(f"{p}{i}_{unit[p]}" for i, row in enumerate(rows, start=1) for p in row)


def by_definition(arm: SerialArm, q: np.ndarray) -> np.ndarray:
    """Trans(z, d) Rot(z, theta) Trans(x, a) Rot(x, alpha) Rot(y, beta), factor by factor."""

    def about(axis: int, angle: float) -> np.ndarray:
        return frames.transform(frames.exp_rotation(angle * np.eye(3)[axis]), np.zeros(3))

    def along(axis: int, distance: float) -> np.ndarray:
        return frames.transform(np.eye(3), distance * np.eye(3)[axis])

    T = arm.T_base_root
    for i, (d, theta, a, alpha, beta) in enumerate(arm.mdh):
        moved = arm.sign[i] * q[i]
        d, theta = (d + moved, theta) if arm.prismatic[i] else (d, theta + moved)
        T = T @ along(2, d) @ about(2, theta) @ along(0, a) @ about(0, alpha) @ about(1, beta)
    return T


# ---- Known poses ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "q_deg", "flange_mm"),
    [
        ("bx200l", (90, 0, 0, 0, 0, 0), (1675.0, 0.0, 1920.0)),
        ("kr150_r3100", (0, -90, 90, 0, 0, 0), (1965.0, 0.0, 1984.0)),
        ("ur10", (0, 0, 0, 0, 0, 0), (-1184.3, -256.141, 11.6)),
    ],
)
def test_check_points(robot, q_deg, flange_mm):
    flange = load_robot(robot).fk(np.radians(q_deg))[:3, 3]
    np.testing.assert_allclose(flange, np.array(flange_mm) * 1e-3, rtol=0.0, atol=EXACT_M)


def test_sliding_arm_by_hand():
    """P1 lifts, R2 turns, P3 reaches out horizontally at right angles to the turned x axis."""
    arm = load_robot("p1r2p3")
    lift, turn, reach = 0.3, 0.7, 0.25
    out = reach + arm.mdh[2, 0]
    up = lift + arm.mdh[0, 0] + arm.mdh[1, 0]
    flange = arm.fk([lift, turn, reach])[:3, 3]
    np.testing.assert_allclose(
        flange, [out * np.sin(turn), -out * np.cos(turn), up], rtol=0.0, atol=EXACT_M
    )


def test_real_bx200l_is_millimetres_off_its_nominal_model():
    """What the unit's controller reported at the check point; it holds a calibrated model."""
    flange = load_robot("bx200l").fk(np.radians([90, 0, 0, 0, 0, 0]))[:3, 3]
    reported = np.array([1675.749, -0.650, 1918.024]) * 1e-3
    assert 1e-3 < np.linalg.norm(flange - reported) < 3e-3


# ---- Definition and derivatives ------------------------------------------------------------------


@given(arms())
@settings(max_examples=60, deadline=None)
def test_forward_kinematics_is_the_definition(case):
    arm, q = case
    np.testing.assert_allclose(arm.fk(q), by_definition(arm, q), rtol=0.0, atol=1e-13 * arm.n * 10)


@given(arms())
@settings(max_examples=60, deadline=None)
def test_jacobian_is_the_derivative(case):
    """Central differences: error h^2/6 times third derivatives (some metres), plus eps/h."""
    arm, q = case
    h, J = 1e-5, arm.jacobian(q)
    for i in range(arm.n):
        step = h * np.eye(arm.n)[i]
        numeric = twist(arm.fk(q - step), arm.fk(q + step)) / (2.0 * h)
        np.testing.assert_allclose(J[:, i], numeric, rtol=0.0, atol=2e-9)


@given(arms())
@settings(max_examples=60, deadline=None)
def test_parameter_jacobian_is_the_derivative(case):
    arm, q = case
    h, p = 1e-5, np.array([0.1, -0.05, 0.2])
    J, chosen = arm.parameter_jacobian(q, p), arm.parameters
    tool = frames.transform(np.eye(3), p)
    for k in range(len(chosen)):
        step = h * np.eye(len(chosen))[k]
        before, after = (arm.with_mdh(chosen.add(arm.mdh, s)).fk(q) @ tool for s in (-step, step))
        np.testing.assert_allclose(J[:, k], twist(before, after) / (2.0 * h), rtol=0.0, atol=2e-9)


@pytest.mark.parametrize("size", [1e-8, 1.0, 10.0, 1e4, 1e6, 1e9])
def test_sines_are_right_to_two_ulp(size):
    """Also beyond 1e6 rad, where libm takes over, and at the multiples of a quarter turn."""
    flat = SerialArm(
        "flat", ("j",), np.zeros((1, 5)), np.ones(1), np.zeros(1, dtype=bool), np.full(1, -np.inf),
        np.full(1, np.inf),
    )  # fmt: skip
    angle = np.random.default_rng(6).uniform(-size, size, 5000)
    quarters = np.arange(-40, 41) * (np.pi / 2.0)
    for q in (angle, quarters, np.nextafter(quarters, 100.0), np.array([0.0, -0.0])):
        T = flat.fk(q[:, None])
        np.testing.assert_array_max_ulp(T[:, 1, 0], np.sin(q), maxulp=2)
        np.testing.assert_array_max_ulp(T[:, 0, 0], np.cos(q), maxulp=2)
    assert np.isnan(flat.fk([np.nan])).any()


# ---- Shapes and frames ---------------------------------------------------------------------------


@pytest.mark.parametrize("robot", SHIPPED)
def test_batch_equals_single(robot):
    """To the last bit: a result must not depend on what else was asked."""
    arm = load_robot(robot)
    q = np.random.default_rng(1).uniform(-1.0, 1.0, (3, 4, arm.n))
    T, J, P = arm.fk(q), arm.jacobian(q), arm.parameter_jacobian(q)
    assert T.shape == (3, 4, 4, 4)
    assert J.shape == (3, 4, 6, arm.n)
    assert P.shape == (3, 4, 6, len(arm.parameters))
    for i, j in np.ndindex(3, 4):
        assert np.array_equal(T[i, j], arm.fk(q[i, j]))
        assert np.array_equal(J[i, j], arm.jacobian(q[i, j]))
        assert np.array_equal(P[i, j], arm.parameter_jacobian(q[i, j]))


def test_no_poses_give_no_results():
    arm = load_robot("ur10")
    assert arm.fk(np.empty((0, 6))).shape == (0, 4, 4)
    assert arm.jacobian(np.empty((0, 6))).shape == (0, 6, 6)


@pytest.mark.parametrize("shape", [(), (5,), (2, 7), (6, 1)])
def test_wrong_number_of_joints(shape):
    with pytest.raises(ValueError, match="expected"):
        load_robot("ur10").fk(np.zeros(shape))


def test_base_moves_everything_and_tool_nothing():
    arm, q = load_robot("kr150_r3100"), np.array([0.3, -1.2, 1.0, 0.4, -0.6, 0.2])
    T_base = frames.transform(frames.exp_rotation([0.1, 0.2, -0.3]), [1.0, -2.0, 0.5])
    moved = replace(arm, T_base_root=T_base)
    tooled = replace(arm, T_flange_tool=T_base)
    np.testing.assert_allclose(moved.fk(q), T_base @ arm.fk(q), rtol=0.0, atol=1e-14)
    turned = np.kron(np.eye(2), T_base[:3, :3]) @ arm.jacobian(q)
    np.testing.assert_allclose(moved.jacobian(q), turned, rtol=0.0, atol=1e-14)
    assert np.array_equal(tooled.fk(q), arm.fk(q))


def test_a_model_cannot_be_changed_in_place():
    arm = load_robot("ur10")
    with pytest.raises(ValueError, match="read-only"):
        arm.mdh[0, 0] = 1.0


@pytest.mark.parametrize(
    "wrong",
    [
        {"mdh": np.zeros((6, 4))},
        {"mdh": np.full((6, 5), np.nan)},
        {"sign": np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.5])},
        {"T_base_root": np.eye(3)},
    ],
    ids=["shape", "nan", "sign", "root"],
)
def test_wrong_models_are_refused(wrong):
    with pytest.raises(ValueError, match=r"sign \+1 or -1|has shape"):
        replace(load_robot("ur10"), **wrong)


def test_postures_lie_within_a_limit_whose_other_side_is_open():
    lower, upper = np.array([0.6, 4.0, -np.inf]), np.array([np.inf, np.inf, -0.6])  # m, rad, m
    q = random_postures(replace(load_robot("p1r2p3"), lower=lower, upper=upper))
    assert np.all((lower <= q) & (q <= upper))
    np.testing.assert_array_less([0.4, 2.5, 0.4], np.ptp(q, axis=0))


# ---- Identity of a model -------------------------------------------------------------------------


def test_hash_tells_models_apart_and_nothing_else():
    arm = load_robot("kr150_r3100")
    same = [
        load_robot("kr150_r3100"),
        replace(arm, name="another name"),
        replace(arm, lower=arm.lower - 1.0, T_flange_tool=np.diag([-1.0, -1.0, 1.0, 1.0])),
        replace(arm, mdh=arm.mdh + 1e-12),
        replace(arm, mdh=np.where(arm.mdh == 0.0, -0.0, arm.mdh)),
    ]
    assert {other.model_hash for other in same} == {arm.model_hash}
    names = ("base_joint", *arm.joint_names[1:])
    root = frames.transform(np.eye(3), [0.0, 0.0, 1e-6])
    different = [
        *(arm.with_mdh(arm.mdh + 1e-6 * np.eye(30)[i].reshape(6, 5)) for i in range(30)),
        *(replace(arm, sign=arm.sign * (1 - 2 * np.eye(6)[i])) for i in range(6)),
        *(replace(arm, prismatic=np.eye(6, dtype=bool)[i]) for i in range(6)),
        replace(arm, joint_names=names),
        replace(arm, T_base_root=root),
    ]
    assert len({other.model_hash for other in [arm, *different]}) == 1 + len(different)


def test_hash_never_changes():
    """Histories on disk name models by it."""
    arm = SerialArm(
        "any", ("j1", "j2"), np.arange(10.0).reshape(2, 5) / 7.0, np.array([1.0, -1.0]),
        np.array([False, True]), np.full(2, -np.inf), np.full(2, np.inf),
    )  # fmt: skip
    assert arm.model_hash == "013c4bb4b3077738"


# ---- Free parameters -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "expected"),
    [
        ("bx200l", (STANDARD, PARALLEL, STANDARD, STANDARD, STANDARD, STANDARD)),
        ("kr150_r3100", (STANDARD, PARALLEL, STANDARD, STANDARD, STANDARD, STANDARD)),
        ("ur10", (STANDARD, PARALLEL, PARALLEL, STANDARD, STANDARD, STANDARD)),
        # R2's zero turns what P1's does, and P3 does not turn: a3 shifts what a2 does
        ("p1r2p3", (PARALLEL, ("d", "a", "alpha"), ("d", "theta", "alpha"))),
    ],
)
def test_free_parameters(robot, expected):
    assert load_robot(robot).parameters.names == names_of(expected)


@pytest.mark.parametrize("robot", SHIPPED)
def test_free_parameters_are_independent_and_complete(robot):
    """Every change of the five parameters of every joint is a change of the free ones.

    Only beta of the last joint is left out: it turns the flange itself, which is how the flange
    is defined, as the tool is.
    """
    arm = load_robot(robot)
    q = np.random.default_rng(2).uniform(-2.0, 2.0, (50, arm.n))

    def columns(chosen: ParameterSet) -> np.ndarray:
        T, J = np.empty((50, 4, 4)), np.zeros((50, 6, len(chosen)))
        zero, none = np.zeros(50, dtype=np.int64), np.array([-1], dtype=np.int64)
        kernels.parameter_batch(
            q, arm.links, arm.T_base_root, np.eye(4)[None], zero, chosen.slots(arm.n),
            -1, none, T, J,
        )  # fmt: skip
        return J.reshape(300, -1)

    every = [(i, c) for i in range(arm.n) for c in range(5) if (i, c) != (arm.n - 1, BETA)]
    free = arm.parameters
    assert np.linalg.matrix_rank(columns(free), tol=1e-9) == len(free)
    assert np.linalg.matrix_rank(columns(ParameterSet(tuple(every))), tol=1e-9) == len(free)


def test_free_parameters_stay_those_of_the_nominal_model():
    """An identified model is no longer exactly parallel; its parameters are the same ones."""
    arm = load_robot("ur10")
    tilted = arm.mdh.copy()
    tilted[1, ALPHA] += np.radians(10.0)
    assert arm.with_mdh(tilted).parameters == arm.parameters
    assert replace(arm, mdh=tilted).parameters != arm.parameters


def test_parameter_choice():
    chosen = load_robot("ur10").parameters
    part = chosen.subset(("a3_mm", "theta1_deg"))
    assert part.names == ("theta1_deg", "a3_mm")
    assert part.to_display == pytest.approx([np.degrees(1.0), 1e3])
    mdh = part.add(np.zeros((6, 5)), np.array([0.1, 0.2]))
    assert part.read(mdh) == pytest.approx([0.1, 0.2])
    assert np.count_nonzero(mdh) == 2
    with pytest.raises(ValueError, match=r"unknown parameter 'd2_mm'.*beta2_deg"):
        chosen.subset(("d2_mm",))


# ---- Universal Robots factory calibration --------------------------------------------------------


@pytest.fixture(scope="module")
def factory_files(data_dir) -> tuple[dict, dict]:
    folder = data_dir / "ur5e_factory"
    files = ("urcontrol.conf.UR5", "calibration.conf")
    nominal, delta = (parse_settings((folder / f).read_text(), f) for f in files)
    return nominal, delta


def plain_dh_arm(nominal: dict, delta: dict) -> SerialArm:
    return replace(nominal_arm(nominal, "plain"), mdh=factory_dh(nominal, delta))


@pytest.mark.data
def test_factory_import_keeps_every_pose(factory_files):
    """To 1 nm, although the factory's own numbers go through 200 m: eps times that is 0.05 nm."""
    plain, hayati = plain_dh_arm(*factory_files), factory_arm(*factory_files, "ur5e")
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (2000, 6))
    before, after = plain.fk(q), hayati.fk(q)
    assert np.abs(before[:, :3, 3] - after[:, :3, 3]).max() < 1e-9
    assert np.abs(before[:, :3, :3] - after[:, :3, :3]).max() < 1e-9


@pytest.mark.data
def test_factory_import_has_no_huge_offsets(factory_files):
    nominal, hayati = nominal_arm(factory_files[0], "ur5e"), factory_arm(*factory_files, "ur5e")
    away = hayati.mdh - nominal.mdh
    assert np.abs(away[:, [0, 2]]).max() < 5e-3
    assert np.abs(away[:, [1, 3, 4]]).max() < np.radians(1.5)
    assert np.all(hayati.mdh[~np.isin(np.arange(6), [1, 2]), BETA] == 0.0)


@pytest.mark.data
def test_factory_import_reproduces_the_controllers_poses(factory_files, data_dir):
    table = np.loadtxt(data_dir / "ur5e_factory/joint-eef-data.csv", delimiter=",", skiprows=1)
    q, position = np.radians(table[:, :6]), table[:, 6:9] * 1e-3
    error = {}
    for name, arm in (
        ("nominal", nominal_arm(factory_files[0], "ur5e")),
        ("factory", factory_arm(*factory_files, "ur5e")),
    ):
        error[name] = 1e3 * np.linalg.norm(arm.fk(q)[:, :3, 3] - position, axis=1)
    assert len(q) == 18
    assert error["nominal"].mean() == pytest.approx(1.081, abs=5e-4)
    assert error["factory"].mean() <= 0.0445
    assert error["factory"].max() <= 0.081


@given(st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_hayati_form_of_any_nearly_parallel_arm(seed):
    """Also without the real file: random small tilts, which put plain DH metres away."""
    rng = np.random.default_rng(seed)
    nominal = load_robot("ur10")
    dh = nominal.mdh.copy()
    dh[:, :4] += rng.normal(size=(6, 4)) * [1e-3, 1e-2, 1e-3, 3e-3]
    dh[1:3, 0] += rng.uniform(-50.0, 50.0, 2)
    hayati = hayati_from_dh(dh, nominal.mdh)
    q = rng.uniform(-np.pi, np.pi, (20, 6))
    before, after = replace(nominal, mdh=dh).fk(q), replace(nominal, mdh=hayati).fk(q)
    np.testing.assert_allclose(after, before, rtol=0.0, atol=1e-9)
    assert np.all(hayati[1:3, 0] == 0.0)
