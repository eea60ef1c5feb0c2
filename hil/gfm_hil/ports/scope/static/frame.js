// Decodes a frame of the server; view.py defines its layout.

const HEAD = ["view", "first", "width", "bins", "channels", "start", "stop", "head", "edge",
  "doing", "state", "law", "misses", "trip", "same", "live"];
export const IDLE = 0, ARMED = 1, FILLING = 2, AUTO = 3, HELD = 4;

// names: the requested channels, in order; watched: channels of which only the present value comes.
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

// Time of each point of a frame from `origin`, s: two points per bin, unless a bin is one tick.
export function times(frame, T_s, origin) {
  const each = frame.width > 1 ? 2 : 1;
  const t = new Float64Array(frame.bins * each);
  for (let k = 0; k < frame.bins; k++) {
    const at = (frame.first + (k + 0.5) * frame.width - 0.5) * T_s - origin;
    for (let j = 0; j < each; j++) t[k * each + j] = at;
  }
  return t;
}

// The points of one channel: minimum and maximum of each bin, first the one nearer to the previous
// bin's last point, so that a slope stays a line and a peak a peak. null: no value.
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
