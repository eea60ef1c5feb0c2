// The bar above the strips: run and pause, the window's length, the trigger, which signals.

import { ARMED, AUTO, FILLING, HELD } from "./frame.js";
import { SPANS } from "./look.js";
import { STRIPS } from "./strips.js";
import { make, span } from "./text.js";

const get = (id) => document.getElementById(id);
const DOING = { [ARMED]: "armed", [FILLING]: "triggered", [AUTO]: "auto", [HELD]: "held" };

export class Tools {
  // on: {signals(), cursors(), si()}
  constructor(look, about, on) {
    this.look = look;
    this.about = about;
    get("run").onclick = () => (look.running ? look.pause() : look.run());
    get("whole").onclick = () => look.whole();
    get("speed").onchange = () => {
      look.speed = +get("speed").value;
      if (look.playing) look.run();
    };
    get("span").replaceChildren(...SPANS.map((s) => make("option", { value: s }, span(s))));
    get("span").onchange = () => get("span").value && look.setSpan(+get("span").value);
    get("shorter").onclick = () => this.step(-1);
    get("longer").onclick = () => this.step(1);
    get("cursors").onclick = on.cursors;
    get("si").onclick = on.si;
    this.makeTrigger();
    this.boxes = new Map(STRIPS.map((strip) => {
      const box = make("input", { type: "checkbox", "data-strip": strip.name });
      box.onchange = () => {
        strip.shown = box.checked;
        on.signals();
      };
      return [strip, box];
    }));
    const listed = (single) => [...this.boxes].filter(([strip]) => Boolean(strip.single) === single)
      .map(([strip, box]) => make("label", { title: strip.title }, box,
        single ? this.about.byName[strip.traces[0]].symbol : "", make("span", {}, strip.title)));
    get("signal-list").replaceChildren(...listed(false), make("h2", {}, "Single signals"),
      ...listed(true));
    document.addEventListener("keydown", (event) => this.key(event));
    document.addEventListener("click", (event) => {
      for (const menu of document.querySelectorAll(".menu")) {
        if (!menu.contains(event.target)) menu.open = false;
      }
    });
  }

  makeTrigger() {
    const channels = new Set(STRIPS.flatMap((strip) => [...strip.traces, ...(strip.marks ? [strip.marks] : [])]));
    get("trigger-channel").replaceChildren(...[...channels].map((name) =>
      make("option", { value: name }, this.about.byName[name].symbol)));
    const change = () => this.look.setTrigger(this.trigger());
    for (const id of ["trigger-mode", "trigger-channel", "trigger-edge"]) {
      get(id).onchange = () => {
        if (id === "trigger-channel" || get("trigger-level").value === "") this.propose();
        change();
      };
    }
    get("trigger-level").onchange = change;
    get("again").onclick = () => {
      if (this.look.mode === "held") this.look.run();
      else change();
    };
  }

  // A trigger level in the middle of the visible values.
  propose() {
    const name = get("trigger-channel").value;
    const low = this.look.frame?.low[name], high = this.look.frame?.high[name];
    let level = name === "miss" ? 0.5 : this.look.frame?.now[name] ?? 1;
    if (name !== "miss" && low?.length) {
      const values = [...low, ...high].filter((v) => !Number.isNaN(v));
      if (values.length) level = (Math.min(...values) + Math.max(...values)) / 2;
    }
    get("trigger-level").value = +level.toPrecision(5);
  }

  trigger() {
    const mode = get("trigger-mode").value;
    if (mode === "off") return null;
    const channel = get("trigger-channel").value;
    return { channel, level: +get("trigger-level").value / this.about.byName[channel].scale,
      edge: get("trigger-edge").value, mode };
  }

  step(by) {
    const { look } = this;
    const now = look.window[1] - look.window[0];
    const next = by > 0 ? SPANS.find((s) => s > now * 1.01) : SPANS.findLast((s) => s < now * 0.99);
    if (next) look.setSpan(next);
  }

  key(event) {
    if (event.target.closest("input, select, summary") || event.ctrlKey || event.metaKey) return;
    if (event.key === " " && event.target.closest("button")) return;
    const act = {
      " ": () => get("run").click(), c: () => get("cursors").click(), 0: () => this.look.whole(),
      "+": () => this.step(-1), "-": () => this.step(1), s: () => {
        get("trigger-mode").value = "single";
        get("trigger-mode").onchange();
      },
      ArrowLeft: () => this.look.pan(-0.2), ArrowRight: () => this.look.pan(0.2),
    }[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  }

  // Shows which strips there are, and the trigger's level in the present units.
  follow() {
    for (const [strip, box] of this.boxes) box.checked = strip.shown;
    const { trigger } = this.look;
    if (!trigger) return;
    get("trigger-level").value = +(trigger.level * this.about.byName[trigger.channel].scale).toPrecision(6);
  }

  show() {
    const { look } = this;
    const verb = look.running ? "Pause" : look.live ? "Run" : "Play";
    if (get("run").textContent !== verb) get("run").textContent = verb;
    get("run").dataset.running = look.running;
    get("speed").hidden = look.live;
    const now = look.mode === "held" ? look.span : look.window[1] - look.window[0];
    const listed = SPANS.find((s) => Math.abs(s - now) < 1e-3 * s);
    if (!listed) this.free(now);
    const wanted = String(listed ?? "");
    if (document.activeElement !== get("span") && get("span").value !== wanted) {
      get("span").value = wanted;
    }
    get("again").hidden = look.trigger?.mode !== "single";
    get("trigger").classList.toggle("off", look.trigger === null);
    get("trigger-unit").textContent = this.about.byName[get("trigger-channel").value]?.unit ?? "";
    const doing = look.mode === "trigger" && look.frame ? DOING[look.frame.doing] : "";
    if (get("doing").textContent !== doing) get("doing").textContent = doing ?? "";
    get("doing").dataset.doing = doing;
  }

  // Shows a length that is not in the list, after a zoom.
  free(now) {
    const first = get("span").options[0];
    const option = first.value === "" ? first : make("option", { value: "" });
    if (option !== first) get("span").prepend(option);
    if (option.textContent !== span(now)) option.textContent = span(now);
  }
}
