// The view: rolling, held, or around a trigger's edge; requests its frames from the server.

export const SPANS = [0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 60];

export class Look {
  // say: sends a message; changed: called when any of it changes
  constructor(say, changed) {
    this.say = say;
    this.changed = changed;
    this.mode = "roll";
    this.span = 2;
    this.start = 0;
    this.trigger = null; // {channel, level, edge, mode, before}
    this.speed = 1; // of the replay of a finished run
    this.playing = false;
    this.live = true;
    this.channels = [];
    this.watched = [];
    this.bins = 800;
    this.frame = null;
    this.id = 0;
    this.T_s = 1e-4;
    this.asked = new Map(); // requested names by id
  }

  get running() {
    return this.live ? this.mode !== "held" : this.playing;
  }

  // Seconds recorded so far.
  get done() {
    return this.frame ? this.frame.head * this.T_s : 0;
  }

  // The visible window, s: the held one, or that of the newest frame.
  get window() {
    if (this.mode === "held") return [this.start, this.start + this.span];
    if (!this.frame) return [0, this.span];
    return [this.frame.start * this.T_s, this.frame.stop * this.T_s];
  }

  ask() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => {
      this.pending = 0;
      this.id += 1;
      this.asked = new Map([[this.id, { channels: this.channels, watched: this.watched }]]);
      const look = { kind: "look", id: this.id, channels: this.channels, watched: this.watched,
        bins: this.bins, mode: this.mode, span: this.span, start: this.start };
      if (this.mode === "trigger") look.trigger = this.trigger;
      this.say(look);
      this.changed();
    });
  }

  pause() {
    const [from, to] = this.window;
    this.hold(from, to);
  }

  hold(from, to) {
    this.mode = "held";
    this.span = Math.max(to - from, 4 * this.T_s);
    this.start = from;
    if (!this.live && this.playing) this.stop();
    this.ask();
  }

  stop() {
    this.playing = false;
    this.say({ kind: "play" });
  }

  // Continues: along with the run, or, if it is over, from the start of the window.
  run() {
    if (!this.live) {
      const [from, to] = this.window;
      const whole = to >= this.done && from <= 0;
      const start = whole || from >= this.done - 2 * this.T_s ? 0 : Math.max(0, from);
      if (whole) this.span = Math.min(this.span, 2);
      this.playing = true;
      this.say({ kind: "play", start, speed: this.speed });
    }
    this.mode = this.trigger ? "trigger" : "roll";
    this.ask();
  }

  whole() {
    this.hold(0, Math.max(this.done, 10 * this.T_s));
  }

  setSpan(span) {
    if (this.mode === "held") {
      const middle = this.start + this.span / 2;
      this.hold(middle - span / 2, middle + span / 2);
    } else {
      this.span = span;
      this.ask();
    }
  }

  // Zooms by a factor around a time that keeps its place.
  zoom(factor, around) {
    const [from, to] = this.window;
    const wide = Math.min(Math.max((to - from) * factor, 8 * this.T_s), 1e5);
    const start = around - ((around - from) / (to - from)) * wide;
    this.hold(start, start + wide);
  }

  pan(part) {
    const [from, to] = this.window;
    const by = part * (to - from);
    this.hold(from + by, to + by);
  }

  setTrigger(trigger) {
    this.trigger = trigger;
    if (this.mode !== "held") this.mode = trigger ? "trigger" : "roll";
    this.ask();
  }
}
