// The camera: turned by mouse and touch, at first where the whole episode is in view.

class View {
  constructor(canvas, episode, changed) {
    const { azimuth, elevation, fov } = episode.camera;
    this.home = [(azimuth * Math.PI) / 180, (elevation * Math.PI) / 180];
    this.points = episode.extent;
    this.camera = new THREE.PerspectiveCamera(fov, 1, 0.03, 30);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { minDistance: 0.15, maxDistance: 12, maxPolarAngle: 2.8, zoomSpeed: 1.5 });
    this.controls.addEventListener("change", changed);
    this.controls.addEventListener("start", () => (this.untouched = false));
    canvas.addEventListener("dblclick", () => this.reset());
  }

  // Pixels; borders, where nothing of the default view is: top, right, bottom, left.
  resize(width, height, borders) {
    Object.assign(this, { width, height, borders });
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.untouched !== false) this.reset(...(this.angles ?? this.home));
  }

  // Look from a direction, radians, from the smallest distance at which every point lies between the borders.
  reset(...angles) {
    this.angles = angles.length ? angles : this.home;
    this.untouched = true;
    const [azimuth, elevation] = this.angles;
    const flat = Math.cos(elevation);
    const out = new Vector3(flat * Math.cos(azimuth), flat * Math.sin(azimuth), Math.sin(elevation));
    const right = new Vector3(-Math.sin(azimuth), Math.cos(azimuth), 0);
    const up = out.clone().cross(right);
    const [top, side, bottom, left] = this.borders;
    const tangent = Math.tan((this.camera.fov * Math.PI) / 360);
    // each border is a plane through the eye
    const span = (axis, free) => {
      const slope = (tangent * free) / this.height;
      const reach = (sign) => Math.max(...this.points.map((p) => p.dot(out) + (sign * p.dot(axis)) / slope));
      const [least, most] = [reach(-1), reach(1)];
      return { depth: (least + most) / 2, centre: ((most - least) / 2) * slope };
    };
    const x = span(right, this.width - left - side);
    const y = span(up, this.height - top - bottom);
    const middle = this.points.reduce((sum, p) => sum + p.dot(out) / this.points.length, 0);
    const distance = Math.max(0.3, Math.max(x.depth, y.depth) - middle);
    const pixel = (2 * tangent * distance) / this.height; // the free area's middle is not the picture's
    this.controls.target = out.clone().multiplyScalar(middle)
      .addScaledVector(right, x.centre + ((side - left) / 2) * pixel)
      .addScaledVector(up, y.centre + ((top - bottom) / 2) * pixel);
    this.camera.position.copy(along(this.controls.target, out, distance));
    this.controls.update();
  }

  zoom(factor) {
    this.untouched = false;
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
  }

  // Place in pixels from the upper left corner, and metres per pixel there (negative behind the camera).
  project(point) {
    const { x, y } = point.clone().project(this.camera);
    const depth = point.clone().applyMatrix4(this.camera.matrixWorldInverse).z;
    const metres = (-2 * depth * Math.tan((this.camera.fov * Math.PI) / 360)) / this.height;
    return { x: ((1 + x) / 2) * this.width, y: ((1 - y) / 2) * this.height, metres };
  }
}
