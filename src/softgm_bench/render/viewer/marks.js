// What stands in the scene at a time, for either renderer: solids {mesh, start, axis, size, radius, colour, ...} and
// segments {a, b, from, to, width}, colours RGBA, widths in pixels.

const FAINT = 0.004; // attention below this is not drawn
const TRAIL = 120; // steps of the tip's path that are drawn

function sceneBounds(episode) {
  const { nodes, elements, position } = episode;
  const points = [episode.target];
  const stride = Math.max(1, Math.floor(episode.steps / 150));
  for (let step = 0; step <= episode.steps; step += stride) {
    for (let node = 0; node < nodes; node += Math.max(1, Math.floor(elements / 8))) {
      points.push(vec(position, 3 * (step * nodes + node)));
    }
    points.push(episode.tip(step));
  }
  const r = episode.baseRadius;
  const padded = points.flatMap((p) => [add(p, [r, r, r]), sub(p, [r, r, r])]);
  let floor = -0.2;
  for (const p of padded) floor = Math.min(floor, p[2] - 0.03);
  for (const c of episode.cylinders) {
    const [start, axis] = [vec(c, 0), vec(c, 3)];
    for (const end of [along(start, axis, -c[7]), along(start, axis, c[6] + c[7])]) {
      padded.push(end);
      floor = Math.min(floor, end[2]);
    }
  }
  const low = [0, 1, 2].map((i) => Math.min(...padded.map((p) => p[i])));
  const high = [0, 1, 2].map((i) => Math.max(...padded.map((p) => p[i])));
  low[2] = Math.min(low[2], floor);
  for (const [x, y] of [[r, r], [r, -r], [-r, r], [-r, -r]]) padded.push([1.25 * x, 1.25 * y, floor]);
  return { points: padded, floor, centre: mixed(low, high, 0.5), reach: length(sub(high, low)) / 2 };
}

function solidsAt(episode, rod, time, bounds, theme, show) {
  const { target, elements } = episode;
  const solids = [];
  const put = (mesh, start, axis, size, radius, colour, more = {}) =>
    solids.push({ mesh, start, axis, size, radius, colour, alpha: 1, glow: 0, gloss: 0.15, shadow: mesh !== "band", ...more });
  const up = [0, 0, 1];
  const base = vec(episode.position, 0);
  put("pedestal", [base[0], base[1], bounds.floor], up, base[2] + 0.004 - bounds.floor, episode.baseRadius, PAINT.pedestal, { gloss: 0.3 });
  const alpha = show.clear ? 0.3 : 1;
  for (const c of episode.cylinders) put("capsule", vec(c, 0), vec(c, 3), c[6], c[7], PAINT.column, { alpha });
  const step = Math.min(Math.floor(time), episode.steps);
  episode.slots.forEach((slot, index) => {
    if (slot.step > time) return;
    let sensed = false;
    for (let agent = 0; agent < episode.agents; agent++) sensed = sensed || episode.edge(step, agent, index) === 1;
    const flash = Math.exp(-(time - slot.step) / 2);
    const colour = mixed(mixed(PAINT.column, PAINT.discovered, sensed ? 1 : 0.62), PAINT.fresh, flash);
    const half = 0.93 * slot.half;
    const radius = slot.radius * (1.03 + 0.14 * flash);
    const glow = (sensed ? 0.22 : 0.04) + 0.5 * flash;
    put("band", along(slot.centre, slot.axis, -half), slot.axis, 2 * half, radius, colour, { glow, alpha: show.clear ? 0.8 : 1 });
  });
  const reached = episode.success && time >= episode.steps;
  const goal = reached ? PAINT.reached : PAINT.target;
  put("capsule", target, up, 0, 0.3 * episode.successRadius, goal, { glow: 0.35 });
  put("capsule", target, up, 0, episode.successRadius, goal, { alpha: reached ? 0.5 : 0.26, shell: true, glow: reached ? 0.35 : 0.1 });
  if (show.actions) putCouples(episode, rod, time, theme, put);
  if (episode.force) {
    const row = Math.min(step, episode.steps - 1);
    const force = vec(episode.force, 3 * row);
    putArrow(put, vec(rod.position, 3 * elements), unit(force), 0.18 * length(force) / strongest(episode), theme.touching);
  }
  return solids;
}

function strongest(episode) {
  let most = 1e-12;
  for (let step = 0; step < episode.steps; step++) most = Math.max(most, length(vec(episode.force, 3 * step)));
  return most;
}

function putArrow(put, start, direction, size, colour) {
  if (size < 0.012) return;
  const head = Math.min(0.035, 0.6 * size);
  put("drum", start, direction, size - head, 0.0045, colour, { glow: 0.25, shadow: false });
  put("cone", along(start, direction, size - head), direction, head, 0.013, colour, { glow: 0.25, shadow: false });
}

// A couple m turns the rod's tangent towards m x d3: the arrows show where each section bends to.
function putCouples(episode, rod, time, theme, put) {
  const row = Math.min(Math.floor(time), episode.steps - 1);
  episode.agentNodes.forEach((node, agent) => {
    const frame = frameAt(rod, node, episode.elements);
    const at = 2 * (row * episode.agents + agent);
    const couple = add(scaled(frame.first, episode.action[at]), scaled(frame.second, episode.action[at + 1]));
    const turn = cross(couple, frame.tangent);
    const strength = length(turn);
    const direction = scaled(turn, 1 / (strength || 1));
    const colour = mixed(agentColour(agent, episode.agents), theme.text, 0.4);
    putArrow(put, along(frame.centre, direction, frame.radius), direction, 0.13 * strength, colour);
  });
}

// segments

function pathAt(episode, time) {
  const from = Math.max(0, time - TRAIL);
  const pieces = Math.max(1, Math.ceil(6 * (time - from)));
  const at = (k) => nodeAt(episode, episode.elements, mix(from, time, k / pieces));
  const colour = (k) => [...gradient(PAINT.path, k / pieces), mix(from > 0 ? 0 : 0.55, 1, k / pieces)];
  return Array.from({ length: pieces }, (_, k) => ({ a: at(k), b: at(k + 1), from: colour(k), to: colour(k + 1), width: 3 }));
}

// Small weights would hardly be seen, so opacity has a floor and grows twice as fast as the weight.
const opacity = (weight) => (weight < FAINT ? 0 : Math.min(1, 0.22 + 2 * weight));

function edgesAt(episode, rod, time, theme, choice, out) {
  const step = Math.min(Math.floor(time), episode.steps - 1);
  const frames = episode.agentNodes.map((node) => frameAt(rod, node, episode.elements));
  const segments = [];
  if (!Object.keys(episode.attention).length) {
    episode.slots.forEach((slot, index) => {
      for (let agent = 0; agent < episode.agents; agent++) {
        if (slot.step <= time && episode.edge(step, agent, index)) segments.push(entityEdge(slot, frames[agent], PAINT.discovered, 0.15));
      }
    });
    return segments;
  }
  for (const name of ["stage1", "stage2"]) {
    const stage = episode.attention[name];
    if (!stage || (choice.stage && choice.stage !== name)) continue;
    for (const { receiver, source, weight } of weightsAt(stage, step, choice.layer, choice.head)) {
      if (source === receiver) continue;
      if (source >= episode.agents) {
        const slot = episode.slots[source - episode.agents];
        segments.push(entityEdge(slot, frames[receiver], PAINT.attention, weight));
      } else {
        segments.push(...agentEdge(frames[source], frames[receiver], theme.neighbours, weight, out));
      }
    }
  }
  return segments;
}

function entityEdge(slot, frame, colour, weight) {
  const side = unit(without(sub(frame.centre, slot.centre), slot.axis));
  const a = along(slot.centre, side, slot.radius * 1.04);
  const b = along(frame.centre, unit(without(sub(a, frame.centre), frame.tangent)), frame.radius * 1.02);
  const alpha = opacity(weight);
  return { a, b, from: [...colour, 0.35 * alpha], to: [...colour, alpha], width: 2.2 + 4 * Math.min(1, 2 * weight) };
}

// A bow beside the rod as seen by the camera; the two directions between neighbours lie on opposite sides.
function agentEdge(source, receiver, colour, weight, out) {
  const chord = sub(receiver.centre, source.centre);
  const side = unit(cross(chord, out));
  const a = along(source.centre, side, 1.05 * source.radius);
  const b = along(receiver.centre, side, 1.05 * receiver.radius);
  const top = along(mixed(a, b, 0.5), side, 0.06);
  const at = (t) => mixed(mixed(a, top, t), mixed(top, b, t), t);
  const alpha = opacity(weight);
  const parts = 24;
  return Array.from({ length: parts }, (_, k) => {
    const [s, t] = [k / parts, (k + 1) / parts];
    return { a: at(s), b: at(t), from: [...colour, alpha * mix(0.3, 1, s)], to: [...colour, alpha * mix(0.3, 1, t)], width: 1.8 + 4 * weight };
  });
}
