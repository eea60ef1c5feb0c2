// The style sheet's present colours, light or dark, for drawing on a canvas.

const probe = document.createElement("span");
probe.hidden = true;
document.body.append(probe);
let cache = new Map();

export function colour(name) {
  if (!cache.has(name)) {
    probe.style.color = `var(--${name})`;
    cache.set(name, getComputedStyle(probe).color);
  }
  return cache.get(name);
}

export const THEMES = ["auto", "light", "dark"];

// Calls `changed` whenever the colours change; returns a function that sets the theme.
export function watch(changed) {
  const again = () => {
    cache = new Map();
    changed();
  };
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", again);
  return (theme) => {
    document.documentElement.dataset.theme = theme;
    again();
  };
}
