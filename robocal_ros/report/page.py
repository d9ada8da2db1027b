"""Many validated bags as one HTML page that needs nothing else."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from typing import Any

from robocal_ros.report.figures import Drawn
from robocal_ros.report.validation import TOLERANCE_MM, Document, summary_rows

# ---- parts of an HTML page that needs nothing else: no network, no script, no other file --------


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


def whole(title: str, parts: Sequence[str]) -> str:
    """A page of these elements."""
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


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
    words: Sequence[int] = (),
) -> str:
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


# ---- many validated bags as one HTML page that needs nothing else -------------------------------


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


def page(report: Document, figures: Figures) -> str:
    """The whole page.

    ``report``: what report.json holds; ``figures``: by the bag's name, one of each of its cells,
    then those of each of its sessions.
    """
    rows, bags = summary_rows(report["bags"]), report["bags"]
    simulated = any(bag.get("simulated") for bag in bags)
    mark = '<span class="mark">simulated data</span>' if simulated else ""
    parts = [
        f"<h1>{escape(report['title'])}</h1>",
        f'<p class="faint">{escape(report["created"])} · {escape(report["software"])} {mark}</p>',
        f'<p class="lead">{_answer(rows, bags)}</p>',
        *_overview(rows),
    ]
    for bag in bags:
        parts += _bag(bag, figures.get(bag["bag"], ()))
    parts += ["<h2>Where this comes from</h2>", _origin(report)]
    return whole(report["title"], parts)


def _answer(rows: Sequence[Document], bags: Sequence[Document]) -> str:
    """Is it good, in mm? In one or two sentences."""
    failed = sum("error" in row for row in rows)
    told = [_cell_answer(bag, cell) for bag in bags for cell in bag.get("cells", [])]
    for row in rows:
        if row["kind"] == "thermal" and row["rms_without_mm"] is not None:
            told.append(_thermal_answer(row))
    if failed:
        told.append(f"{failed} of {len({row['bag'] for row in rows})} bags could not be validated.")
    return "<br>".join(told) or "No thermal cycle in these bags."


def _thermal_answer(row: Document) -> str:
    """By measurements of the model that was in force: no candidate has corrected anything yet."""
    true = row["judged_by"] == "truth"
    corrected = row["rms_after_mm" if true else "rms_in_force_mm"]
    when = "after each cycle" if true else "with the model in force, at its oldest"
    return (
        f"{escape(row['bag'])}: {'true ' if true else ''}rms error {_mm(row['rms_without_mm'])} mm "
        f"without correction, <b>{_mm(corrected)} mm</b> {when} ({_accepted(row)} cycles accepted)."
    )


def _accepted(row: Document) -> str:
    return f"{row['accepted']} of {row['cycles']}"


def _cell_answer(bag: Document, cell: Document) -> str:
    name = bag["bag"] + (f", {cell['topic']}" if len(bag["cells"]) > 1 else "")
    share = f", {_share(cell['lambda_with'])} of all directions within {TOLERANCE_MM:g} mm"
    return (
        f"{escape(name)}: true rms error of the tool {_mm(cell['rms_without_mm'])} mm "
        f"without correction, <b>{_mm(cell['rms_with_mm'])} mm</b> with it"
        f"{share if cell['lambda_with'] is not None else ''}."
    )


def _overview(rows: Sequence[Document]) -> list[str]:
    parts = []
    failed = [row for row in rows if "error" in row]
    if failed:
        cells = [[row["bag"], row["error"]["code"], row["error"]["message"]] for row in failed]
        parts += ["<h2>Not validated</h2>", table(["bag", "code", "why"], cells, words=(1, 2))]
    for kind, heads, cells_of, note in (
        ("thermal", _THERMAL, _thermal_cells, ERRORS_NOTE),
        ("tool", _TOOL, _tool_cells, ""),
        ("hand_eye", _HAND_EYE, _hand_eye_cells, ""),
    ):
        chosen = [row for row in rows if row["kind"] == kind]
        if chosen:
            body = [[row["bag"], *cells_of(row), *_common(row)] for row in chosen]
            head = ["bag", *heads, "live", "refused", "warnings"]
            parts += [f"<h2>{TITLES[kind]}</h2>", table(head, body)]
            parts += [f'<p class="faint">{note}</p>'] if note else []
    return parts


_THERMAL = (
    "judged by", "accepted", "rms without", "rms in force", "rms after", "rms candidate",
    "λ without", "λ in force", "λ after", "below bound",
)  # fmt: skip
_TOOL = ("runs", "largest change, mm", "largest true error, mm")
_HAND_EYE = ("calibrations", "residual, mm", "expected error, mm", "true error, mm")


def _thermal_cells(row: Document) -> list[str]:
    return [
        row["judged_by"],
        _accepted(row),
        *(_mm(row[f"rms_{name}_mm"]) for name in ("without", "in_force", "after", "candidate")),
        *(_share(row[f"lambda_{name}"]) for name in ("without", "in_force", "after")),
        _share(row["share_below_bound"]),
    ]


def _tool_cells(row: Document) -> list[str]:
    return [str(row["runs"]), _mm(row["largest_change_mm"]), _mm(row["largest_true_error_mm"])]


def _hand_eye_cells(row: Document) -> list[str]:
    keys = ("residual_rms_mm", "predicted_rms_mm", "true_error_mm")
    return [str(row["calibrations"]), *(_mm(row[key]) for key in keys)]


def _common(row: Document) -> list[str]:
    """Does the replay give what was live? What was refused, what is to be known?"""
    live = NOTHING
    if row["as_recorded"]:
        live = f"{row['differs']} differ" if row["differs"] else "equal"
    return [live, str(row["refused"]), str(row["warnings"])]


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
    faults = [
        (_after(one["hours"]), f"{one['fault'].replace('_', ' ')} {one['told'] or 'ends'}")
        for one in cell["faults"]
    ]
    told = ["<h3>Faults that were simulated</h3>", listed(faults)] if faults else []
    return [table(head, body), note, *told]


def _after(hours: float) -> str:
    return f"{hours:.2f} h" if hours >= 1.0 else f"{hours * 60.0:.1f} min"


def _session(session: Document) -> list[str]:
    own = {"thermal": _cycles, "tool": _runs, "hand_eye": _calibrations}[session["kind"]](session)
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
        own,
        "<h3>Every decision and its reason</h3>",
        _decisions(session["decisions"]),
        listed(facts),
        f"<details><summary>Settings</summary>{listed(settings)}</details>",
    ]


def _cycles(session: Document) -> str:
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
            _share(found.get("share_within_tolerance")), _of(cycle),
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


def _of(cycle: Document) -> str:
    """How many samples were rejected; their names are in the JSON."""
    rejected = len(cycle["rejected"])
    return f"{rejected} of {cycle['samples']}" if rejected else ""


def _runs(session: Document) -> str:
    head = ["run", "answer", "code", "change, mm", "deg", "sigma, mm", "true error, mm", "why"]
    body = [
        [str(run["run"]), run["answer"], run["verdict"]["code"], _mm(run["change_mm"]),
         _mm(run["change_deg"]), _mm(run["sigma_mm"]), _mm(run["true_error_mm"]),
         run["verdict"]["reason"]]
        for run in session["runs"]
    ]  # fmt: skip
    return table(head, body, words=(1, 2, 7))


def _calibrations(session: Document) -> str:
    head = ["target", "method", "code", "residual, mm", "expected, mm", "true, mm", "why"]
    body = [
        [one["kind"], one["method"], one["verdict"]["code"], _mm(one["residual_rms_mm"]),
         _mm(one["predicted_rms_mm"]), _mm(one["true_error_mm"]), one["verdict"]["reason"]]
        for one in session["calibrations"]
    ]  # fmt: skip
    return table(head, body, words=(1, 2, 6))


def _decisions(decisions: Sequence[Document]) -> str:
    body = [
        [datetime.fromtimestamp(one["stamp"], UTC).strftime("%Y-%m-%d %H:%M:%S"),
         one["command"], one["code"], one["message"]]
        for one in decisions
    ]  # fmt: skip
    return table(["time (UTC)", "command", "code", "reason"], body, words=(1, 2, 3))


def _origin(report: Document) -> str:
    facts = [("software", report["software"]), ("date", report["created"])]
    facts += [(name, version) for name, version in report["versions"].items()]
    tables = "bags.csv, cycles.csv, decisions.csv, hours.csv, report.json"
    facts.append(("tables", f"{tables} beside this page"))
    return listed(facts)


def _mm(value: Any) -> str:
    return NOTHING if value is None else f"{value:.3f}"


def _share(value: Any) -> str:
    return NOTHING if value is None else f"{value:.1%}"
