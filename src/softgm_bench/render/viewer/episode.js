// The episode that the page carries, and its state at any time between two steps.

const { CatmullRomCurve3, Color, Vector3 } = THREE;
const ARRAYS = { uint8: Uint8Array, int8: Int8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };
const by = (id) => document.getElementById(id);
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const mix = (a, b, t) => a + (b - a) * t;
const count = (n) => Array.from({ length: n }, (_, k) => k);
const vec = (array, at = 0) => new Vector3().fromArray(array, at);
const along = (start, direction, distance) => start.clone().addScaledVector(direction, distance);

// Every packed array in a tree of plain values becomes a typed array.
async function unpacked(tree) {
  if (!tree || typeof tree !== "object" || Array.isArray(tree)) return tree;
  if (!("data" in tree)) {
    return Object.fromEntries(await Promise.all(Object.entries(tree).map(async ([name, inner]) => [name, await unpacked(inner)])));
  }
  const bytes = Uint8Array.from(atob(tree.data), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const stored = new ARRAYS[tree.type](await new Response(stream).arrayBuffer());
  return tree.scale === 1 && tree.offset === 0 ? stored : Float32Array.from(stored, (value) => tree.offset + tree.scale * value);
}

async function readEpisode() {
  const episode = await unpacked(JSON.parse(by("episode").textContent));
  const { arrays, nodes, slots, steps } = episode;
  const bits = (bytes) => (step, index) => (bytes[(step * bytes.length) / (steps + 1) + (index >> 3)] >> (index & 7)) & 1;
  const [contact, edge] = [bits(arrays.contact), bits(arrays.edge)];
  const target = vec(episode.target);
  // through every recorded position of a node: smooth, and exact at every step
  const courses = count(nodes).map((node) => new CatmullRomCurve3(
    count(steps + 1).map((step) => vec(arrays.position, 3 * (step * nodes + node))), false, "catmullrom",
  ));
  // sums over the steps before; the state of step 0 has earned nothing
  const summed = (row, sum = 0) => [0, ...Array.from(row, (value) => (sum += value))];
  return {
    ...arrays, ...episode, target, contact, courses,
    agents: episode.agentNodes.length,
    elements: nodes - 1,
    extent: episode.extent.map((point) => vec(point)),
    cylinders: episode.cylinders.map((c) => ({ start: vec(c), axis: vec(c, 3), length: c[6], radius: c[7] })),
    slots: slots.map((slot) => ({ ...slot, centre: vec(slot.centre), axis: vec(slot.axis) })),
    edge: (step, agent, slot) => edge(step, agent * slots.length + slot),
    distance: courses[nodes - 1].points.map((tip) => tip.distanceTo(target)),
    touching: count(steps + 1).map((step) => count(nodes).reduce((sum, node) => sum + contact(step, node), 0)),
    returned: summed(arrays.reward),
    earned: episode.terms.map((_, k) => summed(arrays.terms.subarray(k * steps, (k + 1) * steps))),
  };
}

// How far a cylinder that moves is from where it began, at a time.
function shiftAt(episode, cylinder, time) {
  const { cylinders, shift, steps } = episode;
  if (!shift) return new Vector3();
  const step = Math.min(Math.floor(time), steps);
  const at = (k) => vec(shift, 3 * (k * cylinders.length + cylinder));
  return at(step).lerp(at(Math.min(step + 1, steps)), time - step);
}

// A discovered bin where its cylinder is at a time.
const binAt = (episode, slot, time) => ({ ...slot, centre: shiftAt(episode, slot.cylinder, time).add(slot.centre) });

// Weights of one stage at a step, averaged over the layers and heads that are not chosen (null: all of them).
function weightsAt(stage, step, layer, head) {
  const row = Math.min(Math.floor(step / stage.every), stage.begin.length - 2);
  const all = stage.layers * stage.heads;
  const matches = (wanted, index) => wanted === null || wanted === index;
  const chosen = count(all).filter((k) => matches(layer, Math.floor(k / stage.heads)) && matches(head, k % stage.heads));
  return count(stage.begin[row + 1] - stage.begin[row]).map((n) => {
    const k = stage.begin[row] + n;
    const weight = chosen.reduce((sum, which) => sum + stage.weight[k * all + which], 0) / chosen.length;
    return { receiver: stage.receiver[k], source: stage.source[k], weight };
  });
}

// Every node at a time: centre, tangent, first and second normal, radius and how much it is in contact, 0 to 1.
function rodAt(episode, time) {
  const { elements, steps } = episode;
  const step = Math.min(Math.floor(time), steps);
  const [next, part] = [Math.min(step + 1, steps), time - step];
  const centres = episode.courses.map((course) => course.getPoint(time / steps));
  return centres.map((centre, i) => {
    const sides = [Math.max(i - 1, 0), Math.min(i, elements - 1)]; // the elements that a node joins
    const at = (k, read) => read(k * elements + sides[0], k * elements + sides[1]);
    const radius = (k) => at(k, (a, b) => 0.5 * (episode.radius[a] + episode.radius[b]));
    const normal = (k) => at(k, (a, b) => vec(episode.normal, 3 * a).add(vec(episode.normal, 3 * b)));
    const tangent = centres[Math.min(i + 1, elements)].clone().sub(centres[Math.max(i - 1, 0)]).normalize();
    const first = normal(step).lerp(normal(next), part).projectOnPlane(tangent).normalize();
    return {
      centre, tangent, first, second: tangent.clone().cross(first),
      radius: mix(radius(step), radius(next), part),
      contact: mix(episode.contact(step, i), episode.contact(next, i), part),
    };
  });
}
