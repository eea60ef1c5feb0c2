// The events of the run: a list, lines across the strips, and how the run ended.

import { colour } from "./palette.js";
import { make, span } from "./text.js";

const LINES = 60;
const ENDS = new Set(["end", "tripped", "safe"]);
const SHOWN = new Set([...ENDS, "law-active", "recovered"]);
const UNMARKED = new Set(["law-active", "recovered"]);
const ECHO_S = 0.05;

export class Events {
  constructor(list) {
    this.list = list;
    this.events = [];
    this.said = []; // entries of this page: {t, text, kind}
  }

  set(events) {
    this.events = events.filter((e) => e.label || SHOWN.has(e.event)).filter(firstToSay);
    this.write();
  }

  // Adds a command of this page that was refused, at the run's time.
  refuse(t, why) {
    this.said.push({ t, text: `refused: ${why}`, kind: "refused" });
    this.write();
  }

  write() {
    const lines = [...this.events.map((e) => ({ t: e.t, ...describe(e) })), ...this.said]
      .filter((line) => line.text).sort((a, b) => a.t - b.t).slice(-LINES).reverse();
    this.list.replaceChildren(...lines.map(({ t, text, kind }) =>
      make("li", { class: kind }, make("time", {}, `${t.toFixed(3)} s`), make("span", {}, text))));
  }

  // Draws lines at the events; labels only in the first strip, where there is room.
  draw(u, strip, origin, first) {
    const { ctx, bbox } = u;
    const ratio = devicePixelRatio;
    ctx.save();
    ctx.textAlign = "left";
    ctx.textBaseline = "alphabetic";
    ctx.font = `${10.5 * ratio}px system-ui, sans-serif`;
    const free = [-Infinity, -Infinity, -Infinity]; // of three rows of labels
    for (const e of this.events) {
      if (UNMARKED.has(e.event)) continue;
      const left = Math.round(u.valToPos(e.t - origin, "x", true)) + 0.5;
      if (left < bbox.left || left > bbox.left + bbox.width) continue;
      const bad = describe(e).kind === "bad";
      ctx.strokeStyle = ctx.fillStyle = colour(bad ? "bad" : "event");
      ctx.lineWidth = ratio;
      ctx.setLineDash([2 * ratio, 3 * ratio]);
      ctx.beginPath();
      ctx.moveTo(left, bbox.top);
      ctx.lineTo(left, bbox.top + bbox.height);
      ctx.stroke();
      const right = bbox.left + bbox.width - left - 8 * ratio;
      const before = left - bbox.left - 8 * ratio;
      const [text, wide] = shortened(ctx, e.label ?? e.status ?? e.event, Math.max(right, before));
      const from = wide <= right ? left + 4 * ratio : left - 4 * ratio - wide;
      const row = first ? free.findIndex((at) => from > at) : -1;
      if (row >= 0) {
        ctx.fillText(text, from, bbox.top + bbox.height - (5 + 12 * row) * ratio);
        free[row] = from + wide + 6 * ratio;
      }
    }
    ctx.restore();
  }
}

// As much of a text as fits a width, and the width it has.
function shortened(ctx, text, room) {
  const width = (some) => ctx.measureText(some).width;
  if (width(text) <= room) return [text, width(text)];
  let end = text.length;
  while (end > 0 && width(`${text.slice(0, end)}…`) > room) end -= 1;
  const cut = `${text.slice(0, end)}…`;
  return [cut, width(cut)];
}

// Both sides log one trip, or one end; the first entry is that of the side where it happened.
function firstToSay(e, k, all) {
  const same = (other) => other.event === e.event && e.t - other.t <= ECHO_S;
  return e.label || !all.slice(0, k).some(same);
}

// Text and kind of an event of the log.
function describe(e) {
  if (e.event === "end") {
    return { text: e.reason ? `${e.status}: ${e.reason}` : e.status,
      kind: ENDS.has(e.status) ? "bad" : "end" };
  }
  if (ENDS.has(e.event)) return { text: `${e.event}: ${e.reason}`, kind: "bad" };
  if (e.event === "recovered") return { text: "running again", kind: "done" };
  if (e.event === "law-active") {
    return { text: `${e.law} active, bump ${e.bump_pu.toPrecision(2)} p.u.`, kind: "done" };
  }
  if (e.refused) return { text: `${e.label}: ${e.refused}`, kind: "refused" };
  return { text: e.label, kind: e.by ? "operator" : "planned" };
}

// The slim bar under the strips: the whole run, its events, and the visible window.
export class OverviewMap {
  constructor(element, look) {
    this.element = element;
    this.look = look;
    this.box = make("div", { class: "box" });
    this.filled = make("div", { class: "filled" });
    this.marks = make("div", { class: "marks" });
    this.text = document.getElementById("length");
    element.append(this.filled, this.marks, this.box);
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      const move = (e) => {
        const { left, width } = element.getBoundingClientRect();
        const at = ((e.clientX - left) / width) * this.length;
        const wide = look.window[1] - look.window[0];
        const start = Math.min(Math.max(at - wide / 2, 0), Math.max(0, look.done - wide));
        look.hold(start, start + wide);
      };
      move(event);
      element.addEventListener("pointermove", move);
      element.addEventListener("pointerup", () =>
        element.removeEventListener("pointermove", move), { once: true });
    });
  }

  // Recorded time, not the run's full duration: of a long run one would see nothing.
  get length() {
    return Math.max(this.look.done, this.look.window[1], 1e-6);
  }

  show(events) {
    const { length } = this;
    const [from, to] = this.look.window;
    const per = (t) => `${Math.min(100, Math.max(0, (100 * t) / length))}%`;
    this.box.style.left = per(from);
    this.box.style.width = `max(3px, ${per(Math.min(to, length) - Math.max(from, 0))})`;
    this.filled.style.width = per(this.look.done);
    const wanted = events.filter((e) => !UNMARKED.has(e.event) && e.t <= length);
    if (this.marks.childElementCount !== wanted.length) {
      this.marks.replaceChildren(...wanted.map(() => make("i")));
    }
    wanted.forEach((e, k) => {
      this.marks.children[k].style.left = per(e.t);
      this.marks.children[k].className = describe(e).kind;
    });
    const text = span(length);
    if (this.text.textContent !== text) this.text.textContent = text;
  }
}
