// Numbers and elements.

const DIGITS = { "p.u.": 3, Hz: 3, "µs": 1, "°": 2, "": 0, W: 0, var: 0, V: 1, A: 2 };

export function value(number, unit) {
  if (number === undefined || Number.isNaN(number)) return "–";
  const text = number.toFixed(DIGITS[unit] ?? 3);
  return +text === 0 ? text.replace("-", "") : text.replace("-", "−");
}

// A value as text for an axis with ticks `step` apart.
export function tick(v, step) {
  const thousands = step >= 1e3;
  const digits = Math.max(0, -Math.floor(Math.log10(thousands ? step / 1e3 : step) + 1e-6));
  const text = (thousands ? v / 1e3 : v).toFixed(digits).replace("-", "−");
  return thousands && v !== 0 ? `${text} k` : text;
}

// A time with as many digits as `step` [s] needs.
export function seconds(t, step) {
  const milli = step < 2e-3;
  const digits = Math.max(0, -Math.floor(Math.log10(milli ? step * 1e3 : step) + 1e-6));
  return (milli ? t * 1e3 : t).toFixed(digits).replace("-", "−") + (milli ? " ms" : " s");
}

// The number that an operator has typed, with a decimal point or comma; else the text, for the run
// to refuse.
export function number(text) {
  const plain = text.trim().replace(/^([+-]?\d*),(\d+)$/, "$1.$2");
  return plain === "" || Number.isNaN(+plain) ? text : +plain;
}

// A field for a number. Browsers drop the comma from fields of type "number" where the language has
// a point: 0,1 became 1.
export function numberInput(attributes) {
  return make("input", { type: "text", inputmode: "decimal", class: "number", autocomplete: "off",
    ...attributes });
}

export function span(s) {
  if (s < 0.9995e-3) return `${+(s * 1e6).toPrecision(3)} µs`;
  return s < 0.9995 ? `${+(s * 1e3).toPrecision(3)} ms` : `${+s.toPrecision(4)} s`;
}

// make("div", {class: "x", onclick: f}, child, "text", …)
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, content] of Object.entries(attributes)) {
    if (name.startsWith("on")) element.addEventListener(name.slice(2), content);
    else if (content === true) element.setAttribute(name, "");
    else if (content !== false) element.setAttribute(name, content);
  }
  element.append(...children);
  return element;
}

// A symbol such as V_dcref, shown as V with a subscript.
export function symbol(text) {
  const [base, ...below] = text.split("_");
  if (base.length > 2) return make("span", { class: "symbol word" }, text);
  const part = make("span", { class: "symbol" }, make("i", {}, base));
  if (below.length) part.append(make("sub", {}, below.join(" ")));
  return part;
}
