// The operator page of a bridge.
import {
  byId, clock, Documents, follow, isNumber, percent, setText, showLog, showTable, showTiles, svg,
} from "/assets/common.js";

/** Age of the newest state from which the page says that it is old, milliseconds. */
const STALE_MS = 1500;
/** Time within which the bridge has to confirm a stop. */
const STOP_TIMEOUT_MS = 4000;
/** Least extent of the views: x and y, and z above the table, metres. */
const X = [-0.55, 0.55];
const Y = [-0.3, 0.3];
const Z = [-0.07, 0.62];
/** Least distance from the bases to the edges of the views, along x and y, metres. */
const MARGINS = [0.16, 0.3];

const documents = new Documents();
let state = null;
let link = "connecting";
/** Time of the stop that the page shows as confirmed, seconds since the start of the bridge; null if it shows none. */
let confirmedAt_s = null;

/** Stops the arms. It uses nothing that the page has received, so it works before the first state and without events. */
async function stop() {
  const result = byId("stop-result");
  const button = byId("stop");
  button.classList.add("pressed");
  result.className = "stop-result";
  setText(result, "Stopping …");
  confirmedAt_s = null;
  // Not `AbortSignal.timeout`, which old browsers lack: the request must be sent in any case.
  const abort = new AbortController();
  const timer = setTimeout(() => abort.abort(), STOP_TIMEOUT_MS);
  try {
    const response = await fetch("/stop", {
      method: "POST",
      headers: { "x-tandem-action": "stop" },
      signal: abort.signal,
    });
    if (response.status === 401) return location.reload();
    const answer = await response.json().catch((error) => {
      if (error.name === "AbortError") throw error;
      return {};
    });
    if (!response.ok) throw new Error(answer.problem ?? `the bridge answers ${response.status}`);
    if (typeof answer.stopped !== "string") throw new Error("the answer is not a bridge's");
    result.className = "stop-result confirmed";
    setText(result, `Stopped ${answer.stopped}`);
    confirmedAt_s = answer.time_s;
  } catch (error) {
    const problem = error.name === "AbortError" ? "no answer" : error.message;
    result.className = "stop-result failed";
    setText(result, `The stop is not confirmed: ${problem}. Use the emergency stop.`);
  } finally {
    clearTimeout(timer);
    button.classList.remove("pressed");
  }
}

byId("stop").addEventListener("click", stop);

const TITLES = {
  stopped: "Stopped",
  idle: "Ready: the arms hold their position",
  moving: "Moving",
  holding: "Motion paused",
  settling: "Coming to rest",
};
const BADGES = { stopped: "bad", idle: "good", moving: "", holding: "warning", settling: "" };

const mm = (metres) => (isNumber(metres) ? `${Math.round(1000 * metres)} mm` : "–");
const degrees = (radians) => (isNumber(radians) ? `${((180 / Math.PI) * radians).toFixed(1).replace("-", "−")}°` : "–");
const time = (unixMs) => new Date(unixMs).toLocaleTimeString([], { hour12: false });
const isBelow = (gap, limit) => isNumber(gap) && gap < limit;

function showHeader(s) {
  setText(byId("phase-title"), TITLES[s.phase]);
  document.title = `${TITLES[s.phase].split(":")[0]} – Tandem bridge`;
  const badge = byId("phase");
  setText(badge, s.phase);
  badge.className = `badge ${BADGES[s.phase]}`;
  setText(byId("terms"), `driver ${s.terms.driver}, version ${s.terms.version}, speed limit ${s.terms.speed}`);
  setText(byId("clock"), `${time(s.unix_ms)}, bridge up for ${clock(s.time_s)}`);
  const problem = s.stop_error ? `The drives could not be commanded to stop: ${s.stop_error}. Use the emergency stop.`
    : !s.is_connected ? "The driver has no connection to the arms."
    : s.arms.length === 0 ? "There is no valid state of the arms." : "";
  byId("alert").hidden = !problem;
  setText(byId("alert"), problem);
}

function showMotion(s) {
  const motion = s.motion;
  byId("progress").hidden = !motion;
  if (!motion) {
    const number = s.n_motions > 0 ? `; ${s.n_motions === 1 ? "one has" : `${s.n_motions} have`} been started` : "";
    return setText(byId("motion-text"), `No motion is in progress${number}.`);
  }
  const share = motion.duration_s > 0 ? Math.min(1, motion.played_s / motion.duration_s) : 0;
  byId("bar").style.width = `${100 * share}%`;
  byId("progress").setAttribute("aria-valuenow", Math.round(100 * share));
  // On the clock, as the commands print it: the motion's own times are those at speed 1.
  const [played, duration] = [motion.played_s, motion.duration_s].map((own) => (motion.speed > 0 ? own / motion.speed : own));
  const client = motion.client ? `, client ${motion.client}` : "";
  setText(byId("motion-text"), `Motion ${s.n_motions}${motion.name ? `, ${motion.name}` : ""}: ${played.toFixed(1)} of `
    + `${duration.toFixed(1)} s at speed ${motion.speed}, about ${clock(duration - played)} left${client}.`);
}

function tiles(s) {
  const arms = s.arms.map((arm, idx) => [
    `Arm ${idx} to table`, mm(arm.table_gap_m), `own parts ${mm(arm.self_gap_m)}`,
    isBelow(arm.table_gap_m, 2 * s.terms.table_gap_m) || isBelow(arm.self_gap_m, 2 * s.terms.self_gap_m),
  ]);
  const faults = s.arms.map((arm, idx) => {
    const names = [arm.emergency_stop && "emergency stop", arm.drive_fault && "drive fault", arm.contact && "contact"].filter(Boolean);
    return [`Arm ${idx}`, names.length ? names.join(", ") : "no fault", `gripper ${percent(arm.opening, 0)} open`, names.length > 0];
  });
  return [
    ["Owner", isNumber(s.lease_left_s) ? "a client" : "none",
      isNumber(s.lease_left_s) ? `lease for ${s.lease_left_s.toFixed(1)} s` : "free for any client", false],
    ["Joints", s.arms.length === 0 ? "unknown" : s.at_rest ? "at rest" : "moving", s.is_connected ? "driver connected" : "driver not connected", false],
    ...faults,
    ...(s.injected.length ? [["Drill", s.injected.join("; "), "injected faults; clear them with tandem bridge inject --clear", true]] : []),
    ["Between arms", mm(s.arms_gap_m), `stopped below ${mm(s.terms.arms_gap_m)}`, isBelow(s.arms_gap_m, 1.25 * s.terms.arms_gap_m)],
    ...arms,
  ];
}

function showStop(s) {
  const last = s.last_stop;
  setText(byId("last-stop"), last ? `${last.sentence} (${last.name})` : "The arms have not been stopped.");
  setText(byId("last-stop-time"), last ? `${time(last.at_unix_ms)}${s.stop ? "; the arms are stopped" : "; reset since"}` : "");
}

/** Returns the extent of the views along an axis, which contains the bases of the arms. */
function extent(axis, s) {
  if (axis === 2) return Z.map((z) => z + s.terms.table_z_m);
  const bases = s.shapes.map((arm) => arm.base[axis]);
  const [low, high] = [X, Y][axis];
  const margin = MARGINS[axis];
  return [Math.min(low, ...bases.map((base) => base - margin)), Math.max(high, ...bases.map((base) => base + margin))];
}

/** Draws the arms from above (`axis` 1: y) or from the side (2: z). */
function drawView(id, axis, s) {
  const [left, right] = extent(0, s);
  const [bottom, top] = extent(axis, s);
  const scale = 640 / (right - left);
  const height = (top - bottom) * scale;
  const at = (point) => [(point[0] - left) * scale, height - (point[axis] - bottom) * scale];
  const root = byId(id);
  root.setAttribute("viewBox", `0 0 640 ${height.toFixed(0)}`);
  const parts = [];
  if (axis === 2) {
    const y = at([0, 0, s.terms.table_z_m])[1];
    parts.push(svg("line", { x1: 0, x2: 640, y1: y, y2: y, class: "table" }));
  }
  s.shapes.forEach((arm, idx) => parts.push(drawArm(arm, s.arms[idx], idx, at, scale)));
  root.replaceChildren(...parts);
}

function drawArm(arm, values, idx, at, scale) {
  const line = (a, b, width, name) => {
    const [[x1, y1], [x2, y2]] = [at(a), at(b)];
    return svg("line", { x1, y1, x2, y2, "stroke-width": width, class: name });
  };
  const bars = arm.links.map(([from, to, radius]) => line(from, to, 2 * radius * scale, "bar-shape"));
  // The bones show joints that lie behind one another.
  const bones = arm.links.map(([from, to]) => line(from, to, 3, "bone"));
  const wrist = arm.links.length ? line(arm.links.at(-1)[1], arm.tool, 3, "bone") : null;
  const fingers = arm.fingers.map((finger) => line(arm.tool, finger, 6, "bone"));
  const [x, y] = at(arm.tool);
  const group = svg("g", { class: `arm${idx % 3}` }, bars, bones, wrist, fingers, svg("circle", { cx: x, cy: y, r: 6, class: "finger tool" }));
  if (values?.planned_tool_m) {
    const [cx, cy] = at(values.planned_tool_m);
    group.append(svg("circle", { cx, cy, r: 11, class: "planned" }));
  }
  const [baseX, baseY] = at(arm.base);
  group.append(svg("text", { x: baseX, y: baseY + 22, "text-anchor": "middle", class: "arm-name" }, `arm ${idx}`));
  return group;
}

function showArms(s) {
  drawView("view-above", 1, s);
  drawView("view-side", 2, s);
  const place = (point) => point.map((x) => (100 * x).toFixed(1).replace("-", "−")).join(", ");
  const text = s.arms.map((arm, idx) => `Tool ${idx} at ${place(arm.tool_m)} cm`).join("; ");
  setText(byId("arms-text"), text ? `${text}. Rings show the planned positions.` : "The positions are not known.");
}

function showJoints(s) {
  const n = Math.max(0, ...s.arms.map((arm) => arm.angles_rad.length));
  const joints = Array.from({ length: n }, (_, joint) => joint);
  const row = (name, values) => [name, ...joints.map((joint) => degrees(values[joint]))];
  const rows = s.arms.flatMap((arm, idx) => [
    row(`Arm ${idx}, measured`, arm.angles_rad),
    row(`Arm ${idx}, planned`, arm.planned_rad),
  ]);
  showTable(byId("joint-table"), ["", ...joints.map((joint) => `joint ${joint + 1}`)], rows);
}

function show(s) {
  // The message about a stop disappears with the reset that ends it, even if no state with that stop has arrived.
  const wasStopped = Boolean(state?.stop) || (confirmedAt_s !== null && s.time_s > confirmedAt_s);
  state = s;
  if (wasStopped && !s.stop) {
    confirmedAt_s = null;
    byId("stop-result").className = "stop-result";
    setText(byId("stop-result"), "");
  }
  showHeader(s);
  showMotion(s);
  showTiles(byId("tiles"), tiles(s));
  showStop(s);
  showArms(s);
  showJoints(s);
  documents.update("log", s.versions.log, (events) => showLog(byId("log"), events, (event) => time(event.unix_ms)));
}

function showLink() {
  const isOld = Boolean(link !== "lost" && state && ageOfState() > STALE_MS);
  const old = "the values are old";
  const element = byId("link");
  element.classList.toggle("lost", link === "lost" || isOld);
  document.body.classList.toggle("stale", link === "lost" || isOld);
  setText(element, {
    live: isOld ? old : "live",
    lost: `no connection: ${old}; trying again`,
    full: `too many viewers, trying again; the stop button works${isOld ? `; ${old}` : ""}`,
  }[link] ?? link);
  // Hidden from screen readers, which would say it every second.
  setText(byId("age"), isOld ? `(${Math.round(ageOfState() / 1000)} s)` : "");
}

const { ageOfState } = follow(show, (condition) => {
  // A bridge that starts again may begin with other versions.
  if (condition === "live") documents.forget();
  if (condition === "lost") document.title = "No connection – Tandem bridge";
  link = condition;
  showLink();
}, (s) => 1000 * s.time_s);
setInterval(showLink, 500);
