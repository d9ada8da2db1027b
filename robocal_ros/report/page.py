# SPDX-License-Identifier: Apache-2.0
"""Many validated bags together: rows and tables, and one HTML page that needs nothing else."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from typing import Any

import numpy as np

from robocal_ros.estimation.assessment import summarise
from robocal_ros.ground.frames import Array, Document
from robocal_ros.report.figures import NO_FAULT, TOLERANCE_MM, Drawn

ERRORS = ("without", "in_force", "after")
MEASURED = {"without": "nominal", "in_force": "in_force", "candidate": "candidate"}
ERROR_KEYS = ("mean_mm", "rms_mm", "p95_mm", "max_mm", "share_within_tolerance")
CYCLE = ("bag", "cycle", "stamp", "hours", "samples", "code", "revision")
DECISION = ("bag", "node", "stamp", "command", "code", "message")
HOUR = (
    "bag", "topic", "hour", "minutes", "rms_without_mm", "rms_with_mm", "lambda_without",
    "lambda_with", "bound_mm", "p95_mm", "time_below_bound",
)  # fmt: skip


def summary_rows(bags: Sequence[Document]) -> list[Document]:
    """A row for each session of each bag; one with ``error`` for a bag that gave none.

    One with ``skipped``, which says why, for a session that could not be replayed.
    """
    rows = []
    for bag in bags:
        if "error" in bag:
            rows.append({"bag": bag["bag"], "kind": None, "error": bag["error"]})
        rows += [_row(bag, session) for session in bag.get("sessions", [])]
        rows += [
            {"bag": bag["bag"], "kind": None, "node": node, "skipped": why}
            for node, why in bag.get("skipped", {}).items()
        ]
    return rows


def _row(bag: Document, session: Document) -> Document:
    refused = [d for d in session["decisions"] if d["code"] not in NO_FAULT]
    if session["kind"] == "thermal":
        own = _thermal(session)
    elif session["kind"] == "tool":
        own = {"runs": len(session["runs"])}
        for name in ("change_mm", "true_error_mm"):
            known = [run[name] for run in session["runs"] if run[name] is not None]
            own[f"largest_{name}"] = max(known, default=None)
    else:
        last = (session["calibrations"] or [{}])[-1]
        own = {"calibrations": len(session["calibrations"])}
        for key in ("residual_rms_mm", "predicted_rms_mm", "true_error_mm"):
            own[key] = last.get(key)
    return {
        "bag": bag["bag"],
        "kind": session["kind"],
        "node": session["node"],
        "robot": session["robot"],
        "simulated": bag["simulated"],
        "duration_s": bag["duration_s"],
        "as_recorded": session["as_recorded"],
        "differs": len(session["differs"]),
        "decisions": len(session["decisions"]),
        "refused": len(refused),
        "warnings": len(session["warnings"]),
        **own,
    }


def _thermal(session: Document) -> Document:
    """Errors by the truth where the bag has one, else those of the verdicts.

    What was in force after a cycle only the truth knows; by measurements there is what the
    candidates promised, those too that nobody accepted.
    """
    cycles, true, measured = session["cycles"], session["true"], session["measured"] or {}
    rms = dict.fromkeys((*ERRORS, *MEASURED))
    if true is not None:
        rms |= {name: true[name]["rms_mm"] for name in ERRORS}
    else:
        rms |= {name: pooled_rms_mm(cycles, judged) for name, judged in MEASURED.items()}
    shares = {
        name: (true or measured).get(name, {}).get("share_within_tolerance") for name in ERRORS
    }
    return {
        "cycles": len(cycles),
        "accepted": sum(cycle["revision"] > 0 for cycle in cycles),
        "judged_by": "truth" if true is not None else "measurements",
        **{f"rms_{name}_mm": value for name, value in rms.items()},
        **{f"lambda_{name}": value for name, value in shares.items()},
        "share_below_bound": session["bound"]["measured_share" if true is None else "true_share"],
    }


def pooled_rms_mm(cycles: Sequence[Document], key: str) -> float | None:
    """Rms over the held-out measurements of all cycles; None without cycles."""
    if not cycles:
        return None
    n = np.array([cycle[key]["n"] for cycle in cycles])
    rms = np.array([cycle[key]["rms_mm"] for cycle in cycles])
    return float(np.sqrt(np.sum(n * rms**2) / np.sum(n)))


def bags_table(bags: Sequence[Document]) -> str:
    """The rows as CSV."""
    rows = [
        {**row, "error": f"{row['error']['code']}: {row['error']['message']}"}
        if "error" in row
        else row
        for row in summary_rows(bags)
    ]
    return _csv(rows)


def cycles_table(bags: Sequence[Document]) -> str:
    """Every thermal cycle as CSV."""
    rows = []
    for bag, cycle in thermal_cycles(bags):
        row = {name: cycle[name] for name in ("cycle", "stamp", "hours", "samples")}
        row |= {"code": cycle["verdict"]["code"], "revision": cycle["revision"]}
        for name in ("nominal", "in_force", "candidate"):
            row[f"{name}_rms_mm"] = cycle[name]["rms_mm"]
        row |= {
            "predicted_rms_mm": cycle["predicted_rms_mm"],
            "bound_mm": (cycle["forecast"] or {}).get("bound_mm"),
        }
        for judge in ("measured", "true"):
            for name in ERRORS:
                found = (cycle[judge] or {}).get(name) or {}
                row |= {f"{judge}_{name}_{key}": found.get(key) for key in ERROR_KEYS}
        row |= {f"drift_{name}": value for name, value in cycle["drift"].items()}
        row |= {f"sigma_{name}": value for name, value in cycle["sigma"].items()}
        rows.append({"bag": bag["bag"], **row, "reason": cycle["verdict"]["reason"]})
    return _csv(rows, CYCLE)


def thermal_cycles(bags: Sequence[Document]) -> list[tuple[Document, Document]]:
    """Every bag's thermal cycles, each with its bag."""
    return [
        (bag, cycle)
        for bag in bags
        for session in bag.get("sessions", [])
        if session["kind"] == "thermal"
        for cycle in session["cycles"]
    ]


def decisions_table(bags: Sequence[Document]) -> str:
    """Every decision as CSV."""
    rows = []
    for bag in bags:
        sessions = [(session["node"], session["decisions"]) for session in bag.get("sessions", [])]
        for node, decisions in [*sessions, *bag.get("other_decisions", {}).items()]:
            rows += [{"bag": bag["bag"], "node": node, **decision} for decision in decisions]
    return _csv(rows, DECISION)


def hours_table(bags: Sequence[Document]) -> str:
    """Every hour of each simulated cell as CSV."""
    return _csv(
        [
            {"bag": bag["bag"], "topic": cell["topic"], **hour}
            for bag in bags
            for cell in bag.get("cells", [])
            for hour in cell["by_hour"]
        ],
        HOUR,
    )


def _csv(rows: Sequence[Mapping[str, Any]], first: Sequence[str] = ()) -> str:
    """``first``: columns that a table without rows has too."""
    columns = list(dict.fromkeys((*first, *(name for row in rows for name in row))))
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        cells = {name: row.get(name) for name in columns}
        for name, value in cells.items():
            if isinstance(value, float) and abs(value) < 1e6:
                cells[name] = f"{value:.9g}"
        writer.writerow(cells)
    return stream.getvalue()


def figures_of(error: Array) -> dict[str, float]:
    """Mean, rms, p95, max of the distances, mm, and the share of directions in tolerance.

    ``error`` is (..., 3), m; a direction is one coordinate at one pose.
    """
    found = summarise(error.reshape(-1, 3))
    within = np.abs(error) * 1e3 < TOLERANCE_MM
    return {
        "mean_mm": found.mean_m * 1e3,
        "rms_mm": found.rms_m * 1e3,
        "p95_mm": found.p95_m * 1e3,
        "max_mm": found.max_m * 1e3,
        "share_within_tolerance": float(np.mean(within)),
        "n": found.n,
    }


LONG = 24  # letters; the longest code has 21
MANY = 9  # columns
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
  font-size: .9rem; }
th, td { text-align: right; padding: .42rem .45rem; border-bottom: 1px solid var(--line);
  vertical-align: top; }
th { color: var(--faint); font-weight: 600; }
th:first-child, td:first-child, td.words, th.words { text-align: left; }
.many th, .many td { padding: .4rem .22rem; font-size: .95em; }
.long { overflow-wrap: anywhere; }
td.long:first-child { min-width: 6.5rem; }
figure { margin: 1rem 0 0; }
figure svg { width: 100%; height: auto; display: block; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.2rem;
  margin: .8rem 0 0; font-size: .93rem; }
dt { color: var(--faint); }
dd { margin: 0; overflow-wrap: anywhere; }
@media (max-width: 62rem) { .wide { overflow-x: auto; } }
@media print { body { max-width: none; padding: 0; font-size: 10.5pt; }
  table { font-size: 8pt; } th, td, .many th, .many td { padding: .2rem .2rem; }
  td.long:first-child { min-width: 4.5rem; }
  figure, tr { break-inside: avoid; } h2, h3 { break-after: avoid; } }
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
    """A table; columns ``words`` are text, in which a code breaks behind its underscores alone.

    Sentences and long names break anywhere.
    """

    def cell(tag: str, column: int, value: str) -> str:
        long = tag == "td" and (" " in value or len(value) > LONG)
        kinds = ["words"] * (column in words) + ["long"] * long
        text = escape(value).replace("_", "_<wbr>") if column in words else escape(value)
        kind = f' class="{" ".join(kinds)}"' if kinds else ""
        return f"<{tag}{kind}>{text}</{tag}>"

    def cells(tag: str, values: Sequence[str]) -> str:
        return "".join(cell(tag, column, value) for column, value in enumerate(values))

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows)
    many = " many" if len(head) > MANY else ""
    return f'<div class="wide{many}"><table><tr>{cells("th", head)}</tr>{body}</table></div>'


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
OVERVIEW: Mapping[str, tuple[tuple[Columns, ...], str]] = {
    "thermal": (
        (
            {
                "judged by": lambda row: row["judged_by"],
                "accepted": lambda row: f"{row['accepted']} of {row['cycles']}",
                "rms without": lambda row: _mm(row["rms_without_mm"]),
                "rms in force": lambda row: _mm(row["rms_in_force_mm"]),
                "rms after": lambda row: _mm(row["rms_after_mm"]),
                "rms candidate": lambda row: _mm(row["rms_candidate_mm"]),
            },
            {
                "λ without": lambda row: _share(row["lambda_without"]),
                "λ in force": lambda row: _share(row["lambda_in_force"]),
                "λ after": lambda row: _share(row["lambda_after"]),
                "below bound": lambda row: _share(row["share_below_bound"]),
            },
        ),
        ERRORS_NOTE,
    ),
    "tool": (
        (
            {
                "runs": lambda row: str(row["runs"]),
                "largest change, mm": lambda row: _mm(row["largest_change_mm"]),
                "largest true error, mm": lambda row: _mm(row["largest_true_error_mm"]),
            },
        ),
        "",
    ),
    "hand_eye": (
        (
            {
                "calibrations": lambda row: str(row["calibrations"]),
                "residual, mm": lambda row: _mm(row["residual_rms_mm"]),
                "expected error, mm": lambda row: _mm(row["predicted_rms_mm"]),
                "true error, mm": lambda row: _mm(row["true_error_mm"]),
            },
        ),
        "",
    ),
}
"""Of each kind of session: what the columns of its tables show of a row, and a note."""


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
        *_states(bags),
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
            first, known = cell["states"][0], [one for one in cell["states"] if _is_told(one)]
            now = (known or cell["states"])[-1]
            end = "at the end" if now is cell["states"][-1] else f"after “{now['state']}”"
            before = ""
            if first is not now:
                before = f" Before the first event it was off by {_mm(first['rms_without_mm'])} mm."
            bound = ""
            if now["bound_mm"] is not None:
                bound = f"; 95 % of the errors were told to be below {_mm(now['bound_mm'])} mm"
            answers.append(
                f"{escape(_name_of(bag, cell))}: {escape(end)} the tool is off by "
                f"<b>{_mm(now['rms_with_mm'])} mm</b> (true, rms), without correction by "
                f"{_mm(now['rms_without_mm'])} mm{bound}.{before}"
            )
    told = {bag["bag"] for bag in bags if bag.get("cells")}  # of these the truth was told above
    for row in rows:
        measured = row["kind"] == "thermal" and row["rms_without_mm"] is not None
        if measured and row["bag"] not in told:
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


def _is_told(state: Document) -> bool:
    """Whether the truth was told in it."""
    return state["rms_without_mm"] is not None


def _name_of(bag: Document, cell: Document) -> str:
    return f"{bag['bag']}, {cell['topic']}" if len(bag["cells"]) > 1 else str(bag["bag"])


def _states(bags: Sequence[Document]) -> list[str]:
    """Of each simulated cell: the state before, after each event, and now."""
    parts = []
    head = ["state", "from", "rms without", "rms with", "95 % below", "bound told"]
    for bag in bags:
        for cell in bag.get("cells", []):
            body = [
                [one["state"], _after(one["hours"]),
                 *(_mm(one[n]) for n in ("rms_without_mm", "rms_with_mm", "p95_mm", "bound_mm"))]
                for one in cell["states"]
            ]  # fmt: skip
            name = escape(_name_of(bag, cell))
            parts += [
                f"<h2>Before, after each event, and now: {name}</h2>",
                table(head, body, (0,)),
            ]
    note = (
        '<p class="faint">True errors of the tool at the working poses, mm, as they were when '
        "the next event came, in the last row at the end. With: of what was commanded last. 95 % "
        "below: of these errors; bound told: what the line could read then, below which 95 % were "
        "to be.</p>"
    )
    return [*parts, note] if parts else []


def _after(hours: float) -> str:
    return f"{hours:.2f} h" if hours >= 1.0 else f"{hours * 60.0:.1f} min"


def _overview(rows: Sequence[Document]) -> list[str]:
    """A table of each kind of session; its last columns: does the replay give what was live?"""
    parts = []
    failed = [row for row in rows if "error" in row]
    if failed:
        cells = [[row["bag"], row["error"]["code"], row["error"]["message"]] for row in failed]
        parts += ["<h2>Not validated</h2>", table(["bag", "code", "why"], cells, words=(1, 2))]
    for kind, (tables, note) in OVERVIEW.items():
        own = [row for row in rows if row["kind"] == kind]
        if not own:
            continue
        parts.append(f"<h2>{TITLES[kind]}</h2>")
        for columns in tables:
            shown = dict(columns)
            if columns is tables[-1]:
                shown |= {"live": _live, "refused": lambda row: str(row["refused"])}
                shown |= {"warnings": lambda row: str(row["warnings"])}
            body = [[row["bag"], *(cell(row) for cell in shown.values())] for row in own]
            parts.append(table(["bag", *shown], body))
        parts += [f'<p class="faint">{note}</p>'] if note else []
    return parts


def _live(row: Document) -> str:
    """Does the replay give what was live?"""
    if not row["as_recorded"]:
        return NOTHING
    return f"{row['differs']} differ" if row["differs"] else "equal"


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
    # Of a recording within an hour its states tell more than the mean of all of them.
    hours = [table(head, body), note] if len(body) > 1 else []
    faults = []
    for one in cell["faults"]:
        faults.append(
            (_after(one["hours"]), f"{one['fault'].replace('_', ' ')} {one['told'] or 'ends'}")
        )
    shown = ["<h3>Faults that were simulated</h3>", listed(faults)] if faults else []
    return [*hours, *shown]


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
