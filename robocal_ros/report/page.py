"""Many validated bags as one HTML page that needs nothing else."""

from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from typing import Any

from robocal_ros.ground.frames import Document
from robocal_ros.report.figures import Drawn
from robocal_ros.report.validation import TOLERANCE_MM, summary_rows

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


def listed(facts: Sequence[tuple[str, str]]) -> str:
    """Names with what they stand for."""
    return "<dl>" + "".join(f"<dt>{escape(k)}</dt><dd>{escape(v)}</dd>" for k, v in facts) + "</dl>"


def figure(svg: str, caption: str) -> str:
    """A figure with its caption."""
    return (
        f'<figure role="img" aria-label="{escape(caption)}">{svg}'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]], words: Sequence[int] = ()) -> str:
    """A table; columns ``words`` are text."""

    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(
            f'<{tag} class="words">{escape(v)}</{tag}>'
            if i in words
            else f"<{tag}>{escape(v)}</{tag}>"
            for i, v in enumerate(values)
        )

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    return f'<div class="wide"><table><tr>{cells("th", head)}</tr>{body}</table></div>'


Figures = Mapping[str, Sequence[Sequence[Drawn]]]

TITLES = {
    "thermal": "Accuracy over the cycles",
    "tool": "Tools",
    "hand_eye": "Sensors on the robot",
}
NOTHING = "–"  # noqa: RUF001
OVER_BOUND = "95 % of the errors are to be below the bound that was expected before the cycle"
ERRORS_NOTE = (
    "mm. Accepted: of so many cycles. In force: the model from before a cycle, at its oldest. "
    "After: true, with what was decided at it. Candidate: measured, each pose predicted from the "
    "others, also of cycles that were refused. λ: share of all "
    f"directions within {TOLERANCE_MM:g} mm; by measurements with the noise of the cold and of the "
    f"warm visit. Below bound: {OVER_BOUND}."
)


def _mm(value: Any) -> str:
    return NOTHING if value is None else f"{value:.3f}"


def _share(value: Any) -> str:
    return NOTHING if value is None else f"{value:.1%}"


Columns = Mapping[str, Callable[[Document], str]]
OVERVIEW: Mapping[str, tuple[Columns, str]] = {
    "thermal": (
        {
            "judged by": lambda row: row["judged_by"],
            "accepted": lambda row: f"{row['accepted']} of {row['cycles']}",
            "rms without": lambda row: _mm(row["rms_without_mm"]),
            "rms in force": lambda row: _mm(row["rms_in_force_mm"]),
            "rms after": lambda row: _mm(row["rms_after_mm"]),
            "rms candidate": lambda row: _mm(row["rms_candidate_mm"]),
            "λ without": lambda row: _share(row["lambda_without"]),
            "λ in force": lambda row: _share(row["lambda_in_force"]),
            "λ after": lambda row: _share(row["lambda_after"]),
            "below bound": lambda row: _share(row["share_below_bound"]),
        },
        ERRORS_NOTE,
    ),
    "tool": (
        {
            "runs": lambda row: str(row["runs"]),
            "largest change, mm": lambda row: _mm(row["largest_change_mm"]),
            "largest true error, mm": lambda row: _mm(row["largest_true_error_mm"]),
        },
        "",
    ),
    "hand_eye": (
        {
            "calibrations": lambda row: str(row["calibrations"]),
            "residual, mm": lambda row: _mm(row["residual_rms_mm"]),
            "expected error, mm": lambda row: _mm(row["predicted_rms_mm"]),
            "true error, mm": lambda row: _mm(row["true_error_mm"]),
        },
        "",
    ),
}
"""Of each kind of session: what each column of its table shows of a row, and a note."""


def page(report: Document, figures: Figures) -> str:
    """The whole page.

    ``report``: what report.json holds; ``figures``: by the bag's name, one of each of its cells,
    then those of each of its sessions.
    """
    rows, bags = summary_rows(report["bags"]), report["bags"]
    title = escape(report["title"])
    simulated = any(bag.get("simulated") for bag in bags)
    mark = '<span class="mark">simulated data</span>' if simulated else ""
    parts = [
        f"<h1>{title}</h1>",
        f'<p class="faint">{escape(report["created"])} · {escape(report["software"])} {mark}</p>',
        f'<p class="lead">{_answer(rows, bags)}</p>',
        *_overview(rows),
    ]
    for bag in bags:
        parts += _bag(bag, figures.get(bag["bag"], ()))
    tables = "bags.csv, cycles.csv, decisions.csv, hours.csv, report.json"
    origin = [
        ("software", report["software"]),
        ("date", report["created"]),
        *report["versions"].items(),
        ("tables", f"{tables} beside this page"),
    ]
    parts += ["<h2>Where this comes from</h2>", listed(origin)]
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{title}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def _answer(rows: Sequence[Document], bags: Sequence[Document]) -> str:
    """Is it good, in mm? In one or two sentences.

    By measurements it tells of the model that was in force: no candidate has corrected anything
    yet.
    """
    answers = []
    for bag in bags:
        for cell in bag.get("cells", []):
            name = bag["bag"] + (f", {cell['topic']}" if len(bag["cells"]) > 1 else "")
            share = ""
            if cell["lambda_with"] is not None:
                share = f", {_share(cell['lambda_with'])} of all directions within "
                share += f"{TOLERANCE_MM:g} mm"
            answers.append(
                f"{escape(name)}: true rms error of the tool {_mm(cell['rms_without_mm'])} mm "
                f"without correction, <b>{_mm(cell['rms_with_mm'])} mm</b> with it{share}."
            )
    for row in rows:
        if row["kind"] == "thermal" and row["rms_without_mm"] is not None:
            true = row["judged_by"] == "truth"
            corrected = row["rms_after_mm" if true else "rms_in_force_mm"]
            when = "after each cycle" if true else "with the model in force, at its oldest"
            answers.append(
                f"{escape(row['bag'])}: {'true ' if true else ''}rms error "
                f"{_mm(row['rms_without_mm'])} mm without correction, <b>{_mm(corrected)} mm</b> "
                f"{when} ({row['accepted']} of {row['cycles']} cycles accepted)."
            )
    if failed := sum("error" in row for row in rows):
        count = len({row["bag"] for row in rows})
        answers.append(f"{failed} of {count} bags could not be validated.")
    return "<br>".join(answers) or "No thermal cycle in these bags."


def _overview(rows: Sequence[Document]) -> list[str]:
    """A table of each kind of session; its last columns: does the replay give what was live?"""
    parts = []
    failed = [row for row in rows if "error" in row]
    if failed:
        cells = [[row["bag"], row["error"]["code"], row["error"]["message"]] for row in failed]
        parts += ["<h2>Not validated</h2>", table(["bag", "code", "why"], cells, words=(1, 2))]
    for kind, (columns, note) in OVERVIEW.items():
        body = []
        for row in rows:
            if row["kind"] == kind:
                live = NOTHING
                if row["as_recorded"]:
                    live = f"{row['differs']} differ" if row["differs"] else "equal"
                own = [shown(row) for shown in columns.values()]
                body.append([row["bag"], *own, live, str(row["refused"]), str(row["warnings"])])
        if body:
            head = ["bag", *columns, "live", "refused", "warnings"]
            parts += [f"<h2>{TITLES[kind]}</h2>", table(head, body)]
            parts += [f'<p class="faint">{note}</p>'] if note else []
    return parts


def _bag(bag: Document, figures: Sequence[Sequence[Drawn]]) -> list[str]:
    if "error" in bag:
        return []
    mark = ' <span class="mark">simulated</span>' if bag["simulated"] else ""
    parts = [
        f"<h2>{escape(bag['bag'])}{mark}</h2>",
        f'<p class="faint">{bag["from"]} to {bag["to"]}, {bag["duration_s"] / 3600.0:.2f} h</p>',
    ]
    cells, *sessions = figures
    for cell, drawn in zip(bag["cells"], cells, strict=True):
        parts.append(f"<h3>The cell, by the truth of {escape(cell['topic'])}</h3>")
        parts += [figure(drawn.svg, drawn.caption), *_cell(cell)]
    for session, shown in zip(bag["sessions"], sessions, strict=True):
        parts.append(f"<h3>{TITLES[session['kind']]}</h3>")
        parts += [figure(drawn.svg, drawn.caption) for drawn in shown]
        parts += _session(session)
    if bag["skipped"]:
        parts += ["<h3>Not replayed</h3>", listed([*bag["skipped"].items()])]
    for node, decisions in bag["other_decisions"].items():
        parts += [f"<h3>Decisions of {escape(node)}</h3>", _decisions(decisions)]
    return parts


def _cell(cell: Document) -> list[str]:
    head = ["hour", "rms without", "rms with", "λ without", "λ with", "bound", "p95", "below bound"]
    body = [
        [str(row["hour"]), _mm(row["rms_without_mm"]), _mm(row["rms_with_mm"]),
         _share(row["lambda_without"]), _share(row["lambda_with"]), _mm(row["bound_mm"]),
         _mm(row["p95_mm"]), _share(row["time_below_bound"])]
        for row in cell["by_hour"]
    ]  # fmt: skip
    note = (
        '<p class="faint">mm, of the tool at the working poses. Bound: 95 % of the errors were '
        "expected below it; p95: 95 % truly were; below bound: share of the time in which p95 was. "
        f"λ: share of all directions within {TOLERANCE_MM:g} mm.</p>"
    )
    faults = []
    for one in cell["faults"]:
        hours = one["hours"]
        after = f"{hours:.2f} h" if hours >= 1.0 else f"{hours * 60.0:.1f} min"
        faults.append((after, f"{one['fault'].replace('_', ' ')} {one['told'] or 'ends'}"))
    shown = ["<h3>Faults that were simulated</h3>", listed(faults)] if faults else []
    return [table(head, body), note, *shown]


def _session(session: Document) -> list[str]:
    words = session["node"] or "no recorded commands: cycles found by their recurring poses, each "
    words += "" if session["node"] else "candidate accepted where its verdict accepts it"
    facts = [("session", words), ("robot", f"{session['robot']}, model {session['model_hash']}")]
    if session["as_recorded"]:
        equal = "every recorded result comes out equal, bit for bit"
        facts.append(("replay", "; ".join(session["differs"]) or equal))
    gaps = session["gaps"]
    if gaps["count"]:
        facts.append(("pauses of joints", f"{gaps['count']}, longest {gaps['longest_s']:.2f} s"))
    facts += [("warning", words) for words in session["warnings"]]
    facts += [
        ("not used", f"{number} of {topic}: {why}")
        for topic, reasons in session["ignored"].items()
        for why, number in reasons.items()
    ]
    settings = [(name, str(value)) for name, value in session["settings"].items()]
    return [
        _results(session),
        "<h3>Every decision and its reason</h3>",
        _decisions(session["decisions"]),
        listed(facts),
        f"<details><summary>Settings</summary>{listed(settings)}</details>",
    ]


def _results(session: Document) -> str:
    """Every thermal cycle, tool run or hand-eye calibration of a session."""
    if session["kind"] == "tool":
        head = ["run", "answer", "code", "change, mm", "deg", "sigma, mm", "true error, mm", "why"]
        body = [
            [str(run["run"]), run["answer"], run["verdict"]["code"], _mm(run["change_mm"]),
             _mm(run["change_deg"]), _mm(run["sigma_mm"]), _mm(run["true_error_mm"]),
             run["verdict"]["reason"]]
            for run in session["runs"]
        ]  # fmt: skip
        return table(head, body, words=(1, 2, 7))
    if session["kind"] == "hand_eye":
        head = ["target", "method", "code", "residual, mm", "expected, mm", "true, mm", "why"]
        body = [
            [one["kind"], one["method"], one["verdict"]["code"], _mm(one["residual_rms_mm"]),
             _mm(one["predicted_rms_mm"]), _mm(one["true_error_mm"]), one["verdict"]["reason"]]
            for one in session["calibrations"]
        ]  # fmt: skip
        return table(head, body, words=(1, 2, 6))
    head = ["cycle", "hour", "code", "revision", "without", "in force", "candidate", "expected",
            "bound", "true after", "λ", "rejected"]  # fmt: skip
    body = []
    for cycle in session["cycles"]:
        true, forecast = cycle["true"] or {}, cycle["forecast"] or {}
        found = true.get("after") or (cycle["measured"] or {}).get("in_force") or {}
        body.append([
            cycle["cycle"], f"{cycle['hours']:.2f}", cycle["verdict"]["code"],
            str(cycle["revision"] or NOTHING),
            *(_mm(cycle[name]["rms_mm"]) for name in ("nominal", "in_force", "candidate")),
            _mm(cycle["predicted_rms_mm"]), _mm(forecast.get("bound_mm")),
            _mm((true.get("after") or {}).get("rms_mm")),
            _share(found.get("share_within_tolerance")),
            f"{len(cycle['rejected'])} of {cycle['samples']}" if cycle["rejected"] else "",
        ])  # fmt: skip
    note = (
        '<p class="faint">Rms in mm. Candidate: each pose predicted from the others; expected: the '
        "same from the covariances. Bound: below it 95 % of the tool's errors were expected before "
        "the cycle, at the session's work_poses, without any throughout the workspace. λ: of the "
        "true errors after the cycle where they are "
        "known, else of those measured with the model in force before it. Rejected: samples that "
        "the others contradict.</p>"
    )
    return table(head, body, words=(2,)) + note


def _decisions(decisions: Sequence[Document]) -> str:
    body = [
        [datetime.fromtimestamp(one["stamp"], UTC).strftime("%Y-%m-%d %H:%M:%S"),
         one["command"], one["code"], one["message"]]
        for one in decisions
    ]  # fmt: skip
    return table(["time (UTC)", "command", "code", "reason"], body, words=(1, 2, 3))
