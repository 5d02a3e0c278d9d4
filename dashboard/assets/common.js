// Elements, formats and the stream of states, for all pages.

/** Time after which a hidden page closes its connection, milliseconds. */
const HIDDEN_MS = 5000;
/** Time that the browser has to open an interrupted connection again before it counts as lost, milliseconds. */
const GRACE_MS = 1000;
/** Time between two attempts to open a lost connection, milliseconds. */
const RETRY_MS = 2000;
/** Silence after which a connection is opened again: the service sends something every few seconds. Milliseconds. */
const REOPEN_MS = 30_000;
/** Silence after which a page says that its values are old, milliseconds. */
const SILENT_MS = 10_000;
/** Delay of states beyond which the connection is opened again, milliseconds. */
const LATE_MS = 5000;

export const byId = (id) => document.getElementById(id);

/** Returns an element with attributes and children; `null` attributes are left out. */
export function el(name, attributes = {}, ...children) {
  return fill(document.createElement(name), attributes, children);
}

/** Returns an SVG element. */
export function svg(name, attributes = {}, ...children) {
  return fill(document.createElementNS("http://www.w3.org/2000/svg", name), attributes, children);
}

function fill(element, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined) element.setAttribute(key, value);
  }
  element.append(...children.flat().filter((child) => child !== null));
  return element;
}

/** Sets a text only if it differs, so that screen readers do not repeat it. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

const grouped = new Intl.NumberFormat("en", { maximumFractionDigits: 0, signDisplay: "negative" });
export const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
export const count = (value) => (isNumber(value) ? grouped.format(value) : "–");
/** Formats a share. The space does not break, so that no line begins with the sign. */
export const percent = (value, digits = 1) => (isNumber(value) ? `${(100 * value).toFixed(digits)}\u00a0%` : "–");

/** Formats a real number with about three significant digits. */
export function real(value) {
  if (!isNumber(value)) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 0.001 || size >= 1e6)) return value.toExponential(1).replace("-", "−");
  if (size >= 1000) return count(value).replace("-", "−");
  const digits = size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : 4;
  return value.toFixed(digits).replace("-", "−");
}

/** Formats seconds as h:mm:ss or m:ss. */
export function clock(seconds) {
  if (!isNumber(seconds)) return "–";
  const total = Math.max(0, Math.floor(seconds));
  const two = (n) => String(n).padStart(2, "0");
  const [h, m, s] = [Math.floor(total / 3600), Math.floor(total / 60) % 60, total % 60];
  return h > 0 ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
}

export const plural = (n, noun) => `${count(n)} ${noun}${n === 1 ? "" : "s"}`;

/** Fetches a JSON document of this service. */
export async function fetchJson(path) {
  const response = await fetch(path);
  if (!response.ok) throw new Error(`${path}: ${response.status}`);
  return response.json();
}

/**
 * Calls `onState` with every state, and `onLink` with the condition of the connection: "live", "lost" or "full"; "live"
 * each time that a connection is opened, possibly to a service that has been started again. The service ends connections
 * at a certain age, and the browser opens another one at once, so "lost" is reported only if that fails.
 * A lost connection is opened again for as long as the page exists. A hidden page closes it after a while: browsers open
 * six connections to an address, and the stop button of another page needs one.
 * A page reloads itself if another kind or version of page is now served at its address.
 *
 * `timeOf` returns the time of a state on the service's clock, milliseconds. With it, the age of a state includes its delay:
 * the time that it took to arrive beyond that of the fastest state of the same connection. If states arrive late by more
 * than `LATE_MS`, the connection is opened again, which begins with the service's newest state.
 *
 * Returns functions of the age of the latest state and of the time since the latest sign of the service, milliseconds.
 */
export function follow(onState, onLink, timeOf = null) {
  let source = null;
  let timer = null;
  let hidden = null;
  let stateAt = performance.now();
  let aliveAt = stateAt;
  let openedAt = stateAt;
  /** The least difference between the page's clock and the service's at the arrival of a state of this connection. */
  let leastOffset = Infinity;
  const wait = (action, time_ms) => {
    clearTimeout(timer);
    timer = action && setTimeout(action, time_ms);
  };
  const close = () => {
    wait(null);
    source?.close();
    source = null;
  };
  const open = () => {
    close();
    if (document.hidden) return;
    openedAt = performance.now();
    leastOffset = Infinity;
    source = new EventSource("/events");
    source.onopen = () => {
      wait(null);
      // The browser has connected again by itself.
      leastOffset = Infinity;
      stateAt = aliveAt = performance.now();
      onLink("live");
    };
    source.onmessage = (message) => {
      aliveAt = performance.now();
      const state = JSON.parse(message.data);
      const late_ms = delay(state);
      onState(state);
      stateAt = aliveAt - late_ms;
      if (late_ms > LATE_MS) open();
    };
    source.addEventListener("page", (message) => {
      if (message.data !== document.documentElement.dataset.page) location.reload();
    });
    source.addEventListener("alive", () => {
      aliveAt = performance.now();
    });
    source.onerror = (event) => {
      if (event.target.readyState === EventSource.CLOSED) return refused(event.target);
      if (timer === null) wait(lose, GRACE_MS);
    };
  };
  const delay = (state) => {
    if (timeOf === null) return 0;
    const offset = aliveAt - timeOf(state);
    leastOffset = Math.min(leastOffset, offset);
    return offset - leastOffset;
  };
  const lose = () => {
    close();
    onLink("lost");
    wait(open, RETRY_MS);
  };
  // The browser gives up after a response that is no stream: the reason is in the response.
  const refused = async (closed) => {
    wait(null);
    onLink("lost");
    const status = await fetch("/state").then((response) => response.status, () => 0);
    if (source !== closed) return;
    if (status === 401) location.reload();
    if (status === 200) onLink("full");
    wait(open, RETRY_MS);
  };
  open();
  // A connection whose other end is gone raises no error.
  setInterval(() => {
    if (source !== null && performance.now() - Math.max(aliveAt, openedAt) > REOPEN_MS) open();
  }, 1000);
  addEventListener("pagehide", close);
  addEventListener("pageshow", (event) => event.persisted && open());
  document.addEventListener("visibilitychange", () => {
    clearTimeout(hidden);
    if (!document.hidden) return source === null && open();
    hidden = setTimeout(() => {
      close();
      onLink("lost");
    }, HIDDEN_MS);
  });
  return { ageOfState: () => performance.now() - stateAt, sinceAlive: () => performance.now() - aliveAt };
}

/** Replaces the children of `parent` by one element per item, and keeps elements whose key is the same. */
export function keyed(parent, items, key, create, update) {
  const known = new Map([...parent.children].map((child) => [child.dataset.key, child]));
  items.forEach((item, idx) => {
    const name = String(key(item));
    const child = known.get(name) ?? create(item);
    known.delete(name);
    child.dataset.key = name;
    update(child, item);
    if (parent.children[idx] !== child) parent.insertBefore(child, parent.children[idx] ?? null);
  });
  known.forEach((child) => child.remove());
}

/** Shows a table of texts, and keeps its cells, so that they can be selected. The first cell of a row names it. */
export function showTable(table, names, rows) {
  const nColumns = names.length;
  if (table.tHead?.rows[0].cells.length !== nColumns) {
    table.replaceChildren(
      el("thead", {}, el("tr", {}, names.map(() => el("th", { scope: "col" })))), el("tbody"));
  }
  const body = table.tBodies[0];
  while (body.rows.length > rows.length) body.lastChild.remove();
  while (body.rows.length < rows.length) {
    body.append(el("tr", {}, names.map((_, idx) => (idx === 0 ? el("th", { scope: "row" }) : el("td")))));
  }
  [names, ...rows].forEach((texts, row) => {
    const { cells } = table.rows[row];
    for (let idx = 0; idx < nColumns; idx += 1) setText(cells[idx], texts[idx]);
  });
}

/** Number of characters that fit a tile in its large font. */
const MAX_LARGE_CHARS = 9;

/** Shows tiles: [[name, value, detail, isBad]]. */
export function showTiles(parent, tiles) {
  keyed(parent, tiles, ([name]) => name,
    ([name]) => el("div", { class: "tile" }, el("dt", {}, name), el("dd", { class: "value" }), el("dd", { class: "detail" })),
    (tile, [, value, detail, isBad = false]) => {
      tile.classList.toggle("bad", isBad);
      setText(tile.children[1], value);
      tile.children[1].classList.toggle("long", value.length > MAX_LARGE_CHARS);
      setText(tile.children[2], detail);
    });
}

export const MARKS = { info: "•", good: "✓", warning: "!", bad: "✕" };
export const mark = (level) => el("span", { class: `mark ${level}`, "aria-hidden": "true" }, MARKS[level]);

/** Shows events, latest first. `timeOf` returns the time of an event as text. */
export function showLog(parent, events, timeOf = (event) => clock(event.at_s)) {
  const items = [...(events ?? [])].reverse();
  parent.replaceChildren(...items.map((event) =>
    el("li", {}, el("time", {}, timeOf(event)), mark(event.level), el("span", {}, event.text))));
}

/** Fetches the documents of a state as they change. */
export class Documents {
  constructor() {
    /** The versions that were fetched, and the latest ones; the documents that are being fetched. */
    this.versions = {};
    this.wanted = {};
    this.loading = new Set();
  }

  /** Forgets the versions: a service that starts again may begin with other ones. */
  forget() {
    this.versions = {};
  }

  /**
   * Calls `show` with a document if its version is new. A document has one request at a time, so that on a slow
   * connection it is shown late rather than never. `pathOf` returns its path under `/data`, if that is not its name.
   */
  async update(name, version, show, pathOf = () => name) {
    this.wanted[name] = version;
    if (this.loading.has(name)) return;
    this.loading.add(name);
    try {
      while (this.versions[name] !== this.wanted[name]) {
        const [versions, fetched] = [this.versions, this.wanted[name]];
        const found = await fetchJson(`/data/${pathOf()}`).catch(() => undefined);
        // The next state tries again.
        if (found === undefined) return;
        versions[name] = fetched;
        show(found);
      }
    } finally {
      this.loading.delete(name);
    }
  }
}

/**
 * Shows the condition of the connection, which has been silent for `silent_ms`; `hasEnded` if the service is expected to
 * be gone.
 */
export function showLink(element, condition, hasEnded, silent_ms) {
  const isSilent = condition === "live" && !hasEnded && silent_ms > SILENT_MS;
  element.classList.toggle("lost", isSilent || (condition === "lost" && !hasEnded));
  // In steps, which screen readers repeat.
  setText(element, isSilent ? `nothing received for ${10 * Math.floor(silent_ms / 10_000)} s: the values are old` : {
    live: "live",
    lost: hasEnded ? "the service has ended; these are the final values" : "no connection, trying again",
    full: "too many viewers, trying again",
  }[condition] ?? condition);
}
