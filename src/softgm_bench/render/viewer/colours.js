// Colours: those of the page's style, and those that the episode brings along for what is in the scene.

let PAINT; // of the things in the scene; lists are gradients
const SERIES = ["#366bdb", "#0d9e73", "#d4612e", "#8c57d9", "#d6404d", "#de991f", "#738094", "#d14794"].map((c) => new Color(c));
const [NEGATIVE, POSITIVE] = [new Color("#2e70d1"), new Color("#d1572e")]; // actions

function readPaint(colours) {
  const read = (c) => (Array.isArray(c) ? c.map(read) : new Color(c));
  PAINT = Object.fromEntries(Object.entries(colours).map(([name, c]) => [name, read(c)]));
}

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  const names = ["back", "panel", "line", "text", "soft", "accent", "touching", "neighbours"];
  const theme = Object.fromEntries(names.map((name) => [name, new Color(style.getPropertyValue(`--${name}`).trim())]));
  return { ...theme, dark: theme.back.g < 0.2 };
}

const mixed = (a, b, t) => a.clone().lerp(b, t); // as light mixes
const css = (colour, alpha = 1) => colour.getStyle().replace(")", `,${alpha})`);

// Between equally spaced colours.
function gradient(stops, place) {
  const at = clamp(place, 0, 1) * (stops.length - 1);
  const k = Math.min(Math.floor(at), stops.length - 2);
  return mixed(stops[k], stops[k + 1], at - k);
}

const agentColour = (agent, agents) => gradient(PAINT.arm, (agent + 1) / (agents + 1));
