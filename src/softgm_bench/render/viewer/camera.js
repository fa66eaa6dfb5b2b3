// A camera that turns about a point, and how mouse, touch and buttons move it.

const NEAR = 0.03;
const FAR = 30;

class Camera {
  // points: what the default view shows, as large as it fits between the borders (pixels: top, right, bottom, left).
  constructor(settings, points) {
    this.settings = settings;
    this.points = points;
    this.fov = (settings.fov * Math.PI) / 180;
    this.borders = [0, 0, 0, 0];
    this.width = this.height = 1;
    this.untouched = true;
    this.reset();
  }

  resize(width, height, borders) {
    [this.width, this.height, this.borders] = [width, height, borders];
    if (this.untouched) this.reset(this.azimuth, this.elevation);
  }

  reset(azimuth = (this.settings.azimuth * Math.PI) / 180, elevation = (this.settings.elevation * Math.PI) / 180) {
    [this.azimuth, this.elevation] = [azimuth, elevation];
    this.untouched = true;
    this.fit();
  }

  get out() {
    const c = Math.cos(this.elevation);
    return [c * Math.cos(this.azimuth), c * Math.sin(this.azimuth), Math.sin(this.elevation)];
  }

  get right() {
    return [-Math.sin(this.azimuth), Math.cos(this.azimuth), 0];
  }

  get up() {
    return cross(this.out, this.right);
  }

  get eye() {
    return along(this.centre, this.out, this.distance);
  }

  get viewProjection() {
    const view = lookAt(this.eye, this.centre, this.up);
    return product(perspective(this.fov, this.width / this.height, NEAR, FAR), view);
  }

  // Pixels and depth of a point.
  project(point) {
    const local = sub(point, this.eye);
    const depth = -dot(local, this.out);
    const scale = this.height / 2 / Math.tan(this.fov / 2) / Math.max(depth, NEAR);
    return [this.width / 2 + scale * dot(local, this.right), this.height / 2 - scale * dot(local, this.up), depth, scale];
  }

  fit() {
    const { right, up, out } = this;
    const [top, side, bottom, left] = this.borders;
    const tangent = Math.tan(this.fov / 2);
    const wide = (tangent * (this.width - left - side)) / this.height;
    const high = (tangent * (this.height - top - bottom)) / this.height;
    const local = this.points.map((p) => [dot(p, right), dot(p, up), dot(p, out)]);
    // the nearest camera from which every point lies within the angles: each border is a plane through the eye
    const span = (axis, slope) => {
      let [least, most] = [-Infinity, -Infinity];
      for (const p of local) {
        least = Math.max(least, p[2] - p[axis] / slope);
        most = Math.max(most, p[2] + p[axis] / slope);
      }
      return { depth: (least + most) / 2, centre: ((most - least) / 2) * slope };
    };
    const [x, y] = [span(0, wide), span(1, high)];
    const depth = Math.max(x.depth, y.depth);
    const middle = local.reduce((sum, p) => sum + p[2], 0) / local.length;
    this.distance = Math.max(0.3, depth - middle);
    // the free area's middle is not the picture's
    const pixel = (2 * tangent * this.distance) / this.height;
    const shiftX = ((side - left) / 2) * pixel;
    const shiftY = ((top - bottom) / 2) * pixel;
    const at = add(scaled(right, x.centre + shiftX), scaled(up, y.centre + shiftY));
    this.centre = along(at, out, middle);
  }

  orbit(dx, dy) {
    this.untouched = false;
    this.azimuth -= dx * 0.007;
    this.elevation = clamp(this.elevation + dy * 0.007, -1.2, 1.55);
  }

  pan(dx, dy) {
    this.untouched = false;
    const scale = (2 * this.distance * Math.tan(this.fov / 2)) / this.height;
    this.centre = along(along(this.centre, this.right, -dx * scale), this.up, dy * scale);
  }

  zoom(factor) {
    this.untouched = false;
    this.distance = clamp(this.distance * factor, 0.15, 12);
  }
}

function listenForCamera(canvas, camera, changed) {
  const pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, gap: Math.hypot(a.x - b.x, a.y - b.y) };
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const old = pointers.get(event.pointerId);
    if (!old) return;
    const now = { x: event.clientX, y: event.clientY };
    if (pointers.size === 1) {
      const panning = event.shiftKey || event.buttons & 6;
      (panning ? camera.pan : camera.orbit).call(camera, now.x - old.x, now.y - old.y);
      pointers.set(event.pointerId, now);
    } else {
      const before = spread();
      pointers.set(event.pointerId, now);
      const after = spread();
      camera.pan(after.x - before.x, after.y - before.y);
      camera.zoom(before.gap / Math.max(after.gap, 1));
    }
    changed();
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", () => {
    camera.reset();
    changed();
  });
  canvas.addEventListener(
    "wheel",
    (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      camera.zoom(Math.exp(clamp(event.deltaY * lines, -200, 200) * 0.0015));
      changed();
    },
    { passive: false },
  );
}
