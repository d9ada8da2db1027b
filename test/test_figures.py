# SPDX-License-Identifier: Apache-2.0
"""What the pages quote of bench/results is what stands there, rounded as the page has it."""

import json
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
NUMBER = re.compile(r"(?<![\w.])\d+(?:\.(\d+))?(?![\w.])")
# First cell of a table of accuracy.md; part and table of bench/results; how many rows make one of
# the page's.
QUOTED = [
    ("campaign", "real_data", "ur10_campaigns", 3),
    ("used in", "real_data", "ur10_later", 2),
    ("poses", "real_data", "ur10_few_poses", 1),
    ("unknown", "monte_carlo", "efficiency", 1),
    ("true robot", "monte_carlo", "unmodelled", 1),
]
# The same of sources.md: which of its cells are ours, in how many rows that follow each other.
LIKE_FOR_LIKE = [
    ("| by cycle and direction", "thermal", "thermal_counting", slice(1, 3), 1),
    ('robot; what "0.1 mm" of repeatability is', "tool", "tool_erring", slice(2, None), 2),
    ("arm", "hand_eye_tracker", "hand_eye_erring", slice(2, None), 4),
    ("target", "hand_eye", "hand_eye_count", slice(1, None), 1),
]
# Of the pages of hand-eye calibration by camera and by laser tracker.
JOINTS = [
    ("camera", "hand_eye_camera", "hand_eye_camera_joints"),
    ("arcs and scan", "hand_eye_tracker", "hand_eye_tracker_joints"),
]
CLOSED_FORMS = [
    ("accuracy.md", r"closed\s+forms\s+are\s+at\s+([\d.]+)\s+to\s+([\d.]+\d)"),
    ("hand_eye_camera.md", r"the\s+closed\s+forms\s+([\d.]+)\s+to\s+([\d.]+\d)"),
]


SENTENCES = [
    (
        "ur10_harm",
        r"([\d.]+) times the geometric model's rms in the median, ([\d.]+) at .*? ([\d.]+) in",
    ),
    ("ur10_known_geometry", r"functions to a mean of ([\d.]+), ([\d.]+) and ([\d.]+) mm"),
]
# Of speed: page and words; of each number there the table, cells of its row, the column, the unit.
SPEEDS = [
    (
        "accuracy",
        r"forward kinematics, 10 000 poses \| ([\d.]+) ms .*?: ([\d.]+) ms \| (\d+) times",
        "speed",
        [("kinematics", ("forward kinematics",), column, 1.0) for column in (1, 2, 3)],
    ),
    (
        "accuracy",
        r"Jacobian, 10 000 poses \| ([\d.]+) ms .*?: ([\d.]+) ms \| (\d+) times",
        "speed",
        [("kinematics", ("Jacobian",), column, 1.0) for column in (1, 2, 3)],
    ),
    (
        "accuracy",
        r"least squares \| ([\d.]+) ms .*? in NumPy: (\d+) ms \| ([\d.]+) of .*? takes ([\d.]+) ms",
        "speed",
        [
            ("identification", ("ours",), 1, 1.0),
            ("identification", ("scipy, Jacobian in NumPy",), 1, 1.0),
            ("identification", ("ours",), 2, 1.0),
            ("identification", ("scipy, our compiled Jacobian",), 1, 1.0),
        ],
    ),
    (
        "accuracy",
        r"robust \(default\) \| ([\d.]+) ms .*? loss: (\d+) ms \| ([\d.]+) of .*? over ([\d.]+) s",
        "speed",
        [
            ("identification", ("ours, robust (the default)",), 1, 1.0),
            ("identification", ("scipy, the same with Huber's loss",), 1, 1.0),
            ("identification", ("ours, robust (the default)",), 2, 1.0),
            ("identification", ("pybotics",), 1, 1e-3),
        ],
    ),
    (
        "accuracy",
        r"UR10, 250 poses \| ([\d.]+) s \| ([\d.]+) s as .*? 5961 poses \| ([\d.]+) s",
        "speed",
        [
            ("full_model_speed", ("UR10", 250), 2, 1.0),
            ("full_model_speed", ("UR10", 250), 4, 1.0),
            ("full_model_speed", ("UR10", 5961), 2, 1.0),
        ],
    ),
    (
        "accuracy",
        r"under load, 250, 6000, 20 000 poses \| ([\d.]+), ([\d.]+), ([\d.]+) s",
        "speed",
        [("full_model_speed", ("KR 150, simulated", n), 2, 1.0) for n in (250, 6000, 20000)],
    ),
    (
        "replay",
        r"per second of a core \| ([\d.]+) million, ([\d.]+) times",
        "replay_speed",
        [
            ("joint_ingestion", ("ours, as far as the desk",), 1, 1e-6),
            ("joint_ingestion", ("ours, as far as the desk",), 2, 1.0),
        ],
    ),
    (
        "replay",
        r"whole replay \| ([\d.]+) s, (\d+) times .*?"
        r"([\d.]+) s and ([\d.]+) s .*? (\d+) MB and (\d+) MB",
        "replay_speed",
        [
            ("replay_speed", (cycles,), column, 1.0)
            for cycles, column in ((96, 4), (96, 6), (24, 8), (96, 8), (24, 10), (96, 10))
        ],
    ),
    (
        "replay",
        r"two processes over one \| (\d+) s, ([\d.]+) times .*? count were ([\d.]+) times",
        "replay_speed",
        [
            ("many_bags", ("validate", 2), 2, 1.0),
            ("many_bags", ("validate", 2), 4, 1.0),
            ("many_bags", ("counting", 2), 4, 1.0),
        ],
    ),
]


def figures(part, name):
    """Numbers of each row of a kept table, cells with a goal by their value."""
    document = json.loads((DOCS.parent / "bench" / "results" / f"{part}.json").read_text())
    (table,) = (t for t in document["tables"] if t["name"] == name)
    values = [[c["value"] if isinstance(c, dict) else c for c in row] for row in table["rows"]]
    return [[v for v in row if isinstance(v, int | float)] for row in values], table["rows"]


def rows_quoted(first, name="accuracy.md"):
    page = (DOCS / name).read_text()
    table = page[page.index(f"| {first} |") :].split("\n\n")[0]
    return [line.strip("|").split("|") for line in table.splitlines()[2:]]


def shown(text, kept):
    """Whether a number as a page has it is one of those kept, rounded."""
    decimals = len(NUMBER.fullmatch(text)[1] or "")
    return any(f"{value:.{decimals}f}" == text for value in kept)


@pytest.mark.parametrize(("first", "part", "name", "rows"), QUOTED, ids=[q[0] for q in QUOTED])
def test_a_table_has_the_kept_figures(first, part, name, rows):
    kept, _ = figures(part, name)
    for place, cells in enumerate(rows_quoted(first)):
        numbers = [n for row in kept[rows * place : rows * (place + 1)] for n in row]
        quoted = [found[0] for cell in cells[1:] for found in NUMBER.finditer(cell)]
        assert quoted, cells
        assert [text for text in quoted if not shown(text, numbers)] == [], (cells[0], numbers)


@pytest.mark.parametrize(("first", "part", "name"), JOINTS)
def test_a_table_of_joints_that_err_has_the_kept_figures(first, part, name):
    numbers, rows = figures(part, name)
    for kept, row, cells in zip(numbers, rows, rows_quoted(first, f"{part}.md"), strict=True):
        assert cells[1].strip() == row[1]
        assert all(shown(cell.strip(), kept) for cell in cells[2:]), (cells, kept)


def kept_or_skipped(part, name):
    """As `figures`; a part that was kept before its table was made has to be kept anew."""
    try:
        return figures(part, name)
    except ValueError:
        pytest.skip(f"{name} is not in bench/results yet: python -m bench --keep {part}")


@pytest.mark.parametrize(("first", "part", "name", "cut", "rows"), LIKE_FOR_LIKE)
def test_a_table_beside_the_sources_has_the_kept_figures(first, part, name, cut, rows):
    kept, _ = kept_or_skipped(part, name)
    at = 0
    for cells in rows_quoted(first, "sources.md"):
        quoted = [found[0] for cell in cells[cut] for found in NUMBER.finditer(cell)]
        assert quoted, cells
        groups = ((k, [n for row in kept[k : k + rows] for n in row]) for k in range(at, len(kept)))
        at = next((k for k, group in groups if all(shown(t, group) for t in quoted)), -1)
        assert at >= 0, cells


def test_the_rounds_beside_the_source_are_the_kept_ones():
    _, rows = kept_or_skipped("thermal", "thermal_rounds")
    (told,) = re.findall(r"by cycle: classic (.*?);", (DOCS / "sources.md").read_text(), re.DOTALL)
    quoted = [text for text in re.findall(r"[\d.]+", told) if "." in text]
    assert quoted == [f"{row[1]:.1f}" for row in rows if row[1] is not None]


@pytest.mark.parametrize(("name", "words"), SENTENCES, ids=[name for name, _ in SENTENCES])
def test_a_sentence_has_the_kept_figures_of_few_poses(name, words):
    _, rows = figures("real_few", name)
    goals = [cell["value"] for row in rows for cell in row if isinstance(cell, dict)]
    quoted = re.search(words, " ".join((DOCS / "accuracy.md").read_text().split())).groups()
    assert list(quoted) == [
        f"{goal:.{len(t.split('.')[1])}f}" for goal, t in zip(goals, quoted, strict=True)
    ]


@pytest.mark.parametrize(("page", "words"), CLOSED_FORMS, ids=[page for page, _ in CLOSED_FORMS])
def test_a_sentence_has_the_range_of_the_closed_forms(page, words):
    numbers, rows = figures("hand_eye_camera", "hand_eye_camera_bound")
    found = [n for row, told in zip(rows, numbers, strict=True) if "OpenCV" in row[1] for n in told]
    least, most = re.search(words, (DOCS / page).read_text()).groups()
    assert shown(least, [min(found)])
    assert shown(most, [max(found)])


def test_sentences_of_a_mount_by_a_robot_with_gears_have_the_kept_figures():
    """Of the whole mount by the root of its squares over covariance; of the field by rms."""
    _, rows = figures("hand_eye", "hand_eye_effects")
    kept = {row[1]: row for row in rows if "gears" in row[0]}
    field = [f"{kept[target][4]:.2f}" for target in ("edge", "sphere", "stairs")]
    whole = f"{kept['edge'][5] ** 0.5:.1f}"
    told = " ".join((DOCS / "accuracy.md").read_text().split())
    words = r"error \(rms\) is ([\d.]+) .*?, the sphere's ([\d.]+), the stairs' ([\d.]+) \("
    assert list(re.search(words, told).groups()) == field
    assert re.search(r"1\.2 to ([\d.]+) \(unknown edge\)", told)[1] == whole
    there = " ".join((DOCS / "simulation.md").read_text().split())
    words = r"edge is at ([\d.]+) sigmas of .*? alone at ([\d.]+) of the error"
    assert re.search(words, there).groups() == (whole, field[0])


def test_the_readme_has_the_kept_figures_of_the_real_robot():
    """Ranges: of the nominal model, the full one, the geometry; and of the full one of A later."""
    campaigns, later = (figures("real_data", f"ur10_{name}") for name in ("campaigns", "later"))
    means = [[row[1] for row in campaigns[0][kind::3]] for kind in (0, 2, 1)]
    means.append([row[2] for row in later[0][1:6:2]])
    assert [row[2] for row in campaigns[1][:3]] == ["nominal", "geometric", "full"]
    assert [row[3] for row in later[1][:6]] == 3 * ["geometric", "full"]
    assert [row[0] for row in later[1][:6:2]] == 3 * ["A"]
    text = (DOCS.parent / "README.md").read_text()
    quoted = re.findall(r"(\d\.\d\d)\N{EN DASH}(\d\.\d\d) mm", text)
    assert quoted == [(f"{min(kept):.2f}", f"{max(kept):.2f}") for kept in means]


def test_the_shares_of_programs_and_frames_are_the_kept_ones_robot_by_robot():
    numbers, _ = figures("programs", "frame_shift")
    _, taught, shifted, best, _, program, _ = zip(*numbers, strict=True)
    found = rows_quoted("simulated shift of a KR 150 that warms up, 34 poses, tool", "programs.md")
    for (_, cell), kept in zip(found, (taught, shifted, best, program), strict=True):
        assert cell.strip(" %").split(", ") == [f"{value:.1f}" for value in kept]


def rounded(cell, kept):
    """A kept number as a cell has it, with as many decimals."""
    found = NUMBER.search(cell)
    return f"{kept:.{len(found[1] or '')}f}" == found[0]


def test_the_shares_within_a_tenth_of_a_millimetre_are_the_kept_ones():
    """Shift by shift with the worst robot's; the mean of three shifts is of one decimal each."""
    (_, real), (_, plain) = (figures("thermal", f"thermal_shares{k}") for k in ("", "_modelled"))
    for cells, own, without in zip(rows_quoted("method"), real, plain, strict=True):
        quoted = [cell.strip(" *") for cell in cells[1:]]
        assert quoted[:3] == own[1:4]
        assert rounded(quoted[3], own[4])
        mean = sum(float(words.split()[0]) for words in without[1:4]) / 3.0
        assert float(quoted[4]) == pytest.approx(mean, abs=0.05 + 0.05)
        assert quoted[5].replace(",", "") == (own[5] or "")


def test_what_a_line_goes_by_between_cycles_has_the_kept_figures():
    numbers, rows = figures("thermal", "thermal_between")
    assert rows[-1][0] == "all"
    held, tracker, warm, ratio, warm_ratio, *_ = numbers[-1]
    quoted = rows_quoted("what the line goes by")
    for cells, kept in zip(quoted, ((held, 1), (tracker, ratio), (warm, warm_ratio)), strict=True):
        assert all(rounded(cell, k) for cell, k in zip(cells[1:], kept, strict=True)), cells


def test_whether_bounds_of_a_drift_are_true_has_the_kept_figures():
    _, rows = figures("thermal", "thermal_bounds")
    for cells, row in zip(rows_quoted("errors inside the 95 % bound"), rows, strict=True):
        kept = (row[1], row[5], row[6], row[8])
        assert all(rounded(cell, k) for cell, k in zip(cells[1:], kept, strict=True)), cells


def test_the_real_arm_in_the_order_of_time_has_the_kept_figures():
    _, rows = figures("thermal", "ur10_tracked")
    kept = {(row[0], row[1]): row[2] for row in rows}
    places = {"the first ten hours": "first 10 hours", "every": "every second pose"}
    for cells in rows_quoted("known from"):
        place = next(name for words, name in places.items() if words in cells[0])
        model = {"geometry": "geometric"}.get(cells[1].strip(), cells[1].strip())
        quoted = zip(("static", "tracked", "refitted"), cells[2:], strict=True)
        told = [(way, cell) for way, cell in quoted if cell.strip()]
        assert told
        for way, cell in told:
            assert rounded(cell, kept[place, f"{way}, {model}"]), cells
    told = re.search(
        r"static model is nearer in (\d+ of \d+) blocks", (DOCS / "accuracy.md").read_text()
    )
    assert told[1] == rows[5][5]


def test_what_compliances_without_masses_leave_has_the_kept_figures():
    (_, heavy), (_, real) = (figures("masses", name) for name in ("heavy", "ur10_masses"))
    few, many, quoted = heavy[:3], heavy[3:], rows_quoted("compliances", "identify.md")
    for (_, _, *cells), *rows in zip(quoted, few, many, real, strict=True):
        kept = (rows[0][2], rows[1][2], *rows[2][1:3])
        assert all(rounded(cell, k) for cell, k in zip(cells, kept, strict=True)), cells
    told = r"flange\]\(identify.md#the-full-model\): ([\d.]+) mm instead\s+of ([\d.]+), of 12 such"
    quoted = re.search(told, (DOCS / "accuracy.md").read_text()).groups()
    assert all(rounded(one, row[2]) for one, row in zip(quoted, few[1:], strict=True))


def test_what_is_said_of_streams_has_the_kept_figures():
    page = " ".join((DOCS / "joint_correction_figures.md").read_text().split())
    hour = (DOCS / "figures" / "soak_correction.md").read_text()
    targets, compared = re.search(
        r"of ([\d ]+) targets none was .*? of the ([\d ]+) that", page
    ).groups()
    for what, told in (
        ("targets", targets),
        ("targets compared with the model in force", compared),
    ):
        assert f"| {what} | {told.replace(' ', '')} |" in hour
    for what in ("refused or ended: none", "of them stale"):
        assert f"| {what} | 0 |" in hour
    kept = {
        (row[0], row[1]): row[2:5]
        for row in figures("correction_stream", "correction_beside_relay")[1]
    }
    told = (
        r"median is ([\d.]+) of the relay's at 500 Hz \(([\d.]+) and ([\d.]+) ms\) and ([\d.]+) at"
    )
    ratio, node, relay, faster = re.search(told, page).groups()
    (relay_kept, node_kept, ratio_kept), (*_, faster_kept) = (
        kept[rate, "median"] for rate in (500, 1000)
    )
    for quoted, figure in (
        (ratio, ratio_kept),
        (node, node_kept),
        (relay, relay_kept),
        (faster, faster_kept),
    ):
        assert rounded(quoted, figure), (quoted, figure)
    told = r"99 % \(([\d.]+), ([\d.]+)\) and processor time \(([\d.]+), ([\d.]+)\)"
    wanted = [
        kept[rate, what][2] for what in ("99 %", "CPU time per message") for rate in (500, 1000)
    ]
    quoted = re.search(told, page).groups()
    assert all(rounded(one, of) for one, of in zip(quoted, wanted, strict=True)), quoted


def test_how_fast_a_correction_is_has_the_kept_figures():
    _, rows = figures("correction", "correction_speed")
    kept = {row[0]: row[1:4] for row in rows}
    tasks = {
        "one point, compiled": "one point, compiled entry",
        "the same, full model": "one point, full model",
        "one point, `Joint": "one point, with a whole report",
        "batch of 10 000 ": "10000 points",
        "batch of 10 000, full model": "10000 points, full model",
        "batch of 10 000, free axis": "10000 points, free axis",
    }
    name = "joint_correction_figures.md"
    *ours, peer = rows_quoted("KR 150, 1 mm drift, tool 2 mm and 0.5 deg", name)
    for (first, us, share, _), (words, task) in zip(ours, tasks.items(), strict=True):
        assert first.strip(" ").startswith(words.strip())
        assert (us.strip(), share.strip()) == (f"{kept[task][0]:.2f}", f"{kept[task][2]:.3f}")
    assert rounded(peer[1], kept["10000 points"][1])
    page = " ".join((DOCS / name).read_text().split())
    words = (
        r"arrays in and out: ([\d.]+) ms at 0\.12 mm .*? and ([\d.]+) ms at 1 mm "
        r".*? accelerations (\d+) ms"
    )
    _, times = figures("correction", "correction_trajectory")
    quoted = re.search(words, page).groups()
    assert all(rounded(one, row[1]) for one, row in zip(quoted, times[:3], strict=True)), quoted


def test_crossings_of_singularities_have_the_kept_figures():
    """Of a drift: wanted, out, left, off; of tools bent by 2 and by 9 mm: wanted, left, off."""
    _, rows = figures("correction", "correction_crossings")
    kept = [[c["value"] if isinstance(c, dict) else c for c in row] for row in rows]
    drifts = rows_quoted("a drift", "joint_correction_figures.md")
    bent = rows_quoted("a bent tool", "joint_correction_figures.md")
    groups = zip(kept[::3], kept[1::3], kept[2::3], drifts, bent, strict=True)
    for drift, by_2_mm, by_9_mm, cells, pairs in groups:
        assert cells[1].strip() == pairs[1].strip() == drift[1]
        wanted, left, off, out = (5, 8, 10, 12)
        for cell, column in zip(cells[2:], (wanted, out, left, off), strict=True):
            assert rounded(cell, drift[column]), (cells, drift)
        for cell, column in zip(pairs[2:], (wanted, left, off), strict=True):
            quoted = zip(cell.split("/"), (by_2_mm, by_9_mm), strict=True)
            assert all(rounded(one, row[column]) for one, row in quoted), (pairs, cell)


def test_where_a_correction_gets_has_the_kept_figures():
    """Postures and iterations of six equations and of five, all robots together."""
    tools = ("0 mm, 0 deg", "2 mm, 0.5 deg", "20 mm, 7 deg")
    _, rows = figures("correction", "correction_reach")
    reached = rows_quoted("tool | postures | 2 | 3", "joint_correction_figures.md")
    _, ways = figures("correction", "correction_round_trip")
    back = rows_quoted("tool | six equations", "joint_correction_figures.md")
    for tool, cells, told in zip(tools, reached, back, strict=True):
        of = [[row for row in rows if row[1:3] == [tool, equations]] for equations in (6, 5)]
        for cell, column in zip(cells[1:], (4, 6, 7, 8, 9, 10), strict=True):
            quoted = [int(one.replace(" ", "")) for one in cell.split("/")]
            assert quoted == [sum(row[column] for row in part) for part in of], cells
        for cell, equations in zip(told[1:], (6, 5), strict=True):
            found = [row for row in ways if row[1:3] == [tool, equations]]
            count = sum(row[3] for row in found)
            beyond = sum(row[5] for row in found)
            words = f"all of {count:,}".replace(",", " ") if count >= 10_000 else f"all of {count}"
            assert beyond == 0
            assert cell.strip().startswith(words if count else "none"), cell


@pytest.mark.parametrize(
    ("page", "words", "part", "where"),
    SPEEDS,
    ids=[f"{page} {where[0][0]} {where[0][1][0]}" for page, _, _, where in SPEEDS],
)
def test_what_is_said_of_speed_has_the_kept_figures(page, words, part, where):
    text = " ".join((DOCS / f"{page}.md").read_text().split())
    found = re.search(words, text).groups()
    for quoted, (name, cells, column, unit) in zip(found, where, strict=True):
        (row,) = (row for row in figures(part, name)[1] if all(cell in row for cell in cells))
        assert rounded(quoted, row[column] * unit), (quoted, row)


def test_how_long_a_mount_takes_has_the_kept_figures():
    _, rows = figures("speed", "hand_eye_speed")
    page = " ".join((DOCS / "hand_eye_node.md").read_text().split())
    words = r"poses: ([\d.]+) to ([\d.]+) s in the median, ([\d.]+) s at the longest"
    medians, longest = [row[1] for row in rows], max(row[2] for row in rows)
    quoted = re.search(words, page).groups()
    for one, kept in zip(quoted, (min(medians), max(medians), longest), strict=True):
        assert rounded(one, kept), (one, kept)


@pytest.mark.parametrize(
    ("page", "words", "nodes"),
    [
        (
            "thermal_node",
            r"Measured: ([\d.]+) s in the median, ([\d.]+) s at most",
            [("thermal_node", 1), ("thermal_node", 2)],
        ),
        (
            "joint_correction_figures",
            r"node answers ([\d.]+) s after .*? a bare node takes ([\d.]+) s",
            [("joint_correction_node", 1), ("bare rclpy node", 1)],
        ),
    ],
)
def test_what_is_said_of_starts_has_the_kept_figures(page, words, nodes):
    kept = {row[0]: row for row in figures("startup", "startup")[1]}
    text = " ".join((DOCS / f"{page}.md").read_text().split())
    quoted = re.search(words, text).groups()
    assert all(
        rounded(one, kept[node][column]) for one, (node, column) in zip(quoted, nodes, strict=True)
    )
