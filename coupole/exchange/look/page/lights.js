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

const DAYLIGHT = [0.31272, 0.32903];

/** Chromaticities x, y of lights: of a scene its own; else for the observer of 1931 (CIE 15:2018); of a black body by its own kelvin. */
const ILLUMINANTS = ABOUT.illuminants ?? {
  "": { told: "By warmth" },
  D65: { told: "D65, daylight", xy: DAYLIGHT },
  A: { told: "A, tungsten", xy: [0.44758, 0.40745] },
  "3000 K": { told: "3000 K", xy: blackBody(3000) },
  "LED-B1": { told: "LED-B1, warm", xy: [0.456, 0.4078] },
  "LED-B3": { told: "LED-B3, neutral", xy: [0.3756, 0.3723] },
};
const NEUTRAL_KELVIN = 6500;

/** Chromaticity of a light without its colour. */
function chromaticity({ illuminant, kelvin }) {
  if (illuminant) return ILLUMINANTS[illuminant].xy;
  return kelvin === NEUTRAL_KELVIN ? DAYLIGHT : blackBody(kelvin);
}

/** X, Y, Z of a white of luminance 1. */
const whiteOf = ([x, y]) => [x / y, 1, (1 - x - y) / y];

const RGB_FROM_XYZ = [
  [3.2404542, -1.5371385, -0.4985314], [-0.969266, 1.8760108, 0.041556], [0.0556434, -0.2040259, 1.0572252],
];
const XYZ_FROM_RGB = [
  [0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041],
];
const CONES_FROM_XYZ = [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]];
const XYZ_FROM_CONES = [
  [0.9869929, -0.1470543, 0.1599627], [0.4323053, 0.5183603, 0.0492912], [-0.0085287, 0.0400428, 0.9684867],
];
const turnedBy = (matrix, values) => matrix.map((row) => dot(row, values));

/** Linear sRGB of a chromaticity, of mean 1. */
function tintOf(xy) {
  const rgb = turnedBy(RGB_FROM_XYZ, whiteOf(xy)).map((value) => Math.max(value, 0));
  return times(rgb, 3 / (rgb[0] + rgb[1] + rgb[2]));
}

/** What an eye that is used to a white sees as linear sRGB, whose white is D65 (Bradford's transform, complete
 * adaptation), of red, green and blue: three columns. */
function adaptation(xy) {
  const [from, to] = [xy, DAYLIGHT].map((one) => turnedBy(CONES_FROM_XYZ, whiteOf(one)));
  return [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((rgb) => {
    const cones = turnedBy(CONES_FROM_XYZ, turnedBy(XYZ_FROM_RGB, rgb));
    return turnedBy(RGB_FROM_XYZ, turnedBy(XYZ_FROM_CONES, cones.map((value, k) => value * to[k] / from[k])));
  });
}

const RAKING_DEG = 12;

/** Lights that conservators ask for; `side` is in degrees from the right, as the picture has it, turning to the left. */
const PRESETS = {
  ...Object.fromEntries([
    "the right", "the upper right", "above", "the upper left", "the left", "the lower left", "below", "the lower right",
  ].map((from, number) => [`raking ${number}`, {
    told: `Raking from ${from}`, side: 45 * number, height: RAKING_DEG, strength: 4, softness: 0.5, kelvin: NEUTRAL_KELVIN, sky: 0,
  }])),
  dome: { told: "The dome's LED nearest to the light", height: 0, strength: 1, softness: 0, kelvin: NEUTRAL_KELVIN, sky: 0 },
  day: { told: "Day, under a bright sky", side: 120, height: 45, strength: 0.5, softness: 15, kelvin: NEUTRAL_KELVIN, sky: 0.8 },
  candle: { told: "Candle, from the lower left", side: 215, height: 20, strength: 2, softness: 3, kelvin: 2000, sky: 0 },
};

/** The one light of a preset, for a camera. */
function presetLight({ side = 0, height, strength, softness, kelvin }, camera) {
  const direction = wayOf(camera.azimuth + 90 + side, height);
  return { ...startLight(), direction, strength, softness, kelvin };
}

/** Irradiance by channel of a light on what faces it, `whole` for strength 1 and neutral colour. */
function irradiance(light, whole) {
  const colour = [1, 3, 5].map((at) => toLinear(parseInt(light.colour.slice(at, at + 2), 16) / 255));
  const neutral = tintOf(DAYLIGHT), tint = tintOf(chromaticity(light)).map((value, k) => value / neutral[k]);
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
