// SPDX-License-Identifier: Apache-2.0
// The page: draws what /events tells. Texts go in as text nodes only; docs/panel.md.
"use strict";

const STALE_MS = 3500;      // an event comes each second
const RECONNECT_MS = 8000;  // a stream that is open and silent is opened anew
const SHIFT_S = 12 * 3600;
const BREAK_S = 150;        // a line is broken where nothing was seen for so long
const LEVELS = ["NONE", "OK", "DUE", "DEGRADED", "EXPIRED", "FAULT"];
const DECIDED = ["thermal", "tool", "fixture"];  // kinds; a fixture's goes on with its name
const ICONS = {
  OK: "M12 34 26 48 52 16",
  DUE: "M32 6a26 26 0 1 0 .1 0M32 18v15l10 8",
  DEGRADED: "M32 8 60 56H4zM32 26v14M32 48v.1",
  EXPIRED: "M20 22a12 12 0 1 1 17 11c-4 2-5 4-5 8M32 54v.1",
  FAULT: "M21 4h22l17 17v22L43 60H21L4 43V21zM32 18v18M32 47v.1",
  RUNNING: "M10 56h26M22 56V36L40 22l12 10M52 32v10",
  BREAKING_OFF: "M28 12 10 30l18 18M12 30h28a14 14 0 0 1 0 28",
  SILENT: "M10 10 54 54M18 30a20 20 0 0 1 6-4M46 30a20 20 0 0 0-9-6M8 22a32 32 0 0 1 8-6" +
    "M56 22a34 34 0 0 0-24-10M26 40a10 10 0 0 1 6-2M32 52v.1",
};

const initial = JSON.parse(document.getElementById("initial").textContent);
const { words, language } = initial;
const by = (id) => document.getElementById(id);
const label = (key, ...numbers) => fill(words.labels[key] ?? key, numbers);
let session = initial.session;
let state = initial.state ?? null;
let curve = initial.curve ?? [];
let history_ = initial.history ?? { trouble: "", absent: "", in_force: [], results: [], tools: [] };
let receivedAt = state ? Date.now() : 0;
let source = null;
let openedAt = 0;
let asking = null;          // the decision that waits for a second press
const drawn = {};

function fill(text, numbers) {
  return text.replace(/\{(\d)\}/g, (_, n) => numbers[n] ?? "");
}

function make(tag, options = {}, ...children) {
  const made = tag === "svg" || options.svg
    ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [name, value] of Object.entries(options)) {
    if (name === "svg" || value === undefined || value === false) continue;
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

const put = (id, ...children) => by(id).replaceChildren(...children.filter((c) => c !== null));

// Draws a part only where what it shows has changed: a button does not go from under a finger.
function draw(name, shown, how) {
  const key = JSON.stringify(shown);
  if (drawn[name] !== key) {
    drawn[name] = key;
    how(shown);
  }
}

function span(seconds) {
  const s = Math.max(0, Math.round(seconds));
  if (s < 90) return `${s} s`;
  if (s < 5400) return `${Math.round(s / 60)} min`;
  return `${Math.floor(s / 3600)} h ${Math.floor((s % 3600) / 60)} min`;
}

const clock = (seconds, precise) => new Date(seconds * 1000).toLocaleTimeString(language,
  { hour: "2-digit", minute: "2-digit", second: precise ? "2-digit" : undefined, hour12: false });
const day = (seconds) => new Date(seconds * 1000).toLocaleDateString(language,
  { month: "short", day: "numeric" });
const figure = (value, digits) => value.toLocaleString(language,
  { minimumFractionDigits: digits, maximumFractionDigits: digits });
const mm = (value) => `${figure(value, 2)}\u00a0mm`;
const sentences = (text) => text.split(/(?<=[.?!]) |(?<=[。？！])/).filter(Boolean);

// ---- parts --------------------------------------------------------------------------------------

function connected() {
  const since = Date.now() - receivedAt;
  return state !== null && since < STALE_MS && since > -1000;
}

function drawState() {
  const live = connected();
  const level = live ? state.headline : "SILENT";
  document.body.classList.toggle("old", level === "SILENT");
  draw("state", level, () => {
    by("state").dataset.level = level;
    by("sentence").textContent = words.sentences[level];
    put("icon", make("svg", { viewBox: "0 0 64 64" },
      make("path", { svg: true, d: ICONS[level] ?? ICONS.FAULT })));
    document.title = `${words.sentences[level]} – robocal`;
  });
  const robot = [state?.robot, state?.serial].filter(Boolean).join(" · ");
  by("robot").textContent = robot || "robocal";
  const figures = [];
  if (live && state.headline !== "SILENT") {
    figures.push(state.bound_mm === null ? label("no_bound") : label("below", mm(state.bound_mm)));
    if (state.tolerance_mm !== null) figures.push(`${label("allowed")} ${mm(state.tolerance_mm)}`);
    if (state.due_in_s !== null && !["RUNNING", "BREAKING_OFF"].includes(level)) {
      figures.push(`${label(state.due_in_s < 0 ? "overdue" : "due")} ${span(Math.abs(state.due_in_s))}`);
    }
  }
  draw("figures", figures, () => put("figures", ...figures.map((text) => make("span", {}, text))));
  const lost = state === null || state.age_s === null ? null
    : state.age_s + (Date.now() - receivedAt) / 1000;
  by("age").textContent = live ? (lost === null ? "" : label("heard", span(lost)))
    : [label("no_page"), lost === null ? "" : label("heard", span(lost))].join(" ");
  const tasks = live ? state.tasks : [{ key: "state/SILENT", code: "", detail: "" }];
  draw("tasks", tasks, () => put("tasks", ...tasks.map(drawnTask)));
  draw("acts", [live && state.maintenance, live && state.at_home, session.users, asking],
    () => put("acts", ...acts(live)));
}

function drawnTask(task) {
  const more = [task.code, task.detail].filter(Boolean).join(": ");
  const lines = sentences(words.instructions[task.key] ?? task.key);
  return make("li", {}, ...lines.map((line) => make("span", {}, line)),
    more ? make("details", {}, make("summary", {}, label("details")), make("p", {}, more)) : null);
}

function acts(live) {
  if (!live || !session.users) return [];
  const offered = { IDLE: state.at_home ? ["run"] : [], RUNNING: ["cancel"], FAULT: ["acknowledge"] };
  return (offered[state.maintenance] ?? []).flatMap((act) => asking?.act === act && !asking.id
    ? [make("button", { type: "button", class: "danger", onclick: () => send(act) },
        label(`really_${act}`)), back()]
    : [make("button", { type: "button", class: act === "cancel" ? "danger" : "main",
        onclick: () => act === "cancel" ? send(act) : ask({ act }) }, label(act))]);
}

function back() {
  return make("button", { type: "button", onclick: () => { asking = null; redraw(); } },
    label("back"));
}

function drawCandidates() {
  const pending = history_.results.filter((r) => r.state === "pending" && DECIDED.includes(r.kind.split("/")[0]));
  const known = new Set(pending.map((r) => r.id));
  const others = (state?.waiting ?? []).filter((id) => !known.has(id)).map((id) => ({ id }));
  draw("candidates", [pending, others, session.users, asking], () => {
    const shown = [...pending, ...others].map(drawnCandidate);
    put("candidates", ...(shown.length ? shown
      : [make("p", { class: "soft" }, label("no_candidates"))]));
  });
}

function kindOf(kind) {
  const [first, name] = kind.split("/");
  return [words.labels[first] ?? first, name].filter(Boolean).join(" ");
}

function drawnCandidate(result) {
  const kind = result.kind ? kindOf(result.kind) : "";
  const time = result.stamp_ns ? `${day(result.stamp_ns / 1e9)} ${clock(result.stamp_ns / 1e9)}` : "";
  const rms = result.candidate_rms_mm ? ` · ${mm(result.candidate_rms_mm)}` : "";
  const mine = asking?.id === result.id;
  const reason = mine ? make("input", { maxlength: 200, "aria-label": label("why"),
    placeholder: label("why") }) : null;
  const buttons = !session.users ? [] : mine
    ? [make("button", { type: "button", class: asking.act === "accept" ? "main" : "danger",
        onclick: () => send(asking.act, { id: result.id, reason: reason.value }) },
        label(`really_${asking.act}`)), back()]
    : ["accept", "reject"].map((act) => make("button", { type: "button",
        onclick: () => ask({ act, id: result.id }) }, label(act)));
  return make("div", { class: "item", "data-id": result.id },
    make("div", { class: "row" }, make("strong", {}, `${kind} #${result.id}${rms}`),
      make("span", {}, time)),
    result.reason ? make("p", { class: "soft" }, result.reason) : null,
    reason, make("div", { class: "buttons" }, ...buttons));
}

function drawGap() {
  const shown = state && [state.steps, state.last, state.cycle_id];
  draw("gap", shown, () => {
    if (!state || (!state.last && !state.steps.length)) {
      put("gap", make("p", { class: "soft" }, label("no_gap")));
      return;
    }
    const running = ["RUNNING", "BREAKING_OFF"].includes(state.maintenance);
    const last = running ? null : state.last;
    const steps = state.steps.map((step) => make("li", { class: "row" },
      make("span", {}, fill(words.steps[step.key] ?? "{0}", step.numbers)),
      make("span", {}, clock(step.at_s, true))));
    const end = last ? label(last.code !== "ACCEPT" ? "broken" : last.complete ? "done" : "partly") : "";
    put("gap",
      steps.length ? make("ol", {}, ...steps) : make("p", { class: "soft" }, label("no_steps")),
      last ? make("div", { class: "item row" }, make("strong", {}, end),
        make("span", {}, clock(last.at_s, true))) : null,
      last && last.left.length ? make("p", {}, last.left.join("; ")) : null,
      last ? make("details", {}, make("summary", {}, label("details")),
        make("p", {}, `${state.last.code}: ${last.message}`)) : null);
  });
}

function drawTools() {
  draw("tools", [history_.tools, history_.results], () => {
    const rows = history_.tools.map((tool) => {
      const result = history_.results.find((r) => r.id === tool.id);
      const moved = tool.moved_mm === null ? label("first") : label("moved", figure(tool.moved_mm, 2));
      return drawnResult(result, moved);
    });
    put("tools", ...(rows.length ? rows : [make("p", { class: "soft" }, label("no_tool"))]));
  });
  const note = history_.trouble || history_.absent;
  draw("history", [history_.results, note], () => put("history",
    note ? make("p", {}, note) : null,
    ...history_.results.map((result) => drawnResult(result, result.code))));
}

function drawnResult(result, what) {
  const decided = result.decisions.map((d) => `${clock(d.wall_ns / 1e9)} ${d.action} ${d.by}` +
    (d.reason ? `: ${d.reason}` : ""));
  return make("div", { class: "item" },
    make("div", { class: "row" },
      make("span", {}, make("strong", {}, `#${result.id} ${kindOf(result.kind)} `),
        make("span", { class: `tag ${result.state}` }, label(result.state))),
      make("span", {}, `${day(result.stamp_ns / 1e9)} ${clock(result.stamp_ns / 1e9)}`)),
    make("p", { class: "soft" }, what),
    decided.length ? make("p", { class: "soft" }, decided.join(" · ")) : null);
}

function drawShift() {
  draw("shift", state?.shift, () => {
    if (!state) return;
    const { gaps, complete, accepted, open } = state.shift;
    const rows = [["gaps", gaps], ["complete", complete],
      ["accepted", accepted.map((id) => `#${id}`).join(" ") || label("nothing")],
      ["open", open.join("; ") || label("nothing")]];
    put("shift", ...rows.flatMap(([key, value]) =>
      [make("dt", {}, label(key)), make("dd", {}, String(value))]));
  });
}

// ---- the curve ----------------------------------------------------------------------------------

function drawCurve() {
  const width = by("chart").clientWidth;
  draw("curve", [curve, state?.tolerance_mm, width], () => {
    if (!curve.length || width < 50) {
      put("chart", make("p", { class: "soft" }, label("no_points")));
      put("legend");
      return;
    }
    put("chart", chart(width, 230, state?.tolerance_mm ?? null));
    put("legend",
      ...[["bound", "bound"], ["error", "expected"], ["allowed", "allowed"]].map(([kind, text]) =>
        make("span", {}, make("span", { class: `key ${kind}` }), label(text))),
      make("span", {}, label("seen_since", clock(curve[0][0]))));
  });
}

function chart(width, height, allowed) {
  const [left, right, top, bottom] = [46, 10, 14, 40];
  const end = curve[curve.length - 1][0] + 60;
  const start = Math.max(Math.min(curve[0][0], end - 3600), end - SHIFT_S);
  const most = Math.max(0.05, (allowed ?? 0) * 1.3, ...curve.map((p) => (p[2] ?? p[1] ?? 0) * 1.1));
  const x = (t) => left + (t - start) / (end - start) * (width - left - right);
  const y = (v) => height - bottom - v / most * (height - top - bottom);
  const svg = make("svg", { viewBox: `0 0 ${width} ${height}`, role: "img",
    "aria-label": label("error") });
  const add = (tag, options, ...children) =>
    svg.append(make(tag, { svg: true, ...options }, ...children));
  const step = [0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5].find((s) => most / s <= 5) ?? most / 4;
  for (let v = 0; v <= most; v += step) {
    add("line", { class: "grid", x1: left, x2: width - right, y1: y(v), y2: y(v) });
    add("text", { x: left - 6, y: y(v) + 5, "text-anchor": "end" }, figure(v, step < 0.1 ? 2 : 1));
  }
  add("text", { x: 2, y: 12 }, "mm");
  const hour = [900, 1800, 3600, 7200, 14400].find((h) => (end - start) / h <= width / 90) ?? 14400;
  const zone = new Date().getTimezoneOffset() * 60;
  for (let t = Math.ceil((start - zone) / hour) * hour + zone; t < end; t += hour) {
    add("text", { x: x(t), y: height - 4, "text-anchor": "middle" }, clock(t));
  }
  for (const [t, , , level] of curve) {
    add("rect", { class: LEVELS[level] ?? "FAULT", x: x(t), y: height - bottom + 6,
      width: Math.max(1, x(t + 60) - x(t) + 0.5), height: 10 });
  }
  if (allowed !== null) {
    add("line", { class: "allowed", x1: left, x2: width - right, y1: y(allowed), y2: y(allowed) });
  }
  for (const [kind, place] of [["error", 1], ["bound", 2]]) {
    let path = "";
    let before = null;
    for (const point of curve) {
      const value = point[place];
      if (value === null) { before = null; continue; }
      const starts = before === null || point[0] - before > BREAK_S;
      path += `${starts ? "M" : "L"}${x(point[0] + 30).toFixed(1)} ${y(value).toFixed(1)}`;
      if (starts) path += "h.1";  // one point alone is seen too
      before = point[0];
    }
    add("path", { class: kind, d: path || "M0 0" });
  }
  return svg;
}

// ---- what a person does -------------------------------------------------------------------------

function ask(what) {
  if (!session.user) { openLogin(); return; }
  asking = what;
  redraw();
}

function tell(text, bad) {
  by("toast").textContent = text;
  by("toast").classList.toggle("bad", Boolean(bad));
  by("toast").hidden = !text;
}

async function post(path, body) {
  const answer = await fetch(path, { method: "POST", body: JSON.stringify(body),
    headers: { "Content-Type": "application/json", "X-Robocal-Token": session.token } });
  return [answer.status, await answer.json()];
}

async function send(act, body = {}) {
  if (!session.user) { openLogin(); return; }
  asking = null;
  redraw();
  try {
    const [status, answer] = await post(`/act/${act}`, body);
    if (status === 401) { await renew(); openLogin(); return; }
    if (status === 403) tell(label("failed") + label("not_yours"), true);
    else if (status !== 200) tell(label("failed") + label("no_answer"), true);
    else tell(label(answer.done ? "sent" : "failed") + answer.message, !answer.done);
  } catch {
    tell(label("failed") + label("no_page"), true);
  }
}

function openLogin() {
  put("refused");
  if (session.users && !by("login").open) by("login").showModal();
}

async function renew() {
  const answer = await fetch("/session");
  session = await answer.json();
  redraw();
}

by("login").querySelector("form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const form = event.target;
  try {
    const [status] = await post("/login",
      { name: form.elements.name.value, password: form.elements.password.value });
    form.elements.password.value = "";
    if (status !== 200) { put("refused", label("wrong_login")); return; }
    by("login").close();
    await renew();
    if (!source || source.readyState === 2) connect();
  } catch {
    put("refused", label("no_page"));
  }
});
by("leave").addEventListener("click", () => by("login").close());
by("account").addEventListener("click", async () => {
  if (!session.user) { openLogin(); return; }
  try {
    await post("/logout", {});
    await renew();
    if (!session.public) location.reload();
  } catch {
    tell(label("no_page"), true);
  }
});

// ---- the stream ---------------------------------------------------------------------------------

function connect() {
  source?.close();
  openedAt = Date.now();
  source = new EventSource("/events");
  const take = (name, then) => source.addEventListener(name, (event) => {
    then(JSON.parse(event.data));
    redraw();
  });
  take("state", (found) => { state = found; receivedAt = Date.now(); });
  take("curve", (found) => { curve = found; });
  take("history", (found) => { history_ = found; });
  source.addEventListener("open", () => { renew().catch(() => {}); });
}

function watch() {
  const dead = source && source.readyState === 2;
  const since = Date.now() - Math.max(receivedAt, openedAt);
  if (dead ? Date.now() - openedAt > 2000 : since > RECONNECT_MS || since < -1000) connect();
  redraw();
}

function redraw() {
  const hidden = !session.public && !session.user;
  document.querySelector("main").hidden = hidden;
  by("account").hidden = !session.users;
  by("account").textContent = session.user ? `${session.user} · ${label("logout")}` : label("login");
  const notes = [hidden ? label("login_needed") : "", session.users ? "" : label("no_users"),
    session.encrypted ? "" : label("plain")];
  by("notes").textContent = notes.filter(Boolean).join(" ");
  if (hidden) return;
  drawState();
  drawCandidates();
  drawGap();
  drawTools();
  drawShift();
  drawCurve();
}

for (const place of document.querySelectorAll("[data-label]")) {
  place.textContent = label(place.dataset.label);
}
put("languages", ...Object.entries(initial.languages).map(([key, name]) => make("a",
  { href: `/?language=${key}`, lang: key, title: name, "aria-label": name,
    "aria-current": key === language ? "true" : undefined }, key === "zh" ? "中文" : key.toUpperCase())));
addEventListener("pageshow", (event) => { if (event.persisted) location.reload(); });
addEventListener("resize", drawCurve);
redraw();
if (session.public || session.user) connect(); else openLogin();
setInterval(watch, 1000);
