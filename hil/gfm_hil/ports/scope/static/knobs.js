// The knobs: set-points, grid, law, reset. They only send requests; the run decides.

import { fields, fits } from "./forms.js";
import { make, number, numberInput, symbol, value } from "./text.js";

const SETPOINTS = [["P_ref", 0.1], ["Q_ref", 0.1], ["V_ref", 0.01]];
const OWN = new Set(["reference", "law", "reset"]); // with sections of their own
export const WATCHED = SETPOINTS.map(([name]) => name);

export class Knobs {
  // about: of the run; tell(event, name): sends an event, returns whether it was accepted
  constructor(place, about, tell) {
    this.tell = tell;
    this.about = about;
    this.now = {};
    this.inputs = {};
    place.replaceChildren(this.state(), this.setpoints(), this.laws(), this.events());
    this.all = place.querySelectorAll("button, input, select");
    this.allow(false);
  }

  // why: the reason, in words, if the knobs are disabled
  allow(may) {
    this.may = may;
    for (const knob of this.all) knob.disabled = !may;
    this.condition(this.wasSafe ?? false, this.active);
  }

  section(title, ...content) {
    const said = make("p", { class: "said", role: "status" });
    const section = make("section", {}, make("h2", {}, title), ...content, said);
    section.said = said;
    return section;
  }

  async send(section, event) {
    section.said.className = "said";
    section.said.textContent = "…";
    const answer = await this.tell(event);
    section.said.className = answer.ok ? "said good" : "said bad";
    section.said.textContent = answer.ok ? `${answer.label} at tick ${answer.tick}` : answer.text;
    return answer.ok;
  }

  field(name, { step, unit, initial }) {
    const input = numberInput({ id: `set-${name}` });
    if (initial !== undefined) input.value = initial;
    const by = (sign) => () => {
      const given = number(input.value);
      const from = typeof given === "number" ? given : this.now[name] ?? 0;
      input.value = +(Math.round(from / step + sign) * step).toFixed(6);
      input.dispatchEvent(new Event("input", { bubbles: true }));
    };
    this.inputs[name] = input;
    return make("span", { class: "field" },
      make("button", { type: "button", class: "icon", "aria-label": `${name} less`, tabindex: -1,
        onclick: by(-1) }, "−"), input,
      make("button", { type: "button", class: "icon", "aria-label": `${name} more`, tabindex: -1,
        onclick: by(1) }, "+"), make("small", {}, unit));
  }

  // label, the present value if an id is given for it, and the input field
  row(label, name, now, options) {
    const value = now ? [make("output", { id: now, title: "now" }, "–")] : [];
    return make("div", { class: now ? "row" : "row short" },
      make("label", { for: `set-${name}` }, label), ...value, this.field(name, options));
  }

  // rows, with the button in the last one; send(): sends the request
  form(button, id, rows, send) {
    rows.at(-1).append(make("button", { class: "strong go", id }, button));
    const form = make("form", { novalidate: true }, ...rows);
    form.addEventListener("submit", (submit) => {
      submit.preventDefault();
      send();
    });
    return form;
  }

  setpoints() {
    const rows = SETPOINTS.map(([name, step]) =>
      this.row(symbol(name), name, `now-${name}`, { step, unit: "p.u." }));
    rows.push(this.row("over", "ramp", "", { step: 0.1, unit: "s", initial: 0 }));
    const section = this.section("Set-points", this.form("Apply", "apply", rows, async () => {
      const given = SETPOINTS.map(([name]) => name).filter((name) => this.inputs[name].value !== "");
      const event = { type: "reference", ramp_s: number(this.inputs.ramp.value) || 0 };
      for (const name of given) event[name] = number(this.inputs[name].value);
      if (await this.send(section, event)) for (const name of given) this.inputs[name].value = "";
    }));
    return section;
  }

  // A panel for each kind of event, by its schema.
  events() {
    const { events, choices } = this.about;
    const kinds = Object.entries(events).filter(([kind, schema]) =>
      !OWN.has(kind) && fits(schema, choices));
    const panels = kinds.map(([kind, schema]) => {
      const { rows, read } = fields(`set-${kind}`, schema, choices);
      const form = make("form", { novalidate: true }, ...rows,
        make("button", { class: "strong go", id: `do-${kind}` }, "Send"));
      form.addEventListener("submit", (submit) => {
        submit.preventDefault();
        this.send(panel, { type: kind, ...read() });
      });
      const said = make("p", { class: "said", role: "status" });
      const what = (schema.description ?? "").replace(/\s+/g, " ").replaceAll("``", "");
      const panel = make("details", { "data-event": kind },
        make("summary", {}, kind.replaceAll("-", " ")), make("p", { class: "hint" }, what), form, said);
      panel.said = said;
      return panel;
    });
    return make("section", { class: "events" }, make("h2", {}, "Events"), ...panels);
  }

  laws() {
    this.lawButtons = this.about.laws.map(([law, title]) => {
      const button = make("button", { type: "button", class: "law", "data-law": title,
        "aria-pressed": "false" }, title);
      button.addEventListener("click", () => this.send(section, { type: "law", law }));
      return button;
    });
    const more = this.about.laws.length > 1 ? [] : [make("p", { class: "hint" },
      "No other law is ready. A scenario names more in ready_laws.")];
    const section = this.section("Law", make("div", { class: "laws" }, ...this.lawButtons), ...more);
    return section;
  }

  state() {
    this.reset = make("button", { type: "button", class: "strong", id: "reset" }, "Reset from SAFE");
    this.reason = make("p", { class: "why" });
    const section = this.section("State", this.reset, this.reason);
    section.classList.add("state");
    this.reset.addEventListener("click", () => this.send(section, { type: "reset" }));
    this.safe = section;
    return section;
  }

  // Shows the run's state; only in SAFE is there something to reset.
  condition(safe, active, words = this.words) {
    Object.assign(this, { wasSafe: safe, active, words });
    this.safe.classList.toggle("safe", safe);
    this.reset.disabled = !this.may || !safe;
    if (words !== this.reason.textContent) this.reason.textContent = words ?? "";
    for (const button of this.lawButtons) {
      const is = button.dataset.law === active;
      button.setAttribute("aria-pressed", String(is));
      button.disabled = !this.may || is;
    }
  }

  show(now) {
    for (const [name] of SETPOINTS) {
      this.now[name] = now[name];
      this.write(`now-${name}`, value(now[name], "p.u."));
    }
  }

  write(id, text) {
    const element = document.getElementById(id);
    if (element.textContent !== text) element.textContent = text;
  }
}
