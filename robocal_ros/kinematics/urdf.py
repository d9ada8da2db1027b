# SPDX-License-Identifier: Apache-2.0
"""Robots as URDF describes them: an arm in Hayati's form from one, and an arm put into one.

A URDF gives each joint's axis where its link stands at zero; the lines of these axes and the pose
of the flange at zero are the whole of a serial arm's kinematics (Brockett 1984). Hayati's
parameters (Hayati 1983) are read off from line to line, exactly.
"""

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import reduce
from pathlib import Path

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import (
    Array,
    apart,
    exp_rotation,
    invert,
    rotation_from_rpy,
    rpy,
    skew,
    transform,
)
from robocal_ros.kinematics.arm import NEARLY_PARALLEL, SerialArm
from robocal_ros.kinematics.joint_functions import ArmLoad
from robocal_ros.kinematics.robots import FULL_SPEED_IN_S, RobotDescription, text_hash
from robocal_ros.kinematics.universal_robots import JOINT_NAMES, link_transform, parallel_row

MOVING = ("revolute", "continuous", "prismatic")
BASES, TIPS = ("base",), ("tool0", "flange")  # of REP-199, which industrial robots have
SAME_POSE = 1e-8  # m and rad; what differs by more is another flange
SAME_LINE_M = 1e-9
UNLIMITED_M = 1e3
_PARALLEL = 1e-7  # of two axes that are parallel but for the digits of a URDF


@dataclass(frozen=True, eq=False)
class UrdfJoint:
    """A joint: ``T_parent_child`` (4, 4) at zero, ``axis`` (3,) of unit length in the child.

    ``lower``, ``upper``, ``velocity``: SI; infinite or NaN where it gives none.
    """

    name: str
    kind: str
    parent: str
    child: str
    T_parent_child: Array
    axis: Array
    lower: float
    upper: float
    velocity: float

    @property
    def moves(self) -> bool:
        """Whether the joint moves its child."""
        return self.kind in MOVING


@dataclass(frozen=True, eq=False)
class Urdf:
    """A robot description: joints by their child link; mass (kg) and its centre (3,) of links."""

    name: str
    file: str
    root: str
    joints: dict[str, UrdfJoint]
    masses: dict[str, tuple[float, Array]]

    @property
    def links(self) -> list[str]:
        """Names of the links."""
        return [self.root, *self.joints]

    def way(self, link: str) -> list[UrdfJoint]:
        """Joints from the root to a link.

        Raises `InputError` when there is no such link.
        """
        if link not in self.links:
            raise InputError(
                f"has no link '{link}'; it has {', '.join(self.links)}", file=self.file
            )
        found: list[UrdfJoint] = []
        while link != self.root:
            found.append(self.joints[link])
            link = self.joints[link].parent
        return found[::-1]


@dataclass(frozen=True, eq=False)
class Chain:
    """The way from a base to a flange.

    ``T_base_root``: (4, 4) of the description's root link. ``joints``: from the root to the tip.
    """

    urdf: Urdf
    base: str
    tip: str
    T_base_root: Array
    joints: tuple[UrdfJoint, ...]

    @property
    def at_zero(self) -> list[Array]:
        """Pose (4, 4) of each joint's child link in the base, with all joints at zero."""
        poses, T = [], self.T_base_root
        for joint in self.joints:
            T = T @ joint.T_parent_child
            poses.append(T)
        return poses

    @property
    def moving(self) -> list[UrdfJoint]:
        """Joints that move."""
        return [joint for joint in self.joints if joint.moves]

    def frames(self, q: Array) -> list[Array]:
        """Poses (4, 4) in the base at joints (n,), joint by joint as a URDF says it.

        Of each link that a joint moves, before it does, and of the tip.
        """
        T, values, found = self.T_base_root, iter(q), []
        for joint in self.joints:
            T = T @ joint.T_parent_child
            if joint.moves:
                found.append(T)
                moved = joint.axis * next(values)
                slides = joint.kind == "prismatic"
                step = (np.eye(3), moved) if slides else (exp_rotation(moved), np.zeros(3))
                T = T @ transform(*step)
        return [*found, T]

    def fk(self, q: Array) -> Array:
        """Pose (4, 4) of the tip in the base at joints (n,)."""
        return self.frames(q)[-1]


def read_urdf(text: str, file: str) -> Urdf:
    """Read a robot description.

    Raises `InputError`, naming file and joint, when it is no URDF or a number cannot be read.
    """
    try:
        top = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise InputError(f"is no XML: {error}", file=file) from error
    if top.tag != "robot":
        raise InputError(f"is no URDF: its element is '{top.tag}', not 'robot'", file=file)
    if any("xacro" in element.tag for element in top.iter()):
        raise InputError("is a xacro: expand it with 'xacro FILE > robot.urdf'", file=file)
    found = [_joint(element, file) for element in top.findall("joint")]
    joints = {joint.child: joint for joint in found}
    links = {str(element.get("name")): element for element in top.findall("link")}
    roots = [name for name in links if name not in joints]
    for joint in found:
        if missing := {joint.parent, joint.child} - links.keys():
            words = f"joint '{joint.name}': no link {', '.join(sorted(missing))}"
            raise InputError(words, file=file)
    carried, parents = set(roots), {joint.child: joint.parent for joint in found}
    for _ in found:
        carried |= {child for child, parent in parents.items() if parent in carried}
    if len(roots) != 1 or len(joints) != len(found) or len(carried) != len(links):
        words = f"is no tree of links with one root: {', '.join(roots) or 'none'}"
        raise InputError(words, file=file)
    names = [joint.name for joint in found]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"has two joints '{twice[0]}'", file=file)
    masses = {}
    for name, element in links.items():
        inertial = element.find("inertial")
        if inertial is not None and (mass := inertial.find("mass")) is not None:
            centre = _origin(inertial, f"link '{name}'", file)[:3, 3]
            value = _number(mass, "value", 0.0, f"link '{name}'", file)
            if not 0.0 <= value < np.inf:
                raise InputError(f"link '{name}' has the mass {value:g}", file=file)
            masses[name] = value, centre
    return Urdf(str(top.get("name", "robot")), file, roots[0], joints, masses)


def _joint(element: ElementTree.Element, file: str) -> UrdfJoint:
    name, kind = str(element.get("name", "")), str(element.get("type"))
    if not name:
        raise InputError("has a joint without a name", file=file)
    if element.find("mimic") is not None:
        kind = "a mimic of another joint"
    ends = [element.find(end) for end in ("parent", "child")]
    if None in ends:
        raise InputError(f"joint '{name}' lacks its parent or child", file=file)
    parent, child = (str(end.get("link")) for end in ends if end is not None)
    given, limit = element.find("axis"), element.find("limit")
    axis = np.array([1.0, 0.0, 0.0])
    if given is not None:
        axis = _numbers(given.get("xyz", "1 0 0"), 3, f"joint '{name}'", file)
    length = float(np.linalg.norm(axis))
    if kind in MOVING and length == 0.0:
        raise InputError(f"joint '{name}' has an axis of no length", file=file)
    lower, upper, velocity = -np.inf, np.inf, np.nan
    if limit is not None:
        place = f"joint '{name}'"
        velocity = _number(limit, "velocity", np.nan, place, file)
        if kind in ("revolute", "prismatic"):
            lower, upper = (_number(limit, end, 0.0, place, file) for end in ("lower", "upper"))
    return UrdfJoint(
        name, kind, parent, child, _origin(element, f"joint '{name}'", file),
        axis / length if length else axis, lower, upper,
        velocity if 0.0 < velocity < np.inf else np.nan,
    )  # fmt: skip


def _origin(element: ElementTree.Element, place: str, file: str) -> Array:
    origin = element.find("origin")
    if origin is None:
        return np.eye(4)
    xyz = _numbers(origin.get("xyz", "0 0 0"), 3, place, file)
    turn = _numbers(origin.get("rpy", "0 0 0"), 3, place, file)
    return transform(rotation_from_rpy(turn), xyz)


def _number(element: ElementTree.Element, key: str, default: float, place: str, file: str) -> float:
    text = element.get(key)
    try:
        return default if text is None else float(text)
    except ValueError:
        raise InputError(f"{place}: {key} '{text}' is no number", file=file) from None


def _numbers(text: str, count: int, place: str, file: str) -> Array:
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"{place}: '{text}' are not {count} finite numbers", file=file)
    return values


def chain(urdf: Urdf, base: str = "", tip: str = "") -> Chain:
    """The joints between two links.

    ``base``, ``tip``: links; empty: ``base`` and ``tool0`` (or ``flange``) as REP-199 calls them,
    else the root and the only link that carries none.

    Raises `InputError` when there are no such links, nothing tells the tip, or a joint on the way
    moves otherwise than about or along one axis.
    """
    ends = sorted(set(urdf.links) - {joint.parent for joint in urdf.joints.values()})
    base = base or next((name for name in BASES if name in urdf.links), urdf.root)
    tip = tip or next((name for name in TIPS if name in urdf.links), "")
    if not tip and len(ends) != 1:
        raise InputError(
            f"nothing tells which link is the flange: name it, of {', '.join(urdf.links)}",
            file=urdf.file,
        )
    to_base, to_tip = urdf.way(base), urdf.way(tip or ends[0])
    shared = [joint for joint in to_base if joint in to_tip]
    if any(joint.moves for joint in to_base if joint not in shared):
        raise InputError(f"link '{base}' moves beside '{tip or ends[0]}'", file=urdf.file)
    after = to_tip[len(shared) :]
    side = [joint.T_parent_child for joint in to_base[len(shared) :]]
    odd = next((joint for joint in after if not joint.moves and joint.kind != "fixed"), None)
    if odd is not None:
        raise InputError(f"joint '{odd.name}' is {odd.kind}, which no arm's is", file=urdf.file)
    odd = next((joint for joint in after if joint.moves and not joint.lower < joint.upper), None)
    if odd is not None:
        words = f"joint '{odd.name}' has the limits {odd.lower:g} and {odd.upper:g}: it cannot move"
        raise InputError(words, file=urdf.file)
    if not any(joint.moves for joint in after):
        raise InputError(f"no joint moves '{tip or ends[0]}' against '{base}'", file=urdf.file)
    T_base_start = invert(reduce(np.matmul, side, np.eye(4)))
    return Chain(urdf, base, tip or ends[0], T_base_start, tuple(after))


# ---- from a URDF --------------------------------------------------------------------------------


def arm_of(links: Chain, name: str = "") -> RobotDescription:
    """The arm of a description, with the limits and masses that it gives.

    Its flange is the tip, and its joints count as the description's do.

    Raises `InputError` when the tip lies off the last joint's axis and is turned against it as
    Hayati's five parameters cannot say.
    """
    moving, at_zero = links.moving, links.at_zero
    frames = [T for T, joint in zip(at_zero, links.joints, strict=True) if joint.moves]
    axes = np.array([T[:3, :3] @ j.axis for T, j in zip(frames, moving, strict=True)])
    points = np.array([T[:3, 3] for T in frames])
    T_base_tip = at_zero[-1]
    root, mdh = _hayati(axes, points, T_base_tip, links)
    arm = SerialArm(
        name=name or links.urdf.name,
        joint_names=tuple(joint.name for joint in moving),
        mdh=mdh,
        sign=np.ones(len(moving)),
        prismatic=np.array([joint.kind == "prismatic" for joint in moving]),
        lower=np.array([joint.lower for joint in moving]),
        upper=np.array([joint.upper for joint in moving]),
        T_base_root=root,
        load=_load(links, _frames(root, mdh)),
    )
    velocity = np.array([joint.velocity for joint in moving])
    return RobotDescription(
        arm=arm,
        path=Path(links.urdf.file),
        max_velocity=velocity,
        max_acceleration=velocity / FULL_SPEED_IN_S,
        acceleration_assumed=np.ones(len(moving), dtype=bool),
        notes=(),
        file_hash=text_hash(urdf_of(arm, velocity)),  # a xacro's comments name its host's folders
    )


def _frames(root: Array, mdh: Array) -> list[Array]:
    """Frame (4, 4) after each joint at zero."""
    found, T = [], root
    for row in mdh:
        T = T @ link_transform(row)
        found.append(T)
    return found


def _hayati(axes: Array, points: Array, tip: Array, links: Chain) -> tuple[Array, Array]:
    """Frame of the first joint (4, 4), and the parameters (n, 5) from axis to axis."""
    T = root = _first_frame(axes[0], points[0])
    rows = []
    for axis, point in zip(axes[1:], points[1:], strict=True):
        direction, meets = T[:3, :3].T @ axis, T[:3, :3].T @ (point - T[:3, 3])
        parallel = np.hypot(direction[0], direction[1]) < NEARLY_PARALLEL
        row = _parallel(direction, meets) if parallel else _crossing(direction, meets)
        rows.append(row)
        T = T @ link_transform(row)
    last = invert(T) @ tip
    row = _flange(last)
    if (off := float(np.abs(link_transform(row) - last).max())) > SAME_POSE:
        raise InputError(
            f"link '{links.tip}' lies off the axis of '{links.moving[-1].name}' and is turned by "
            f"more than Hayati's parameters hold (by {off:.3g}): name a link on the axis, and give "
            "the rest as a tool",
            file=links.urdf.file,
        )
    rows.append(row)
    mdh = np.array(rows)
    mdh[:, 1] = np.pi - (np.pi - mdh[:, 1]) % (2.0 * np.pi)
    return root, np.where(np.abs(mdh) < 1e-12, 0.0, mdh)


def _first_frame(axis: Array, point: Array) -> Array:
    """A frame on the first axis: the base itself where that is one, else nearest to it."""
    if np.hypot(axis[0], axis[1]) < 1e-12 and axis[2] > 0.0 and np.hypot(*point[:2]) < SAME_LINE_M:
        return np.eye(4)
    origin = point - axis * (point @ axis)
    x = np.eye(3)[np.argmin(np.abs(axis))]
    x = x - axis * (x @ axis)
    x /= np.linalg.norm(x)
    return transform(np.column_stack([x, np.cross(axis, x), axis]), origin)


def _crossing(axis: Array, point: Array) -> Array:
    """Row to a line that is not parallel to z: d along z to the common normal, a along that."""
    z = np.array([0.0, 0.0, 1.0])
    normal = np.cross(z, axis)
    sine = float(np.linalg.norm(normal))
    normal /= sine
    a = float(point @ normal)
    if abs(a) < SAME_LINE_M:
        a = 0.0
    elif a < 0.0:
        normal, a, sine = -normal, -a, -sine
    # point - t axis = d z + a normal
    flat = normal[0] * point[1] - normal[1] * point[0]
    across = normal[0] * axis[1] - normal[1] * axis[0]
    d = float(point[2] - flat / across * axis[2])
    return np.array([d, np.arctan2(normal[1], normal[0]), a, np.arctan2(sine, axis[2]), 0.0])


def _parallel(axis: Array, point: Array) -> Array:
    """Row to a line that is nearly parallel to z: where it meets the plane z = 0."""
    if np.hypot(axis[0], axis[1]) < _PARALLEL:
        axis = np.array([0.0, 0.0, np.sign(axis[2])])
    meeting = point - axis * (point[2] / axis[2])
    if np.hypot(meeting[0], meeting[1]) <= SAME_LINE_M:
        meeting = np.zeros(3)
    return parallel_row(axis, meeting)


def _flange(T: Array) -> Array:
    """Row to a flange: Rot(z, theta) Rot(x, alpha) Rot(y, beta) turns it.

    Off the axis, theta is the direction in which it lies, and two angles are left for its turn.
    """
    R, a = T[:3, :3], float(np.hypot(T[0, 3], T[1, 3]))
    theta = np.arctan2(-R[0, 1], R[1, 1])
    if a > SAME_LINE_M:
        theta = np.arctan2(T[1, 3], T[0, 3])
    elif np.hypot(R[0, 1], R[1, 1]) < 1e-9:  # turned by a right angle about x: beta is not needed
        theta = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(theta), np.sin(theta)
    left = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ R
    alpha, beta = np.arctan2(left[2, 1], left[1, 1]), np.arctan2(left[0, 2], left[0, 0])
    if abs(beta) > np.pi / 2.0 + 1e-9 and a <= SAME_LINE_M:  # the other of the two forms
        theta, alpha, beta = theta + np.pi, np.pi - alpha, beta - np.copysign(np.pi, beta)
    return np.array([T[2, 3], theta, a if a > SAME_LINE_M else 0.0, alpha, beta])


def _load(links: Chain, frames: list[Array]) -> ArmLoad | None:
    """What gravity pulls at: masses of all that each joint carries up to the next, in its frame."""
    masses, centres = np.zeros(len(frames)), np.zeros((len(frames), 3))
    at_zero = {joint.child: T for joint, T in zip(links.joints, links.at_zero, strict=True)}
    carrier = -1
    for joint in links.joints:
        carrier += joint.moves
        if carrier < 0 or joint.child not in links.urdf.masses:
            continue
        mass, centre = links.urdf.masses[joint.child]
        place = invert(frames[carrier]) @ at_zero[joint.child] @ [*centre, 1.0]
        masses[carrier] += mass
        centres[carrier] += mass * place[:3]
    if not masses.any():
        return None
    centres[masses > 0.0] /= masses[masses > 0.0, None]
    return ArmLoad(masses, centres)


# ---- beside a robot file ------------------------------------------------------------------------

# What the least digits in use make of one arm: 1.5708 for a right angle is 3.7e-6 rad, at each of
# six joints of a 3 m arm 0.07 mm. A drift is worth correcting from 0.1 mm on: what differs by more
# would be corrected twice, or against the wrong arm.
SAME_ARM_M, SAME_ARM_RAD = 1e-4, 1e-4
AT_PRESENT, AT_MOST = "at the present joints", "at most"
_COMPARED = 32  # poses over the joints' ranges


@dataclass(frozen=True)
class ModelDifference:
    """By how much a description is another arm than a robot file says.

    ``flange``: m and rad, AT_PRESENT where the robot stands, AT_MOST over the joints' ranges too.
    ``where``: up to which joint or link both agree, and what differs then.
    """

    flange: dict[str, tuple[float, float]]
    where: str

    def __str__(self) -> str:
        off = [
            f"{shift * 1e3:.3f} mm and {np.degrees(turn):.4f} deg {when}"
            for when, (shift, turn) in self.flange.items()
        ]
        return f"its flange is off by {', '.join(off)}; {self.where}" if off else self.where


def model_difference(
    links: Chain, arm: SerialArm, present: Array | None = None
) -> ModelDifference | None:
    """Compare a description with an arm's geometry: axis by axis, and the flange; None: the same.

    ``present``: joints (n,) where the robot stands. They alone would not tell a joint that counts
    the other way from zero on, so poses over the joints' ranges are looked at too.
    """
    names = [joint.name for joint in links.moving]
    if names != list(arm.joint_names):
        words = f"its joints are {', '.join(names)}, the robot file's {', '.join(arm.joint_names)}"
        return ModelDifference({}, words)
    low, high = np.clip(arm.lower, -np.pi, np.pi), np.clip(arm.upper, -np.pi, np.pi)
    drawn = np.random.default_rng(0).uniform(low, high, (_COMPARED, arm.n))
    poses = [*([] if present is None else [present]), *drawn]
    pairs = [(links.frames(q), _moved(arm, q)) for q in poses]
    off = np.array([apart(ours[-1], theirs[-1]) for ours, theirs in pairs])
    if (off <= [SAME_ARM_M, SAME_ARM_RAD]).all():
        return None
    worst = int(np.argmax((off / [SAME_ARM_M, SAME_ARM_RAD]).max(axis=1)))
    flange = {} if present is None else {AT_PRESENT: apart(pairs[0][0][-1], pairs[0][1][-1])}
    flange |= {AT_MOST: (float(off[:, 0].max()), float(off[:, 1].max()))}
    return ModelDifference(flange, _begins(links, arm, *pairs[worst]))


def _moved(arm: SerialArm, q: Array) -> list[Array]:
    """Frames (4, 4) that the joints move along or about z, and the flange, at joints (n,)."""
    rows = arm.mdh.copy()
    rows[np.arange(arm.n), np.where(arm.prismatic, 0, 1)] += arm.sign * q
    return [arm.T_base_root, *_frames(arm.T_base_root, rows)]


def _begins(links: Chain, arm: SerialArm, described: list[Array], filed: list[Array]) -> str:
    """The first joint whose axis is elsewhere: line from line, near the flange."""
    before = f"from '{links.base}' on"
    for i, joint in enumerate(links.moving):
        axis, ours = arm.sign[i] * filed[i][:3, 2], described[i][:3, :3] @ joint.axis
        turn = float(np.arctan2(np.linalg.norm(np.cross(axis, ours)), axis @ ours))
        point = filed[i][:3, 3]
        rest = point + axis * (axis @ (filed[-1][:3, 3] - point)) - described[i][:3, 3]
        off = 0.0 if arm.prismatic[i] else float(np.linalg.norm(rest - ours * (ours @ rest)))
        if off > SAME_ARM_M or turn > SAME_ARM_RAD:
            shift = f"{off * 1e3:.3f} mm and {np.degrees(turn):.4f} deg"
            return f"they differ {before}: the axis of '{joint.name}' is {shift} off"
        before = f"behind '{joint.name}'"
    return f"they differ {before}: all axes agree, the flange '{links.tip}' does not"


# ---- into a URDF --------------------------------------------------------------------------------


def urdf_of(arm: SerialArm, max_velocity: Array | None = None) -> str:
    """A description of the arm's joints from link ``base`` to ``flange``; no shapes, no masses.

    What joints turn besides what is read (joint functions) has no place in a URDF.

    ``max_velocity`` (n,): NaN where not known; 0 is written, as urdfdom reads no limit without one.
    """
    top = ElementTree.Element("robot", name=arm.name)
    links = ["base", *(f"link_{i + 1}" for i in range(arm.n)), "flange"]
    for link in links:
        ElementTree.SubElement(top, "link", name=link)
    fixed = [arm.T_base_root, *(link_transform(row) for row in arm.mdh)]
    for i, name in enumerate(arm.joint_names):
        slides, low, high = arm.prismatic[i], float(arm.lower[i]), float(arm.upper[i])
        bounded = np.isfinite(low) and np.isfinite(high)
        kind = "prismatic" if slides else "revolute" if bounded else "continuous"
        joint = _element(top, name, kind, links[i], links[i + 1], fixed[i])
        ElementTree.SubElement(joint, "axis", xyz=f"0 0 {arm.sign[i]:.0f}")
        speed = np.nan if max_velocity is None else float(max_velocity[i])
        if slides and not bounded:  # a URDF needs limits there
            bounded, low, high = True, -UNLIMITED_M, UNLIMITED_M
        limit = {"lower": repr(low), "upper": repr(high)} if bounded else {}
        limit |= {"effort": "0", "velocity": repr(speed) if np.isfinite(speed) else "0"}
        ElementTree.SubElement(joint, "limit", limit)
    _element(top, "flange_joint", "fixed", links[arm.n], "flange", fixed[-1])
    return _text(top)


def _element(
    top: ElementTree.Element, name: str, kind: str, parent: str, child: str, T: Array
) -> ElementTree.Element:
    joint = ElementTree.SubElement(top, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    _set_origin(joint, T)
    return joint


def _set_origin(joint: ElementTree.Element, T: Array) -> None:
    origin = joint.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(joint, "origin")
    origin.set("xyz", " ".join(repr(x) for x in (T[:3, 3] + 0.0).tolist()))
    origin.set("rpy", " ".join(repr(x) for x in (rpy(T[:3, :3]) + 0.0).tolist()))


def _text(top: ElementTree.Element) -> str:
    ElementTree.indent(top)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(top, encoding="unicode") + "\n"


def urdf_with(text: str, links: Chain, arm: SerialArm) -> str:
    """The description ``text`` of ``links`` with an arm's kinematics; all but origins stays.

    Raises `InputError` as `origins_of`.
    """
    builder = ElementTree.TreeBuilder(insert_comments=True)
    top = ElementTree.fromstring(text, ElementTree.XMLParser(target=builder))
    origins = origins_of(links, arm)
    for joint in top.findall("joint"):
        if (T := origins.get(str(joint.get("name")))) is not None:
            _set_origin(joint, T)
    return _text(top)


def origins_of(links: Chain, arm: SerialArm) -> dict[str, Array]:
    """Poses (4, 4) in their parents, by joint, with which a description has an arm's kinematics.

    Each link goes with its axis, by the smallest turn and shift, so that shapes stay where they
    were; the flange is where the arm's is.

    Raises `InputError` when the joints are not the arm's in their order, or no fixed joint follows
    the last one that moves: there the flange could not be set.
    """
    names = tuple(joint.name for joint in links.moving)
    if names != arm.joint_names:
        raise InputError(
            f"has the joints {', '.join(names)} from '{links.base}' to '{links.tip}'; "
            f"{arm.name} has {', '.join(arm.joint_names)}",
            file=links.urdf.file,
        )
    last = max(i for i, joint in enumerate(links.joints) if joint.moves)
    if last + 1 == len(links.joints):
        words = (
            f"link '{links.tip}' is moved by its joint: name a tip behind a fixed joint, as tool0"
        )
        raise InputError(words, file=links.urdf.file)
    frames = [arm.T_base_root, *_frames(arm.T_base_root, arm.mdh)]
    found: dict[str, Array] = {}
    was = now = links.T_base_root  # of the parent at zero, in the base
    moved = 0
    for i, joint in enumerate(links.joints):
        was = was @ joint.T_parent_child
        if joint.moves:
            axis = arm.sign[moved] * frames[moved][:3, 2]
            there = _with_axis(was, joint.axis, axis, frames[moved][:3, 3])
            found[joint.name] = invert(now) @ there
            now, moved = there, moved + 1
        elif i == last + 1:
            rest = [after.T_parent_child for after in links.joints[i + 1 :]]
            found[joint.name] = (
                invert(now) @ frames[-1] @ invert(reduce(np.matmul, rest, np.eye(4)))
            )
            now = now @ found[joint.name]
        else:
            now = now @ joint.T_parent_child
    return found


def _with_axis(T: Array, axis: Array, wanted: Array, point: Array) -> Array:
    """The pose next to ``T`` (4, 4) whose ``axis`` lies on the line along ``wanted`` (3,)."""
    before = T[:3, :3] @ axis
    K, cosine = skew(np.cross(before, wanted)), float(before @ wanted)
    if cosine < 0.0:
        raise InputError("a joint counts the other way than in the description: turn its sign")
    R = (np.eye(3) + K + K @ K / (1.0 + cosine)) @ T[:3, :3]
    origin = point + wanted * (wanted @ (T[:3, 3] - point))
    return transform(R, origin)


# ---- kinematics of Universal Robots' description (``kinematics.yaml``) --------------------------

_UR_LINKS = ("shoulder", "upper_arm", "forearm", "wrist_1", "wrist_2", "wrist_3")
_UR_KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


def ur_chain(document: object, file: str) -> Chain:
    """The six joints of a ``kinematics.yaml``, as ur_calibration writes it, from base to tool0.

    Its ``shoulder`` stands in ``base_link_inertia``, which is ``base``; ``tool0`` is where
    ``wrist_3_link`` is (Universal_Robots_ROS2_Description, urdf/ur_macro.xacro).

    Raises `InputError` when it is not such a document.
    """
    found = document.get("kinematics") if isinstance(document, dict) else None
    joints, parent = {}, "base"
    for link, name in zip(_UR_LINKS, JOINT_NAMES, strict=True):
        values = found.get(link) if isinstance(found, dict) else None
        if not isinstance(values, dict) or not set(_UR_KEYS) <= set(values):
            words = f"has no kinematics of {link} with {', '.join(_UR_KEYS)}"
            raise InputError(words, file=file)
        text = [" ".join(str(values[key]) for key in keys) for keys in (_UR_KEYS[:3], _UR_KEYS[3:])]
        xyz, turn = (_numbers(part, 3, link, file) for part in text)
        T = transform(rotation_from_rpy(turn), xyz)
        child = f"{link}_link"
        joints[child] = UrdfJoint(
            name, "revolute", parent, child, T, np.array([0.0, 0.0, 1.0]),
            -2.0 * np.pi, 2.0 * np.pi, np.nan,
        )  # fmt: skip
        parent = child
    joints["tool0"] = UrdfJoint(
        "wrist_3-tool0", "fixed", parent, "tool0", np.eye(4), np.zeros(3), -np.inf, np.inf, np.nan
    )
    urdf = Urdf("ur", file, "base", joints, {})
    return Chain(urdf, "base", "tool0", np.eye(4), tuple(joints.values()))


def ur_kinematics(links: Chain, arm: SerialArm) -> tuple[dict[str, dict[str, float]], Array]:
    """Values of a ``kinematics.yaml`` with an arm's kinematics, and what they cannot hold.

    The latter is T_tool0_flange (4, 4): the description has no place for a flange off its last
    axis or turned against it.

    Raises `InputError` as `origins_of`.
    """
    origins = origins_of(links, arm)
    beyond = origins["wrist_3-tool0"]
    turn = np.eye(4)
    c, s = beyond[:2, 0] / np.hypot(beyond[0, 0], beyond[1, 0])
    turn[:2, :2], turn[2, 3] = [[c, -s], [s, c]], beyond[2, 3]
    origins[JOINT_NAMES[-1]] = origins[JOINT_NAMES[-1]] @ turn  # along its axis the link is free
    values = {}
    for link, name in zip(_UR_LINKS, JOINT_NAMES, strict=True):
        numbers = [*origins[name][:3, 3], *rpy(origins[name][:3, :3])]
        values[link] = dict(zip(_UR_KEYS, (float(x) + 0.0 for x in numbers), strict=True))
    return values, invert(turn) @ beyond
