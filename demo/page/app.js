// The page: plays the student, lets a visitor move the goals, and plays logs that were simulated again.

import { decompressed, Refused, Simulator } from "./simulator.js";
import { Screen } from "./screen.js";

const STEP_CM = 1;
const MAX_LOG_BYTES = 64 << 20;
/** Most control steps between two pictures; a slow machine plays in slow motion instead. */
const MAX_STEPS_PER_PICTURE = 4;
const ARMS = ["blue", "orange"];
const PRETTY = { "push": "Push, classic world", "pick-and-place": "Pick and place, classic world",
  "shared-push": "Push", "shared-pick-and-place": "Pick and place", "carry-bar": "Carry a bar" };

const $ = id => document.getElementById(id);

class App {
  constructor(simulator) {
    this.simulator = simulator;
    this.screen = new Screen(simulator, $("canvas"), $("scene"));
    this.start = 0;
    this.isPlaying = true;
    this.speed = Number($("speed").value);
    this.log = null;
    this.owed_s = 0;
    this.times = [];
    this.n_steps = 0;
    this.n_choices = 0;
    this.bind();
    this.setReady(false, "Loading");
  }

  /** Enables the controls of the student once there is one; until then, the badge says `instead`. */
  setReady(isReady, instead) {
    this.isReady = isReady;
    this.instead = instead;
    for (const id of ["play", "restart", "next", "compute"]) $(id).disabled = !isReady;
    if (!isReady && this.isLive) show(badge, instead, "");
  }

  /** Loads the student of a task. */
  async choose(task) {
    const choice = ++this.n_choices;
    this.setReady(false, "Loading");
    try {
      const response = await fetch(`student-${task}.safetensors.gz`);
      if (!response.ok) throw new Error(`the policy: ${response.status} ${response.statusText}`);
      const policy = new Uint8Array(await decompressed(await response.blob()));
      // A later choice has been made meanwhile.
      if (choice !== this.n_choices) return;
      this.policy = policy;
      this.task = task;
      this.load();
      $("digests").hidden = $("digest-verdict").hidden = true;
    } catch (error) {
      if (choice !== this.n_choices) return;
      // The student before, if there is one, plays on.
      this.setReady(this.task !== undefined, "Not loaded");
      for (const radio of tasks()) radio.checked = radio.value === this.task;
      if (this.status) this.update(this.status);
      throw error;
    }
  }

  load() {
    this.facts = this.simulator.read("load_policy", this.policy, this.start);
    this.setReady(true);
    $("heights").hidden = !this.facts.grasps;
    for (const arm of [0, 1]) [$(`height-${arm}`).min, $(`height-${arm}`).max] = this.facts.heights_m;
    this.restart();
  }

  restart() {
    this.update(this.simulator.json("restart", this.start));
    this.owed_s = 0;
    this.screen.isStale = true;
  }

  get isLive() { return this.log === null; }

  /** Called before every picture. */
  frame(now_ms) {
    const elapsed_s = Math.min((now_ms - (this.last_ms ?? now_ms)) / 1000, 0.5);
    this.last_ms = now_ms;
    // A log needs no student.
    if (this.isReady || !this.isLive) {
      try {
        if (this.isLive) this.advance(elapsed_s, now_ms);
        else this.log.advance(elapsed_s);
        if (this.screen.draw(this.isLive ? null : this.log.position) && this.isLive) this.screen.place(this.handles);
      } catch (error) {
        this.recover(error);
      }
    }
    requestAnimationFrame(now => this.frame(now));
  }

  /** Executes the control steps that are due. */
  advance(elapsed_s, now_ms) {
    if (!this.isPlaying) return;
    const step_s = this.facts.control_step_s / this.speed;
    this.owed_s = Math.min(this.owed_s + elapsed_s, MAX_STEPS_PER_PICTURE * step_s);
    let status = null;
    while (this.owed_s >= step_s) {
      this.owed_s -= step_s;
      status = this.simulator.json("step");
      this.times.push(now_ms);
      this.n_steps += 1;
    }
    if (status) {
      this.update(status);
      this.screen.isStale = true;
      this.times = this.times.filter(time => time > now_ms - 2000);
      $("steps").textContent = this.n_steps;
      const rate = (this.times.length - 1) / Math.max((now_ms - this.times[0]) / 1000, 0.5);
      $("rate").textContent = `${rate.toFixed(0)} per s`;
      $("drawing").textContent = `drawn in ${(this.screen.cost_ms ?? 0).toFixed(1)} ms`;
    }
  }

  /** A trap ends an instance; a refusal does not. */
  recover(error) {
    complain(error);
    if (error instanceof Refused) {
      if (this.isReady) this.restart();
      return;
    }
    this.simulator.start();
    this.leaveLog();
    if (this.policy) this.load();
  }

  update(status) {
    const wasSuccess = this.status?.is_success;
    this.status = status;
    // The values are those of a log.
    if (!this.isLive) return;
    const step_s = this.facts.control_step_s;
    showDistances(status.distances_m, this.facts.tolerance_m);
    for (const [arm, goal] of status.goals.entries()) {
      const [across, along] = [towards(goal[0], "right", "left"), towards(goal[1], "back", "front")];
      const label = `Goal of the ${ARMS[arm]} cube: ${across}, ${along}, ${cm(goal[2])} up. Arrow keys move it.`;
      $(`goal-${arm}`).ariaLabel = label;
      if (document.activeElement !== $(`height-${arm}`)) $(`height-${arm}`).value = goal[2];
      $(`height-${arm}`).ariaValueText = cm(goal[2]);
    }
    $("since-label").textContent = "Since the goals moved";
    $("since").textContent = seconds(status.steps_since_change * step_s);
    const first = status.steps_to_success;
    $("since-detail").textContent = first === null ? counted(status.steps_since_change, "control step")
      : `reached after ${counted(first, "step")}`;
    if (status.is_success) show(badge, "Both goals reached", "good");
    else if (!status.is_in_reach) show(badge, "A cube is out of reach: restart", "bad");
    else show(badge, `${status.achieved.filter(Boolean).length} of ${status.achieved.length} goals reached`, "");
    if (wasSuccess !== undefined && wasSuccess !== status.is_success)
      $("status").textContent = status.is_success ? "Both goals are reached." : "A goal is no longer reached.";
  }

  /** Moves a goal by centimetres. */
  nudge(arm, [x, y, z]) {
    const goal = this.status.goals[arm];
    this.moveGoal(arm, [goal[0] + x / 100, goal[1] + y / 100, goal[2] + z / 100]);
  }

  moveGoal(arm, point) {
    this.update(this.simulator.json("move_goal", arm, ...point));
    this.screen.isStale = true;
  }

  bind() {
    this.handles = [0, 1].map(arm => $(`goal-${arm}`));
    this.handles.forEach((handle, arm) => this.bindHandle(handle, arm));
    for (const arm of [0, 1])
      $(`height-${arm}`).oninput = event => {
        const [x, y] = this.status.goals[arm];
        this.moveGoal(arm, [x, y, event.target.valueAsNumber]);
      };
    for (const radio of document.querySelectorAll("input[name=task]"))
      radio.onchange = () => attempt(() => this.choose(radio.value));
    $("play").onclick = () => this.setPlaying(!this.isPlaying);
    $("restart").onclick = () => this.restart();
    $("next").onclick = () => { this.start += 1; this.restart(); };
    $("speed").onchange = event => { this.speed = Number(event.target.value); this.times = []; };
    $("compute").onclick = () => attempt(() => this.compute());
    $("file").onchange = event => {
      const [file] = event.target.files;
      event.target.value = "";
      if (file) attempt(() => this.open(file));
    };
    this.bindDrop();
    $("replay-play").onclick = () => this.log.toggle();
    $("position").oninput = event => { this.log.seek(event.target.valueAsNumber); this.screen.isStale = true; };
    $("back").onclick = () => { this.leaveLog(); $("play").focus(); };
    new ResizeObserver(() => { this.screen.isStale = true; }).observe($("scene"));
  }

  bindHandle(handle, arm) {
    let offset = null;
    handle.onpointerdown = event => {
      if (event.button !== 0) return;
      const [x, y] = this.screen.at(event);
      const [goalX, goalY] = this.screen.goals[arm].centre;
      offset = [goalX - x, goalY - y];
      handle.setPointerCapture(event.pointerId);
      handle.classList.add("dragged");
    };
    handle.onpointermove = event => {
      if (!offset) return;
      const [x, y] = this.screen.at(event);
      const { width, height } = this.screen.size();
      this.update(this.simulator.json("drag_goal", arm, x + offset[0], y + offset[1], width, height));
      this.screen.isStale = true;
    };
    handle.onpointerup = handle.onpointercancel = () => {
      offset = null;
      handle.classList.remove("dragged");
    };
    handle.onkeydown = event => {
      const step = event.shiftKey ? 5 * STEP_CM : STEP_CM;
      const motion = { ArrowLeft: [-step, 0, 0], ArrowRight: [step, 0, 0], ArrowUp: [0, step, 0],
        ArrowDown: [0, -step, 0], PageUp: [0, 0, step], PageDown: [0, 0, -step] }[event.key];
      if (motion) this.nudge(arm, motion);
      else if (event.key === " ") this.setPlaying(!this.isPlaying);
      else return;
      event.preventDefault();
    };
  }

  setPlaying(isPlaying) {
    this.isPlaying = isPlaying;
    this.times = [];
    this.owed_s = 0;
    $("play").textContent = isPlaying ? "Pause" : "Play";
    this.screen.isStale = true;
  }

  bindDrop() {
    const hasFiles = event => event.dataTransfer?.types.includes("Files");
    let depth = 0;
    const hint = change => { depth = Math.max(depth + change, 0); $("drop-hint").hidden = depth === 0; };
    addEventListener("dragenter", event => { if (hasFiles(event)) hint(1); });
    addEventListener("dragleave", event => { if (hasFiles(event)) hint(-1); });
    addEventListener("dragover", event => { if (hasFiles(event)) event.preventDefault(); });
    addEventListener("drop", event => {
      if (!hasFiles(event)) return;
      event.preventDefault();
      depth = 0;
      hint(0);
      const [file] = event.dataTransfer.files;
      if (file) attempt(() => this.open(file));
    });
  }

  /** Simulates a log again, and plays it. */
  async open(file) {
    $("log-details").hidden = true;
    try {
      if (file.size > MAX_LOG_BYTES) throw new Refused("the file is too large for the log of an episode");
      const facts = this.simulator.read("open_log", new Uint8Array(await file.arrayBuffer()));
      this.verdict(facts, file.name);
      this.log = new Log(facts);
      this.showLog(file.name);
    } catch (error) {
      if (!(error instanceof Refused)) this.recoverFromLog();
      const line = error instanceof Refused ? error.message : "the file is damaged";
      showVerdict("verdict", `${file.name}: ${line}`, false);
      this.leaveLog();
    }
  }

  /** Starts the simulator again after a file that made it trap. */
  recoverFromLog() {
    this.simulator.start();
    if (this.policy) this.load();
  }

  verdict(facts, name) {
    const { difference, steps, equal_steps } = facts;
    const scope = facts.is_cut_short ? " (the log ends before its episode does)" : "";
    showVerdict("verdict", difference
      ? `${equal_steps} of ${steps} steps equal, then step ${difference.step}: ${difference.field}[${difference.component}] `
        + `is ${difference.logged} in the log, ${difference.played} when simulated again`
      : `${steps} of ${steps} steps equal bit for bit${scope}`, !difference);
    $("replay-verdict").textContent = $("verdict").textContent;
    $("replay-verdict").className = $("verdict").className;
    $("log-details").textContent = `${name}: ${PRETTY[facts.task]}, ${facts.arms === 1 ? "1 arm" : `${facts.arms} arms`}, `
      + `${facts.is_training ? "training" : "evaluation"} episode ${facts.episode}`
      + `${facts.run ? ` of run ${facts.run}` : ""}, seed ${facts.seed}`;
    $("log-details").hidden = false;
  }

  showLog(name) {
    $("title").textContent = name;
    $("live-controls").hidden = $("rate-tile").hidden = true;
    $("replay-controls").hidden = false;
    $("second-tile").hidden = this.log.facts.arms < 2;
    $("position").max = this.log.facts.steps;
    for (const handle of this.handles) handle.hidden = true;
    this.log.onmove = () => { this.screen.isStale = true; };
    this.log.seek(0);
    this.log.setPlaying(true);
    $("scene").scrollIntoView({ block: "nearest" });
  }

  leaveLog() {
    this.log = null;
    $("title").textContent = "The student";
    $("live-controls").hidden = $("rate-tile").hidden = false;
    $("replay-controls").hidden = true;
    $("second-tile").hidden = false;
    this.times = [];
    if (this.status) this.update(this.status);
    else show(badge, this.instead, "");
    this.screen.isStale = true;
  }

  /** Computes the hash of 1,000 steps, and compares it with that of the native program. */
  async compute() {
    $("compute").disabled = true;
    $("compute").textContent = "Computing …";
    try {
      const { policy, facts: { task } } = this;
      // A worker of its own: the scene stays in motion.
      const here = await inWorker(policy);
      const response = await fetch("digests.json");
      if (!response.ok) throw new Error(`digests.json: ${response.status} ${response.statusText}`);
      const native = (await response.json())[task];
      // Another student has been chosen meanwhile.
      if (this.policy !== policy) return;
      $("digest-here").textContent = here;
      $("digest-native").textContent = native;
      $("digests").hidden = false;
      showVerdict("digest-verdict", here === native ? "Equal: 1,000 steps, every bit" : "The hashes differ", here === native);
    } finally {
      $("compute").disabled = !this.isReady;
      $("compute").textContent = "Compute it here";
    }
  }
}

/** A log that plays: its position in control steps. */
class Log {
  constructor(facts) {
    this.facts = facts;
    this.position = 0;
    this.isPlaying = false;
    this.onmove = () => {};
  }

  advance(elapsed_s) {
    if (!this.isPlaying) return;
    const position = Math.min(this.position + elapsed_s / this.facts.control_step_s, this.facts.steps);
    this.show(position);
    if (position === this.facts.steps) this.setPlaying(false);
  }

  seek(position) {
    this.setPlaying(false);
    this.show(position);
  }

  toggle() {
    if (!this.isPlaying && this.position >= this.facts.steps) this.show(0);
    this.setPlaying(!this.isPlaying);
  }

  setPlaying(isPlaying) {
    this.isPlaying = isPlaying;
    $("replay-play").textContent = isPlaying ? "Pause" : "Play";
  }

  show(position) {
    this.position = position;
    const step = Math.floor(position);
    $("position").value = step;
    $("position").ariaValueText = `Step ${step} of ${this.facts.steps}`;
    $("replay-step").textContent = step;
    const distances_m = this.facts.distances_m[step];
    showDistances(distances_m, 0.05);
    const n_reached = distances_m.filter(it => it <= 0.05).length;
    show(badge, `${n_reached} of ${distances_m.length} goals reached`, n_reached === distances_m.length ? "good" : "");
    $("since-label").textContent = "Time of the episode";
    $("since").textContent = seconds(step * this.facts.control_step_s);
    $("since-detail").textContent = `step ${step} of ${this.facts.steps}`;
    this.onmove();
  }
}

/** Computes the digest of a policy in a worker. */
function inWorker(policy) {
  return new Promise((resolve, reject) => {
    const worker = new Worker("digest.js", { type: "module" });
    worker.onmessage = ({ data }) => {
      worker.terminate();
      if (data.digest) resolve(data.digest);
      else reject(new Error(data.problem));
    };
    worker.onerror = event => reject(new Error(event.message));
    worker.postMessage(policy);
  });
}

const badge = $("badge");

function show(element, text, kind) {
  if (element.textContent !== text) element.textContent = text;
  element.className = `badge ${kind}`;
}

function showDistances(distances_m, tolerance_m) {
  distances_m.forEach((distance_m, arm) => {
    const isReached = distance_m <= tolerance_m;
    $(`distance-${arm}`).textContent = `${(100 * distance_m).toFixed(1)} cm`;
    $(`reached-${arm}`).textContent = isReached ? "from its goal: reached" : "from its goal";
    $(`reached-${arm}`).className = isReached ? "detail good" : "detail";
  });
}

function showVerdict(id, text, isGood) {
  $(id).textContent = text;
  $(id).className = `verdict ${isGood ? "good" : "bad"}`;
  $(id).hidden = false;
}

const tasks = () => [...document.querySelectorAll("input[name=task]")];
const counted = (n, noun) => `${n} ${noun}${n === 1 ? "" : "s"}`;
const cm = metres => `${Math.round(100 * metres)} cm`;
/** Names the direction of a distance, so that nothing is minus one to the right. */
const towards = (metres, ahead, behind) => `${cm(Math.abs(metres))} ${metres < 0 ? behind : ahead}`;
const seconds = time_s => `${time_s.toFixed(1)} s`;

function complain(error) {
  $("alert").textContent = error.message;
  $("alert").hidden = false;
}

/** Runs an action of the visitor, and displays its error. */
async function attempt(action) {
  try {
    $("alert").hidden = true;
    await action();
  } catch (error) {
    complain(error);
  }
}

attempt(async () => {
  const app = new App(await Simulator.load("tandem_demo.wasm.gz"));
  requestAnimationFrame(now => app.frame(now));
  // A browser that loads the page again keeps the choice.
  await app.choose(tasks().find(radio => radio.checked).value);
});
