# SPDX-License-Identifier: Apache-2.0
"""The policies for SROS 2 allow what each node has on the graph, and no more; who may call whom.

Fast DDS of the wheels is built without security: nothing is enforced here. What permissions are
made of is judged, in the form of sros2's policy.xsd 0.2.0. What nodes have is read from the list
that test_public_names.py holds against them.
"""

import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from xml.etree import ElementTree

import pytest
from test_config_files import NODES

from robocal_ros.bags.recorder_node import RecorderNode

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "config" / "security"
INCLUDE = "{http://www.w3.org/2001/XInclude}include"
RULES = {
    "topics": {"publish", "subscribe"},
    "services": {"reply", "request"},
    "actions": {"execute", "call"},
}
PEOPLE = {"observer", "operator", "engineer"}
CONTROLLER = "/joint_trajectory_controller"
ACTION = f"{CONTROLLER}/follow_joint_trajectory"
REMAPPED = {  # by cell.launch.py, and by the parameters of what may move
    "~/joint_trajectory": f"{CONTROLLER}/joint_trajectory",
    "controller_state": f"{CONTROLLER}/controller_state",
    "follow_joint_trajectory": ACTION,
    "kinematic_model": "thermal_node/model",
    "tool": "tcf_node/tool",
}
SIMULATED = {
    "joint_trajectory": f"{CONTROLLER}/joint_trajectory",
    "~/controller_state": f"{CONTROLLER}/controller_state",
    "~/follow_joint_trajectory": ACTION,
}
DOES = {
    "publishes": "publish", "subscribes": "subscribe", "serves": "reply", "requests": "request",
    "executes": "execute", "calls": "call",
}  # fmt: skip
LINE = re.compile(rf"^(every node|\w+_node) ({'|'.join(DOES)}) (\S+) ", re.M)
MOVERS = {"tcf_node", "joint_correction_node", "maintenance_node"}
Rules = dict[str, set[str]]


def included(profile: ElementTree.Element) -> Iterator[ElementTree.Element]:
    for part in profile:
        if part.tag == INCLUDE:
            assert part.attrib["xpointer"] == "xpointer(/profile/*)"
            yield from ElementTree.parse(FOLDER / part.attrib["href"]).getroot()
        else:
            yield part


def policies() -> dict[str, Rules]:
    """What each enclave may do, by resolved names, which have wildcards where the files have."""
    found: dict[str, Rules] = {}
    for path in FOLDER.glob("*.policy.xml"):
        root = ElementTree.parse(path).getroot()
        assert (root.tag, root.attrib) == ("policy", {"version": "0.2.0"})
        for enclave in root.findall("enclaves/enclave"):
            (profile,) = enclave.findall("profiles/profile")
            namespace, node = profile.attrib["ns"], profile.attrib["node"]
            rules: Rules = {rule: set() for kind in RULES.values() for rule in kind}
            for part in included(profile):
                ((rule, allowed),) = part.attrib.items()
                assert rule in RULES[part.tag]
                assert allowed == "ALLOW"
                for name in part:
                    assert name.tag == part.tag.removesuffix("s")
                    text = str(name.text).replace("~", f"{namespace}{node}")
                    rules[rule].add(text if text.startswith("/") else namespace + text)
            name = enclave.attrib["path"].removeprefix("/robocal/")
            assert name not in found
            found[name] = rules
    return found


def test_each_node_of_a_cell_has_one() -> None:
    """Not replay_node, which plays what others said: its graph is to have no robot."""
    assert set(policies()) == {node.NAME for node in NODES} - {"replay_node"} | PEOPLE


def listed() -> dict[str, Rules]:
    """What each node has on the graph, of the kept list, by its name in cell.launch.py's graph."""
    everyone: list[tuple[str, str]] = []
    found = {node.NAME: [("subscribe", "/clock")] for node in NODES}  # where time is simulated
    for giver, does, name in LINE.findall((ROOT / "test" / "public_names.txt").read_text()):
        (everyone if giver == "every node" else found[giver]).append((DOES[does], name))
    # What is recorded is a parameter; what else the list does not see is said at its maker's head.
    (recorded,) = (setting for setting in RecorderNode.SETTINGS if setting.name == "topics")
    assert isinstance(recorded.default, list)
    found["recorder_node"] += [("subscribe", str(topic)) for topic in recorded.default]
    found["adapter_node"] += [("subscribe", f"{name}_states") for name in ("io", "gpio")]
    found["thermal_node"] += [("subscribe", topic) for topic in ("/tf", "/tf_static")]
    seen = {}
    for node, names in found.items():
        remapped = SIMULATED if node == "cell_sim_node" else REMAPPED
        seen[node] = {rule: set[str]() for kind in RULES.values() for rule in kind}
        for rule, name in (*everyone, *names):
            text = remapped.get(name, name).replace("~", f"/{node}")
            seen[node][rule].add(text if text.startswith("/") else f"/{text}")
        seen[node]["publish"].add(f"/{node}/identity_*")  # for a moment, at its start
    return seen


def test_it_allows_what_the_node_has_and_no_more() -> None:
    allowed, seen = policies(), listed()
    for name in allowed.keys() - PEOPLE:
        assert allowed[name] == seen[name], name


def who(rule: str, name: str) -> set[str]:
    """Enclaves that may do so with a name."""
    return {
        enclave for enclave, rules in policies().items()
        if any(fnmatchcase(name, allowed) for allowed in rules[rule])
    }  # fmt: skip


def test_three_may_move_the_robot_and_one_opens_the_gap() -> None:
    assert who("publish", f"{CONTROLLER}/joint_trajectory") == MOVERS
    assert who("call", ACTION) == MOVERS
    assert who("request", f"{ACTION}/_action/send_goal") == set()
    assert who("publish", "/gap_open") == {"plc_bridge_node"}
    assert who("publish", "/motion_lease") == MOVERS - {"joint_correction_node"}


@pytest.mark.parametrize("call", ["accept", "reject", "rollback"])
def test_who_decides(call: str) -> None:
    doors = {"plc_bridge_node"} | ({"panel_node"} if call != "rollback" else set())
    assert who("request", f"/maintenance_node/{call}") == {"engineer", *doors}
    for node in ("thermal_node", "tcf_node", "hand_eye_node", "fixture_node"):
        assert who("request", f"/{node}/{call}") == {"engineer"}


def test_parameters_and_life_cycles_are_the_engineers() -> None:
    for node in {node.NAME for node in NODES} - {"replay_node", "cell_sim_node"}:
        for call in ("set_parameters", "set_parameters_atomically", "change_state"):
            assert who("request", f"/{node}/{call}") == {"engineer"}
    assert who("request", "/maintenance_node/run") == {"operator", "engineer", "plc_bridge_node"}
    assert not policies()["observer"]["request"] | policies()["observer"]["call"]


def test_what_is_called_is_served() -> None:
    """Names change; a policy with the old one would only be found out at the customer's."""
    known = policies()
    for enclave, rules in known.items():
        for rule, served in (("request", "reply"), ("call", "execute")):
            there = {name for other in known.values() for name in other[served]}
            for name in rules[rule] - {"/hard_stop"}:  # of a driver
                assert any(fnmatchcase(one, name) for one in there), (enclave, name)
    there = {name for other in known.values() for name in other["publish"]}
    for name in known["observer"]["subscribe"] - {"/clock", "/tf"}:
        assert any(fnmatchcase(one, name) for one in there), name
