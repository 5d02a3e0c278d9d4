// The dashboard of a sweep.
import {
  byId, clock, count, Documents, el, follow, isNumber, keyed, percent, plural, setText, showLink, showLog, showTable, showTiles,
} from "/assets/common.js";
import { Chart } from "/assets/chart.js";

const N_CLASSES = 8;
const documents = new Documents();
let state = null;
let link = "connecting";
let runs = [];
let curves = [];

const chart = new Chart(byId("success-chart"), {
  label: "Success in evaluations",
  height: 320,
  range: [0, 1],
  format: (value) => percent(value),
  tick: (value) => `${Math.round(100 * value)} %`,
  series: [],
});

const mean = (values) => (values.length ? values.reduce((sum, value) => sum + value, 0) / values.length : null);
const tasks = () => [...new Set(runs.map((run) => run.task))];
const live = (idx) => state?.live.find((each) => each.run === idx);
const counted = (wanted) => runs.filter((run) => run.state === wanted).length;

function tiles(s) {
  const names = { running: "Running", waiting: "Waiting", failed: "Failed", saved: "Saved", "left out": "Left out" };
  const further = Object.entries(names).filter(([name]) => counted(name) > 0 || name === "running");
  return [
    ["Finished", count(counted("finished")), `of ${plural(s.n_runs, "run")}`],
    ...further.map(([name, title]) => [title, count(counted(name)), name === "running" ? `at most ${count(s.n_jobs)} at a time` : plural(counted(name), "run")]),
    ["Env steps", count(s.env_steps), `${count(s.env_steps_per_s)} per second`],
  ];
}

/** The colours of the ends of a sweep without failures; further ones count runs that were left out. */
const ENDS = { complete: "good", interrupted: "warning" };

function levelOfEnd(end) {
  return end.includes("failed") ? "bad" : ENDS[end] ?? "warning";
}

function showHeader(s) {
  setText(byId("name"), s.name || "Sweep");
  document.title = `${s.name || "Sweep"} – Tandem`;
  setText(byId("terms"), `${plural(s.n_runs, "run")} in ${s.directory}`);
  const phase = byId("phase");
  setText(phase, s.end || "running");
  phase.className = `badge ${s.end ? levelOfEnd(s.end) : ""}`;
  setText(byId("clock"), `${clock(s.wall_s)} since its start`);
  const isLimited = s.max_env_steps > 0;
  const done = isLimited ? Math.min(1, s.env_steps / s.max_env_steps) : counted("finished") / Math.max(1, s.n_runs);
  byId("bar").style.width = `${100 * done}%`;
  byId("progress").setAttribute("aria-valuenow", Math.round(100 * done));
  const rest = s.max_env_steps - s.env_steps;
  const remaining = isLimited && s.env_steps_per_s > 0 && rest > 0 && !s.end ? `, about ${clock(rest / s.env_steps_per_s)} left` : "";
  setText(byId("progress-text"), isLimited
    ? `${count(s.env_steps)} of ${count(s.max_env_steps)} environment steps${remaining}`
    : `${count(counted("finished"))} of ${plural(s.n_runs, "run")} finished`);
}

const BADGES = { finished: "good", failed: "bad", saved: "warning", "left out": "warning" };

function showRuns() {
  keyed(byId("run-list"), runs.map((run, idx) => ({ run, idx })), ({ idx }) => idx,
    () => el("li", { class: "run" }, el("strong", {}), el("span", { class: "badge" }),
      el("div", { class: "progress", "aria-hidden": "true" }, el("div", { class: "bar" })), el("span", { class: "note" }), el("span", { class: "trouble" })),
    (row, { run, idx }) => {
      const now = live(idx);
      const [name, badge, progress, text, trouble] = row.children;
      row.dataset.state = run.state;
      if (name.dataset.link !== run.dashboard || name.textContent !== run.name) {
        name.dataset.link = run.dashboard;
        name.replaceChildren(run.dashboard ? el("a", { href: run.dashboard }, run.name) : run.name);
      }
      setText(badge, run.state);
      badge.className = `badge ${BADGES[run.state] ?? ""}`;
      const steps = now?.env_steps ?? run.env_steps;
      const share = run.state === "finished" ? 1 : run.max_env_steps > 0 ? steps / run.max_env_steps : 0;
      progress.firstChild.style.width = `${100 * Math.min(1, share)}%`;
      setText(text, describe(run, now, steps, curves[idx]?.at(-1)));
      setText(trouble, run.failure || now?.warning || "");
      trouble.hidden = !trouble.textContent;
    });
}

/** Describes how far a run is. */
function describe(run, now, steps, latest) {
  const parts = [];
  if (run.result) parts.push(`test success ${percent(run.result.success)} [${(100 * run.result.low).toFixed(1)}, ${(100 * run.result.high).toFixed(1)}]`);
  else if (latest) parts.push(`success ${percent(latest.success)}`);
  if (steps > 0) parts.push(`${count(steps)} steps`);
  const advice = now?.advice_spent ?? run.advice_spent;
  if (advice > 0) parts.push(`${count(advice)} units of advice`);
  if (isNumber(now?.remaining_s)) parts.push(`${clock(now.remaining_s)} left`);
  return parts.join(", ") || (run.state === "running" ? "starting" : "");
}

/** Returns the groups of a task, each with the indices of its runs. */
function groups(task) {
  const found = new Map();
  runs.forEach((run, idx) => {
    if (run.task !== task) return;
    found.set(run.group, [...(found.get(run.group) ?? []), idx]);
  });
  return [...found];
}

function showTasks() {
  const names = tasks();
  byId("task-field").hidden = names.length < 2;
  const choice = byId("task");
  if ([...choice.options].map((option) => option.value).join("\n") !== names.join("\n")) {
    const former = choice.value;
    choice.replaceChildren(...names.map((name) => el("option", { value: name }, name)));
    if (names.includes(former)) choice.value = former;
  }
}

function showCurves() {
  showTasks();
  const shown = groups(byId("task").value || tasks()[0]);
  const rows = new Map();
  shown.forEach(([group, indices]) => indices.flatMap((idx) => curves[idx] ?? []).forEach((point) => {
    const row = rows.get(point.env_steps) ?? { env_steps: point.env_steps, values: {} };
    row.values[group] = [...(row.values[group] ?? []), point.success];
    rows.set(point.env_steps, row);
  }));
  chart.setSeries(shown.map(([group], idx) => ({
    name: group,
    class: `g${idx % N_CLASSES}${idx >= N_CLASSES ? " thin" : ""}`,
    value: (row) => mean(row.values[group] ?? []),
    low: (row) => (row.values[group]?.length > 1 ? Math.min(...row.values[group]) : null),
    high: (row) => (row.values[group]?.length > 1 ? Math.max(...row.values[group]) : null),
  })));
  chart.show([...rows.values()].sort((a, b) => a.env_steps - b.env_steps));
  showGroups(shown);
}

function showGroups(shown) {
  const names = ["Group", "Finished", "Env steps", "Success", "Seeds", "Without contact", "Test success"];
  const cells = ([group, indices]) => {
    const latest = indices.map((idx) => curves[idx]?.at(-1)).filter(Boolean);
    const values = (key) => latest.map((point) => point[key]).filter(isNumber);
    const success = values("success");
    const finished = indices.filter((idx) => runs[idx].state === "finished");
    const tests = finished.map((idx) => runs[idx].result?.success).filter(isNumber);
    const range = success.length > 1 ? `${(100 * Math.min(...success)).toFixed(1)} – ${percent(Math.max(...success))}` : "–";
    return [group, `${finished.length} of ${indices.length}`, count(mean(latest.map((point) => point.env_steps))), percent(mean(success)), range,
      percent(mean(values("success_without_contact"))), percent(mean(tests))];
  };
  showTable(byId("groups"), names, shown.map(cells));
}

function show(s) {
  state = s;
  showHeader(s);
  showTiles(byId("tiles"), tiles(s));
  showRuns();
  documents.update("runs", s.versions.runs, (found) => {
    runs = found;
    showHeader(state);
    showTiles(byId("tiles"), tiles(state));
    showRuns();
    showCurves();
  });
  documents.update("curves", s.versions.curves, (found) => {
    curves = found;
    showRuns();
    showCurves();
  });
  documents.update("log", s.versions.log, (events) => showLog(byId("log"), events));
}

byId("task").addEventListener("change", showCurves);

const showCondition = () => showLink(byId("link"), link, state?.end, sinceAlive());

const { sinceAlive } = follow(show, (condition) => {
  if (condition === "live") documents.forget();
  link = condition;
  showCondition();
});
setInterval(showCondition, 1000);
