// The single-line diagram of a network: what its converters do now, and which breakers are closed.

import { value } from "./text.js";

const BOX = 204, FIRST = BOX + 66, COLUMN = 150, ROW = 58, HANG = 64, TOP = 22; // pixels
const LEAST = 5e-4; // p.u.; a smaller power has no arrow
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
  // network: as the server describes it; shown: the converter that the page shows
  constructor(network, shown) {
    this.converters = new Map();
    this.breakers = new Map();
    const at = Object.fromEntries(network.bars.map((bar) => [bar.name, FIRST + COLUMN * bar.column]));
    this.parts = new Map();
    const wide = Math.max(...Object.values(at)) + HANG + 150;
    const high = TOP + ROW * network.rows;
    this.element = svg("svg", { viewBox: `0 0 ${wide} ${high}`,
      role: "img", "aria-label": "Single-line diagram" });
    this.element.style.maxWidth = `${wide}px`;
    const rows = new Map(network.bars.map((bar) => [bar.name, [...bar.rows]]));
    for (const part of network.lines) {
      const [left, right] = [at[part.start], at[part.end]].sort((a, b) => a - b);
      const y = this.y(part.row);
      this.element.append(line(left, y, right, y), text((left + right) / 2, y + 18, part.name, "name"));
      this.inLine((left + right) / 2, y, part.symbol);
      this.breaker(part.name, left + 22, y);
      this.flow(part.name, right - 24, y, at[part.start] > at[part.end],
        text((left + right) / 2, y + 32, "", "name"));
      for (const end of [part.start, part.end]) rows.get(end).push(part.row);
    }
    for (const bar of network.bars) {
      const x = at[bar.name], of = rows.get(bar.name);
      bar.converters.forEach((name, k) => this.converter(name, network.laws[name], x,
        this.y(bar.rows[k]), name === shown));
      bar.right.forEach((part, k) => this.hang(part, x, this.y(bar.rows[k])));
      const [top, bottom] = [Math.min(...of), Math.max(...of)].map((row) => this.y(row));
      this.element.append(line(x, top - 12, x, bottom + 12, "bar"), text(x, top - 16, bar.name, "name"));
    }
  }

  y(row) {
    return TOP + ROW * (row + 0.5);
  }

  converter(name, law, x, y, shown) {
    const numbers = text(10, y + 2, "–", "flow"), more = text(10, y + 17, "", "flow");
    const box = svg("rect", { x: 1, y: y - 26, width: BOX, height: 50, rx: 5 });
    const link = svg("a", { href: `?of=${encodeURIComponent(name)}`, class: "converter",
      "data-converter": name, ...(shown ? { "aria-current": "page" } : {}) },
    svg("title", {}, `${name} under ${law}`), box, text(10, y - 12, `${name} \u00b7 ${law}`, "head"),
    numbers, more);
    this.element.append(line(BOX + 1, y, x, y), link);
    this.converters.set(name, { link, numbers, more });
    this.breaker(name, BOX + 34, y);
  }

  inLine(x, y, symbol) {
    if (symbol === "windings") {
      for (const side of [-5, 5]) this.element.append(svg("circle", { cx: x + side, cy: y, r: 9 }));
    } else {
      this.element.append(svg("rect", { x: x - 16, y: y - 6, width: 32, height: 12 }));
    }
  }

  // A part's power, and an arrow that shows where it flows; leftwards: where a positive one does.
  flow(name, x, y, leftwards, words) {
    const arrow = svg("path", { class: "arrow", "data-flow": name, display: "none" });
    words.dataset.power = name;
    this.element.append(arrow, words);
    this.parts.set(name, { arrow, words, x, y, leftwards });
  }

  hang({ name, symbol, feeds }, x, y) {
    const end = x + HANG;
    this.element.append(line(x, y, end, y), text(end + 30, y - 2, name, "part"));
    if (symbol !== "capacitor") this.flow(name, x + 48, y, feeds, text(end + 30, y + 13, "", "flow"));
    if (symbol === "load" || symbol === "capacitor") {
      this.element.append(svg("path", { d: `M${end} ${y}v10m-5 0h10l-5 8z`, class: "load" }));
    } else {
      this.element.append(svg("circle", { cx: end + 12, cy: y, r: 12 }),
        text(end + 12, y + 4, symbol === "box" ? "" : symbol, "name"));
    }
    if (symbol !== "capacitor") this.breaker(name, x + 24, y);
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
      const { arrow, words, x, y, leftwards } = part, to = (P < 0) === leftwards ? 6 : -6;
      words.textContent = `P ${value(P, "p.u.")}  Q ${value(Q, "p.u.")}`;
      arrow.setAttribute("d", `M${x + to} ${y}l${-1.6 * to} ${-5}v10z`);
      arrow.setAttribute("display", Math.abs(P) < LEAST ? "none" : "inline");
    }
    for (const [name, now] of Object.entries(converters)) {
      const { link, numbers, more } = this.converters.get(name);
      link.dataset.state = now.state ?? "";
      numbers.textContent = `P ${value(now.p, "p.u.")}  Q ${value(now.q, "p.u.")}`;
      more.textContent = `V ${value(now.V, "p.u.")}  ${value(now.omega_u, "Hz")} Hz` +
        (now.misses ? `  ${now.misses} missed` : "");
    }
    for (const [name, is] of Object.entries(closed)) {
      const mark = this.breakers.get(name);
      if (!mark) continue;
      mark.dataset.closed = String(is);
      mark.firstChild.textContent = `${name}: breaker ${is ? "closed" : "open"}`;
    }
  }
}
