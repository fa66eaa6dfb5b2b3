// The scene with three.js. What is see-through is drawn after the rest, in the order of these numbers.

const ORDER = { floor: 0, behind: 1, ghost: 2, arm: 3, depth: 4, clear: 5, lines: 6, shell: 8, seen: 9 };
const UP = new Vector3(0, 0, 1);
// nine even samples instead of five at random: soft shadows without grain
THREE.ShaderChunk.shadowmap_pars_fragment = THREE.ShaderChunk.shadowmap_pars_fragment.replace(
  /shadow = \([^;]*\) \* 0\.2;/,
  `shadow = 0.0;
  for (int i = 0; i < 9; i++)
    shadow += texture(shadowMap, vec3(shadowCoord.xy + vec2(i % 3 - 1, i / 3 - 1) * radius, shadowCoord.z)) / 9.0;`,
);

const patched = (material, place, text) => Object.assign(material, {
  onBeforeCompile: (shader) => (shader.fragmentShader = shader.fragmentShader.replace(place, text)),
});
// See-through things throw a fourth of a shadow: one texel in four, which the soft lookup blurs.
const quarterShadow = patched(new THREE.MeshDepthMaterial(), "void main() {", `void main() {
  if ((int(gl_FragCoord.x) & 1) + (int(gl_FragCoord.y) & 1) > 0) discard;`);
// A sphere that is seen at its rim rather than in its middle.
const shellMaterial = (more) => patched(
  new THREE.MeshStandardMaterial({ transparent: true, depthWrite: false, roughness: 0.5, ...more }), "#include <opaque_fragment>",
  "diffuseColor.a *= 0.45 + 1.5 * pow(1.0 - abs(dot(normal, normalize(vViewPosition))), 1.6);\n#include <opaque_fragment>",
);

// Lines every 10 cm and every 50 cm that fade with the distance from the middle.
const GRID = {
  vertexShader: `
    varying vec2 place;
    void main() {
      place = position.xy;
      gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    }`,
  fragmentShader: `
    varying vec2 place;
    uniform vec3 colour, middle;
    uniform float reach, lit;
    float ruled(vec2 p) {
      vec2 w = fwidth(p), d = abs(fract(p - 0.5) - 0.5) / max(w, 1e-5);
      return (1.0 - min(min(d.x, d.y), 1.0)) * clamp(1.0 - 3.0 * max(w.x, w.y), 0.0, 1.0);
    }
    void main() {
      float near = 1.0 - smoothstep(0.55, 1.7, length(place - middle.xy) / reach);
      float lines = 0.45 * ruled(place * 10.0) + 0.35 * ruled(place * 2.0);
      gl_FragColor = vec4(colour, max(lines, lit) * near);
      #include <colorspace_fragment>
    }`,
};

class ArmScene {
  constructor(canvas, episode, view) {
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, powerPreference: "high-performance" });
    this.renderer.shadowMap.enabled = true;
    Object.assign(this, { episode, view, scene: new THREE.Scene(), arm: new Arm(episode) });
    const box = new THREE.Box3().setFromPoints(episode.extent);
    this.centre = box.getCenter(new Vector3());
    this.reach = box.getSize(new Vector3()).length() / 2;
    this.lights();
    this.floor();
    this.makeArm();
    this.obstacles();
    this.target();
    const arrow = new THREE.MeshStandardMaterial({ roughness: 0.6 });
    this.shafts = this.instances(new THREE.CylinderGeometry(1, 1, 1, 16), arrow, episode.agents + 1);
    this.heads = this.instances(new THREE.ConeGeometry(1, 1, 24), arrow, episode.agents + 1);
    const ribbon = { vertexColors: true, transparent: true, depthWrite: false, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetUnits: -3000 };
    this.ribbons = new THREE.BufferGeometry();
    this.add(this.ribbons, new THREE.MeshBasicMaterial({ ...ribbon, opacity: 0.3, depthFunc: THREE.GreaterDepth }), ORDER.lines);
    this.add(this.ribbons, new THREE.MeshBasicMaterial(ribbon), ORDER.lines + 1);
  }

  add(geometry, material, order = 0, shadow = false) {
    const mesh = geometry.isObject3D ? geometry : new THREE.Mesh(geometry, material);
    Object.assign(mesh, { renderOrder: order, castShadow: shadow, receiveShadow: true, frustumCulled: false });
    this.scene.add(mesh);
    return mesh;
  }

  instances(geometry, material, most, order = 0) {
    const mesh = new THREE.InstancedMesh(geometry, material, Math.max(most, 1));
    mesh.setColorAt(0, new Color());
    return this.add(mesh, material, order);
  }

  // From the upper left, before the scene, as the default camera sees it; a little from the camera; the sky's.
  lights() {
    const sun = Object.assign(new THREE.DirectionalLight(0xffffff, 0.95 * Math.PI), { castShadow: true });
    const azimuth = (this.episode.camera.azimuth * Math.PI) / 180;
    const direction = new Vector3(0.62, -0.35, 1).normalize().applyAxisAngle(UP, azimuth);
    sun.position.copy(along(this.centre, direction, 2 * this.reach));
    sun.target.position.copy(this.centre);
    const size = 1.05 * this.reach;
    Object.assign(sun.shadow.camera, { left: -size, right: size, bottom: -size, top: size, near: 0.1, far: 4 * this.reach });
    Object.assign(sun.shadow, { normalBias: 0.006, bias: -0.0006, radius: 1.4 });
    sun.shadow.mapSize.set(2048, 2048);
    this.sky = new THREE.HemisphereLight(0, 0, Math.PI);
    this.sky.position.copy(UP);
    this.view.camera.add(new THREE.DirectionalLight(0xffffff, 0.18 * Math.PI));
    this.scene.add(sun, sun.target, this.sky, this.view.camera);
  }

  floor() {
    const plane = new THREE.PlaneGeometry(24, 24).translate(0, 0, this.episode.floor);
    this.shade = new THREE.ShadowMaterial({ depthWrite: false });
    const uniforms = { colour: { value: new Color() }, middle: { value: this.centre }, reach: { value: this.reach }, lit: { value: 0 } };
    this.grid = new THREE.ShaderMaterial({ ...GRID, uniforms, transparent: true, depthWrite: false });
    for (const material of [this.grid, this.shade]) this.add(plane, material, ORDER.floor);
  }

  makeArm() {
    const { geometry, texture } = this.arm;
    this.ghost = new THREE.MeshBasicMaterial({ transparent: true, opacity: 0.22, depthWrite: false, depthFunc: THREE.GreaterDepth });
    this.add(geometry, this.ghost, ORDER.ghost);
    this.add(geometry, new THREE.MeshStandardMaterial({ map: texture, transparent: true, roughness: 0.45 }), ORDER.arm, true);
    const { baseRadius, courses, floor } = this.episode;
    const base = courses[0].points[0];
    const height = base.z + 0.004 - floor;
    const pedestal = new THREE.CylinderGeometry(1.1 * baseRadius, 1.25 * baseRadius, height, 48).rotateX(Math.PI / 2);
    pedestal.translate(base.x, base.y, floor + height / 2);
    this.add(pedestal, new THREE.MeshStandardMaterial({ color: PAINT.pedestal, roughness: 0.5 }), 0, true);
  }

  obstacles() {
    const { cylinders, shift, slots } = this.episode;
    const material = { roughness: 0.55 };
    const bins = new THREE.CylinderGeometry(1, 1, 1, 40);
    this.bins = this.instances(bins, new THREE.MeshStandardMaterial(material), slots.length, ORDER.clear);
    this.depths = [this.instances(bins, new THREE.MeshBasicMaterial({ colorWrite: false, transparent: true }), slots.length, ORDER.depth)];
    this.depths[0].instanceMatrix = this.bins.instanceMatrix;
    this.posts = [];
    if (!cylinders.length) return;
    const capsules = cylinders.map(({ start, axis, length, radius }) =>
      new THREE.CapsuleGeometry(radius, length, 10, 40).applyMatrix4(placed(start, axis, length, 1, 1)));
    const shapes = shift ? capsules : [THREE.mergeGeometries(capsules)]; // what moves, moves by itself
    const solid = new THREE.MeshStandardMaterial({ ...material, color: PAINT.column });
    const depth = new THREE.MeshBasicMaterial({ colorWrite: false, transparent: true });
    this.posts = shapes.map((shape) => this.add(shape, solid, ORDER.clear, true));
    this.depths.push(...shapes.map((shape) => this.add(shape, depth, ORDER.depth)));
  }

  setPosts(time) {
    if (!this.episode.shift) return;
    this.posts.forEach((post, c) => {
      for (const mesh of [post, this.depths[1 + c]]) mesh.position.copy(shiftAt(this.episode, c, time));
    });
  }

  target() {
    const { successRadius, target } = this.episode;
    const sphere = (radius) => new THREE.SphereGeometry(radius, 40, 24).translate(...target);
    this.core = this.add(sphere(0.3 * successRadius), new THREE.MeshStandardMaterial({ emissiveIntensity: 0.35 }), 0, true);
    this.shell = this.add(sphere(successRadius), shellMaterial({}), ORDER.shell);
    this.behind = this.add(sphere(successRadius), shellMaterial({ depthFunc: THREE.GreaterDepth }));
  }

  draw(time, rod, segments, theme, show, pixels) {
    const reached = this.episode.success && time >= this.episode.steps;
    this.renderer.setPixelRatio(pixels);
    this.renderer.setSize(this.view.width, this.view.height, false);
    this.setTheme(theme);
    this.setClear(show.clear);
    this.arm.set(rod, reached);
    this.setPosts(time);
    this.setBins(time);
    this.setTarget(reached, show.clear);
    this.setArrows(time, rod, theme, show.actions);
    const { places, colours, triangles } = strips(segments, this.view);
    this.ribbons.dispose(); // its size has changed
    this.ribbons.setAttribute("position", new THREE.Float32BufferAttribute(places, 3));
    this.ribbons.setAttribute("color", new THREE.Float32BufferAttribute(colours, 4));
    this.ribbons.setIndex(triangles);
    this.renderer.render(this.scene, this.view.camera);
  }

  setTheme(theme) {
    this.renderer.setClearColor(theme.back);
    const [sky, ground] = theme.dark ? [[0.3, 0.34, 0.42], [0.1, 0.1, 0.12]] : [[0.5, 0.53, 0.58], [0.24, 0.23, 0.23]];
    this.sky.color.setRGB(...sky);
    this.sky.groundColor.setRGB(...ground);
    this.shade.opacity = theme.dark ? 0.5 : 0.26;
    this.grid.uniforms.colour.value.lerpColors(theme.line, theme.soft, theme.dark ? 0.4 : 0.5);
    this.grid.uniforms.lit.value = theme.dark ? 0.09 : 0;
    this.ghost.color.lerpColors(PAINT.arm[1], theme.back, 0.2);
  }

  // Of see-through obstacles only the nearest surface is drawn: their depth comes first.
  setClear(clear) {
    if (this.clear === clear) return;
    this.clear = clear;
    for (const depth of this.depths) depth.visible = clear;
    for (const mesh of [this.bins, ...this.posts]) {
      const { material } = mesh;
      Object.assign(material, { transparent: clear, opacity: !clear ? 1 : mesh === this.bins ? 0.8 : 0.3, needsUpdate: true });
      mesh.customDepthMaterial = clear ? quarterShadow : undefined;
    }
  }

  // Discovered bins: bright at first, then turquoise, paler as long as no agent senses them.
  setBins(time) {
    const { agents, edge, slots, steps } = this.episode;
    let shown = 0;
    slots.forEach((slot, index) => {
      if (slot.step > time) return;
      const sensed = count(agents).some((agent) => edge(Math.min(Math.floor(time), steps), agent, index));
      const flash = Math.exp(-(time - slot.step) / 2);
      const half = 0.93 * slot.half;
      const radius = slot.radius * (1.03 + 0.14 * flash);
      const { centre } = binAt(this.episode, slot, time);
      this.bins.setMatrixAt(shown, placed(along(centre, slot.axis, -half), slot.axis, 2 * half, radius));
      const colour = mixed(PAINT.column, PAINT.discovered, sensed ? 1 : 0.72).lerp(PAINT.new, flash);
      this.bins.setColorAt(shown++, colour.multiplyScalar(1 + 0.2 * flash));
    });
    this.depths[0].count = this.bins.count = shown;
    this.bins.instanceMatrix.needsUpdate = this.bins.instanceColor.needsUpdate = true;
  }

  setTarget(reached, clear) {
    const colour = reached ? PAINT.reached : PAINT.target;
    for (const { material } of [this.core, this.shell, this.behind]) material.emissive = material.color = colour;
    this.shell.material.opacity = reached ? 0.5 : 0.26;
    this.behind.material.opacity = this.shell.material.opacity * (clear ? 0.8 : 0.4);
    this.behind.renderOrder = clear ? ORDER.seen : ORDER.behind; // with solid obstacles, not through the arm
    this.shell.material.emissiveIntensity = this.behind.material.emissiveIntensity = reached ? 0.35 : 0.1;
  }

  // A couple m turns the rod's tangent towards m x d3: arrows show where each section bends to; one is a tip force's.
  setArrows(time, rod, theme, couples) {
    const { action, agentNodes, agents, force, steps } = this.episode;
    const row = Math.min(Math.floor(time), steps - 1);
    this.shafts.count = 0;
    if (couples) agentNodes.forEach((index, agent) => {
      const node = rod[index];
      const [m1, m2] = [0, 1].map((k) => action[2 * (row * agents + agent) + k]);
      const turn = node.first.clone().multiplyScalar(m1).addScaledVector(node.second, m2).cross(node.tangent);
      const direction = turn.clone().normalize();
      this.arrow(along(node.centre, direction, node.radius), direction, 0.13 * turn.length(), mixed(agentColour(agent, agents), theme.text, 0.35));
    });
    if (force) {
      const forces = count(steps).map((k) => vec(force, 3 * k));
      const strongest = Math.max(1e-12, ...forces.map((f) => f.length()));
      const size = (0.18 * forces[row].length()) / strongest;
      this.arrow(rod[rod.length - 1].centre, forces[row].normalize(), size, theme.touching);
    }
    this.heads.count = this.shafts.count;
    for (const mesh of [this.shafts, this.heads]) mesh.instanceMatrix.needsUpdate = mesh.instanceColor.needsUpdate = true;
  }

  arrow(start, direction, size, colour) {
    if (size < 0.012) return;
    const head = Math.min(0.035, 0.6 * size);
    const k = this.shafts.count++;
    this.shafts.setMatrixAt(k, placed(start, direction, size - head, 0.0045));
    this.heads.setMatrixAt(k, placed(along(start, direction, size - head), direction, head, 0.013));
    for (const mesh of [this.shafts, this.heads]) mesh.setColorAt(k, colour);
  }
}

// From a thing of length and radius 1 about the origin, along y, to one that begins at a point.
function placed(start, axis, length, radius, stretch = length) {
  const turn = new THREE.Quaternion().setFromUnitVectors(new Vector3(0, 1, 0), axis);
  return new THREE.Matrix4().compose(along(start, axis, length / 2), turn, new Vector3(radius, stretch, radius));
}
