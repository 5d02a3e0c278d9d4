// The dashboard of a run.
import {
  byId, clock, count, Documents, el, follow, isNumber, keyed, mark, MARKS, percent, plural, real, setText, showLink, showLog, showTable,
  showTiles,
} from "/assets/common.js";
import { Chart } from "/assets/chart.js";
import { Player } from "/assets/player.js";

const documents = new Documents();
const player = new Player();
let state = null;
let link = "connecting";
let latest = null;
/** The evaluations, and whether the latest one has episodes to play; `null` until they are loaded. */
let evaluations = null;
let hasPlayback = null;

/**
 * Returns `value` for rows after the first update: before it there is no loss, and no Q of a trained critic. The loss is zero
 * until the round of the first update has ended.
 */
const learned = (value) => (row) => (row.updates > 0 && row.critic_loss !== 0 ? value(row) : null);
/** Returns the success in training, which the row of the initial policy does not have. */
const trained = (row) => (row.episodes > 0 ? row.training_success : null);

/** Returns the series of the chart of success. One arm has no other to touch. */
const successSeries = (nArms) => [
  { name: "success", class: "first", value: (row) => row.success, low: (row) => row.success_low, high: (row) => row.success_high },
  nArms > 1 && { name: "without contact between arms", class: "second", value: (row) => row.success_without_contact },
  { name: "training", class: "third", value: trained },
].filter(Boolean);

const charts = [
  new Chart(byId("success-chart"), {
    label: "Success in evaluations",
    height: 300,
    range: [0, 1],
    format: (value) => percent(value),
    tick: (value) => `${Math.round(100 * value)} %`,
    bandName: "95 % interval",
    best: (row) => row.best,
    series: [],
  }),
  new Chart(byId("q-chart"), {
    label: "Mean Q",
    format: real,
    series: [{ name: "mean Q", class: "first", value: learned((row) => row.mean_q) }],
  }),
  new Chart(byId("loss-chart"), {
    label: "Losses",
    format: real,
    series: [
      { name: "critic", class: "first", value: learned((row) => row.critic_loss) },
      { name: "actor", class: "second", value: learned((row) => row.actor_loss) },
    ],
  }),
  new Chart(byId("advice-chart"), {
    label: "Advice spent",
    format: count,
    fromZero: true,
    series: [{ name: "units spent", class: "first", value: (row) => row.advice_spent }],
  }),
];

function tiles(s) {
  const interval = (low, high) => (isNumber(low) ? `interval ${(100 * low).toFixed(1)} – ${percent(high)}`
    : latest ? "not reported" : "no evaluation yet");
  const usesAdvice = s.advice_spent + s.advice_left > 0;
  return [
    ["Success", percent(latest?.success), interval(latest?.success_low, latest?.success_high)],
    s.n_arms > 1 && ["Without contact", percent(latest?.success_without_contact),
      interval(latest?.success_without_contact_low, latest?.success_without_contact_high)],
    ["In training", percent(s.round > 0 ? s.training_success : null), "latest round"],
    ["Mean Q", real(learned((it) => it.mean_q)(s)), "latest round"],
    ["Critic loss", real(learned((it) => it.critic_loss)(s)), `actor loss ${real(learned((it) => it.actor_loss)(s))}`],
    ["Env steps", count(s.env_steps), `${count(s.env_steps_per_s)} per second`],
    ["Updates", count(s.updates), `${count(s.updates_per_s)} per second`],
    usesAdvice && ["Advice left", count(s.advice_left), `${count(s.advice_per_min)} per minute`],
  ].filter(Boolean);
}

/** Returns the word and the colour for the end of a run. */
function ending(end) {
  if (!end.interrupted) return { word: "complete", level: "good" };
  return end.digest === null ? { word: "failed", level: "bad" } : { word: "stopped", level: "warning" };
}

function showHeader(s) {
  setText(byId("name"), s.run || "Run");
  document.title = `${s.run || "Run"} – Tandem`;
  setText(byId("terms"), `${s.task}, ${plural(s.n_arms, "arm")}, strategy ${s.strategy}, seed ${s.seed}`);
  const phase = byId("phase");
  const ended = s.end && ending(s.end);
  // The phases of a fast run change several times a second: only its end is announced.
  phase.setAttribute("aria-live", s.end ? "polite" : "off");
  setText(phase, ended ? ended.word : s.phase || "starting");
  phase.className = `badge ${ended ? ended.level : ""}`;
  setText(byId("clock"), `${clock(s.wall_s)} elapsed, round ${count(s.round)}`);
  const alert = byId("alert");
  const problem = [ended?.level === "bad" && `The run has failed: ${s.end.reason}`, s.warning].filter(Boolean).join("; ");
  alert.hidden = !problem;
  setText(alert, problem);
  showProgress(s);
}

function showProgress(s) {
  const ends = [];
  if (s.max_env_steps > 0) {
    ends.push({
      share: s.env_steps / s.max_env_steps, left: (s.max_env_steps - s.env_steps) / s.env_steps_per_s,
      text: `${count(s.env_steps)} of ${count(s.max_env_steps)} environment steps`,
    });
  }
  if (s.max_minutes > 0) {
    ends.push({
      share: s.wall_s / (60 * s.max_minutes), left: 60 * s.max_minutes - s.wall_s,
      text: `${clock(s.wall_s)} of ${clock(60 * s.max_minutes)}`,
    });
  }
  byId("progress").hidden = ends.length === 0;
  const verbs = { complete: "Ended", stopped: "Stopped", failed: "Failed" };
  const end = s.end ? `. ${verbs[ending(s.end).word]}: ${s.end.reason}` : "";
  if (ends.length === 0) return setText(byId("progress-text"), `This run has no limit of steps or minutes${end || "."}`);
  const done = Math.min(1, Math.max(...ends.map((end) => end.share)));
  byId("bar").style.width = `${100 * done}%`;
  byId("progress").setAttribute("aria-valuenow", Math.round(100 * done));
  const limit = ends.map((end) => end.text).join(", ");
  // The run ends at the first of its limits.
  const left = Math.min(...ends.map((end) => end.left).filter(Number.isFinite));
  const remaining = s.end || !(left > 0) || !Number.isFinite(left) ? "" : `, about ${clock(left)} left`;
  setText(byId("progress-text"), `${limit}${remaining}${end}`);
}

function ago(seconds) {
  return seconds < 1 ? "seen just now" : seconds < 90 ? `seen ${Math.floor(seconds)} s ago` : `seen ${Math.floor(seconds / 60)} min ago`;
}

const DOING = {
  playing: (worker) => (worker.slot === null ? "playing" : `plays slot ${count(worker.slot)}`),
  waiting: () => "waits for a slot",
  disconnected: () => "disconnected",
  silent: () => "silent",
};

function showWorkers(s) {
  const hidden = s.n_workers - s.workers.length;
  const more = hidden > 0 ? `, of which ${s.workers.length} are shown` : "";
  setText(byId("worker-summary"), s.end ? `${plural(s.n_workers, "worker")}; ${plural(s.n_replay_episodes, "episode")} in the replay buffer.`
    : s.n_workers === 0 ? "No worker has joined yet."
    : `${s.n_active_workers} of ${plural(s.n_workers, "worker")} active${more}; ${plural(s.n_playing_slots, "slot")} playing, `
      + `${count(s.n_waiting_slots)} waiting; ${plural(s.n_replay_episodes, "episode")} in the replay buffer.`);
  const byName = [...s.workers].sort((a, b) => a.name.localeCompare(b.name, "en", { numeric: true }) || a.id - b.id);
  keyed(byId("worker-tiles"), byName, (worker) => worker.id,
    () => el("li", {}, el("strong"), el("span", { class: "doing" }), el("span"), el("span")),
    (tile, worker) => {
      tile.className = `worker ${s.end ? "ended" : worker.state}`;
      tile.dataset.state = worker.state;
      setText(tile.children[0], worker.name);
      setText(tile.children[1], s.end ? "ended" : DOING[worker.state](worker));
      setText(tile.children[2], plural(worker.n_episodes, "episode"));
      setText(tile.children[3], ago(worker.last_seen_s));
    });
}

/**
 * Shows bars of two shares with texts: [{ title, shares, texts }], where `title` is unique. The bars are hidden from screen
 * readers: the texts say the same.
 */
function showShares(parent, items) {
  keyed(parent, items, ({ title }) => title,
    ({ title, texts }) => el("div", {}, el("p", {}, title),
      el("div", { class: "meter", "aria-hidden": "true" }, el("i", { class: "fill-first" }), el("i", { class: "fill-second" })),
      el("p", { class: "pairs" }, texts.map(() => el("span")))),
    (item, { shares, texts }) => {
      const [, meter, pairs] = item.children;
      shares.forEach((share, idx) => {
        meter.children[idx].style.width = `${100 * (isNumber(share) ? share : 0)}%`;
      });
      texts.forEach((text, idx) => setText(pairs.children[idx], text));
    });
}

function showAdvice(s) {
  const total = s.advice_spent + s.advice_left;
  const uses = total > 0;
  byId("advice-spent-heading").closest("section").hidden = !uses;
  byId("advice-heading").closest("section").hidden = !uses;
  if (!uses) return;
  const arms = s.acted.map((arm, idx) => {
    const steps = arm.teacher + arm.student;
    const shares = [arm.teacher / steps, arm.student / steps];
    const texts = [`teacher ${percent(shares[0])} (${count(arm.teacher)} steps)`, `student ${percent(shares[1])} (${count(arm.student)} steps)`];
    return { title: `Arm ${idx}: who acted since the learner started`, shares, texts };
  });
  const spent = s.advice_spent / total;
  showShares(byId("shares"), [{
    title: "Budget",
    shares: [spent],
    texts: [
      `${count(s.advice_spent)} of ${count(total)} units spent (${percent(spent)})`, `${count(s.advice_left)} left`,
      `${count(s.advice_per_min)} per minute`, `teacher asked on ${count(s.advice_queries)} of ${count(s.env_steps)} training steps`,
    ],
  }, ...arms]);
}

function services(s) {
  const t = s.teacher;
  if (s.advice_spent + s.advice_left === 0) return [["info", "Teacher", "This run takes no advice."]];
  const teacher = {
    none: ["info", "is starting"],
    answering: ["good", "answers"],
    unreachable: ["bad", `does not answer: ${t.error || "no connection"}`],
    lost: ["warning", "has lost the account, which is opened again"],
  }[t.state];
  const account = t.account ? `${count(t.spent)} of ${count(t.budget)} units charged, ${count(t.leased)} reserved for open episodes` : "no account yet";
  return [
    [teacher[0], "Teacher", teacher[1]],
    [t.warning ? "bad" : t.state === "answering" ? "good" : "info", "Policy and ledger", t.warning || (t.state === "answering" ? "work" : "state unknown")],
    ["info", "Account", account],
  ];
}

function showServices(s) {
  const items = services(s);
  keyed(byId("services"), items, ([, name]) => name,
    ([, name]) => el("li", {}, mark("info"), el("span", { class: "what" }, name), el("span")),
    (item, [level, , text]) => {
      const sign = item.children[0];
      sign.className = `mark ${level}`;
      setText(sign, MARKS[level]);
      setText(item.children[2], text);
    });
}

/** Fills the table, unless it is folded: a long run has thousands of rows. */
function showEvaluations(rows) {
  const table = byId("success-table");
  if (!table.closest("details").open) return table.replaceChildren();
  const loss = (name) => (row) => real(learned((it) => it[name])(row));
  const columns = [
    ["Env steps", (row) => count(row.env_steps)],
    ["Success", (row) => percent(row.success)],
    ["95 % interval", (row) => `${percent(row.success_low)} – ${percent(row.success_high)}`],
    state?.n_arms > 1 && ["Without contact", (row) => percent(row.success_without_contact)],
    ["Training", (row) => percent(trained(row))],
    ["Mean Q", loss("mean_q")],
    ["Critic loss", loss("critic_loss")],
    ["Actor loss", loss("actor_loss")],
    ["Advice", (row) => count(row.advice_spent)],
  ].filter(Boolean);
  showTable(table, columns.map(([name]) => name), [...rows].reverse().map((row) => columns.map(([, text]) => text(row))));
}

/** Says why there is no episode to play. */
function showEpisodeNote() {
  if (evaluations === null || hasPlayback !== false) return;
  setText(byId("episode-note"), evaluations.length === 0 ? "The first evaluation has not been completed yet."
    : state.has_episodes ? "The goals of this task are not points, so its episodes are not drawn."
    : "The episodes of the latest evaluation were not kept when the learner was started again.");
}

const nameOf = (s) => [s.run, s.task, s.strategy, s.seed].join(" ");

function show(s) {
  if (state && nameOf(state) !== nameOf(s)) {
    // Another run has the address.
    documents.forget();
    player.reset();
    latest = evaluations = null;
  }
  if (state?.n_arms !== s.n_arms) charts[0].setSeries(successSeries(s.n_arms));
  state = s;
  showHeader(s);
  showTiles(byId("tiles"), tiles(s));
  showWorkers(s);
  showAdvice(s);
  showServices(s);
  // Of a service whose rows the page has, it fetches the further ones.
  let kept = [];
  documents.update("evaluations", s.versions.evaluations, (rows) => {
    evaluations = [...kept, ...rows];
    latest = evaluations.at(-1);
    charts.forEach((chart) => chart.show(evaluations));
    showEvaluations(evaluations);
    showTiles(byId("tiles"), tiles(state));
    showEpisodeNote();
  }, () => {
    kept = documents.versions.evaluations === undefined ? [] : evaluations;
    return `evaluations/${kept.length}`;
  });
  if (documents.versions.playback !== s.versions.playback) hasPlayback = null;
  documents.update("playback", s.versions.playback, (playback) => {
    hasPlayback = playback !== null;
    player.load(playback);
    showEpisodeNote();
  });
  documents.update("log", s.versions.log, (events) => showLog(byId("log"), events));
}

byId("success-table").closest("details").addEventListener("toggle", () => showEvaluations(evaluations ?? []));

const showCondition = () => showLink(byId("link"), link, state?.end, sinceAlive());

const { sinceAlive } = follow(show, (condition) => {
  if (condition === "live") documents.forget();
  link = condition;
  showCondition();
});
setInterval(showCondition, 1000);
