// Colours: those of the page's style, and those that the episode brings along for what is in the scene.

let PAINT; // of the things in the scene, sRGB from 0 to 1; lists are gradients

function readPaint(colours) {
  PAINT = Object.fromEntries(Object.entries(colours).map(([name, c]) => [name, Array.isArray(c) ? c.map(hex) : hex(c)]));
}

// Between equally spaced colours, mixed as light mixes.
function gradient(stops, place) {
  const at = clamp(place, 0, 1) * (stops.length - 1);
  const k = Math.min(Math.floor(at), stops.length - 2);
  const light = (rgb) => rgb.map((x) => x ** 2.2);
  return mixed(light(stops[k]), light(stops[k + 1]), at - k).map((x) => x ** (1 / 2.2));
}

// Along the arm colours change half gradually, half from one control point to the next.
function armColour(place, agents) {
  const stepped = (Math.floor(place * (agents + 1)) + 0.5) / (agents + 1);
  return gradient(PAINT.arm, 0.5 * place + 0.5 * stepped);
}

const agentColour = (agent, agents) => gradient(PAINT.arm, (agent + 1) / (agents + 1));

function hex(text) {
  const number = parseInt(text.trim().slice(1), 16);
  return [(number >> 16) / 255, ((number >> 8) & 255) / 255, (number & 255) / 255];
}

const css = (rgb, alpha = 1) => `rgba(${rgb.slice(0, 3).map((x) => Math.round(255 * x)).join(",")},${alpha})`;

const THEME = ["back", "panel", "line", "text", "soft", "accent", "touching", "neighbours"];

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  const theme = Object.fromEntries(THEME.map((name) => [name, hex(style.getPropertyValue(`--${name}`))]));
  return { ...theme, dark: theme.back[0] < 0.5 };
}

// -1 blue, 0 the plot's ground, 1 orange.
function signed(value, theme) {
  const end = value < 0 ? [0.18, 0.44, 0.82] : [0.82, 0.34, 0.18];
  return mixed(theme.line, end, Math.min(1, Math.abs(value)));
}

const SERIES = [
  [0.21, 0.42, 0.86], [0.05, 0.62, 0.45], [0.83, 0.38, 0.18], [0.55, 0.34, 0.85],
  [0.84, 0.25, 0.3], [0.87, 0.6, 0.12], [0.45, 0.5, 0.58], [0.82, 0.28, 0.58],
];
