// The single-line diagram of a network: what its converters do now, and which breakers are closed.

import { value } from "./text.js";

const BOX = 220, FIRST = BOX + 66, COLUMN = 150, TOP = 22; // pixels
// A narrow page, whose nodes are below each other: its width, a line's, and what words need, at least.
const NARROW = 356, LANE = 22, WORDS = 230;
const LEAST = 5e-4; // p.u.; a smaller power has no arrow
const BAD = new Set(["SAFE", "tripped"]);
const SPACE = "http://www.w3.org/2000/svg";

function svg(tag, attributes = {}, ...children) {
  const element = document.createElementNS(SPACE, tag);
  for (const [name, content] of Object.entries(attributes)) element.setAttribute(name, content);
  element.append(...children);
  return element;
}

const line = (x1, y1, x2, y2, kind = "wire") => svg("line", { x1, y1, x2, y2, class: kind });
const text = (x, y, words, kind = "") => svg("text", { x, y, class: kind }, words);

export class Diagram {
  // network: as the server describes it; shown: the converter that the page shows; narrow: the page
  constructor(network, shown, narrow) {
    this.converters = new Map();
    this.breakers = new Map();
    this.parts = new Map();
    const { stacked } = network, lanes = Object.values(stacked.lines).map(([, lane]) => lane + 1);
    this.narrow = narrow;
    this.row = narrow ? 52 : 58;
    this.reach = narrow ? 44 : 64;
    const left = 10 + LANE * Math.max(0, ...lanes);
    const at = Object.fromEntries(network.bars.map((bar) =>
      [bar.name, narrow ? left : FIRST + COLUMN * bar.column]));
    this.right = Math.max(NARROW, left + WORDS);
    const wide = narrow ? this.right : Math.max(...Object.values(at)) + this.reach + 150;
    const high = TOP + this.row * (narrow ? stacked.rows : network.rows);
    this.element = svg("svg", { viewBox: `0 0 ${wide} ${high}`,
      role: "img", "aria-label": "Single-line diagram" });
    this.element.style.maxWidth = `${wide}px`;
    const own = new Map(network.bars.map((bar) =>
      [bar.name, narrow ? stacked.bars[bar.name] : bar.rows]));
    const rows = new Map([...own].map(([name, of]) => [name, [...of]]));
    for (const part of network.lines) {
      if (narrow) {
        this.upright(part, left, stacked.lines[part.name], own.get(part.start), own.get(part.end));
      } else {
        this.across(part, at[part.start], at[part.end]);
        for (const end of [part.start, part.end]) rows.get(end).push(part.row);
      }
    }
    for (const bar of network.bars) {
      const x = at[bar.name], of = own.get(bar.name);
      bar.converters.forEach((name, k) => this.converter(name, network.laws[name], x,
        this.y(of[k]), name === shown));
      const first = narrow ? bar.converters.length : 0;
      bar.right.forEach((part, k) => this.hang(part, x, this.y(of[first + k])));
      const all = rows.get(bar.name);
      const [top, bottom] = [Math.min(...all), Math.max(...all)].map((row) => this.y(row));
      this.element.append(line(x, top - 12, x, bottom + 12, "bar"),
        text(narrow ? x - 2 : x, top - 16, bar.name, narrow ? "of" : "name"));
    }
  }

  // A line between two nodes beside each other.
  across(part, start, end) {
    const [left, right] = [start, end].sort((a, b) => a - b), middle = (left + right) / 2;
    const y = this.y(part.row);
    this.element.append(line(left, y, right, y), text(middle, y + 18, part.name, "name"));
    this.inLine(middle, y, part.symbol);
    this.breaker(part.name, left + 22, y);
    this.flow(part.name, right - 24, y, start > end, text(middle, y + 32, "", "name"));
  }

  // A line on the left of nodes that are below each other.
  upright(part, x, [row, lane], start, end) {
    const [upper, lower] = start[0] < end[0] ? [start, end] : [end, start];
    const at = x - LANE * (1 + lane) + 3, y = this.y(row);
    const top = this.y(upper.at(-1)) + 8, bottom = this.y(lower[0]) - 8;
    this.element.prepend(svg("path", { d: `M${x} ${top}H${at}M${at} ${bottom}H${x}` }));
    this.element.append(line(at, top + 3, at, bottom - 3, "gap"), line(at, top, at, bottom),
      text(x + 12, y - 3, part.name, "of"));
    this.inLine(at, y, part.symbol);
    this.breaker(part.name, at, y - 27);
    this.flow(part.name, at, y + 27, start[0] > end[0], text(x + 12, y + 12, "", "flow"), true);
  }

  y(row) {
    return TOP + this.row * (row + 0.5);
  }

  converter(name, law, x, y, shown) {
    const at = this.narrow ? x + 36 : 1, width = this.narrow ? this.right - 1 - at : BOX;
    const numbers = text(at + 9, y + 2, "–", "flow"), more = text(at + 9, y + 17, "", "flow");
    const about = `${name} \u00b7 ${law}`, head = text(at + 9, y - 12, about, "head");
    const box = svg("rect", { x: at, y: y - 26, width, height: 50, rx: 5 });
    const link = svg("a", { href: `?of=${encodeURIComponent(name)}`, class: "converter",
      "data-converter": name, ...(shown ? { "aria-current": "page" } : {}) },
    svg("title", {}, `${name} under ${law}`), box, head, numbers, more);
    this.element.append(line(this.narrow ? at : BOX + 1, y, x, y), link);
    this.converters.set(name, { link, about, head, numbers, more });
    this.breaker(name, this.narrow ? x + 18 : BOX + 34, y);
  }

  inLine(x, y, symbol) {
    if (symbol === "windings") {
      for (const side of [-5, 5]) {
        const [cx, cy] = this.narrow ? [x, y + side] : [x + side, y];
        this.element.append(svg("circle", { cx, cy, r: 9 }));
      }
    } else {
      const [width, height] = this.narrow ? [10, 26] : [32, 12];
      this.element.append(svg("rect", { x: x - width / 2, y: y - height / 2, width, height }));
    }
  }

  // A part's power, and an arrow that shows where it flows; back: a positive one goes to the left,
  // or up if the part is upright.
  flow(name, x, y, back, words, upright = false) {
    const arrow = svg("path", { class: "arrow", "data-flow": name, display: "none" });
    words.dataset.power = name;
    this.element.append(arrow, words);
    this.parts.set(name, { arrow, words, x, y, back, upright });
  }

  hang({ name, symbol, feeds }, x, y) {
    const end = x + this.reach;
    this.element.append(line(x, y, end, y), text(end + 30, y - 2, name, "part"));
    if (symbol !== "capacitor") this.flow(name, x + 0.75 * this.reach, y, feeds, text(end + 30, y + 13, "", "flow"));
    if (symbol === "load" || symbol === "capacitor") {
      this.element.append(svg("path", { d: `M${end} ${y}v10m-5 0h10l-5 8z`, class: "load" }));
    } else {
      this.element.append(svg("circle", { cx: end + 12, cy: y, r: 12 }),
        text(end + 12, y + 4, symbol === "box" ? "" : symbol, "name"));
    }
    if (symbol !== "capacitor") this.breaker(name, x + 0.375 * this.reach, y);
  }

  breaker(name, x, y) {
    const mark = svg("rect", { x: x - 5, y: y - 5, width: 10, height: 10, class: "breaker",
      "data-breaker": name }, svg("title", {}, name));
    this.element.append(mark);
    this.breakers.set(name, mark);
  }

  // flows: {converters: {name: {p, q, V, omega_u, state, misses}}, flows: {name: [P, Q]},
  // closed: {name: boolean}}
  show({ converters, flows, closed }) {
    for (const [name, [P, Q]] of Object.entries(flows)) {
      const part = this.parts.get(name);
      if (!part) continue;
      const { arrow, words, x, y, back, upright } = part, to = (P < 0) === back ? 6 : -6;
      words.textContent = `P ${value(P, "p.u.")}  Q ${value(Q, "p.u.")}`;
      arrow.setAttribute("d", upright ? `M${x} ${y + to}l-5 ${-1.6 * to}h10z`
        : `M${x + to} ${y}l${-1.6 * to} -5v10z`);
      arrow.setAttribute("display", Math.abs(P) < LEAST ? "none" : "inline");
    }
    for (const [name, now] of Object.entries(converters)) {
      const { link, about, head, numbers, more } = this.converters.get(name);
      link.dataset.state = now.state ?? "";
      head.textContent = about + (BAD.has(now.state) ? ` \u00b7 ${now.state}` : "");
      numbers.textContent = `P ${value(now.p, "p.u.")}  Q ${value(now.q, "p.u.")}`;
      more.textContent = `V ${value(now.V, "p.u.")}  ${value(now.omega_u, "Hz")} Hz` +
        (now.misses ? `  ${now.misses < 1e4 ? now.misses : `${Math.round(now.misses / 1e3)}k`} missed` : "");
    }
    for (const [name, is] of Object.entries(closed)) {
      const mark = this.breakers.get(name);
      if (!mark) continue;
      mark.dataset.closed = String(is);
      mark.firstChild.textContent = `${name}: breaker ${is ? "closed" : "open"}`;
    }
  }
}
