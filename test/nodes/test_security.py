# SPDX-License-Identifier: Apache-2.0
"""The policies for SROS 2 allow what each node has on the graph, and no more; who may call whom.

Fast DDS of the wheels is built without security: nothing is enforced here. What permissions are
made of is judged, in the form of sros2's policy.xsd 0.2.0.
"""

import contextlib
import json
from collections.abc import Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from test_config_files import NODES

from bench.live.opc_ua import free_port, security_folder
from robocal_ros.cell_sim.fixture import PLATE
from robocal_ros.fixture.files import fixture_document

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "config" / "security"
CELL = ROOT / "config" / "cells"
INCLUDE = "{http://www.w3.org/2001/XInclude}include"
RULES = {
    "topics": {"publish", "subscribe"},
    "services": {"reply", "request"},
    "actions": {"execute", "call"},
}
SEES_DEG = [4.97, -74.1, 98.61, 2.92, 79.56, 41.63]  # the plate, from one of the cell's poses
PEOPLE = {"observer", "operator", "engineer"}
CONTROLLER = "/joint_trajectory_controller"
ACTION = f"{CONTROLLER}/follow_joint_trajectory"
MOVERS = {"tcf_node", "joint_correction_node", "maintenance_node"}
Rules = dict[str, set[str]]
Seen = set[tuple[str, str]]


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


def remapped(name: str) -> list[str]:
    """As cell.launch.py does."""
    simulated = name == "cell_sim_node"
    return [
        "--ros-args", "--params-file", str(CELL / "kr150_shift.yaml"),
        "-r", f"{'' if simulated else '~/'}joint_trajectory:={CONTROLLER}/joint_trajectory",
        "-r", f"{'~/' if simulated else ''}controller_state:={CONTROLLER}/controller_state",
        *(["-r", f"~/follow_joint_trajectory:={ACTION}"] if simulated else []),
        "-r", "kinematic_model:=thermal_node/model", "-r", "tool:=tcf_node/tool",
    ]  # fmt: skip


def on_graph(probe: Any, node: str) -> Seen:
    """What a node has; of an action the services say who serves and who calls it."""
    asked = {
        "publish": probe.get_publisher_names_and_types_by_node,
        "subscribe": probe.get_subscriber_names_and_types_by_node,
        "reply": probe.get_service_names_and_types_by_node,
        "request": probe.get_client_names_and_types_by_node,
    }
    of_actions = {"reply": "execute", "request": "call"}
    seen = set()
    for rule, ask in asked.items():
        for name, _ in ask(node, "/"):
            action, hidden, _ = name.partition("/_action/")
            if not hidden:
                seen.add((rule, name))
            elif rule in of_actions:
                seen.add((of_actions[rule], action))
    return seen


def test_it_allows_what_the_node_has_and_no_more(graph: Any, tmp_path: Path) -> None:
    allowed = policies()
    moves = {"follow_joint_trajectory": ACTION.removeprefix("/"), "hard_stop_service": "hard_stop"}
    laser = {"laser": str(CELL / "kr150_laser.yaml")}
    (tmp_path / "plate.yaml").write_text(json.dumps(fixture_document(PLATE)))
    plc = {"security_dir": str(security_folder(tmp_path)), "port": free_port()}
    given: dict[str, dict[str, Any]] = {
        "thermal_node": {"arrangement": "flange-sensor"},  # which has all of the other's topics
        "tcf_node": laser | moves,
        "joint_correction_node": moves,
        "maintenance_node": laser | moves | {"fixture_poses_deg": SEES_DEG},
        "cell_sim_node": {"profile": True, "fixture": True, "run_program": True},
        "plc_bridge_node": plc | {"host": "127.0.0.1", "beams": ["x"]},
        "panel_node": {"page_port": free_port()},
        "fixture_node": {"fixture_file": str(tmp_path / "plate.yaml")},
        "adapter_node": {"input": "bool", "profile_input": "scan", "profile_frame": "scanner"}
        | {"target_frame": "tag36h11:0"},
    }
    robot = {"robot": "kr150_r3100"}
    nodes, ever = {}, {}
    for kind in NODES:
        if kind.NAME in allowed:
            own = robot if any(s.name == "robot" for s in kind.SETTINGS) else {}
            settings = own | given.get(kind.NAME, {})
            nodes[kind.NAME] = graph.add(kind, settings, cli_args=remapped(kind.NAME))
            assert nodes[kind.NAME].is_active, kind.NAME
            graph.spin_for(0.1)  # some listen to /tf at their start only
            ever[kind.NAME] = on_graph(graph.probe, kind.NAME)

    # What this cell does not show: adapter_node's other inputs, what nobody publishes yet, how a
    # placed sensor's frame is looked for on tf.
    recorded = nodes["recorder_node"]
    unseen = {name: {("subscribe", "/clock")} for name in nodes}
    unseen["adapter_node"] |= {("subscribe", f"/{s}_states") for s in ("io", "gpio")}
    unseen["adapter_node"] |= {("subscribe", "/cloud")}
    unseen["thermal_node"] = {("subscribe", topic) for topic in ("/clock", "/tf", "/tf_static")}
    for topic in recorded.settings["topics"]:
        unseen["recorder_node"].add(("subscribe", recorded.resolve_topic_name(topic)))

    def difference() -> dict[str, list[tuple[str, str]]]:
        differs = {}
        for name in nodes:
            rules = {(rule, n) for rule, of in allowed[name].items() for n in of}
            rules.remove(("publish", f"/{name}/identity_*"))  # for a moment, at its start
            ever[name] |= on_graph(graph.probe, name)
            found = {one for one in ever[name] if f"/{name}/identity_" not in one[1]}
            both = (found | unseen[name]) ^ (rules | unseen[name])
            if name == "recorder_node":  # not more than its parameter says, either
                both |= {r for r in rules ^ unseen[name] if r[0] == "subscribe"}
            if both:
                differs[name] = sorted(both)
        return differs

    with contextlib.suppress(pytest.fail.Exception):
        graph.spin_until(lambda: not difference())
    assert difference() == {}


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
