// Attention as a picture: one row per receiving agent, one column per agent or bin that it hears.

const STAGES = { stage1: "obstacles → agents", stage2: "agents ↔ agents" };

function makeMatrix(episode, state, changed) {
  const names = Object.keys(STAGES).filter((name) => episode.attention[name]);
  if (!names.length) {
    by("s-edges-name").textContent = "sensed bins";
    return [];
  }
  by("attention").hidden = false;
  const options = (id, entries) => by(id).replaceChildren(...entries.map(([text, value]) => new Option(text, value)));
  const first = episode.attention[names[0]];
  const numbered = (n, name) => count(n).map((k) => [`${name} ${k}`, k]);
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
    by("c-attention").textContent = `decision at step ${step - (step % first.every)}${every}`;
  });
  by("p-matrix").style.height = `${clamp(18 * episode.agents, 84, 240) + 16}px`;
  return [plot];
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
  const [gap, left, top] = [14, 16, 15];
  const room = width - left - gap * (tables.length - 1);
  const rows = (height - top) / agents;
  const fill = (colour, ...box) => {
    context.fillStyle = colour;
    context.fillRect(...box);
  };
  const write = (text, x, y) => {
    Object.assign(context, { font: "10.5px system-ui, sans-serif", textBaseline: "middle", fillStyle: css(theme.soft) });
    context.fillText(text, x, y);
  };
  for (let agent = 0; agent < agents; agent++) {
    const y = top + rows * (agents - 1 - agent);
    fill(css(agentColour(agent, agents)), left - 6, y + 1, 4, rows - 2);
    if (rows > 9) write(String(agent), 0, y + rows / 2);
  }
  // no cell wider than 1.6 rows; the agents' square first, bins share the rest
  const square = tables.length > 1 ? Math.min(0.42 * room, agents * rows * 1.6) : room;
  let x = left;
  for (const { name, columns, cells } of tables) {
    const neighbours = name === "stage2";
    const available = neighbours || tables.length === 1 ? square : room - square;
    const cell = Math.min(available / columns, rows * 1.6);
    write(neighbours ? "agents" : columns > 1 ? `self, ${columns - 1} bins` : "self", x, 6);
    fill(css(theme.line, 0.45), x, top, cell * columns, height - top);
    const inset = cell > 5 ? 0.5 : 0;
    for (const [receiver, source, weight] of cells) {
      const box = [x + cell * source + inset, top + rows * (agents - 1 - receiver) + 0.5, cell - 2 * inset, rows - 1];
      fill(css(theme.panel), ...box);
      fill(css(neighbours ? theme.neighbours : PAINT.attention, Math.sqrt(weight)), ...box);
    }
    x += cell * columns + gap;
  }
}
