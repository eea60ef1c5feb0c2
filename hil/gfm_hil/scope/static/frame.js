// One frame of the server taken apart; its layout is that of view.py.

const HEAD = ["view", "first", "width", "bins", "channels", "start", "stop", "head", "edge",
  "doing", "state", "law", "misses", "trip", "same", "live"];
export const IDLE = 0, ARMED = 1, FILLING = 2, AUTO = 3, HELD = 4;

// names: the channels that were asked for, in order; watched: those of which only the value now.
export function decode(buffer, names, watched) {
  const numbers = new Float64Array(buffer, 0, HEAD.length);
  const frame = Object.fromEntries(HEAD.map((name, k) => [name, numbers[k]]));
  const n = frame.bins;
  let at = 8 * HEAD.length;
  const take = (count) => {
    const values = new Float32Array(buffer, at, count);
    at += 4 * count;
    return values;
  };
  frame.low = {};
  frame.high = {};
  if (n > 0) {
    for (const name of names) {
      frame.low[name] = take(n);
      frame.high[name] = take(n);
    }
  }
  const now = take(names.length + watched.length);
  frame.now = Object.fromEntries([...names, ...watched].map((name, k) => [name, now[k]]));
  return frame;
}

// Seconds of each point of a frame, against `origin`: two for each bin, unless a bin is one tick.
export function times(frame, T_s, origin) {
  const each = frame.width > 1 ? 2 : 1;
  const t = new Float64Array(frame.bins * each);
  for (let k = 0; k < frame.bins; k++) {
    const at = (frame.first + (k + 0.5) * frame.width - 0.5) * T_s - origin;
    for (let j = 0; j < each; j++) t[k * each + j] = at;
  }
  return t;
}

// The points of one channel: least and greatest of each bin, first the one that is nearer to where
// the bin before ended, so that a slope is a line and a peak a peak. null: there is no value.
export function points(low, high, width) {
  const n = low.length;
  if (width === 1) return Array.from(low, (v) => (Number.isNaN(v) ? null : v));
  const y = new Array(2 * n);
  let before = NaN;
  for (let k = 0; k < n; k++) {
    const a = low[k], b = high[k];
    if (Number.isNaN(a)) {
      y[2 * k] = y[2 * k + 1] = null;
    } else {
      const falling = Math.abs(before - b) < Math.abs(before - a);
      y[2 * k] = falling ? b : a;
      y[2 * k + 1] = falling ? a : b;
    }
    before = y[2 * k + 1] ?? NaN;
  }
  return y;
}
