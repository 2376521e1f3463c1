// Vectors [x, y, z] and 4 x 4 matrices, column by column as WebGL takes them.

const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const times = (a, factor) => [a[0] * factor, a[1] * factor, a[2] * factor];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
const length = (a) => Math.sqrt(dot(a, a));
const unit = (a) => times(a, 1 / (length(a) || 1));
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const radians = (degrees) => degrees * Math.PI / 180;
const degrees = (angle) => angle * 180 / Math.PI;

/** Two unit vectors across a unit vector, and across each other. */
function across(way) {
  const first = unit(cross(Math.abs(way[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], way));
  return [first, cross(way, first)];
}

/** a b */
function product(a, b) {
  const made = new Float32Array(16);
  for (let column = 0; column < 4; column++) {
    for (let row = 0; row < 4; row++) {
      for (let k = 0; k < 4; k++) made[4 * column + row] += a[4 * k + row] * b[4 * column + k];
    }
  }
  return made;
}

/** From the object's frame into one at `place` whose axes are right, up and back. */
function lookingFrom(place, right, up, back) {
  const axes = [right, up, back];
  const made = new Float32Array(16);
  for (let row = 0; row < 3; row++) {
    for (let k = 0; k < 3; k++) made[4 * k + row] = axes[row][k];
    made[12 + row] = -dot(axes[row], place);
  }
  made[15] = 1;
  return made;
}

/** Clip coordinates of a frame whose z is back; the halves are those of the picture at distance 1. */
function perspective(halfWidth, halfHeight, near, far) {
  const made = new Float32Array(16);
  made[0] = 1 / halfWidth;
  made[5] = 1 / halfHeight;
  made[10] = -(far + near) / (far - near);
  made[11] = -1;
  made[14] = -2 * far * near / (far - near);
  return made;
}

/** The same without perspective. */
function orthographic(halfWidth, halfHeight, near, far) {
  const made = new Float32Array(16);
  made[0] = 1 / halfWidth;
  made[5] = 1 / halfHeight;
  made[10] = -2 / (far - near);
  made[14] = -(far + near) / (far - near);
  made[15] = 1;
  return made;
}

/** Point k of a sequence that fills the unit square evenly; the first is its middle (Roberts' R2). */
function evenly(k) {
  return [(0.5 + k * 0.7548776662466927) % 1, (0.5 + k * 0.5698402909980532) % 1];
}

/** A point of the unit disk, of one of the unit square; the square's middle is the disk's. */
function onDisk([x, y]) {
  const a = 2 * x - 1, b = 2 * y - 1;
  if (a === 0 && b === 0) return [0, 0];
  const [radius, angle] = Math.abs(a) > Math.abs(b)
    ? [a, Math.PI / 4 * (b / a)]
    : [b, Math.PI / 2 - Math.PI / 4 * (a / b)];
  return [radius * Math.cos(angle), radius * Math.sin(angle)];
}
