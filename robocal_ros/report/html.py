"""A report as one HTML page that needs nothing else: no network, no script, no other file."""

from collections.abc import Sequence
from html import escape

from robocal_ros.report import figures
from robocal_ros.report.drift import TOLERANCE_MM, DriftReport

CSS = """
:root { --ink: #22303a; --faint: #6d7b85; --line: #e1e6ea; --accent: #0f6f86; --warm: #c2603a; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 58rem; padding: 2.5rem 1.5rem 4rem; color: var(--ink);
  font: 16px/1.55 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 .3rem; letter-spacing: -.01em; }
h2 { font-size: 1.15rem; margin: 2.6rem 0 .6rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 .4rem; }
summary { cursor: pointer; color: var(--faint); margin: 1rem 0; }
p { max-width: 46rem; }
.lead { font-size: 1.15rem; margin: 1.2rem 0; }
.lead b { color: var(--accent); white-space: nowrap; }
.mark { display: inline-block; border: 1.5px solid var(--warm); color: var(--warm);
  border-radius: 4px; padding: .1rem .55rem; font-size: .8rem; font-weight: 650;
  letter-spacing: .06em; text-transform: uppercase; }
.faint, figcaption { color: var(--faint); font-size: .9rem; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums;
  font-size: .93rem; }
th, td { text-align: right; padding: .42rem .7rem; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { color: var(--faint); font-weight: 600; }
th:first-child, td:first-child, td.words, th.words { text-align: left; }
td:first-child { white-space: nowrap; }
tr.good td { color: var(--accent); font-weight: 600; }
figure { margin: 1rem 0 0; }
figure svg { width: 100%; height: auto; display: block; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.2rem; margin: 0;
  font-size: .93rem; }
dt { color: var(--faint); }
dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 40rem) { .wide { overflow-x: auto; } }
@media print { body { max-width: none; padding: 0; font-size: 10.5pt; }
  figure, tr { break-inside: avoid; } h2 { break-after: avoid; } }
"""


def page(report: DriftReport) -> str:
    """The whole page."""
    origin = report.origin
    mark = '<span class="mark">simulated</span>' if origin.simulated else ""
    parts = [
        f"<h1>{escape(report.title)}</h1>",
        f'<p class="faint">{escape(origin.robot)}, serial {escape(origin.serial)} · '
        f"{escape(origin.created)} {mark}</p>",
        f'<p class="lead">{_answer(report)}</p>',
        _errors(report),
        "<h2>Over the shift</h2>",
        figure(figures.svg(figures.drift_over_time(report)), "Error over the shift"),
        figure(figures.svg(figures.error_by_pose(report)), "Error of each check pose"),
        "<h2>How the model moved</h2>",
        figure(
            figures.svg(figures.parameter_drift(report)),
            "The parameters that moved most in units of their own standard deviation; the band "
            "is two standard deviations. Single parameters can trade with each other: the error "
            "at the check poses decides.",
        ),
        "<h2>Every decision and its reason</h2>",
        _decisions(report),
        "<h2>Where this comes from</h2>",
        _origin(report),
    ]
    return whole(report.title, parts)


def whole(title: str, parts: Sequence[str]) -> str:
    """A page of these elements."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def _answer(report: DriftReport) -> str:
    """Is it good, in mm? In one sentence."""
    (_, before), (_, after), _ = report.rows()
    return (
        f"The tool's mean error at {report.before.shape[1]} check poses over "
        f"{report.hours[-1]:.1f} h fell from {before['mean_mm']:.3f} mm to "
        f"<b>{after['mean_mm']:.3f} mm</b>; <b>{after['share_within_tolerance']:.1%}</b> of all "
        f"directions are within {TOLERANCE_MM:g} mm, {before['share_within_tolerance']:.1%} "
        "without correction."
    )


def _errors(report: DriftReport) -> str:
    head = ["", "mean", "rms", "p95", "max", f"directions within {TOLERANCE_MM:g} mm"]
    keys = ("mean_mm", "rms_mm", "p95_mm", "max_mm")
    rows = [
        [name, *(f"{found[key]:.3f}" for key in keys), f"{found['share_within_tolerance']:.1%}"]
        for name, found in report.rows()
    ]
    note = (
        '<p class="faint">mm at the tool, against where the cold robot put it. No check pose was '
        "measured or used to solve. Before a cycle the model in force is at its oldest; after it, "
        "renewed where the verdict accepts.</p>"
    )
    return table(head, rows, good=1) + note


def _decisions(report: DriftReport) -> str:
    head = ["cycle", "hour", "verdict", "revision", "predicted", "achieved", "why"]
    rows = []
    for i, decided in enumerate(report.decisions):
        achieved = float(report.document()["cycles"][i]["after"]["rms_mm"])
        predicted = "" if decided.predicted_mm is None else f"{decided.predicted_mm:.3f}"
        why = decided.reason
        if decided.rejected:
            why += "; samples rejected: " + ", ".join(decided.rejected)
        rows.append(
            [decided.cycle, f"{report.hours[i]:.2f}", decided.code, str(decided.revision),
             predicted, f"{achieved:.3f}", why]
        )  # fmt: skip
    note = (
        '<p class="faint">Predicted: rms error at the check poses, expected from the covariance of '
        "the model in force; achieved: rms there; both in mm, after the decision.</p>"
    )
    return table(head, rows, words=(2, 6)) + note


def _origin(report: DriftReport) -> str:
    origin = report.origin
    facts = [
        ("data", origin.data),
        ("kind", "simulated" if origin.simulated else "measured"),
        ("robot", origin.robot),
        ("serial", origin.serial),
        ("nominal model", origin.model_hash),
        ("software", origin.commit),
        ("date", origin.created),
    ]
    return listed(facts)


def listed(facts: Sequence[tuple[str, str]]) -> str:
    """Names with what they stand for."""
    return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts) + "</dl>"


def figure(svg: str, caption: str) -> str:
    """A figure with its caption."""
    return (
        f'<figure role="img" aria-label="{escape(caption)}">{svg}'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    good: int | None = None,
    words: Sequence[int] = (),
) -> str:
    """A table; row ``good`` is the one to look at, columns ``words`` are text."""

    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(
            f'<{tag} class="words">{escape(v)}</{tag}>'
            if i in words
            else f"<{tag}>{escape(v)}</{tag}>"
            for i, v in enumerate(values)
        )

    body = "".join(
        f'<tr class="good">{cells("td", row)}</tr>' if i == good else f"<tr>{cells('td', row)}</tr>"
        for i, row in enumerate(rows)
    )
    return f'<div class="wide"><table><tr>{cells("th", head)}</tr>{body}</table></div>'
