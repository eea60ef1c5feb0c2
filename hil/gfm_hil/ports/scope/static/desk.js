// What an operator keeps: layouts by name in this browser, the strips as a picture, the window as CSV.

import { colour } from "./palette.js";
import { make } from "./text.js";

const KEY = "gfmhil-scope-layouts";
const get = (id) => document.getElementById(id);

// Layouts: which strips, which units and which panels are open. now(): the present one;
// take(layout): applies one.
export class Layouts {
  constructor(now, take) {
    this.take = take;
    const kept = localStorage.getItem(KEY);
    this.kept = kept ? JSON.parse(kept) : {};
    get("keep").onsubmit = (submit) => {
      submit.preventDefault();
      const name = get("layout-name").value.trim();
      if (!name) return;
      this.kept[name] = now();
      get("layout-name").value = "";
      this.write();
    };
    this.write();
  }

  write() {
    localStorage.setItem(KEY, JSON.stringify(this.kept));
    get("layout-list").replaceChildren(...Object.keys(this.kept).map((name) => make("p", {},
      make("button", { "data-layout": name, onclick: () => this.take(this.kept[name]) }, name),
      make("button", { class: "icon quiet", "aria-label": `forget ${name}`, onclick: () => {
        delete this.kept[name];
        this.write();
      } }, "×"))));
  }
}

function save(blob, name) {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}

// A name for a file: of the run, and at which of its seconds.
const called = (title, t, kind) => `${title.replace(/[^\w-]+/g, "-")}-${t.toFixed(2)}s.${kind}`;

// The strips with their titles and values, below a line about the run.
export function savePicture(strips, title, condition, t) {
  const ratio = devicePixelRatio, left = 150 * ratio, line = 17 * ratio;
  const canvases = strips.map(({ plot }) => plot.ctx.canvas);
  const paper = document.createElement("canvas");
  paper.width = left + Math.max(...canvases.map(({ width }) => width));
  paper.height = 2 * line + canvases.reduce((sum, { height }) => sum + height, 0);
  const ctx = paper.getContext("2d");
  const write = (text, x, y, ink, bold) => {
    ctx.font = `${bold ? 600 : 400} ${12 * ratio}px system-ui, sans-serif`;
    ctx.fillStyle = ink;
    ctx.fillText(text, x, y);
  };
  ctx.fillStyle = colour("sheet");
  ctx.fillRect(0, 0, paper.width, paper.height);
  write(`${title} · ${condition}`, 8 * ratio, 1.2 * line, colour("text"), true);
  let top = 2 * line;
  strips.forEach(({ spec, element }, k) => {
    write(spec.title, 8 * ratio, top + line, colour("dim"));
    element.querySelectorAll(".trace").forEach((trace, row) =>
      write(trace.innerText.replace(/\s+/g, " "), 8 * ratio, top + (row + 2) * line,
        colour(`c-${spec.traces[row] ?? "miss"}`), true));
    ctx.drawImage(canvases[k], left, top);
    top += canvases[k].height;
  });
  paper.toBlob((blob) => save(blob, called(title, t, "png")));
}

// The visible window, a row a bin: its time, and the least and the greatest value of each channel.
export function saveTable(strips, about, frame, T_s, title) {
  const names = [...new Set(strips.flatMap(({ spec }) => spec.traces))]
    .filter((name) => frame.low[name]);
  const one = frame.width === 1;
  const heads = names.flatMap((name) => {
    const head = `${name} [${about[name].unit}]`;
    return one ? [head] : [`${head} least`, `${head} most`];
  });
  const lines = [["t [s]", ...heads].join(",")];
  for (let k = 0; k < frame.bins; k++) {
    const t = (frame.first + (k + 0.5) * frame.width - 0.5) * T_s;
    const cells = names.flatMap((name) => one ? [frame.low[name][k]]
      : [frame.low[name][k], frame.high[name][k]]);
    lines.push([+t.toFixed(9), ...cells.map((v) => (Number.isNaN(v) ? "" : +v.toPrecision(7)))]
      .join(","));
  }
  save(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" }),
    called(title, frame.head * T_s, "csv"));
}
