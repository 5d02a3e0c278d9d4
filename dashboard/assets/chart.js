// Line charts as SVG, drawn at the width they have, so that text keeps its size.
import { el, isNumber, svg } from "/assets/common.js";

/** End of the horizontal axis while all points are at its start, environment steps. */
const FIRST_STEPS = 1000;
/** Margins, pixels. The last label of the horizontal axis may end in the right one. */
const MARGIN = { left: 46, right: 28, top: 10, bottom: 36 };

/** Returns about `n` round numbers from `low` to `high`. */
function ticks(low, high, n) {
  const span = high - low || 1;
  const magnitude = 10 ** Math.floor(Math.log10(span / n));
  const step = magnitude * [1, 2, 2.5, 5, 10].find((factor) => span / (factor * magnitude) <= n);
  const found = [];
  // Values that hardly differ may have steps below the resolution of a number.
  for (let idx = Math.ceil(low / step - 1e-9); idx * step <= high + step * 1e-6 && found.length <= 2 * n; idx += 1) {
    found.push(idx === 0 ? 0 : idx * step);
  }
  return found;
}

/** Returns the smallest and the largest value; unlike `Math.min(...)`, of any number of values. */
const extremes = (values) => values.reduce(([low, high], it) => [Math.min(low, it), Math.max(high, it)], [Infinity, -Infinity]);

function short(value) {
  const size = Math.abs(value);
  const text = size >= 1e6 ? `${+(value / 1e6).toPrecision(3)} M` : size >= 1e4 ? `${+(value / 1e3).toPrecision(3)} k`
    : size !== 0 && size < 1e-3 ? value.toExponential(0) : String(+value.toPrecision(3));
  return text.replace("-", "−");
}

/**
 * A chart of series against environment steps.
 *
 * `series`: [{ name, class, value(row), low(row), high(row) }], `format(value)`, `range`: [low, high] or null for that of
 * the values, `best(row)` marks points of the first series.
 */
export class Chart {
  constructor(parent, options) {
    this.options = { height: 190, format: short, tick: short, range: null, best: () => false, ...options };
    this.rows = [];
    this.cursor = null;
    this.legend = el("p", { class: "legend" });
    this.svg = svg("svg", { role: "img", tabindex: "0", "aria-label": options.label });
    this.readout = el("p", { class: "readout" });
    parent.append(this.legend, this.svg, this.readout);
    this.svg.addEventListener("pointermove", (event) => this.point(event));
    this.svg.addEventListener("pointerleave", () => this.moveTo(null));
    this.svg.addEventListener("keydown", (event) => this.key(event));
    this.svg.addEventListener("blur", () => {
      this.readout.removeAttribute("aria-live");
      this.moveTo(null);
    });
    new ResizeObserver(() => this.draw()).observe(parent);
    this.drawLegend();
  }

  /** Replaces the series; `show` draws them. */
  setSeries(series) {
    this.options.series = series;
    this.drawLegend();
  }

  /** Shows other rows; the cursor stays at its steps. */
  show(rows) {
    const steps = this.rows[this.cursor]?.env_steps;
    this.rows = rows;
    const kept = rows.findIndex((row) => row.env_steps === steps);
    this.cursor = kept < 0 ? null : kept;
    this.draw();
  }

  drawLegend() {
    const { series } = this.options;
    this.legend.replaceChildren();
    if (series.length < 2 && !series[0]?.low) return;
    const line = (name) => svg("svg", { viewBox: "0 0 26 10", "aria-hidden": "true" },
      svg("line", { x1: 1, y1: 5, x2: 25, y2: 5, class: `series ${name}` }));
    this.legend.append(...series.map((each) => el("span", {}, line(each.class), each.name)));
    if (this.options.bandName) {
      const band = svg("svg", { viewBox: "0 0 26 10", "aria-hidden": "true" },
        svg("rect", { x: 1, y: 0, width: 24, height: 10, class: "band" }));
      this.legend.append(el("span", {}, band, this.options.bandName));
    }
  }

  /** Returns the shown series with their points. */
  points() {
    return this.options.series.map((series) => ({
      series,
      points: this.rows.map((row) => [row.env_steps, series.value(row), row]).filter(([, y]) => isNumber(y)),
    }));
  }

  draw() {
    const width = Math.max(240, this.svg.parentElement.clientWidth);
    const { height } = this.options;
    const all = this.points();
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.setAttribute("height", height);
    this.svg.replaceChildren();
    this.scale(all, width);
    if (!all.some(({ points }) => points.length)) {
      this.overlay = null;
      this.readout.textContent = "";
      this.svg.setAttribute("aria-label", this.options.label);
      this.svg.append(svg("text", { x: width / 2, y: height / 2 - 8, "text-anchor": "middle", class: "empty" },
        "waiting for the first evaluation"));
      this.svg.append(svg("line", { x1: this.box.left, x2: this.box.right, y1: this.box.bottom, y2: this.box.bottom, class: "axis" }));
      return;
    }
    this.drawAxes(width);
    for (const { series, points } of [...all].reverse()) this.drawSeries(series, points);
    this.overlay = svg("g");
    this.svg.append(this.overlay);
    this.moveTo(this.cursor);
    this.describe(all[0]?.points ?? []);
  }

  scale(all, width) {
    const { height, range } = this.options;
    const xs = this.rows.map((row) => row.env_steps);
    const bounds = all.flatMap(({ series, points }) => points.flatMap(([, y, row]) =>
      [y, series.low?.(row), series.high?.(row)].filter(isNumber)));
    let [low, high] = range ?? extremes(bounds);
    if (!isNumber(low) || !isNumber(high)) [low, high] = [0, 1];
    if (!range) {
      const pad = (high - low) * 0.08 || Math.abs(high) * 0.1 || 1;
      [low, high] = [this.options.fromZero ? 0 : low - pad, high + pad];
    }
    // Room after a single point, and round numbers before the first step.
    const last = Math.max(0, extremes(xs)[1]);
    const xMax = last > 0 ? last * (new Set(xs).size > 1 ? 1 : 1.25) : FIRST_STEPS;
    const [left, right, top, bottom] = [MARGIN.left, width - MARGIN.right, MARGIN.top, height - MARGIN.bottom];
    this.x = (value) => left + (value / xMax) * (right - left);
    this.y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);
    this.box = { left, right, top, bottom, low, high, xMax };
  }

  drawAxes(width) {
    const { left, right, bottom, low, high, xMax } = this.box;
    for (const tick of ticks(low, high, 4)) {
      const y = this.y(tick);
      this.svg.append(svg("line", { x1: left, x2: right, y1: y, y2: y, class: "grid" }),
        svg("text", { x: left - 7, y: y + 4, "text-anchor": "end" }, this.options.tick(tick)));
    }
    this.svg.append(svg("line", { x1: left, x2: right, y1: bottom, y2: bottom, class: "axis" }));
    if (this.rows.length) {
      const marks = ticks(0, xMax, width < 300 ? 3 : width < 450 ? 4 : 6);
      marks.forEach((tick) => this.svg.append(
        svg("line", { x1: this.x(tick), x2: this.x(tick), y1: bottom, y2: bottom + 4, class: "axis" }),
        svg("text", { x: this.x(tick), y: bottom + 17, "text-anchor": "middle" }, short(tick))));
    }
    this.svg.append(svg("text", { x: (left + right) / 2, y: bottom + 32, "text-anchor": "middle" }, "environment steps"));
  }

  drawSeries(series, points) {
    const at = ([x, y]) => `${this.x(x).toFixed(1)},${this.y(y).toFixed(1)}`;
    if (series.low) {
      const edge = (bound) => points.filter(([, , row]) => isNumber(bound(row))).map(([x, , row]) => [x, bound(row)]);
      const outline = [...edge(series.high), ...edge(series.low).reverse()].map(at).join(" ");
      this.svg.append(svg("polygon", { points: outline, class: `band ${series.class}` }));
    }
    this.svg.append(svg("polyline", { points: points.map(at).join(" "), class: `series ${series.class}` }));
    if (points.length <= 60) {
      points.forEach(([x, y]) => this.svg.append(
        svg("circle", { cx: this.x(x), cy: this.y(y), r: 3.4, class: `dot ${series.class}` })));
    }
    if (series !== this.options.series[0]) return;
    const best = points.filter(([, , row]) => this.options.best(row)).at(-1);
    if (best) this.svg.append(svg("circle", { cx: this.x(best[0]), cy: this.y(best[1]), r: 7, class: "best" }));
  }

  /** Describes the first series to screen readers. */
  describe(points) {
    const last = points.at(-1);
    if (!last) return;
    const { label, format } = this.options;
    this.svg.setAttribute("aria-label",
      `${label}: ${points.length} values, latest ${format(last[1])}. Arrow keys read the values.`);
  }

  point(event) {
    if (!this.rows.length) return;
    const x = event.clientX - this.svg.getBoundingClientRect().left;
    const distances = this.rows.map((row) => Math.abs(this.x(row.env_steps) - x));
    this.moveTo(distances.indexOf(extremes(distances)[0]));
  }

  key(event) {
    const last = this.rows.length - 1;
    const to = { ArrowLeft: (this.cursor ?? last + 1) - 1, ArrowRight: (this.cursor ?? -1) + 1, Home: 0, End: last }[event.key];
    if (to === undefined || last < 0) return;
    event.preventDefault();
    this.readout.setAttribute("aria-live", "polite");
    this.moveTo(Math.min(last, Math.max(0, to)));
  }

  /** Shows the values of the row with this index; the latest ones without a cursor. */
  moveTo(idx) {
    this.cursor = idx;
    const row = this.rows[idx ?? this.rows.length - 1];
    if (!row || !this.overlay) return;
    const { series, format } = this.options;
    const { top, bottom } = this.box;
    const values = series.map((each) => {
      const bounds = each.low && isNumber(each.low(row)) ? ` [${format(each.low(row))}, ${format(each.high(row))}]` : "";
      return `${each.name} ${isNumber(each.value(row)) ? format(each.value(row)) : "–"}${bounds}`;
    });
    const when = idx === null ? "Latest" : `At ${row.env_steps.toLocaleString("en")} steps`;
    this.readout.textContent = `${when}: ${values.join(", ")}`;
    this.overlay.replaceChildren();
    if (idx === null) return;
    const x = this.x(row.env_steps);
    this.overlay.append(svg("line", { x1: x, x2: x, y1: top, y2: bottom, class: "cursor" }));
  }
}
