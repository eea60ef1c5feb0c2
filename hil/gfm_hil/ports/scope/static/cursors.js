// Two cursors: draggable lines over all strips; shows the values at them and the time between them.

import { colour } from "./palette.js";
import { make, seconds, span, symbol, value } from "./text.js";

export class Cursors {
  // strips(): the visible strips; about: of the channels; origin(): run time at 0 of the axis;
  // redraw(): redraws the strips
  constructor(table, strips, about, origin, redraw) {
    this.table = table;
    this.strips = strips;
    this.about = about;
    this.origin = origin;
    this.redraw = redraw;
    this.on = false;
    this.at = [0.35, 0.65]; // fractions of the window; while it is held: times of the run, s
    this.held = false;
  }

  toggle(on, window) {
    this.on = on;
    this.at = [0.35, 0.65];
    if (this.held) {
      this.held = false;
      this.follow(true, window);
    }
    this.table.hidden = !on;
    this.redraw();
  }

  // While the picture rolls, cursors keep their place on the screen; in a held picture they keep
  // their time.
  follow(held, window) {
    if (held === this.held) return;
    const wide = window[1] - window[0];
    const from = window[0] + this.origin();
    this.at = this.at.map((at) => held ? from + at * wide
      : Math.min(1, Math.max(0, (at - from) / wide)));
    this.held = held;
  }

  times(window) {
    return this.held ? this.at.map((t) => t - this.origin()) : this.at.map((part) => window[0] + part * (window[1] - window[0]));
  }

  // Lets the pointer drag a near cursor on the plot of a strip.
  attach(strip) {
    const over = strip.plot.over;
    const near = (event) => {
      if (!this.on || !strip.window) return -1;
      const x = event.clientX - over.getBoundingClientRect().left;
      const away = this.times(strip.window).map((t) => Math.abs(strip.plot.valToPos(t, "x") - x));
      const k = away[0] <= away[1] ? 0 : 1;
      return away[k] <= (event.pointerType === "touch" ? 24 : 7) ? k : -1;
    };
    over.addEventListener("pointermove", (event) => {
      over.style.cursor = near(event) >= 0 ? "col-resize" : "";
    });
    // before the plot's own mousedown, which would start a selection
    over.addEventListener("mousedown", (event) => {
      if (near(event) >= 0) event.stopImmediatePropagation();
    }, { capture: true });
    over.addEventListener("pointerdown", (event) => {
      const k = near(event);
      if (k < 0) return;
      over.setPointerCapture(event.pointerId);
      const move = (e) => {
        const x = e.clientX - over.getBoundingClientRect().left;
        const t = strip.plot.posToVal(Math.min(over.clientWidth, Math.max(0, x)), "x");
        const [from, to] = strip.window;
        this.at[k] = this.held ? t + this.origin() : (t - from) / (to - from);
        this.redraw();
      };
      over.addEventListener("pointermove", move);
      over.addEventListener("pointerup", () => over.removeEventListener("pointermove", move),
        { once: true });
      event.preventDefault();
    });
  }

  draw(u, strip, first) {
    if (!this.on) return;
    const { ctx, bbox } = u;
    ctx.save();
    ctx.strokeStyle = ctx.fillStyle = colour("cursor");
    ctx.lineWidth = devicePixelRatio;
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    ctx.font = `600 ${10 * devicePixelRatio}px system-ui, sans-serif`;
    this.times(strip.window).forEach((t, k) => {
      const left = Math.round(u.valToPos(t, "x", true)) + 0.5;
      if (left < bbox.left || left > bbox.left + bbox.width) return;
      ctx.beginPath();
      ctx.moveTo(left, bbox.top);
      ctx.lineTo(left, bbox.top + bbox.height);
      ctx.stroke();
      if (first) {
        ctx.fillText("AB"[k], left + 3 * devicePixelRatio, bbox.top + 10 * devicePixelRatio);
      }
    });
    ctx.restore();
  }

  // Values at the cursors' bins; of a bin with several values, the middle.
  tell(frame, x, window, T_s) {
    if (!this.on || !frame.bins) return;
    const [a, b] = this.times(window);
    const each = frame.width > 1 ? 2 : 1;
    const bin = (t) => Math.round((t - x[0]) / (frame.width * T_s));
    const at = (name, t) => {
      const k = bin(t);
      if (k < 0 || k >= x.length / each) return NaN;
      return (frame.low[name][k] + frame.high[name][k]) / 2;
    };
    const names = this.strips().flatMap((strip) => strip.spec.traces);
    const row = (title, time, cell) => make("tr", {}, make("th", {}, title), make("td", {}, time),
      ...names.map((name) => make("td", {}, value(cell(name), this.about[name].unit))));
    const head = make("tr", {}, make("th"), make("th", {}, symbol("t")), ...names.map((name) => {
      const { symbol: text, unit } = this.about[name];
      return make("th", { class: `c-${name}` }, symbol(text), " ", make("small", {}, unit));
    }));
    const delta = row("B − A", `${span(Math.abs(b - a))} · ${(1 / Math.abs(b - a)).toPrecision(3)} Hz`,
      (name) => at(name, b) - at(name, a));
    delta.className = "delta";
    this.table.replaceChildren(make("tbody", {}, head, row("A", seconds(a, 1e-4), (n) => at(n, a)),
      row("B", seconds(b, 1e-4), (n) => at(n, b)), delta));
  }
}
