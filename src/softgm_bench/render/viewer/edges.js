// Segments {a, b, from, to, alphas, width} in the scene, widths in pixels: the tip's path and who heeds what.

const FAINT = 0.004; // attention below this is not drawn
const TRAIL = 120; // steps of the tip's path that are drawn

function pathAt(episode, time) {
  const begin = Math.max(0, time - TRAIL);
  const pieces = Math.max(1, Math.ceil(6 * (time - begin)));
  const tip = episode.courses[episode.elements];
  return joined(count(pieces + 1).map((k) => ({
    at: tip.getPoint(mix(begin, time, k / pieces) / episode.steps),
    colour: gradient(PAINT.path, k / pieces),
    alpha: mix(begin > 0 ? 0 : 0.55, 1, k / pieces),
  })), 3);
}

const joined = (points, width) => points.slice(1).map((end, k) => ({ start: points[k], end, width }));

// Small weights would hardly be seen, so opacity has a floor and grows twice as fast as the weight.
const opacity = (weight) => (weight < FAINT ? 0 : Math.min(1, 0.22 + 2 * weight));

// out: the direction towards the camera.
function edgesAt(episode, rod, time, theme, choice, out) {
  const step = Math.min(Math.floor(time), episode.steps - 1);
  const agents = episode.agentNodes.map((node) => rod[node]);
  if (!Object.keys(episode.attention).length) {
    return episode.slots.flatMap((slot, index) => agents
      .filter((_, agent) => slot.step <= time && episode.edge(step, agent, index))
      .flatMap((node) => binEdge(binAt(episode, slot, time), node, PAINT.discovered, 0.15)));
  }
  const shown = Object.keys(episode.attention).filter((name) => !choice.stage || choice.stage === name);
  return shown.flatMap((name) => weightsAt(episode.attention[name], step, choice.layer, choice.head))
    .filter(({ receiver, source }) => source !== receiver)
    .flatMap(({ receiver, source, weight }) => source < episode.agents
      ? agentEdge(agents[source], agents[receiver], theme.neighbours, weight, out)
      : binEdge(binAt(episode, episode.slots[source - episode.agents], time), agents[receiver], PAINT.attention, weight));
}

// From surface to surface.
function binEdge(slot, node, colour, weight) {
  const side = node.centre.clone().sub(slot.centre).projectOnPlane(slot.axis).normalize();
  const start = along(slot.centre, side, slot.radius * 1.04);
  const towards = start.clone().sub(node.centre).projectOnPlane(node.tangent).normalize();
  const alpha = opacity(weight);
  const ends = [{ at: start, colour, alpha: 0.35 * alpha }, { at: along(node.centre, towards, node.radius * 1.02), colour, alpha }];
  return joined(ends, 2.2 + 4 * Math.min(1, 2 * weight));
}

// A bow beside the rod as seen by the camera; the two directions between neighbours lie on opposite sides.
function agentEdge(source, receiver, colour, weight, out) {
  const side = receiver.centre.clone().sub(source.centre).cross(out).normalize();
  const [a, b] = [source, receiver].map((node) => along(node.centre, side, 1.05 * node.radius));
  const bow = new THREE.QuadraticBezierCurve3(a, along(a.clone().lerp(b, 0.5), side, 0.06), b).getPoints(24);
  return joined(bow.map((at, k) => ({ at, colour, alpha: opacity(weight) * mix(0.3, 1, k / 24) })), 1.8 + 4 * weight);
}

// All segments as flat strips that face the camera: places and colours of their corners.
function strips(segments, view) {
  const [places, colours, triangles] = [[], [], []];
  segments.forEach(({ start, end, width }, k) => {
    for (const { at, colour, alpha } of [start, end]) {
      const towards = view.camera.position.clone().sub(at);
      const side = end.at.clone().sub(start.at).cross(towards).setLength(0.5 * width * view.project(at).metres);
      places.push(...at.clone().sub(side), ...at.clone().add(side));
      for (let twice = 0; twice < 2; twice++) colours.push(...colour, alpha);
    }
    triangles.push(...[0, 1, 2, 2, 1, 3].map((corner) => 4 * k + corner));
  });
  return { places, colours, triangles };
}
