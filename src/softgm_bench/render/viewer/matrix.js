// Attention as a picture: one row per receiving agent, one column per agent or bin that it hears.

const STAGES = { stage1: "obstacles → agents", stage2: "agents ↔ agents" };

function makeMatrix(episode, state, changed) {
  const names = Object.keys(STAGES).filter((name) => episode.attention[name]);
  if (!names.length) {
    by("s-edges-name").textContent = "sensed bins";
    return { resize: () => {}, draw: () => {} };
  }
  by("attention").hidden = false;
  const options = (id, entries) => by(id).replaceChildren(...entries.map(([text, value]) => new Option(text, value)));
  const first = episode.attention[names[0]];
  const numbered = (n, name) => count(n).map((k) => [`${name} ${k + 1}`, k]);
  options("a-stage", [...(names.length > 1 ? [["both", ""]] : []), ...names.map((name) => [STAGES[name], name])]);
  options("a-layer", [["mean", ""], ...numbered(first.layers, "layer")]);
  options("a-head", [["mean", ""], ...numbered(first.heads, "head")]);
  const number = (id) => (by(id).value === "" ? null : Number(by(id).value));
  const choose = () => {
    state.choice = { stage: by("a-stage").value || null, layer: number("a-layer"), head: number("a-head") };
    plot.resize();
    changed();
  };
  for (const id of ["a-stage", "a-layer", "a-head"]) by(id).addEventListener("change", choose);

  const plot = new Plot(by("p-matrix"), episode.steps, () => {}, (context, width, height) => {
    const step = Math.min(Math.floor(state.time), episode.steps - 1);
    const stages = names.filter((name) => !state.choice.stage || state.choice.stage === name);
    const tables = stages.map((name) => table(episode, name, step, state.choice));
    paintTables(context, width, height, tables, episode, state.theme);
    const every = first.every > 1 ? `; kept for every ${first.every}th step` : "";
    by("c-attention").textContent = `decision of step ${step - (step % first.every) + 1}${every}`;
    by("a-note").textContent = "One row per agent, the tip's on top; its weights add up to 1. In the scene violet lines lead from bins to agents and blue bows from neighbour to neighbour; the larger the weight, the more opaque.";
  });
  by("p-matrix").style.height = `${clamp(18 * episode.agents, 84, 240) + 16}px`;
  return plot;
}

// Columns that carry any weight at this step.
function table(episode, name, step, choice) {
  const found = weightsAt(episode.attention[name], step, choice.layer, choice.head);
  const { agents } = episode;
  if (name === "stage2") return { name, columns: agents, cells: found.map((w) => [w.receiver, w.source, w.weight]) };
  const bins = [...new Set(found.filter((w) => w.source >= agents).map((w) => w.source))].sort((a, b) => a - b);
  const column = (w) => (w.source < agents ? 0 : 1 + bins.indexOf(w.source));
  return { name, columns: 1 + bins.length, cells: found.map((w) => [w.receiver, column(w), w.weight]) };
}

function paintTables(context, width, height, tables, episode, theme) {
  const { agents } = episode;
  const gap = 14;
  const left = 16;
  const top = 15;
  const room = width - left - gap * (tables.length - 1);
  const rows = (height - top) / agents;
  // no cell wider than 1.6 rows; the agents' square first, bins share the rest
  const wanted = tables.map((t) => t.columns * rows * 1.6);
  const square = tables.find((t) => t.name === "stage2");
  const fixed = square && tables.length > 1 ? Math.min(0.42 * room, agents * rows * 1.6) : 0;
  let x = left;
  context.font = "10.5px system-ui, sans-serif";
  context.textBaseline = "middle";
  for (let agent = 0; agent < agents; agent++) {
    context.fillStyle = css(agentColour(agent, agents));
    const y = top + rows * (agents - 1 - agent);
    context.fillRect(left - 6, y + 1, 4, rows - 2);
    context.fillStyle = css(theme.soft);
    if (rows > 9) context.fillText(String(agent + 1), 0, y + rows / 2);
  }
  tables.forEach((t, k) => {
    const available = tables.length === 1 ? room : t.name === "stage2" ? fixed : room - fixed;
    const cell = Math.min(available, wanted[k]) / t.columns;
    context.fillStyle = css(theme.soft);
    const text = t.name === "stage2" ? "agents" : t.columns > 1 ? `self, ${t.columns - 1} bins` : "self";
    context.fillText(text, x, 6);
    const colour = t.name === "stage2" ? theme.neighbours : PAINT.attention;
    context.fillStyle = css(theme.line, 0.45);
    context.fillRect(x, top, cell * t.columns, height - top);
    for (const [receiver, source, weight] of t.cells) {
      const inset = cell > 5 ? 0.5 : 0;
      for (const fill of [css(theme.panel), css(colour, Math.sqrt(weight))]) {
        context.fillStyle = fill;
        context.fillRect(x + cell * source + inset, top + rows * (agents - 1 - receiver) + 0.5, cell - 2 * inset, rows - 1);
      }
    }
    x += cell * t.columns + gap;
  });
}
