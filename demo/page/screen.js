// Draws the shapes of a scene, which the simulator sorts from back to front.

/** Colours of the arms' joints, objects and goals; red, green and blue. They are those of films and reports. */
const ARMS = [[47, 120, 189], [224, 128, 51]];
/** Colour of the parts of a shared object that belong to no arm, as in films. */
const PART = [150, 156, 163];
const TABLE = [233, 228, 219];
const LINK = [238, 240, 243];
const HAND = [74, 82, 92];
const PEDESTAL = [89, 97, 107];
/** Share of an arm's colour in that of its links. */
const LINK_TINT = 0.16;
const SHADOW = 0.17;
const GOAL_OPACITY = 0.3;
const ACHIEVED_OPACITY = 0.52;
/** Side of the light, as seen in the picture. */
const LIGHT = [-0.55, -0.83];
const MAX_RATIO = 2;

export class Screen {
  constructor(simulator, canvas, frame) {
    this.simulator = simulator;
    this.canvas = canvas;
    this.frame = frame;
    this.context = canvas.getContext("2d");
    this.shadows = document.createElement("canvas").getContext("2d");
    this.isStale = true;
    /** The goals of the last picture. */
    this.goals = [];
    /** Mean time that a picture takes, milliseconds. */
    this.cost_ms = null;
  }

  /** Returns the size of the scene on the page, to which the places of goals and pointers refer. */
  size() {
    return { width: Math.max(this.frame.clientWidth, 1), height: Math.max(this.frame.clientHeight, 1) };
  }

  /** Returns the place of a pointer in the scene. */
  at(event) {
    const box = this.frame.getBoundingClientRect();
    return [event.clientX - box.left - this.frame.clientLeft, event.clientY - box.top - this.frame.clientTop];
  }

  /** Draws the scene if it has changed: the student's world, or the log `position` steps after its start. */
  draw(position) {
    if (!this.isStale) return false;
    const began = performance.now();
    const { width, height } = this.size();
    const ratio = Math.min(window.devicePixelRatio || 1, MAX_RATIO);
    const drawing = this.simulator.json("draw", position ?? -1, width, height);
    for (const context of [this.context, this.shadows]) {
      const canvas = context.canvas;
      const [columns, rows] = [width, height].map(it => Math.round(ratio * it));
      if (canvas.width !== columns || canvas.height !== rows) [canvas.width, canvas.height] = [columns, rows];
      context.setTransform(ratio, 0, 0, ratio, 0, 0);
      context.clearRect(0, 0, width, height);
      context.lineCap = context.lineJoin = "round";
    }
    this.paint(drawing, width, height);
    this.goals = drawing.items.filter(it => it.of === "goal").sort((a, b) => a.arm - b.arm);
    this.isStale = false;
    const spent_ms = performance.now() - began;
    this.cost_ms = this.cost_ms === null ? spent_ms : 0.9 * this.cost_ms + 0.1 * spent_ms;
    return true;
  }

  paint({ table, top, shadows, rings, items }, width, height) {
    const { context } = this;
    for (const face of table) this.polygon(face.points, css(lit(TABLE, face.shade)));
    this.paintShadows(shadows, top, width, height);
    rings.forEach((ring, arm) => {
      this.polygon(ring, css(ARMS[arm], 0.14));
      context.strokeStyle = css(lit(ARMS[arm], 0.9), 0.75);
      context.lineWidth = 1.5;
      context.stroke();
    });
    for (const item of items) {
      if (item.of === "goal") this.goal(item);
      else if (item.of === "joint") this.joint(item);
      else if (item.points) this.face(item);
      else this.rod(item);
    }
  }

  /** Draws all shadows with one opacity, where they fall on the table. */
  paintShadows(shapes, table, width, height) {
    const { shadows, context } = this;
    shadows.fillStyle = shadows.strokeStyle = "#000";
    for (const { points, from, to, width } of shapes) {
      path(shadows, points ?? [from, to], Boolean(points));
      if (points) shadows.fill();
      else {
        shadows.lineWidth = width;
        shadows.stroke();
      }
    }
    context.save();
    path(context, table, true);
    context.clip();
    context.globalAlpha = SHADOW;
    context.drawImage(shadows.canvas, 0, 0, width, height);
    context.restore();
  }

  face({ of, arm, points, shade }) {
    const color = { object: ARMS[arm] ?? PART, hand: HAND, pedestal: PEDESTAL }[of];
    this.polygon(points, css(lit(color, shade)));
    // Covers the gap between neighbouring faces.
    this.context.strokeStyle = css(lit(color, 0.94 * shade));
    this.context.lineWidth = 0.8;
    this.context.stroke();
  }

  /** Draws a cylinder with round ends, lit from one side. */
  rod({ arm, from, to, width }) {
    const color = mix(LINK, ARMS[arm], LINK_TINT);
    const { context } = this;
    const [x, y] = [to[0] - from[0], to[1] - from[1]];
    const length = Math.hypot(x, y);
    // Across the axis, on the side of the light.
    let across = length > 1 ? [-y / length, x / length] : LIGHT;
    if (across[0] * LIGHT[0] + across[1] * LIGHT[1] < 0) across = across.map(it => -it);
    for (const [share, offset, brightness] of [[1, 0, 0.66], [0.88, 0.05, 0.8], [0.66, 0.12, 0.93], [0.4, 0.18, 1.05], [0.16, 0.22, 1.3]]) {
      const move = ([x, y]) => [x + offset * width * across[0], y + offset * width * across[1]];
      path(context, [move(from), move(to)], false);
      context.strokeStyle = css(lit(color, brightness));
      context.lineWidth = share * width;
      context.stroke();
    }
  }

  joint({ arm, centre, radius }) {
    const [x, y] = centre.map((it, axis) => it + 0.35 * radius * LIGHT[axis]);
    const shading = this.context.createRadialGradient(x, y, 0.1 * radius, ...centre, radius);
    shading.addColorStop(0, css(lit(ARMS[arm], 1.4)));
    shading.addColorStop(0.5, css(ARMS[arm]));
    shading.addColorStop(1, css(lit(ARMS[arm], 0.68)));
    this.disc(centre, radius, shading);
  }

  disc(centre, radius, style) {
    this.context.beginPath();
    this.context.arc(...centre, radius, 0, 2 * Math.PI);
    this.context.fillStyle = style;
    this.context.fill();
  }

  goal({ arm, centre, radius, foot, is_achieved }) {
    const { context } = this;
    const color = ARMS[arm];
    if (foot[1] - centre[1] > 1.5 * radius) {
      path(context, [[centre[0], centre[1] + radius], foot], false);
      context.setLineDash([3, 5]);
      context.strokeStyle = css(color, 0.8);
      context.lineWidth = 1.5;
      context.stroke();
      context.setLineDash([]);
    }
    const opacity = is_achieved ? ACHIEVED_OPACITY : GOAL_OPACITY;
    const shading = context.createRadialGradient(centre[0] - 0.3 * radius, centre[1] - 0.35 * radius, 0.1 * radius, ...centre, radius);
    shading.addColorStop(0, css(lit(color, 1.5), 0.7 * opacity));
    shading.addColorStop(0.75, css(color, opacity));
    shading.addColorStop(1, css(color, Math.min(opacity + 0.3, 0.85)));
    this.disc(centre, radius, shading);
  }

  polygon(points, color) {
    path(this.context, points, true);
    this.context.fillStyle = color;
    this.context.fill();
  }

  /** Puts the handles where the goals are. */
  place(handles) {
    handles.forEach((handle, arm) => {
      const goal = this.goals[arm];
      handle.hidden = !goal;
      if (!goal) return;
      handle.style.left = `${goal.centre[0]}px`;
      handle.style.top = `${goal.centre[1]}px`;
      handle.style.width = handle.style.height = `${2 * goal.radius}px`;
    });
  }
}

function path(context, points, isClosed) {
  context.beginPath();
  context.moveTo(...points[0]);
  for (const point of points.slice(1)) context.lineTo(...point);
  if (isClosed) context.closePath();
}

const mix = (a, b, share) => a.map((it, channel) => it + share * (b[channel] - it));

/** Changes the brightness of a colour: 0 is black, 1 the colour itself, 2 white. */
function lit(color, brightness) {
  return brightness <= 1 ? color.map(it => it * brightness) : mix(color, [255, 255, 255], brightness - 1);
}

function css(color, opacity = 1) {
  return `rgb(${color.map(Math.round).join(" ")} / ${opacity})`;
}
