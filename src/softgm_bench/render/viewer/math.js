// Vectors are arrays of three numbers; matrices are columns of four, as WebGL wants them.

const vec = (array, at) => [array[at], array[at + 1], array[at + 2]];
const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const scaled = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
const along = (a, direction, s) => [a[0] + direction[0] * s, a[1] + direction[1] * s, a[2] + direction[2] * s];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.hypot(a[0], a[1], a[2]);
const unit = (a) => scaled(a, 1 / (length(a) || 1));
const mix = (a, b, t) => a + (b - a) * t;
const mixed = (a, b, t) => [mix(a[0], b[0], t), mix(a[1], b[1], t), mix(a[2], b[2], t)];
const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
const without = (a, direction) => along(a, direction, -dot(a, direction));

function perspective(fov, aspect, near, far) {
  const f = 1 / Math.tan(fov / 2);
  const d = 1 / (near - far);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (near + far) * d, -1, 0, 0, 2 * near * far * d, 0];
}

function orthographic(halfWidth, near, far) {
  const d = 1 / (near - far);
  return [1 / halfWidth, 0, 0, 0, 0, 1 / halfWidth, 0, 0, 0, 0, 2 * d, 0, 0, 0, (near + far) * d, 1];
}

function lookAt(eye, target, up) {
  const back = unit(sub(eye, target));
  const right = unit(cross(up, back));
  const top = cross(back, right);
  const row = (i) => [right[i], top[i], back[i], 0];
  return [...row(0), ...row(1), ...row(2), -dot(right, eye), -dot(top, eye), -dot(back, eye), 1];
}

function product(a, b) {
  const out = new Array(16).fill(0);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      for (let k = 0; k < 4; k++) out[4 * column + row] += a[4 * k + row] * b[4 * column + k];
    }
  }
  return out;
}

// Homogeneous image of a point.
function transformed(m, p) {
  const row = (i) => m[i] * p[0] + m[4 + i] * p[1] + m[8 + i] * p[2] + m[12 + i];
  return [row(0), row(1), row(2), row(3)];
}
