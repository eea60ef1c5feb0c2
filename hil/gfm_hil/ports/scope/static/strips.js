// The strips: one plot below the other over one time axis.

import { points } from "./frame.js";
import { colour } from "./palette.js";
import { make, seconds, symbol, tick, value } from "./text.js";

// `references` are dashed, in the colour of their trace.
export const STRIPS = [
  { name: "power", title: "Power", traces: ["p", "q"],
    references: { P_ref: "p", Q_ref: "q" }, shown: true },
  { name: "voltage", title: "Voltage", traces: ["V"], references: { V_ref: "V" }, shown: true },
  { name: "frequency", title: "Frequency", traces: ["omega_u"], references: { d_omega_g: "omega_u" },
    shown: true },
  { name: "dc", title: "DC link", traces: ["v_dc"], references: { V_dcref: "v_dc" }, shown: true },
  { name: "inputs", title: "Inputs u", traces: ["u_i_u", "u_E_u"], references: {}, shown: true },
  { name: "loop", title: "Loop", traces: ["slack"], references: {}, marks: "miss", shown: true },
  { name: "current", title: "Current", traces: ["i"], references: {}, shown: false },
  { name: "v-abc", title: "Phase voltages", traces: ["v_a", "v_b", "v_c"], references: {},
    shown: false },
  { name: "i-abc", title: "Phase currents", traces: ["i_a", "i_b", "i_c"], references: {},
    shown: false },
  { name: "inner", title: "Inner stage", traces: ["i_d", "i_q", "i_ref"], references: {},
    shown: false },
  { name: "bridge", title: "Bridge", traces: ["E_law", "u_E_q", "limited"], references: {},
    shown: false },
  { name: "angle", title: "Angle", traces: ["delta"], references: {}, shown: false },
  { name: "trip-time", title: "Round trip", traces: ["round_trip", "late"], references: {},
    shown: false },
];

// A strip of its own for every channel.
export function addSingles(channels) {
  if (STRIPS.some((strip) => strip.single)) return;
  STRIPS.push(...channels.map(({ name, description }) => ({ name: `one-${name}`, title: description,
    traces: [name], references: {}, shown: false, single: true })));
}

const STEPS = [];
for (let e = -9; e < 7; e++) for (const m of [1, 2, 5]) STEPS.push(+`${m}e${e}`);

export function channelsOf(strip) {
  return [...strip.traces, ...Object.keys(strip.references), ...(strip.marks ? [strip.marks] : [])];
}

// A stable range: it contains all values and changes only if they leave it or need much less.
export function calm(range, low, high, least) {
  if (!(low <= high)) return range ?? [0, 1];
  const need = Math.max(high - low, least);
  const middle = (low + high) / 2;
  const inside = range && low >= range[0] && high <= range[1];
  if (inside && need > 0.3 * (range[1] - range[0])) return range;
  const step = STEPS.find((s) => s * 8 >= need * 1.15);
  const bottom = Math.floor(Math.min(low - 0.05 * need, middle - 0.55 * need) / step) * step;
  const top = Math.ceil(Math.max(high + 0.05 * need, middle + 0.55 * need) / step) * step;
  return [bottom, top];
}

export class Strip {
  // about: of the channels, by name; on: {zoom(t0, t1), draw(plot, strip)}
  constructor(spec, about, on) {
    this.spec = spec;
    this.about = about;
    this.on = on;
    this.range = null; // computed
    this.held = null; // chosen by the operator
    this.last = false;
    this.values = new Map();
    this.element = make("section", { class: "strip", "data-strip": spec.name,
      "aria-label": spec.title });
    this.element.append(this.head(), (this.area = make("div", { class: "plot" })));
  }

  head() {
    const head = make("header", {}, make("h3", {}, this.spec.title));
    for (const name of this.spec.traces) {
      const { symbol: text, unit, description } = this.about[name];
      const number = make("b", { class: "now" }, "–");
      this.values.set(name, number);
      head.append(make("p", { class: `trace c-${name}`, title: description }, symbol(text), number,
        make("small", {}, unit)));
    }
    if (this.spec.marks) {
      const number = make("b", { class: "now", "data-misses": "" }, "0");
      this.misses = number;
      head.append(make("p", { class: "trace c-miss", title: "ticks without a fresh u, in all" },
        "misses", number));
    }
    this.auto = make("button", { class: "quiet fit", hidden: true, title: "Fit the range again",
      onclick: () => this.hold(null) }, "fit");
    head.append(this.auto);
    return head;
  }

  hold(range) {
    this.held = range;
    this.range = null;
    this.auto.hidden = range === null;
    if (this.frame) this.show(this.frame, this.x, this.window);
  }

  build() {
    this.plot?.destroy();
    const { traces, references } = this.spec;
    const line = (name, of, dash) => ({
      stroke: () => colour(`c-${of}`), width: dash ? 1 : 1.4, dash, points: { show: false },
      spanGaps: false, alpha: dash ? 0.75 : 1, label: name,
    });
    this.names = [...Object.keys(references), ...traces];
    const series = [{}, ...Object.entries(references).map(([name, of]) => line(name, of, [5, 4])),
      ...traces.map((name) => line(name, name))];
    const axis = { stroke: () => colour("dim"), font: "11px system-ui, sans-serif",
      grid: { stroke: () => colour("grid"), width: 1 }, ticks: { show: false }, incrs: STEPS };
    const narrow = this.area.clientWidth < 600;
    this.plot = new uPlot({
      width: Math.max(60, this.area.clientWidth), height: Math.max(40, this.area.clientHeight),
      padding: [7, 24, this.last ? 0 : 7, 0], legend: { show: false },
      scales: { x: { time: false, auto: false }, y: { auto: false } },
      series,
      axes: [
        { ...axis, size: this.last ? 24 : 0, space: narrow ? 64 : 90, gap: 4,
          values: (_, at, __, ___, step) => at.map((t) => (this.last ? seconds(t, step) : "")) },
        { ...axis, size: narrow ? 44 : 56, space: 24, gap: 6,
          values: (_, at, __, ___, step) => at.map((v) => tick(v, step)) },
      ],
      cursor: { sync: { key: "scope" }, y: false, points: { show: false },
        drag: { setScale: false, x: true, y: true, uni: 30 } },
      hooks: { setSelect: [(u) => this.selected(u)], draw: [(u) => this.draw(u)] },
    }, [[]], this.area);
  }

  selected(u) {
    const { left, top, width, height } = u.select;
    if (width < 4 && height < 4) return;
    u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    if (height < u.over.clientHeight - 1) {
      this.hold([u.posToVal(top + height, "y"), u.posToVal(top, "y")]);
    }
    if (width < u.over.clientWidth - 1) {
      this.on.zoom(u.posToVal(left, "x"), u.posToVal(left + width, "x"));
    }
  }

  resize() {
    if (!this.plot) return;
    this.plot.setSize({ width: Math.max(60, this.area.clientWidth),
      height: Math.max(40, this.area.clientHeight) });
  }

  // frame: with its bins; x: its times; window: [from, to] in the same seconds
  show(frame, x, window) {
    this.frame = frame;
    this.x = x;
    this.window = window;
    if (!this.plot) return;
    let low = Infinity, high = -Infinity;
    for (const name of [...this.spec.traces, ...Object.keys(this.spec.references)]) {
      for (const v of frame.low[name] ?? []) if (v < low) low = v;
      for (const v of frame.high[name] ?? []) if (v > high) high = v;
    }
    const least = this.about[this.spec.traces[0]].least;
    this.range = calm(this.range, low, high, least);
    const data = [x, ...this.names.map((name) => name in frame.low
      ? points(frame.low[name], frame.high[name], frame.width) : new Array(x.length).fill(null))];
    const [min, max] = this.held ?? this.range;
    this.plot.batch(() => {
      this.plot.setData(data, false);
      this.plot.setScale("x", { min: window[0], max: window[1] });
      this.plot.setScale("y", { min, max });
    });
  }

  // shows the present values, a few times a second
  tell(frame) {
    for (const [name, element] of this.values) {
      const text = value(frame.now[name], this.about[name].unit);
      if (element.textContent !== text) element.textContent = text;
    }
    if (this.misses) {
      this.misses.textContent = String(frame.misses);
      this.misses.parentElement.classList.toggle("some", frame.misses > 0);
    }
  }

  draw(u) {
    if (this.spec.marks && this.frame) this.drawMarks(u);
    this.on.draw(u, this);
  }

  drawMarks(u) {
    const { ctx, bbox } = u;
    const values = this.frame.high[this.spec.marks] ?? [];
    const each = this.frame.width > 1 ? 2 : 1;
    ctx.save();
    ctx.fillStyle = colour("bad");
    const wide = Math.max(2, devicePixelRatio * 1.5);
    for (let k = 0; k < values.length; k++) {
      if (!(values[k] > 0)) continue;
      const left = u.valToPos(this.x[k * each], "x", true);
      ctx.fillRect(left - wide / 2, bbox.top + bbox.height * 0.8, wide, bbox.height * 0.2);
    }
    ctx.restore();
  }
}
