"""The report: numbers that can be checked by hand, and a page that needs nothing else."""

import csv
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from robocal_ros.report import figures
from robocal_ros.report.drift import Decided, DriftReport, Origin, figures_of, read_report
from robocal_ros.report.html import page

CYCLES, POSES = 4, 6
NAMES = ("d1_mm", "theta1_deg", "a2_mm", "beta2_deg")


def make_report(simulated: bool = True) -> DriftReport:
    rng = np.random.default_rng(0)
    before = rng.normal(0.0, 2e-4, (CYCLES, POSES, 3))
    return DriftReport(
        title="A shift <tested> & told",
        origin=Origin(simulated, "bag & words", "KR 150", "S<1>", "0123abcd", "robocal 0", "today"),
        hours=np.arange(1.0, CYCLES + 1.0),
        decisions=[
            Decided("c1", "ACCEPT", "better", 1, ("17",), 0.05),
            Decided("c2", "WORSE_THAN_CURRENT", "0.2 mm against 0.1 mm", 1, (), 0.06),
            Decided("c3", "BAD_INPUT", "nothing <measured>", 1),
            Decided("c4", "ACCEPT", "better", 2, (), 0.04),
        ],
        before=before,
        after=0.25 * before,
        held=0.5 * before,
        parameter_names=NAMES,
        drift=rng.normal(0.0, 0.1, (CYCLES, len(NAMES))),
        sigma=np.full((CYCLES, len(NAMES)), 0.02),
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


def test_json_has_every_decision_and_no_more_than_json():
    report = make_report()
    document = json.loads(json.dumps(report.document(), allow_nan=False))
    assert document["simulated"] is True
    verdicts = [cycle["verdict"]["code"] for cycle in document["cycles"]]
    assert verdicts == [decided.code for decided in report.decisions]
    assert [cycle["verdict"]["accept"] for cycle in document["cycles"]] == [
        True,
        False,
        False,
        True,
    ]
    before, after, oldest = document["errors"].values()
    assert after["mean_mm"] == pytest.approx(0.25 * before["mean_mm"])
    assert oldest["max_mm"] == pytest.approx(0.5 * before["max_mm"])


def test_csv_has_every_error():
    report = make_report()
    rows = list(csv.DictReader(io.StringIO(report.table())))
    assert len(rows) == CYCLES * POSES
    row = rows[POSES + 2]
    assert (row["cycle"], row["check_pose"]) == ("c2", "3")
    assert float(row["before_y_mm"]) == pytest.approx(report.before[1, 2, 1] * 1e3, abs=1e-4)


def test_a_report_is_read_back(tmp_path):
    report = make_report()
    (tmp_path / "r.json").write_text(json.dumps(report.document()))
    (tmp_path / "r.csv").write_text(report.table())
    again = read_report(tmp_path / "r.json", tmp_path / "r.csv")
    np.testing.assert_allclose(again.before, report.before, atol=6e-8)
    assert again.document()["cycles"][0]["drift"] == report.document()["cycles"][0]["drift"]
    assert again.origin == report.origin


class Page(HTMLParser):
    """Tags, attributes and text of a page; an unclosed tag is an error."""

    EMPTY = frozenset(("meta", "link", "br", "img", "input", "hr"))

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in self.EMPTY:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        if self._open[-1:] != ["style"]:
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def html() -> str:
    return page(make_report())


def test_the_page_needs_nothing_else(html):
    shown = Page(html)
    for tag, attributes in shown.tags:
        assert tag not in ("script", "link", "iframe", "img", "object", "embed")
        for name in ("src", "href", "xlink:href", "data", "action"):
            value = attributes.get(name) or "#"
            assert value.startswith("#"), f"<{tag} {name}={value}>"
    assert not re.search(r"@import|url\(\s*[\"']?(?!#)", html)


def test_the_page_shows_its_figures_numbers_and_reasons(html):
    report, shown = make_report(), Page(html)
    assert sum(tag == "svg" for tag, _ in shown.tags) == 3
    for _, found in report.rows():
        assert f"{found['mean_mm']:.3f}" in shown.text
        assert f"{found['share_within_tolerance']:.1%}" in shown.text
    for decided in report.decisions:
        assert decided.code in shown.text
        assert decided.reason in shown.text
    assert "samples rejected: 17" in shown.text
    for words in ("S<1>", "0123abcd", "robocal 0", "today", "bag & words", "A shift <tested>"):
        assert words in shown.text


def test_what_is_simulated_says_so_and_what_is_measured_too(html):
    assert re.search(r'class="mark">simulated<', html)
    measured = page(make_report(simulated=False))
    assert 'class="mark"' not in measured
    assert "simulated" not in Page(measured).text
    assert "measured" in Page(measured).text


def test_ids_of_the_figures_do_not_clash(html):
    """Figures of one page share its name space: a reference must find its own definition."""
    definitions: dict[str, str] = {}
    for found in re.finditer(r'<clipPath id="([^"]+)">(.*?)</clipPath>', html, re.DOTALL):
        name, body = found.groups()
        assert definitions.setdefault(name, body) == body
    used = set(re.findall(r"url\(#([^)]+)\)", html))
    assert used <= set(definitions)


def test_figures_are_drawn_the_same_each_time():
    report = make_report()
    for draw in (figures.drift_over_time, figures.error_by_pose, figures.parameter_drift):
        first, second = figures.svg(draw(report)), figures.svg(draw(report))
        assert first == second
        assert figures.png(draw(report)).startswith(b"\x89PNG")


def test_the_drift_curve_shows_the_mean_error():
    """The line of the figure is the number of the table."""
    report = make_report()
    (axes,) = figures.drift_over_time(report).axes
    line = next(line for line in axes.lines if line.get_color() == figures.BEFORE)
    assert np.asarray(line.get_ydata())[0] == 0.0
    expected = [figures_of(error)["mean_mm"] for error in report.before]
    np.testing.assert_allclose(np.asarray(line.get_ydata())[1:], expected)
