"use strict";
// Draws the plots of a page with uPlot when they come into view or are printed. Drag to zoom in on a time, in all
// plots of the run; double-click to see all of it again.
(async () => {
  // A document that is still open holds back the page's load event: `chromium --print-to-pdf` prints at that event.
  const open = document.body.appendChild(document.createElement("iframe"));
  open.hidden = true;
  open.contentDocument.open();
  const read = (id) => document.getElementById(id).textContent;
  const bytes = Uint8Array.from(atob(read("curves")), (c) => c.charCodeAt(0));
  const plain = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const view = new DataView(await new Response(plain).arrayBuffer());
  const plots = JSON.parse(read("plots"));
  const COLOURS = ["#c9d6e2", "#0072B2"], LEVELS = 4094, NO_VALUE = 0xffff, HEIGHT = 190;

  const abscissa = (first, count, low, step, whole) => {
    if (!whole) return curve(first, count, low, step);
    const found = new Array(count);
    for (let k = 0, ticks = 0; k < count; k++) {
      ticks += view.getUint16(2 * (first + k), true);
      found[k] = low + step * ticks;
    }
    return found;
  };

  const curve = (first, count, low, high) => {
    const found = new Array(count);
    for (let k = 0, level = 0; k < count; k++) {
      level = (level + view.getUint16(2 * (first + k), true)) & 0xffff;
      found[k] = level === NO_VALUE ? null : low + ((high - low) * level) / LEVELS;
    }
    return found;
  };

  const mark = (of) => (u) => {
    const c = u.ctx, { left, top, width, height } = u.bbox, px = u.px ?? devicePixelRatio;
    const x = (t) => u.valToPos(t, "x", true), y = (v) => u.valToPos(v, "y", true);
    c.save();
    c.beginPath();
    c.rect(left, top, width, height);
    c.clip();
    c.font = `${10 * px}px system-ui`;
    c.fillStyle = "#E69F0040";
    for (const [from, to] of of.bands) c.fillRect(x(from), top, x(to) - x(from), height);
    c.setLineDash([4 * px, 3 * px]);
    c.strokeStyle = c.fillStyle = "#888";
    c.textAlign = "left";
    const free = [left, left, left];  // of three rows of labels
    for (const [t, label] of of.events) {
      c.beginPath();
      c.moveTo(x(t), top);
      c.lineTo(x(t), top + height);
      c.stroke();
      const room = c.measureText(label).width + 8 * px, late = x(t) + room > left + width;
      const from = x(t) - (late ? room : 0), row = free.findIndex((at) => from >= at);
      if (row < 0) continue;  // it would cover the labels before it
      c.fillText(label, from + 4 * px, top + (10 + 12 * row) * px);
      free[row] = from + room;
    }
    c.lineWidth = 1.5 * px;
    of.limits.forEach(([ts, vs, colour, number], k) => {
      const [, below, , same] = of.limits[k - 1] ?? [];
      if (same === number) {
        c.globalAlpha = 0.1;
        c.fillStyle = colour;
        c.beginPath();
        ts.forEach((t, j) => c.lineTo(x(t), y(vs[j])));
        [...ts].reverse().forEach((t, j) => c.lineTo(x(t), y(below[ts.length - 1 - j])));
        c.fill();
        c.globalAlpha = 1;
      }
      c.strokeStyle = c.fillStyle = colour;
      c.beginPath();
      ts.forEach((t, k) => c.lineTo(x(t), y(vs[k])));
      c.stroke();
      const at = Math.min(Math.max(x(ts[0]), left), left + width - 12 * px);
      c.fillText(number, at + 2 * px, y(vs[0]) - 3 * px);
    });
    c.setLineDash([]);
    of.bars.forEach(([from, to, colour, number], k) => {
      const row = top + height - (4 + 6 * (k % 4)) * px;
      c.strokeStyle = c.fillStyle = colour;
      c.beginPath();
      c.moveTo(x(from), row);
      c.lineTo(x(to), row);
      c.stroke();
      c.fillText(number, Math.max(x(from), left) + 2 * px, row - 2 * px);
    });
    c.restore();
  };

  // Takes what `mark` draws on a canvas as SVG.
  const recorder = (out) => ({
    lineWidth: 1, globalAlpha: 1, path: "", dash: "",
    save() {}, restore() {}, rect() {}, clip() {},
    beginPath() { this.path = ""; },
    moveTo(x, y) { this.path += `M${x} ${y}`; },
    lineTo(x, y) { this.path += `${this.path && "L"}${this.path ? "" : "M"}${x} ${y}`; },
    setLineDash(dash) { this.dash = dash.join(" "); },
    measureText: (text) => ({ width: 5 * text.length }),
    stroke() {
      out.push(`<path d="${this.path}" fill="none" stroke="${this.strokeStyle}" stroke-width="${this.lineWidth}" stroke-dasharray="${this.dash}"/>`);
    },
    fill() { out.push(`<path d="${this.path}" fill="${this.fillStyle}" opacity="${this.globalAlpha}"/>`); },
    fillRect(x, y, width, height) {
      out.push(`<rect x="${x}" y="${y}" width="${width}" height="${height}" fill="${this.fillStyle}"/>`);
    },
    fillText(text, x, y) { out.push(`<text x="${x}" y="${y}" fill="${this.fillStyle}">${safe(text)}</text>`); },
  });
  const safe = (text) => String(text).replace(/[&<>]/g, (c) => `&#${c.charCodeAt(0)};`);

  // A plot as it is on the screen, as SVG: a printer draws lines and text as sharp as it can.
  const drawing = (u, of) => {
    const [left, top, width, height] = ["left", "top", "width", "height"].map((k) => u.bbox[k] / devicePixelRatio);
    const out = [];
    const at = (v, scale) => u.valToPos(v, scale) + (scale === "x" ? left : top);
    u.axes.forEach(({ _splits: splits, _values: values }, axis) => splits.forEach((v, k) => {
      const p = at(v, axis ? "y" : "x").toFixed(1), text = values[k] === null ? "" : safe(values[k]);
      out.push(axis ? `<path d="M${left} ${p}h${width}" stroke="#ddd"/><text x="${left - 6}" y="${p}" dy=".35em" text-anchor="end">${text}</text>`
        : `<path d="M${p} ${top}v${height}" stroke="#ddd"/><text x="${p}" y="${top + height + 14}" text-anchor="middle">${text}</text>`);
    }));
    out.push(`<text x="${left + width / 2}" y="${top + height + 28}" text-anchor="middle">${safe(of.over)}</text>`,
      `<svg x="${left}" y="${top}" width="${width}" height="${height}" viewBox="${left} ${top} ${width} ${height}">`);
    u.series.forEach(({ label, show, points }, k) => {
      if (!k || !show || u.series[k].scale === "run") return;
      const dots = of.dots || points.show === true;
      let path = "", pen = "M";
      u.data[k].forEach((y, j) => {
        if (y === null) return void (pen = "M");
        path += `${pen}${at(u.data[0][j], "x").toFixed(1)} ${at(y, "y").toFixed(1)}${dots ? "h0" : ""}`;
        pen = dots ? "M" : "L";
      });
      const colour = of.colours[k - 1] ?? COLOURS[of.curves.length === 1 ? 1 : k - 1];
      out.push(`<path d="${path}" fill="none" stroke="${colour}" stroke-width="${dots ? 4 : 1.2}" stroke-linecap="round"/>`);
    });
    mark(of)({
      ctx: recorder(out), bbox: { left, top, width, height }, px: 1, valToPos: at,
    });
    const size = `${u.width} ${u.height}`;
    return `<svg class="printed" viewBox="0 0 ${size}" font-size="10">${out.join("")}</svg></svg>`;
  };

  const draw = (place) => {
    const of = plots[place.dataset.plot];
    const data = [abscissa(...of.x), ...of.curves.map(([, ...packed]) => curve(...packed))];
    const limits = of.limits.flatMap(([, vs]) => vs);
    const range = (u, low, high) => {
      low = Math.min(low ?? Infinity, ...limits);
      high = Math.max(high ?? -Infinity, ...limits);
      const least = 1e-3 * Math.max(Math.abs(low), Math.abs(high), 1e-3);
      const pad = Math.max(0.05 * (high - low), least / 2);
      return of.log[1] ? [low / 1.3, high * 1.3] : [low - pad, high + pad];
    };
    const isMeasured = (label) => of.dots || (of.log[0] && label === "measured");
    const isNumber = (label) => of.dots && label === "run";
    const axis = (more) => ({ stroke: "#666", grid: { stroke: "#8884", width: 1 }, ...more });
    return new uPlot({
      width: place.clientWidth,
      height: HEIGHT,
      scales: {
        x: { time: false, distr: of.log[0] ? 3 : 1, min: of.ends[0], max: of.ends[1] },
        y: { distr: of.log[1] ? 3 : 1, range },
      },
      cursor: { sync: { key: place.dataset.group, scales: ["x", null] } },
      axes: [axis({ label: of.over, labelSize: 18, size: 28 }), axis({
        size: 56,
        values: (u, ticks) => ticks.map((v) => (v === null ? null : Number(v.toPrecision(6)))),
      })],
      series: [
        { label: of.over },
        ...of.curves.map(([label], k) => ({
          label,
          stroke: of.colours[k] ?? COLOURS[of.curves.length === 1 ? 1 : k],
          width: 1.2,
          scale: isNumber(label) ? "run" : "y",
          points: { show: isMeasured(label) && !isNumber(label), size: 5, fill: of.dots ? of.colours[k] : undefined },
          paths: isMeasured(label) ? () => null : undefined,
          value: (u, v) => (v === null ? "–" : Number(v.toPrecision(4)).toString()),
        })),
      ],
      hooks: { draw: [mark(of)] },
    }, data, place);
  };

  // A finger drags as a mouse does; up and down it scrolls, see .u-over in the style.
  const touch = (u) => {
    for (const [from, to] of [["touchstart", "mousedown"], ["touchmove", "mousemove"], ["touchend", "mouseup"]]) {
      u.over.addEventListener(from, ({ changedTouches: [{ clientX, clientY }] }) => {
        const at = { clientX, clientY, bubbles: true, detail: 1, movementX: 1 };  // uPlot wants it to have moved
        if (to === "mousedown") u.over.dispatchEvent(new MouseEvent("mousemove", at));
        u.over.dispatchEvent(new MouseEvent(to, at));
      }, { passive: true });
    }
  };

  const rest = new Set(document.querySelectorAll(".plot")), drawn = new Map();
  const show = (place) => {
    if (!rest.delete(place)) return;
    const plot = draw(place), same = [...drawn].find(([{ dataset }]) => dataset.group === place.dataset.group);
    if (same) plot.setScale("x", same[1].scales.x);  // others may have been zoomed
    drawn.set(place, plot);
    touch(plot);
    choose(place);
  };
  const seen = new IntersectionObserver((found) => {
    for (const { isIntersecting, target } of found) if (isIntersecting) show(target);
  }, { rootMargin: "600px" });
  rest.forEach((place) => seen.observe(place));

  // #only=A,B shows the curves of some runs of all, or those that begin with "A: "; #only= all.
  let only = [];
  const ofAll = [...document.querySelectorAll("#all ~ .panels")].slice(0, 1).flatMap((row) => [...row.querySelectorAll(".plot")]);
  const choose = (place) => {
    const plot = drawn.get(place);
    if (!plot || !ofAll.includes(place)) return;
    plot.series.forEach(({ label }, k) => {
      const wanted = !only.length || only.some((name) => label === name || label.startsWith(`${name}: `));
      if (k && plot.series[k].show !== wanted) plot.setSeries(k, { show: wanted });
    });
  };
  const follow = () => {
    const [, names] = decodeURIComponent(location.hash).split("#only=");
    if (names === undefined) return;
    only = names ? names.split(",") : [];
    const told = document.getElementById("shown");
    told.hidden = !only.length;
    told.querySelector("b").textContent = only.join(", ");
    ofAll.forEach(choose);
    document.getElementById("all").scrollIntoView();
  };
  addEventListener("hashchange", follow);
  follow();

  addEventListener("beforeprint", () => {
    rest.forEach(show);
    drawn.forEach((plot, place) => {
      plot.batch(() => {});  // one that was not in view has no ticks yet
      plot.root.insertAdjacentHTML("afterbegin", drawing(plot, plots[place.dataset.plot]));
    });
  });
  addEventListener("afterprint", () => document.querySelectorAll(".printed").forEach((svg) => svg.remove()));
  open.contentDocument.close();
  open.remove();
})();
