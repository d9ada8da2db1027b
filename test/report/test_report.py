# SPDX-License-Identifier: Apache-2.0
"""Figures, rows, tables and page of a report: numbers that can be counted by hand."""

import csv
import io
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from forked import HANGS_S

from robocal_ros.cli.validating import changes_of
from robocal_ros.ground.errors import Code
from robocal_ros.report import figures
from robocal_ros.report.figures import (
    CellCourse,
    ShiftErrors,
    accuracy_by_cycle,
    cell_drawn,
    thermal_figures,
    tool_figures,
)
from robocal_ros.report.page import (
    bags_table,
    cycles_table,
    decisions_table,
    figures_of,
    hours_table,
    page,
    pooled_rms_mm,
    summary_rows,
)

COUNT, POSES = 4, 6


def make_errors() -> ShiftErrors:
    before = np.random.default_rng(0).normal(0.0, 2e-4, (COUNT, POSES, 3))
    return ShiftErrors(
        hours=np.arange(1.0, COUNT + 1.0),
        accepted=[True, False, False, True],
        before=before,
        after=0.25 * before,
        held=0.5 * before,
    )


def test_figures_of_known_errors():
    """Distances 0.05, 0.1 (three axes of 0.0577) and 5 mm: counted by hand."""
    axis = 0.1e-3 / np.sqrt(3.0)
    error = np.array([[0.05e-3, 0.0, 0.0], [axis, axis, axis], [3e-3, 4e-3, 0.0]])
    found = figures_of(error)
    assert found["mean_mm"] == pytest.approx((0.05 + 0.1 + 5.0) / 3)
    assert found["rms_mm"] == pytest.approx(np.sqrt((0.05**2 + 0.1**2 + 25.0) / 3))
    assert found["max_mm"] == pytest.approx(5.0)
    assert found["share_within_tolerance"] == pytest.approx(7 / 9)
    assert found["n"] == 3


def test_figures_are_drawn_the_same_each_time():
    report = make_errors()
    for draw in (figures.drift_over_time, figures.error_by_pose):
        first, second = figures.svg(draw(report)), figures.svg(draw(report))
        assert first == second
        assert figures.png(draw(report)).startswith(b"\x89PNG")


def test_the_drift_curve_shows_the_mean_error():
    """The line of the figure is the number of the table."""
    report = make_errors()
    (axes,) = figures.drift_over_time(report).axes
    line = next(line for line in axes.lines if line.get_color() == figures.BEFORE)
    assert np.asarray(line.get_ydata())[0] == 0.0
    expected = [figures_of(error)["mean_mm"] for error in report.before]
    np.testing.assert_allclose(np.asarray(line.get_ydata())[1:], expected)


def errors(rms_mm, share=None, n=6):
    found = {"mean_mm": rms_mm, "rms_mm": rms_mm, "p95_mm": rms_mm, "max_mm": rms_mm, "n": n}
    return found if share is None else found | {"share_within_tolerance": share}


def cycle(number, code="ACCEPT", revision=0, n=6):
    reason = f"<because> of {number}"
    return {
        "cycle": f"c{number}", "stamp": 1e9 + number, "hours": float(number), "samples": n,
        "nominal": errors(0.4), "in_force": errors(0.2), "candidate": errors(0.1 * number, n=n),
        "predicted_rms_mm": 0.06, "forecast": {"rms_mm": 0.1, "bound_mm": 0.3},
        "measured": {"without": errors(0.4, 0.2), "in_force": errors(0.2, 0.5)}, "true": None,
        "verdict": {"accept": code == "ACCEPT", "code": code, "reason": reason},
        "revision": revision, "based_on": 0, "rejected": ["17"], "unobservable": [],
        "drift": {"d1_mm": 0.1 * number, "a2_mm": -0.2}, "sigma": {"d1_mm": 0.02, "a2_mm": 0.03},
    }  # fmt: skip


def session(**own):
    return {
        "node": None, "robot": "KR & <150>", "model_hash": "0123456789abcdef", "as_recorded": True,
        "differs": [], "settings": {"sigma_m": 2e-5}, "ignored": {"joint_states": {"late": 3}},
        "gaps": {"count": 1, "longest_s": 2.5, "damaged": []}, "warnings": ["a <warning>"],
        "decisions": [
            {"stamp": 1e9, "command": "identify", "code": "ACCEPT", "message": "good"},
            {"stamp": 1e9, "command": "accept", "code": "CONFLICT", "message": "too <late>"},
        ],
    } | own  # fmt: skip


OTHER = {"/plc/session_events": [
    {"stamp": 1e9, "command": "run", "code": "LIMIT_EXCEEDED", "message": "gap <too> short"}
]}  # fmt: skip


def bag(name, *sessions, simulated=False):
    return {
        "bag": name, "path": f"/x/{name}", "from": "a", "to": "b", "duration_s": 7200.0,
        "topics": {}, "simulated": simulated, "sessions": list(sessions), "other_decisions": OTHER,
        "cells": [], "skipped": {},
    }  # fmt: skip


CYCLES = [cycle(1, revision=1), cycle(2, "SENSOR_OR_ROBOT_MOVED", n=2)]
THERMAL = session(
    kind="thermal", cycles=CYCLES, tolerance_mm=0.1, true=None,
    measured={"without": errors(0.4, 0.2), "in_force": errors(0.2, 0.5)},
    bound={"measured_share": 0.9, "true_share": None},
)  # fmt: skip
RUN = {
    "run": 1, "stamp": 1e9, "answer": "recalibrate", "tcp_mm": None, "change_mm": 3.5,
    "change_deg": 1.0, "sigma_mm": 0.05, "misfit_mm": 0.02, "true_error_mm": None,
    "verdict": {"accept": False, "code": "LIMIT_EXCEEDED", "reason": "bent"},
}  # fmt: skip
TOOL = session(kind="tool", runs=[RUN], final={})
BAD = {"bag": "bad.mcap", "error": {"code": "BAD_INPUT", "message": "no <bag>"}}
BAGS = [bag("one.mcap", THERMAL), bag("two.mcap", TOOL, simulated=True), BAD]
REPORT = {
    "title": "T <1>", "created": "today", "software": "robocal 0", "versions": {"numpy": "2"},
    "bags": BAGS,
}  # fmt: skip


def test_a_row_for_each_session_and_each_bad_bag():
    thermal, tool, bad = summary_rows(BAGS)
    assert (thermal["cycles"], thermal["accepted"], thermal["refused"]) == (2, 1, 1)
    assert thermal["rms_without_mm"] == pytest.approx(0.4)
    assert thermal["rms_in_force_mm"] == pytest.approx(0.2)
    assert (thermal["lambda_without"], thermal["lambda_in_force"]) == (0.2, 0.5)
    assert thermal["share_below_bound"] == 0.9
    assert thermal["lambda_after"] is None
    assert thermal["rms_after_mm"] is None  # only a truth would tell
    # 6 measurements at 0.1 mm and 2 at 0.2 mm: sqrt((6 * 0.01 + 2 * 0.04) / 8)
    assert thermal["rms_candidate_mm"] == pytest.approx(np.sqrt(0.14 / 8))
    assert tool["largest_change_mm"] == 3.5
    assert tool["largest_true_error_mm"] is None
    assert bad == {"bag": "bad.mcap", "kind": None, "error": BAD["error"]}


def test_the_truth_judges_where_there_is_one():
    true = {"without": errors(0.3, 0.1), "in_force": errors(0.1, 0.8), "after": errors(0.05, 1.0)}
    judged = THERMAL | {"true": true, "bound": {"measured_share": 0.9, "true_share": 1.0}}
    (row,) = summary_rows([bag("one.mcap", judged)])
    assert row["judged_by"] == "truth"
    assert (row["rms_after_mm"], row["lambda_after"], row["share_below_bound"]) == (0.05, 1.0, 1.0)
    assert row["rms_candidate_mm"] is None
    html = page(REPORT | {"bags": [bag("one.mcap", judged)]}, {"one.mcap": [[], []]})
    assert "<b>0.050 mm</b> after each cycle (1 of 2 cycles accepted)" in html


def test_candidates_that_never_came_into_force_claim_no_gain():
    """Two refused cycles: the robot went on as it was."""
    cycles = [
        cycle(i, code) | {"in_force": errors(0.3), "nominal": errors(0.3)}
        | {"candidate": errors(0.05)}
        for i, code in ((1, "RESIDUAL_TOO_LARGE"), (2, "SENSOR_OR_ROBOT_MOVED"))
    ]  # fmt: skip
    html = page(
        REPORT | {"bags": [bag("one.mcap", THERMAL | {"cycles": cycles})]}, {"one.mcap": [[], []]}
    )
    (lead,) = re.findall(r'<p class="lead">.*</p>', html)
    assert "rms error 0.300 mm without correction" in lead
    assert "<b>0.300 mm</b> with the model in force, at its oldest (0 of 2 cycles" in lead
    assert "0.050" not in lead


def test_a_session_without_cycles_has_no_errors():
    empty = THERMAL | {"cycles": [], "measured": None}
    (row,) = summary_rows([bag("one.mcap", empty)])
    assert row["rms_without_mm"] is row["rms_candidate_mm"] is None
    assert pooled_rms_mm([], "candidate") is None
    assert thermal_figures([], None) == []
    json.dumps(row, allow_nan=False)


def test_the_tables():
    rows = list(csv.DictReader(io.StringIO(cycles_table(BAGS))))
    assert [(row["bag"], row["cycle"], row["code"]) for row in rows] == [
        ("one.mcap", "c1", "ACCEPT"), ("one.mcap", "c2", "SENSOR_OR_ROBOT_MOVED"),
    ]  # fmt: skip
    assert float(rows[1]["drift_d1_mm"]) == pytest.approx(0.2)
    assert rows[0]["true_after_rms_mm"] == ""
    assert float(rows[0]["measured_in_force_share_within_tolerance"]) == 0.5
    rows = list(csv.DictReader(io.StringIO(bags_table(BAGS))))
    assert rows[2]["error"] == "BAD_INPUT: no <bag>"
    rows = list(csv.DictReader(io.StringIO(decisions_table(BAGS))))
    assert len(rows) == 6
    assert rows[2]["node"] == "/plc/session_events"
    assert rows[1]["message"] == "too <late>"


def test_the_page_needs_nothing_else_and_says_all():
    shown = {
        "one.mcap": [(), thermal_figures(CYCLES, None)], "two.mcap": [(), tool_figures([RUN])]
    }  # fmt: skip
    html = page(REPORT, shown)
    assert html.count("<svg") == 3
    assert not re.search(r"<(script|link|img|iframe|object)\b|@import", html)
    words = ("too &lt;late&gt;", "a &lt;warning&gt;", "no &lt;bag&gt;",
             "gap &lt;too&gt; short", "KR &amp; &lt;150&gt;", "3 of joint_states: late",
             "1 of 6", "LIMIT_EXCEEDED", "bit for bit", "sigma_m", "90.0%")  # fmt: skip
    for said in words:
        assert said in html.replace("<wbr>", "")
    assert "<late>" not in html
    assert 'class="mark">simulated' in html


def test_what_is_measured_is_not_called_simulated():
    html = page(REPORT | {"bags": [bag("one.mcap", THERMAL)]}, {"one.mcap": [[], []]})
    assert "simulated" not in html


def test_the_curves_are_the_numbers_of_the_cycles():
    (axes,) = accuracy_by_cycle(CYCLES).axes
    drawn = {line.get_label(): np.asarray(line.get_ydata()) for line in axes.lines}
    np.testing.assert_allclose(drawn["without correction"], [0.4, 0.4])
    np.testing.assert_allclose(drawn["candidate"], [0.1, 0.2])
    np.testing.assert_allclose(drawn["95 % bound"], [0.3, 0.3])
    np.testing.assert_allclose(drawn["refused"], [0.2])  # the one that is a fault
    accepted = next(line for line in axes.lines if line.get_marker() == "^")
    np.testing.assert_allclose(np.asarray(accepted.get_xdata()), [1.0])
    assert figures.svg(accuracy_by_cycle(CYCLES)) == figures.svg(accuracy_by_cycle(CYCLES))


COURSE = CellCourse(
    topic="/left/truth/state",
    hours=np.array([0.0, 0.5, 1.0, 1.5]),
    without_mm=np.array([0.3, 0.4, 2.0, 2.0]),
    with_mm=np.array([0.03, 0.04, 2.0, np.nan]),
    p95_mm=np.array([0.05, 0.07, 2.5, np.nan]),
    lambda_without=np.array([0.2, 0.4, 0.0, 0.0]),
    lambda_with=np.array([1.0, 0.9, 0.0, np.nan]),
    bound_mm=np.array([np.nan, 0.2, 0.2, 0.2]),
    tolerance_mm=0.3,
    faults=[{"hours": 1.0, "fault": "collision", "size": 2e-3, "told": "2 mm"}],
)


def test_the_course_of_a_cell_hour_by_hour():
    found = COURSE.document()
    first, second = found["by_hour"]
    assert (first["hour"], second["hour"]) == (1, 2)
    assert first["minutes"] == pytest.approx(60.0)
    assert first["rms_without_mm"] == pytest.approx(np.sqrt((0.09 + 0.16) / 2))
    assert first["rms_with_mm"] == pytest.approx(np.sqrt((0.0009 + 0.0016) / 2))
    assert (first["lambda_without"], first["lambda_with"]) == pytest.approx((0.3, 0.95))
    assert (first["bound_mm"], first["p95_mm"], first["time_below_bound"]) == (0.2, 0.07, 1.0)
    assert (second["rms_with_mm"], second["time_below_bound"]) == (2.0, 0.0)
    assert found["time_below_bound"] == 0.5
    json.dumps(found, allow_nan=False)


def test_the_states_of_a_cell_are_as_told_last_before_the_next_event():
    changes = [
        (1.0, "collision 2 mm"),
        (0.6, "unseen"),
        (0.9, "drift accepted"),
        (1.6, "rolled back"),
    ]
    before, bent, now = COURSE.document(changes)["states"]
    assert (before["state"], before["hours"]) == ("at the beginning", 0.0)
    assert (before["rms_without_mm"], before["rms_with_mm"], before["bound_mm"]) == (0.4, 0.04, 0.2)
    # nothing was told between 0.6 h and the collision
    assert bent["state"] == "unseen, drift accepted, collision 2 mm"
    assert (bent["hours"], bent["rms_without_mm"], bent["rms_with_mm"]) == (1.0, 2.0, None)
    # what came after the last truth claims nothing
    assert (now["state"], now["rms_without_mm"], now["rms_with_mm"]) == ("rolled back", None, None)


def test_acceptances_count_once_between_faults():
    def decided(kind, *commands):
        decisions = [
            {"stamp": 1e9 + 3600.0 * hours, "command": command, "code": code}
            for hours, command, code in commands
        ]
        return {"kind": kind, "decisions": decisions}

    ok = Code.ACCEPT.name
    thermal = decided(
        "thermal", (0.1, "accept", ok), (0.2, "accept", ok), (1.1, "accept", "CONFLICT"),
        (1.2, "accept", ok), (1.3, "accept", ok), (1.4, "identify", ok),
    )  # fmt: skip
    tool = decided("tool", (1.5, "accept", ok), (1.6, "rollback", ok))
    changes = changes_of(COURSE.faults, [thermal, tool], 1e9)
    assert sorted((round(hours, 6), words.split(" ")[0]) for hours, words in changes) == [
        (0.1, "drift"), (1.0, "collision"), (1.2, "drift"), (1.5, "tool"), (1.6, "tool:"),
    ]  # fmt: skip


def test_the_page_tells_of_the_cell():
    collided = [(1.0, "collision 2 mm")]
    cell = replace(COURSE, with_mm=np.array([0.03, 0.04, 2.0, 0.055])).document(collided)
    told = bag("one.mcap", simulated=True) | {"cells": [cell]}
    html = page(REPORT | {"bags": [told]}, {"one.mcap": [[cell_drawn(COURSE)]]})
    assert html.count("<svg") == 1
    assert "The cell, by the truth of /left/truth/state</h3>" in html
    (lead,) = re.findall(r'<p class="lead">.*</p>', html)
    assert "one.mcap: at the end the tool is off by <b>0.055 mm</b> (true, rms)" in lead
    assert "told to be below 0.200 mm. Before the first event it was off by 0.400 mm." in lead
    for said in ("collision 2 mm", "95.0%", "1.00 h"):
        assert said in html
    # before every other table
    assert html.index("Before, after each event, and now: one.mcap") < html.index("rms with</th>")
    (row, _) = csv.DictReader(io.StringIO(hours_table([told])))
    assert float(row["lambda_with"]) == pytest.approx(0.95)
    without = hours_table([bag("two.mcap")])
    assert hours_table([told]).startswith(without)
    assert without.split(",")[:3] == ["bag", "topic", "hour"]


def test_the_page_opens_with_what_was_told_last():
    """Of an event after the last truth nothing is known, and where nothing happened nothing was."""
    for changes, said in (
        ([(0.9, "collision 2 mm"), (1.6, "rolled back")], "after “collision 2 mm” the tool"),
        ([], "at the end the tool"),
    ):
        told = bag("one.mcap", simulated=True) | {"cells": [COURSE.document(changes)]}
        html = page(REPORT | {"bags": [told]}, {"one.mcap": [[cell_drawn(COURSE)]]})
        (lead,) = re.findall(r'<p class="lead">.*</p>', html)
        assert f"{said} is off by" in lead
        assert "without correction by 2.000 mm" in lead
        assert ("Before the first event" in lead) == bool(changes)


def test_the_page_names_each_of_two_cells():
    right = replace(COURSE, topic="/right/truth/state", with_mm=2.0 * COURSE.with_mm)
    cells = [COURSE, right]
    told = bag("two.mcap", simulated=True) | {"cells": [cell.document() for cell in cells]}
    html = page(REPORT | {"bags": [told]}, {"two.mcap": [[cell_drawn(cell) for cell in cells]]})
    assert html.count("<svg") == 2
    for said in (
        "two.mcap, /left/truth/state: at the end", "two.mcap, /right/truth/state: at the end",
        "by the truth of /left/truth/state</h3>", "by the truth of /right/truth/state</h3>",
    ):  # fmt: skip
        assert said in html
    rows = list(csv.DictReader(io.StringIO(hours_table([told]))))
    assert [row["topic"][:6] for row in rows] == ["/left/"] * 2 + ["/right"] * 2


def test_tables_without_a_row_have_their_columns():
    for table in (cycles_table([]), decisions_table([])):
        (head,) = table.splitlines()
        assert head.startswith("bag,")


def test_many_runs_are_drawn_over_time():
    runs = [RUN | {"run": i, "stamp": 1e9 + 1800.0 * i} for i in range(40)]
    (drawn,) = tool_figures(runs)
    assert "run 39" not in drawn.svg
    assert drawn.svg != tool_figures(runs[:39])[0].svg


@pytest.mark.parametrize(("paper", "width"), [(False, 1280), (False, 1000), (True, 718)])
def test_no_table_is_wider_than_the_page(tmp_path, paper, width):
    """Measured by a browser; 718 pixels are A4 within margins of 10 mm, by CSS 96 to an inch."""
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("there is no Chromium")
    long = "robocal_2026-11-25T23-53-23Z_of_the_cell_at_the_north_end.mcap"
    wide = cycle(3, "NO_SIGNIFICANT_GAIN") | {"cycle": "gap-20261127", "hours": 123.456}
    cycles = THERMAL | {"cycles": [*CYCLES, wide]}
    told = bag(long, cycles, TOOL, simulated=True) | {"cells": [COURSE.document([(1.0, long)])]}
    html = page(REPORT | {"bags": [told]}, {long: [[cell_drawn(COURSE)], [], []]})
    if paper:
        html = html.replace("@media print", "@media all")
    measure = (
        "<script>document.title = [...document.querySelectorAll('table')].map("
        "t => t.scrollWidth + '/' + t.parentElement.clientWidth).join(' ')</script></body>"
    )
    file = tmp_path / "page.html"
    file.write_text(html.replace("</body>", measure))
    done = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", f"--window-size={width},900",
         "--dump-dom", file.as_uri()],
        capture_output=True, text=True, check=True, timeout=HANGS_S,
    )  # fmt: skip
    (title,) = re.findall("<title>(.*)</title>", done.stdout)
    sizes = [[int(part) for part in pair.split("/")] for pair in title.split()]
    assert len(sizes) == html.count("<table")
    assert all(table <= room for table, room in sizes), sizes
