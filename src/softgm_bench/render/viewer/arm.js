// The arm's skin: rings of vertices along a smooth curve through the nodes, with a picture along and around it.

const SIDES = 28;
const DOME = 6; // rings of the rounded tip
const TEXELS = { around: 128, along: 2048 };

class Arm {
  constructor(episode) {
    this.episode = episode;
    this.body = episode.elements * Math.max(1, Math.ceil(120 / episode.elements)) + 1;
    this.rings = this.body + DOME;
    this.geometry = new THREE.PlaneGeometry(1, 1, SIDES, this.rings - 1); // a grid, bent to a tube at every moment
    this.canvas = Object.assign(document.createElement("canvas"), { width: TEXELS.around, height: TEXELS.along });
    this.texture = Object.assign(new THREE.CanvasTexture(this.canvas), { colorSpace: THREE.SRGBColorSpace, anisotropy: 8 });
  }

  set(rod, reached) {
    const { elements } = this.episode;
    const { position, normal } = this.geometry.attributes;
    const curve = new CatmullRomCurve3(rod.map((node) => node.centre), false, "catmullrom");
    const centres = curve.getPoints(this.body - 1);
    for (let ring = 0; ring < this.rings; ring++) {
      const k = Math.min(ring, this.body - 1);
      const place = (k * elements) / (this.body - 1);
      const [a, b] = [rod[Math.floor(place)], rod[Math.min(Math.floor(place) + 1, elements)]];
      const tangent = centres[Math.min(k + 1, this.body - 1)].clone().sub(centres[Math.max(k - 1, 0)]).normalize();
      const first = mixed(a.first, b.first, place % 1).projectOnPlane(tangent).normalize();
      const second = tangent.clone().cross(first);
      const slope = ((ring - k) / DOME) * (Math.PI / 2);
      const radius = mix(a.radius, b.radius, place % 1);
      const centre = along(centres[k], tangent, 0.4 * radius * Math.sin(slope));
      for (let side = 0; side <= SIDES; side++) {
        const angle = (-2 * Math.PI * side) / SIDES; // this way round the skin faces outwards
        const radial = first.clone().multiplyScalar(Math.cos(angle)).addScaledVector(second, Math.sin(angle));
        const at = ring * (SIDES + 1) + side;
        position.setXYZ(at, ...along(centre, radial, radius * Math.cos(slope)));
        normal.setXYZ(at, ...radial.multiplyScalar(Math.cos(slope)).addScaledVector(tangent, Math.sin(slope)));
      }
    }
    position.needsUpdate = normal.needsUpdate = this.texture.needsUpdate = true;
    this.paint(rod, reached);
  }

  // From the base at the top: half gradual, half stepped colours, contacts, control points, the line of d1, the tip.
  paint(rod, reached) {
    const { agents, baseLength, elements } = this.episode;
    const context = this.canvas.getContext("2d");
    const [width, height] = [TEXELS.around, (TEXELS.along * (this.body - 1)) / (this.rings - 1)];
    if (!this.bare) {
      for (let row = 0; row < TEXELS.along; row++) {
        const place = Math.min(row / height, 0.9999);
        context.fillStyle = css(gradient(PAINT.arm, 0.5 * place + (0.5 * (Math.floor(place * (agents + 1)) + 0.5)) / (agents + 1)));
        context.fillRect(0, row, width, 1);
      }
      this.bare = context.getImageData(0, 0, width, TEXELS.along);
    }
    context.putImageData(this.bare, 0, 0);
    const touch = context.createLinearGradient(0, 0, 0, height);
    rod.forEach((node, i) => touch.addColorStop(i / elements, css(PAINT.touch, 0.75 * node.contact)));
    context.fillStyle = touch;
    context.fillRect(0, 0, width, height);
    const thick = (0.008 * height) / baseLength;
    context.fillStyle = css(PAINT.ring, 0.9);
    for (let agent = 1; agent <= agents; agent++) context.fillRect(0, (agent * height) / (agents + 1) - thick / 2, width, thick);
    context.fillStyle = css(PAINT.ring, 0.3);
    for (const left of [0, width - 1]) context.fillRect(left, 0, 1, height);
    context.fillStyle = css(reached ? PAINT.reached : PAINT.tip);
    context.fillRect(0, height, width, TEXELS.along - height);
  }
}
