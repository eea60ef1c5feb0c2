// The page: assembles its parts.

import { Cursors } from "./cursors.js";
import { Layouts, savePicture, saveTable } from "./desk.js";
import { Events, OverviewMap } from "./events.js";
import { Diagram } from "./diagram.js";
import { decode, times } from "./frame.js";
import { Knobs, WATCHED } from "./knobs.js";
import { Link } from "./link.js";
import { Look } from "./look.js";
import { THEMES, colour, watch } from "./palette.js";
import { STRIPS, Strip, addSingles, channelsOf } from "./strips.js";
import { make, span } from "./text.js";
import { Tools } from "./tools.js";

const get = (id) => document.getElementById(id);
const WORDS = { RUNNING: "running, no fault", READY: "ready", INIT: "not started yet" };
const WORDS_MS = 200; // numbers that change faster are illegible
const RATE_S = 2; // of the run, over which misses are counted for their rate

const events = new Events(document.querySelector("#log ol"));
let si = false, counted = []; // counted: [ticks done, misses] of late
let diagram = null; // of a network
let network = null, flows = null; // what the server says of it
const narrow = matchMedia("(max-width: 860px)");
let about = null, strips = [], knobs = null, tools = null, cursors = null, x = new Float64Array(0);
let summary = null, reason = "", control = false, pictures = 0, told = 0, later = 0;

const link = new Link({ open: opened, lost, message: heard, frame: seen });
const look = new Look((message) => link.say(message), () => {
  tools?.show();
  redraw();
});
const map = new OverviewMap(get("map"), look);

function opened() {
  control = false;
}

function lost() {
  control = false;
  state("not connected", "lost");
  permit();
}

function heard(message) {
  if (message.kind === "about") begin(message);
  else if (message.kind === "control") {
    control = message.granted;
    permit();
  } else if (message.kind === "events") {
    events.set(message.events);
    summary = message.summary;
    if (about) about.labels = message.labels;
    permit();
    why();
    redraw();
  } else if (message.kind === "network") {
    network = message;
    draw();
    narrow.onchange = draw;
    get("network").hidden = false;
  } else if (message.kind === "flows") {
    flows = message;
    diagram?.show(flows);
  } else if (message.kind === "error") {
    console.error(message.text);
  }
}

function draw() {
  diagram = new Diagram(network, about.converter, narrow.matches || network.mesh);
  if (flows) diagram.show(flows);
  get("network").lastElementChild.replaceChildren(diagram.element);
}

function begin(message) {
  // after a reconnection the page stays as the operator has it
  about ??= { byName: Object.fromEntries(message.channels.map((c) => [c.name, {}])) };
  Object.assign(about, message);
  addSingles(message.channels);
  document.title = `${whole()} · gfmhil scope`;
  get("title").textContent = about.title;
  const { converter, converters } = about;
  get("converter").replaceChildren(...converters.map((name) => make("option", { value: name }, name)));
  get("converter").value = converter;
  get("converter").hidden = !converters.length;
  get("where").textContent = `${about.link}, ${about.mode}, T\u209B = ${span(about.T_s)}`;
  look.T_s = about.T_s;
  look.live = about.live;
  look.watched = WATCHED;
  knobs ??= new Knobs(get("knobs"), about, tell);
  useUnits();
  tools ??= new Tools(look, about, { signals: layout, cursors: toggleCursors,
    si: () => arrange({ si: !si }) });
  cursors ??= new Cursors(get("readout"), () => strips, about.byName, origin, redraw);
  if (!strips.length && !look.live) look.mode = "held", look.span = about.capacity * about.T_s;
  layout();
  permit();
}

// Units of the channels as they are shown: p.u. as they come, or SI.
function useUnits() {
  for (const channel of about.channels) {
    const [unit, scale] = (si && about.bases[channel.base]) || [channel.unit, 1];
    Object.assign(about.byName[channel.name], channel, { unit, scale, least: channel.least * scale });
  }
}

const panels = () => [...document.querySelectorAll("[data-event]")];

// Applies a layout, or what it says of one.
function arrange({ shown, si: units, open }) {
  if (shown) for (const strip of STRIPS) strip.shown = shown.includes(strip.name);
  if (units !== undefined) si = units;
  if (open) for (const panel of panels()) panel.open = open.includes(panel.dataset.event);
  get("si").setAttribute("aria-pressed", String(si));
  useUnits();
  layout();
}

const present = () => ({ si, shown: STRIPS.filter((strip) => strip.shown).map(({ name }) => name),
  open: panels().filter((panel) => panel.open).map((panel) => panel.dataset.event) });

async function tell(event) {
  const answer = await link.tell(event);
  if (!answer.ok) events.refuse(look.done, answer.text);
  return answer;
}

// The selected strips, one below the other; all share one time axis.
function layout() {
  for (const strip of strips) strip.plot?.destroy();
  strips = STRIPS.filter((spec) => spec.shown).map((spec) => new Strip(spec, about.byName, {
    zoom: (from, to) => look.hold(from + origin(), to + origin()),
    draw: (u, strip) => drawOver(u, strip),
  }));
  get("strips").replaceChildren(...strips.map((strip) => strip.element));
  strips.forEach((strip, k) => {
    strip.last = k === strips.length - 1;
    strip.element.classList.toggle("last", strip.last);
    strip.build();
    cursors.attach(strip);
    hold(strip.plot.over);
  });
  const wanted = strips.flatMap((strip) => channelsOf(strip.spec));
  look.channels = [...new Set(wanted)];
  look.bins = bins();
  tools.follow();
  look.ask();
}

function bins() {
  const wide = (strips[0]?.area.clientWidth ?? 860) - 60;
  return Math.max(100, Math.min(2000, Math.round(wide)));
}

// Handles wheel and double click on a plot.
function hold(over) {
  over.addEventListener("wheel", (event) => {
    event.preventDefault();
    const { left, width } = over.getBoundingClientRect();
    const [from, to] = look.window;
    if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) look.pan(event.deltaX / width);
    else look.zoom(Math.exp(event.deltaY * 2e-3), from + ((event.clientX - left) / width) * (to - from));
  }, { passive: false });
  over.addEventListener("dblclick", () => {
    for (const strip of strips) strip.hold(null);
    if (look.live) look.run();
    else look.whole();
  });
}

// Time at 0 of the axis: the edge of a trigger, else the start of the run.
function origin() {
  const { frame } = look;
  return frame && frame.edge >= 0 ? frame.edge * about.T_s : 0;
}

function seen(buffer) {
  const id = new Float64Array(buffer, 0, 1)[0];
  const asked = look.asked.get(id);
  if (!asked) return; // a frame of an outdated request
  const frame = decode(buffer, asked.channels, asked.watched);
  frame.plain = { ...frame.now }; // as they came, p.u.
  scale(frame);
  const before = look.frame;
  if (frame.same && before) frame.bins = before.bins, frame.low = before.low, frame.high = before.high;
  look.frame = frame;
  pictures += 1;
  if (look.live && !frame.live) over();
  if (!frame.same) {
    x = times(frame, about.T_s, origin());
    redraw();
  }
  words(frame);
}

function scale(frame) {
  for (const values of [frame.low, frame.high]) {
    for (const [name, list] of Object.entries(values)) {
      const by = about.byName[name].scale;
      if (by !== 1) values[name] = list.map((v) => v * by);
    }
  }
  for (const name of Object.keys(frame.now)) frame.now[name] *= about.byName[name].scale;
}

function over() {
  const [from, to] = look.window;
  look.live = false;
  if (look.mode !== "held") look.hold(from, to);
  permit();
}

function window_() {
  return look.window.map((t) => t - origin());
}

function redraw() {
  if (!look.frame || !about) return;
  const window = window_();
  cursors.follow(look.mode === "held", window);
  for (const strip of strips) strip.show(look.frame, x, window);
  cursors.tell(look.frame, x, window, about.T_s);
}

function drawOver(u, strip) {
  if (!strip.window) return;
  const first = strip === strips[0];
  events.draw(u, strip, origin(), first);
  if (look.frame.edge >= 0) drawEdge(u);
  if (look.trigger && strip.spec.traces.includes(look.trigger.channel)) drawLevel(u);
  cursors.draw(u, strip, first);
}

function drawEdge(u) {
  const { ctx, bbox } = u;
  const left = Math.round(u.valToPos(0, "x", true)) + 0.5;
  ctx.save();
  ctx.fillStyle = colour("trigger");
  ctx.fillRect(left - devicePixelRatio / 2, bbox.top, devicePixelRatio, bbox.height);
  ctx.restore();
}

function drawLevel(u) {
  const { ctx, bbox } = u;
  const level = look.trigger.level * about.byName[look.trigger.channel].scale;
  const top = Math.round(u.valToPos(level, "y", true)) + 0.5;
  if (top < bbox.top || top > bbox.top + bbox.height) return;
  const r = devicePixelRatio;
  ctx.save();
  ctx.strokeStyle = ctx.fillStyle = colour("trigger");
  ctx.lineWidth = r;
  ctx.setLineDash([6 * r, 4 * r]);
  ctx.beginPath();
  ctx.moveTo(bbox.left, top);
  ctx.lineTo(bbox.left + bbox.width, top);
  ctx.stroke();
  ctx.beginPath();
  ctx.moveTo(bbox.left, top - 5 * r);
  ctx.lineTo(bbox.left + 8 * r, top);
  ctx.lineTo(bbox.left, top + 5 * r);
  ctx.fill();
  ctx.restore();
}

function toggleCursors() {
  const on = !cursors.on;
  get("cursors").setAttribute("aria-pressed", String(on));
  cursors.held = look.mode === "held";
  cursors.toggle(on, window_());
}

// Updates the texts, a few times a second.
function words(frame) {
  const now = performance.now();
  clearTimeout(later);
  if (now - told < WORDS_MS) {
    later = setTimeout(() => words(look.frame), WORDS_MS);
    return;
  }
  told = now;
  const law = about.labels[frame.law];
  get("law").textContent = law ? [law.label, law.gains].filter(Boolean).join(", ") : "–";
  get("time").textContent = `${(frame.head * about.T_s).toFixed(2)} s`;
  get("misses").textContent = String(frame.misses);
  get("misses").parentElement.classList.toggle("some", frame.misses > 0);
  get("miss-rate").textContent = frame.live ? `${missRate(frame)}/s` : "";
  for (const strip of strips) strip.tell(frame);
  const running = stateOf(frame);
  if (frame.live) state(running || "running", running);
  else state(summary && summary.status !== "over" ? `over: ${summary.status}` : "over",
    summary?.status ?? "over");
  knobs.show(frame.plain);
  why();
  knobs.condition(running === "SAFE", law?.gains ? "" : law?.name, reason || WORDS[running] || "");
  map.show(events.events);
  tools.show();
}

// Misses a second of the run, of late.
function missRate({ head, misses }) {
  counted = [...counted, [head, misses]].filter(([at]) => at <= head && (head - at) * about.T_s <= RATE_S);
  const [[from, before]] = counted;
  return head > from ? +((misses - before) / ((head - from) * about.T_s)).toPrecision(2) : 0;
}

// Of a converter whose controller is dead or was stopped: that its bridge has tripped.
function stateOf(frame) {
  const own = about.states[frame.state] ?? "";
  return frame.trip > 0 && own !== "SAFE" ? "tripped" : own;
}

function state(text, kind) {
  if (get("state").textContent !== text) get("state").textContent = text;
  get("state").dataset.state = kind;
}

// The reason for which the run is in SAFE or has tripped, or how it ended if not regularly.
function why() {
  const frame = look.frame;
  const safe = frame && ["SAFE", "tripped"].includes(stateOf(frame));
  const last = events.events.findLast((e) => e.reason);
  reason = summary?.reason || (safe && last?.reason) || "";
  if (get("reason").textContent !== reason) get("reason").textContent = reason;
  get("reason").hidden = !reason;
}

function permit() {
  if (!knobs) return;
  let text = "";
  if (!look.live) text = "The run is over: look back, play it, measure in it.";
  else if (!about.commands) text = "A run in one process (link inproc) takes no commands. Start it with --link shm.";
  else if (!control) text = "Looking only. Open the address with the token to control the run.";
  get("permission").textContent = text;
  get("permission").hidden = !text;
  get("panel").classList.toggle("barred", Boolean(text));
  get("panel").classList.toggle("ended", !look.live && Boolean(summary?.reason));
  knobs.allow(!text);
}

// Each converter has an address of its own, for windows side by side.
get("converter").onchange = ({ target }) => location.assign(`?of=${encodeURIComponent(target.value)}`);

new Layouts(present, arrange);
// The converter that the page shows, and the run.
function whole() {
  return [about.converter, about.title].filter(Boolean).join(" · ");
}

get("png").onclick = () => savePicture(strips, whole(),
  ["state", "law", "time"].map((id) => get(id).textContent).join(" · "), look.done);
get("csv").onclick = () => saveTable(strips, about.byName, look.frame, about.T_s, whole());

setInterval(() => {
  get("rate").textContent = pictures ? `${pictures} fps` : "";
  pictures = 0;
}, 1000);

const setTheme = watch(() => {
  for (const strip of strips) strip.plot?.redraw(false, true);
});
let theme = localStorage.getItem("gfmhil-scope-theme") ?? "auto";
get("theme").onclick = () => applyTheme(THEMES[(THEMES.indexOf(theme) + 1) % THEMES.length]);

function applyTheme(name) {
  theme = name;
  localStorage.setItem("gfmhil-scope-theme", name);
  const icon = { auto: "◐", light: "○", dark: "●" }[name];
  get("theme").replaceChildren(icon, make("span", {}, ` ${name}`));
  setTheme(name);
}
applyTheme(theme);

new ResizeObserver(() => {
  for (const strip of strips) strip.resize();
  if (strips.length && look.bins !== bins()) {
    look.bins = bins();
    look.ask();
  }
}).observe(get("strips"));
