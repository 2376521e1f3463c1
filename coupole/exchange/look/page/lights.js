// Lights as the shaders take them. Of a mesh, a white diffuser that faces a light of strength 1 is 1; of measured
// pictures, strength 1 is that of their lights.

const toLinear = (value) => value <= 0.04045 ? value / 12.92 : ((value + 0.055) / 1.055) ** 2.4;
const toShown = (value) => value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055;

/** Chromaticity x, y of a black body (Kim et al. 2002, a fit to 1667 K to 25000 K). */
function blackBody(kelvin) {
  const t = 1000 / clamp(kelvin, 1667, 25000);
  const x = kelvin <= 4000
    ? -0.2661239 * t ** 3 - 0.2343589 * t ** 2 + 0.8776956 * t + 0.17991
    : -3.0258469 * t ** 3 + 2.1070379 * t ** 2 + 0.2226347 * t + 0.24039;
  if (kelvin <= 2222) return [x, -1.1063814 * x ** 3 - 1.3481102 * x ** 2 + 2.18555832 * x - 0.20219683];
  if (kelvin <= 4000) return [x, -0.9549476 * x ** 3 - 1.37418593 * x ** 2 + 2.09137015 * x - 0.16748867];
  return [x, 3.081758 * x ** 3 - 5.8733867 * x ** 2 + 3.75112997 * x - 0.37001483];
}

/** Linear sRGB of a black body, of mean 1. */
function warmth(kelvin) {
  const [x, y] = blackBody(kelvin);
  const X = x / y, Z = (1 - x - y) / y;
  const rgb = [
    3.2404542 * X - 1.5371385 - 0.4985314 * Z,
    -0.969266 * X + 1.8760108 + 0.041556 * Z,
    0.0556434 * X - 0.2040259 + 1.0572252 * Z,
  ].map((value) => Math.max(value, 0));
  return times(rgb, 3 / (rgb[0] + rgb[1] + rgb[2]));
}

const NEUTRAL_KELVIN = 6500;

/** Irradiance by channel of a light on what faces it, `whole` for strength 1 and neutral colour. */
function irradiance(light, whole) {
  const colour = [1, 3, 5].map((at) => toLinear(parseInt(light.colour.slice(at, at + 2), 16) / 255));
  const neutral = warmth(NEUTRAL_KELVIN), warm = warmth(light.kelvin);
  const tint = light.kelvin === NEUTRAL_KELVIN ? [1, 1, 1] : warm.map((value, k) => value / neutral[k]);
  return colour.map((value, k) => whole * light.strength * value * tint[k]);
}

/** A direction within a light's disk, whose radius is its softness, degrees: sample k, the first its middle. */
function sampledDirection(light, k, salt) {
  const way = unit(light.direction);
  if (light.softness === 0 || k === 0) return way;
  const [x, y] = evenly(k);
  const [a, b] = onDisk([(x + salt * 0.618) % 1, (y + salt * 0.382) % 1]);
  const reach = Math.tan(radians(light.softness)), [first, second] = across(way);
  return unit(add(way, add(times(first, a * reach), times(second, b * reach))));
}

/** Sample k of a sky that is alike everywhere above: a direction, and the irradiance that stands for it. */
function sampledSky(strength, k) {
  const height = 1 - (0.5 + k * 0.6180339887498949) % 1, [, y] = evenly(k);
  const reach = Math.sqrt(1 - height * height), angle = 2 * Math.PI * y;
  return {
    way: [reach * Math.cos(angle), reach * Math.sin(angle), height],
    irradiance: [1, 1, 1].map(() => 2 * Math.PI * strength),
  };
}
