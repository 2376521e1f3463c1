// Lengths between two places of the surface, with their uncertainties (JCGM 100:2008, independent parts).

const COVERAGE = 2;
const LEAST_SLANT = 0.1;

/** Standard uncertainties of one end along any direction: of the scan, of the pixel that was clicked, of numbers
 * that are written short. `cosine` is that between surface and view. */
function partsOfEnd(about, camera, shorter_px, place, cosine) {
  const { back, place: eye } = axesOf(camera), depth = dot(minus(eye, place), back);
  const pixel = 2 * halfFieldOf(camera) * depth / shorter_px / Math.max(Math.abs(cosine), LEAST_SLANT);
  return { scan: (about.scan_noise_um ?? 0) / 1000, pixel: pixel / Math.sqrt(12), written: about.step_mm / Math.sqrt(12) };
}

/** A length, its standard uncertainty, and the parts of that, all in mm (px of pictures), from both ends. */
function measuredLength(about, [one, other]) {
  const parts = {};
  for (const name of ["scan", "pixel", "written"]) parts[name] = Math.hypot(one.parts[name], other.parts[name]);
  if (about.picture_px) parts.scan = parts.written = 0;
  return { size: length(minus(other.place, one.place)), u: Math.hypot(...Object.values(parts)), parts };
}

/** "34.21 ± 0.12 mm": the expanded uncertainty in two digits, and the length in as many places. */
function measuredText({ size, u }) {
  const expanded = COVERAGE * u, places = clamp(1 - Math.floor(Math.log10(expanded)), 0, 4);
  return `${size.toFixed(places)} ± ${expanded.toFixed(places)} ${lengthUnitOf(ABOUT)}`;
}

/** What stands in the panel of a length. */
function lengthTold(measured) {
  const unit = lengthUnitOf(ABOUT), told = (value) => `${Number(value.toPrecision(2))} ${unit}`;
  const { scan, pixel, written } = measured.parts;
  const from = [scan && `scan ${told(scan)}`, `clicked pixels ${told(pixel)}`, written && `places as written ${told(written)}`];
  return `${measuredText(measured)} (k = ${COVERAGE}; standard uncertainty from ${from.filter(Boolean).join(", ")})`;
}
