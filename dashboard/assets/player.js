// Playback of an episode, from above and from the side.
import { byId, el, setText, svg } from "/assets/common.js";

/** Shortest time for which a step is shown, so that fast tasks can be followed. */
const MIN_STEP_MS = 80;
const HALF_OBJECT_M = 0.0225;
/** Width of a view, and what is drawn above a hand as seen from above (beyond its fingers) and from the side: pixels. */
const WIDTH_PX = 600;
const ABOVE_HAND_PX = { 1: 42, 2: 68 };
/** Half of the smallest gap that is drawn between the fingers, metres. */
const MIN_GAP_M = 0.012;

export class Player {
  constructor() {
    this.playback = null;
    /** The latest evaluation, `null` if it is shown: it waits until the episode that is shown has ended. */
    this.next = null;
    this.step = 0;
    this.playing = false;
    /** Whether the viewer has paused: then nothing moves until the viewer asks for it. */
    this.isHeld = false;
    byId("play").addEventListener("click", () => {
      this.isHeld = this.playing;
      if (this.playing) this.pause();
      else this.start();
    });
    byId("step").addEventListener("input", (event) => {
      this.isHeld = true;
      this.pause();
      this.seek(Number(event.target.value));
    });
    byId("episode-choice").addEventListener("change", (event) => {
      this.isHeld ||= isMotionReduced();
      this.choose(Number(event.target.value));
    });
  }

  /**
   * Shows the episodes of an evaluation, `null` if it has none that can be shown. An episode that plays comes to its end
   * first, and one that the viewer has paused stays: evaluations can follow one another faster than an episode plays.
   */
  load(playback) {
    if (playback && this.episode && (this.playing || this.isHeld)) {
      this.next = JSON.stringify(playback) === JSON.stringify(this.playback) ? null : playback;
      this.seek(this.step);
      return;
    }
    if (playback && JSON.stringify(playback) === JSON.stringify(this.playback)) return;
    this.show(playback);
  }

  /** Forgets the episodes: another run has the address of the page. */
  reset() {
    this.isHeld = false;
    this.show(null);
  }

  /** Replaces what is shown. */
  show(playback) {
    this.playback = playback;
    this.next = null;
    byId("player").hidden = !playback;
    byId("episode-note").hidden = Boolean(playback);
    if (!playback) {
      this.pause();
      this.episode = null;
      return;
    }
    const choice = byId("episode-choice");
    const chosen = Math.min(Number(choice.value) || 0, playback.episodes.length - 1);
    choice.replaceChildren(...playback.episodes.map((episode, idx) =>
      el("option", { value: idx }, `${idx + 1}: ${episode.success ? "success" : "no success"}`)));
    choice.value = chosen;
    this.choose(chosen);
  }

  choose(idx) {
    this.episode = this.playback.episodes[idx];
    byId("step").max = this.last();
    this.views = [this.view("view-above", 1), this.view("view-side", 2)];
    this.seek(0);
    this.playing = false;
    if (this.isHeld || isMotionReduced()) this.pause();
    else this.start();
  }

  start() {
    if (!this.episode) return;
    if (this.step >= this.last()) {
      if (this.next) this.show(this.next);
      else this.seek(0);
    }
    if (this.playing) return;
    const last = this.last();
    this.playing = true;
    setText(byId("play"), "Pause");
    const stepMs = Math.max(MIN_STEP_MS, 1000 * this.playback.step_s);
    const from = { at: performance.now(), step: this.step, episode: this.episode };
    const frame = (now) => {
      if (!this.playing || from.episode !== this.episode) return;
      const step = from.step + Math.max(0, now - from.at) / stepMs;
      this.seek(Math.min(step, last));
      if (step < last) requestAnimationFrame(frame);
      else if (this.next) this.show(this.next);
      else this.pause();
    };
    requestAnimationFrame(frame);
  }

  /** Returns the last step of the episode. */
  last() {
    return this.episode.steps.length - 1;
  }

  pause() {
    this.playing = false;
    setText(byId("play"), "Play");
  }

  /** Shows a step; a fraction lies between two steps. */
  seek(step) {
    this.step = step;
    const whole = Math.floor(step);
    const parts = this.between(whole, step - whole);
    this.views.forEach((view) => view(parts, whole));
    const slider = byId("step");
    if (Number(slider.value) !== whole) slider.value = whole;
    const reached = parts.filter((part) => part.at_goal).length;
    const touching = this.episode.contacts.includes(whole) ? ", arms touch" : "";
    const text = `Step ${whole} of ${this.last()}: ${reached} of ${parts.length} at the goal${touching}`;
    if (slider.getAttribute("aria-valuetext") !== text) slider.setAttribute("aria-valuetext", text);
    const next = this.next ? ` The evaluation of round ${this.next.round} follows.` : "";
    setText(byId("episode-text"), `${text}. Policy of round ${this.playback.round}.${next}`);
  }

  between(whole, share) {
    const [now, next] = [this.episode.steps[whole], this.episode.steps[whole + 1] ?? this.episode.steps[whole]];
    const mixed = (a, b) => a?.map((x, axis) => x + share * (b[axis] - x));
    return now.map((part, idx) => ({
      ...part,
      hand: mixed(part.hand, next[idx].hand),
      object: mixed(part.object, next[idx].object),
      opening: part.opening,
    }));
  }

  /** Returns the largest extent of all positions in x and in `axis` (1: y, 2: z), metres. */
  extent(axis) {
    const points = this.episode.steps.flat().flatMap((part) => [part.hand, part.object].filter(Boolean)).concat(this.episode.goals);
    const margin = 1.3 * this.playback.tolerance_m;
    const reach = (a) => [Math.min(...points.map((p) => p[a])) - margin, Math.max(...points.map((p) => p[a])) + margin];
    const [x, other] = [reach(0), reach(axis)];
    const half = Math.max(0.3, -x[0], x[1]);
    const isArms = this.playback.bases.length > 0;
    const shown = isArms ? [-half, half] : x;
    // The hand and its label have a size in pixels.
    const label_m = ABOVE_HAND_PX[axis] * (shown[1] - shown[0]) / WIDTH_PX;
    const tops = this.episode.steps.flat().filter((part) => part.hand)
      .map((part) => part.hand[axis] + label_m + (axis === 1 ? gapOf(part) : 0));
    const high = Math.max(other[1], ...tops);
    if (!isArms) return { x, other: [other[0], high] };
    return { x: shown, other: axis === 1 ? [Math.min(-0.18, other[0]), Math.max(0.18, high)] : [-0.04, Math.max(0.26, high)] };
  }

  /** Prepares a view and returns the function that draws a step. */
  view(id, axis) {
    const root = byId(id);
    const { x: [xLow, xHigh], other: [low, high] } = this.extent(axis);
    const scale = WIDTH_PX / (xHigh - xLow);
    const height = (high - low) * scale;
    root.setAttribute("viewBox", `0 0 ${WIDTH_PX} ${height.toFixed(0)}`);
    const at = (point) => [(point[0] - xLow) * scale, height - (point[axis] - low) * scale];
    const ground = axis === 2 ? svg("line", { x1: 0, x2: WIDTH_PX, y1: at([0, 0, 0])[1], y2: at([0, 0, 0])[1], class: "table" }) : null;
    root.replaceChildren(...[ground].filter(Boolean));
    const drawing = { root, at, axis, scale, height };
    root.append(ruler(drawing));
    const goals = this.episode.goals.map((goal, arm) => this.goal(drawing, goal, arm));
    const trails = this.episode.goals.map((_, arm) => svg("polyline", { class: `trail arm${arm % 3}` }));
    const moving = svg("g");
    root.append(...goals, ...trails, moving);
    return (parts, whole) => {
      parts.forEach((part, arm) => {
        goals[arm].classList.toggle("reached", part.at_goal);
        const trail = this.episode.steps.slice(0, whole + 1).map((step) => at(step[arm].object).map((v) => v.toFixed(1)).join(","));
        trails[arm].setAttribute("points", trail.join(" "));
      });
      moving.replaceChildren(...parts.map((part, arm) => this.part(drawing, part, arm)));
    };
  }

  goal({ at, scale }, goal, arm) {
    const [x, y] = at(goal);
    const r = this.playback.tolerance_m * scale;
    const shape = this.playback.is_cube
      ? svg("rect", { x: x - r, y: y - r, width: 2 * r, height: 2 * r })
      : svg("circle", { cx: x, cy: y, r });
    shape.setAttribute("class", `goal arm${arm % 3}`);
    return shape;
  }

  /** Draws an arm with its hand and its object. */
  part(drawing, part, arm) {
    const { at, scale, axis } = drawing;
    const [ox, oy] = at(part.object);
    const half = this.playback.bases.length ? HALF_OBJECT_M * scale : 6;
    const object = svg("rect", { x: ox - half, y: oy - half, width: 2 * half, height: 2 * half, rx: 2, class: "object" });
    const group = svg("g", { class: `arm${arm % 3}` }, object);
    if (!part.hand) return group;
    const hand = at(part.hand);
    const base = this.playback.bases[arm];
    if (base) group.prepend(link(at(shoulder(base, part.hand, axis)), hand));
    const gap = gapOf(part) * scale;
    group.append(...(axis === 1 ? fromAbove(hand, gap, base ? Math.sign(base[0]) : 0) : fromSide(hand, gap)));
    group.append(svg("text", { x: hand[0], y: hand[1] - (axis === 1 ? gap + 16 : 44), "text-anchor": "middle" }, `arm ${arm}`));
    return group;
  }
}

const isMotionReduced = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

/** Returns half of the drawn gap between the fingers, metres. */
const gapOf = (part) => Math.max(MIN_GAP_M, part.opening ?? 0);

/** Returns where the drawn forearm begins: towards the base, and above the table as seen from the side. */
function shoulder(base, hand, axis) {
  return axis === 1 ? base : [base[0], 0, Math.max(0.28, hand[2] + 0.16)];
}

function link([x1, y1], [x2, y2]) {
  return svg("line", { x1, y1, x2, y2, class: "link-shape" });
}

/** Draws palm and fingers as seen from above; the palm lies towards the base. */
function fromAbove([x, y], gap, side) {
  const away = 9 * side;
  return [
    svg("rect", { x: x - 7 + away, y: y - gap - 6, width: 14, height: 2 * gap + 12, rx: 4, class: "palm", "fill-opacity": 0.75 }),
    svg("rect", { x: x - 10, y: y - gap - 6, width: 20, height: 6, rx: 2, class: "finger" }),
    svg("rect", { x: x - 10, y: y + gap, width: 20, height: 6, rx: 2, class: "finger" }),
  ];
}

/** Draws palm and fingers as seen from the side; the fingers point down. */
function fromSide([x, y], gap) {
  return [
    svg("rect", { x: x - gap - 7, y: y - 38, width: 2 * gap + 14, height: 14, rx: 4, class: "palm", "fill-opacity": 0.75 }),
    svg("rect", { x: x - gap - 6, y: y - 26, width: 6, height: 28, rx: 2, class: "finger" }),
    svg("rect", { x: x + gap, y: y - 26, width: 6, height: 28, rx: 2, class: "finger" }),
  ];
}

/** Draws a bar of known length in the lower left corner. */
function ruler({ scale, height }) {
  const length_m = 100 / scale > 0.15 ? 0.2 : 0.1;
  const [x, y, width] = [12, height - 10, length_m * scale];
  return svg("g", {}, svg("line", { x1: x, x2: x + width, y1: y, y2: y, class: "table" }),
    svg("text", { x: x + width + 6, y: y + 4 }, `${100 * length_m} cm`));
}
