// The episode that the page carries, and its state at any time between two steps.

const ARRAYS = { uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };

function decoded(packed) {
  const binary = atob(packed.data);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = binary.charCodeAt(i);
  return new ARRAYS[packed.type](bytes.buffer);
}

function values(packed) {
  const stored = decoded(packed);
  if (packed.scale === 1 && packed.offset === 0) return stored;
  return Float32Array.from(stored, (value) => packed.offset + packed.scale * value);
}

function bits(packed) {
  const bytes = decoded(packed);
  const width = packed.shape[1];
  return (row, index) => (bytes[row * width + (index >> 3)] >> (index & 7)) & 1;
}

function readEpisode() {
  const episode = JSON.parse(document.getElementById("episode").textContent);
  const { arrays, attention } = episode;
  const nodes = episode.nodes;
  const agents = episode.agentNodes.length;
  const position = values(arrays.position);
  const steps = episode.steps;
  const contact = bits(arrays.contact);
  const edge = bits(arrays.edge);
  const tip = (step) => vec(position, 3 * (step * nodes + nodes - 1));
  const distance = new Float32Array(steps + 1);
  const touching = new Uint16Array(steps + 1);
  for (let step = 0; step <= steps; step++) {
    distance[step] = length(sub(tip(step), episode.target));
    for (let node = 0; node < nodes; node++) touching[step] += contact(step, node);
  }
  const reward = values(arrays.reward);
  const terms = values(arrays.terms);
  // sums over the steps before; the state of step 0 has earned nothing
  const summed = (row, from) => {
    const sums = new Float64Array(steps + 1);
    for (let step = 0; step < steps; step++) sums[step + 1] = sums[step] + row[from + step];
    return sums;
  };
  return {
    ...episode, nodes, agents, elements: nodes - 1, position, tip, distance, touching, contact, reward,
    normal: values(arrays.normal),
    radius: values(arrays.radius),
    action: values(arrays.action),
    force: arrays.force ? values(arrays.force) : null,
    edge: (step, agent, slot) => edge(step, agent * episode.slots.length + slot),
    returned: summed(reward, 0),
    earned: episode.terms.map((_, index) => summed(terms, index * steps)),
    attention: Object.fromEntries(Object.entries(attention).map(([name, stage]) => [name, readStage(stage)])),
  };
}

function readStage(stage) {
  return {
    ...stage,
    begin: values(stage.begin), receiver: values(stage.receiver), source: values(stage.source),
    weight: values(stage.weight),
  };
}

// Weights of one stage at a step, averaged over the layers and heads that are not chosen (null: all of them).
function weightsAt(stage, step, layer, head) {
  const row = Math.min(Math.floor(step / stage.every), stage.begin.length - 2);
  const all = stage.layers * stage.heads;
  const chosen = [];
  for (let l = 0; l < stage.layers; l++) {
    for (let h = 0; h < stage.heads; h++) {
      if ((layer === null || layer === l) && (head === null || head === h)) chosen.push(l * stage.heads + h);
    }
  }
  const found = [];
  for (let k = stage.begin[row]; k < stage.begin[row + 1]; k++) {
    let sum = 0;
    for (const which of chosen) sum += stage.weight[k * all + which];
    found.push({ receiver: stage.receiver[k], source: stage.source[k], weight: sum / chosen.length });
  }
  return found;
}

// A node between two steps: smooth, and exact at every step.
function nodeAt(episode, node, time) {
  const step = clamp(Math.floor(time), 0, Math.max(episode.steps - 1, 0));
  const at = (k) => vec(episode.position, 3 * (clamp(k, 0, episode.steps) * episode.nodes + node));
  return catmullRom(at(step - 1), at(step), at(step + 1), at(step + 2), time - step);
}

function rodAt(episode, time) {
  const step = Math.min(Math.floor(time), episode.steps);
  const next = Math.min(step + 1, episode.steps);
  const part = time - step;
  const between = (source, size) => {
    const out = new Float32Array(size);
    for (let i = 0; i < size; i++) out[i] = source[step * size + i] * (1 - part) + source[next * size + i] * part;
    return out;
  };
  const contact = new Float32Array(episode.nodes);
  for (let i = 0; i < contact.length; i++) {
    contact[i] = episode.contact(step, i) * (1 - part) + episode.contact(next, i) * part;
  }
  const position = new Float32Array(3 * episode.nodes);
  for (let i = 0; i < episode.nodes; i++) position.set(nodeAt(episode, i, time), 3 * i);
  return {
    position,
    normal: between(episode.normal, 3 * episode.elements),
    radius: between(episode.radius, episode.elements),
    contact,
  };
}
