// The material of a triangle, in numbers: what is fitted, and how well it is known.

const NORMAL_COVERAGE = 1.959964;  // standard deviations of 95 % of a normal distribution

function lobe(nl, nv, nh, alpha) {
  const square = alpha * alpha;
  const t = nh * nh * (square - 1) + 1;
  const a = Math.sqrt(square + (1 - square) * nl * nl), b = Math.sqrt(square + (1 - square) * nv * nv);
  return 0.5 * square / (Math.PI * t * t * (nl * b + nv * a));
}

/** Relative standard uncertainty that a code stands for; null for none. */
const uncertaintyOf = (code) => code ? 1e-4 * 1e5 ** ((code - 1) / 254) : null;

function normalOf(arrays, triangle) {
  const [x, y] = [0, 1].map((k) => arrays.normals[2 * triangle + k] / 65535 * 2 - 1);
  const z = 1 - Math.abs(x) - Math.abs(y);
  if (z >= 0) return unit([x, y, z]);
  return unit([(1 - Math.abs(y)) * (x >= 0 ? 1 : -1), (1 - Math.abs(x)) * (y >= 0 ? 1 : -1), z]);
}

/** What was fitted to a triangle; null where too few samples were. */
function materialOf(arrays, triangle) {
  const alpha = half(arrays.gloss[2 * triangle]);
  if (alpha === 0) return null;
  const three = (array) => [0, 1, 2].map((k) => half(array[3 * triangle + k]));
  const codes = [0, 1, 2, 3].map((k) => uncertaintyOf(arrays.uncertainty[4 * triangle + k]));
  return {
    normal: normalOf(arrays, triangle), kd: three(arrays.kd), ks: three(arrays.ks), alpha,
    residual: ABOUT.texels ? null : half(arrays.gloss[2 * triangle + 1]),
    uncertainty: { kd: codes[0], ks: codes[1], normal: codes[2], roughness: codes[3] },
  };
}

/** Reflectance, 1/sr, of a light that stands `light` degrees from the normal in the plane of the normal and the
 * view, positive on the side where the view is mirrored; the view stands `view` degrees from the normal. */
function reflectance(kd, ks, alpha, view, light) {
  const nl = Math.cos(radians(light)), nv = Math.cos(radians(view));
  const nh = Math.cos(radians((light - view) / 2));
  return kd + ks * lobe(nl, nv, nh, alpha);
}

const mean = (values) => values.reduce((sum, value) => sum + value, 0) / values.length;

/** Lower and upper end of the channels' mean where kd, ks and roughness are at the ends of their 95 % intervals.
 * What they have in common is left out, which makes it wider. */
function reflectanceBounds(material, view, light) {
  const far = (value, u, side) => value * Math.exp(side * NORMAL_COVERAGE * Math.min(u ?? 0, 5));
  const { kd, ks, roughness } = material.uncertainty;
  const ends = [-1, 1].map((side) => [-1, 1].map((turn) => reflectance(
    far(mean(material.kd), kd, side), far(mean(material.ks), ks, side),
    clamp(far(material.alpha, roughness, turn), 0.02, 1), view, light,
  )));
  return [Math.min(...ends[0]), Math.max(...ends[1])];
}
