// The rod's skin: rings of vertices along a smooth curve through the nodes.

const SIDES = 28;
const DOME = 6; // rings of the rounded tip

// How many rings a rod of so many elements gets.
const ringsOf = (elements) => elements * Math.max(1, Math.ceil(120 / elements)) + 1 + DOME;

function catmullRom(a, b, c, d, t) {
  const part = (i) =>
    0.5 * (2 * b[i] + (c[i] - a[i]) * t + (2 * a[i] - 5 * b[i] + 4 * c[i] - d[i]) * t * t +
      (3 * b[i] - a[i] - 3 * c[i] + d[i]) * t * t * t);
  return [part(0), part(1), part(2)];
}

// Of elements to nodes: the mean of both neighbours.
function atNode(read, node, elements) {
  return mixed(read(Math.max(node - 1, 0)), read(Math.min(node, elements - 1)), 0.5);
}

// Rows of a texture, RGBA each: centre and radius; first normal and arc length 0 to 1; second normal and contact;
// tangent and the sine of the skin's slope.
function skin(rod, elements) {
  const rings = ringsOf(elements);
  const out = new Float32Array(4 * 4 * rings);
  const pieces = (rings - 1 - DOME) / elements;
  const node = (i) => vec(rod.position, 3 * clamp(i, 0, elements));
  const normal = (i) => atNode((e) => vec(rod.normal, 3 * e), i, elements);
  const radius = (i) => 0.5 * (rod.radius[Math.max(i - 1, 0)] + rod.radius[Math.min(i, elements - 1)]);
  const put = (ring, centre, r, first, s, contact, tangent, slope) => {
    const e1 = unit(without(first, tangent));
    const e2 = cross(tangent, e1);
    const rows = [[...centre, r], [...e1, s], [...e2, contact], [...tangent, slope]];
    rows.forEach((row, k) => out.set(row, 4 * (k * rings + ring)));
  };
  const body = rings - DOME;
  const centres = [];
  for (let ring = 0; ring < body; ring++) {
    const i = Math.min(Math.floor(ring / pieces), elements - 1);
    const t = ring / pieces - i;
    // beyond the ends the rod goes on straight
    const before = i > 0 ? node(i - 1) : sub(scaled(node(0), 2), node(1));
    const after = i + 2 <= elements ? node(i + 2) : sub(scaled(node(elements), 2), node(elements - 1));
    centres.push(catmullRom(before, node(i), node(i + 1), after, t));
  }
  let tangent;
  for (let ring = 0; ring < body; ring++) {
    const i = Math.min(Math.floor(ring / pieces), elements - 1);
    const t = ring / pieces - i;
    tangent = unit(sub(centres[Math.min(ring + 1, body - 1)], centres[Math.max(ring - 1, 0)]));
    const contact = mix(rod.contact[i], rod.contact[i + 1], t);
    put(ring, centres[ring], mix(radius(i), radius(i + 1), t), mixed(normal(i), normal(i + 1), t), ring / (body - 1), contact, tangent, 0);
  }
  const [end, r] = [centres[body - 1], radius(elements)];
  for (let k = 1; k <= DOME; k++) {
    const angle = (k / DOME) * (Math.PI / 2);
    const centre = along(end, tangent, 0.4 * r * Math.sin(angle));
    put(body - 1 + k, centre, r * Math.cos(angle), normal(elements), 1 + k, rod.contact[elements], tangent, Math.sin(angle));
  }
  return { rings, texture: out };
}

// The frame at an agent's node: centre, radius, first and second normal, tangent.
function frameAt(rod, node, elements) {
  const before = vec(rod.position, 3 * Math.max(node - 1, 0));
  const after = vec(rod.position, 3 * Math.min(node + 1, elements));
  const tangent = unit(sub(after, before));
  const first = unit(without(atNode((e) => vec(rod.normal, 3 * e), node, elements), tangent));
  const radius = 0.5 * (rod.radius[Math.max(node - 1, 0)] + rod.radius[Math.min(node, elements - 1)]);
  return { centre: vec(rod.position, 3 * node), radius, first, second: cross(tangent, first), tangent };
}
