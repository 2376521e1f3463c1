// The camera: it goes round a target. Frame of the object: the support's, z up, mm.

const FIELD_DEG = 24;
const MARGIN = 1.25;

/** Where the camera begins: all corners of the object's box are seen, from a height above the
 * support, degrees. */
function startCamera(corners, width, height, above) {
  const target = times(corners.reduce(add), 1 / corners.length);
  const camera = { target, azimuth: -90, height: above, distance: 1 };
  const { right, up, back } = axesOf(camera), [halfWidth, halfHeight] = halvesOf(camera, width, height);
  const needed = corners.map((corner) => {
    const way = minus(corner, target);
    const reach = Math.max(Math.abs(dot(way, right)) / halfWidth, Math.abs(dot(way, up)) / halfHeight);
    return MARGIN * reach + dot(way, back);
  });
  return { ...camera, distance: Math.max(...needed) };
}

const FRAME_ROUNDS = 8, FRAME_FILL = 0.96;

/** The same camera, nearer and aside, so that places of the object fill an area of the picture: [left, top, right,
 * bottom], px. */
function framed(camera, places, width, height, [left, top, right, bottom]) {
  let found = camera;
  for (let round = 0; round < FRAME_ROUNDS; round++) {
    const seen = places.map((place) => projected(found, width, height, place));
    if (seen.includes(null)) return camera;
    const [x, y] = [0, 1].map((k) => seen.map((at) => at[k]));
    const [low, high] = [Math.min, Math.max].map((end) => [end(...x), end(...y)]);
    const factor = Math.max((high[0] - low[0]) / (right - left), (high[1] - low[1]) / (bottom - top)) / FRAME_FILL;
    found = moved(found, (left + right - low[0] - high[0]) / 2, (top + bottom - low[1] - high[1]) / 2, Math.min(width, height));
    if (factor > 0) found = { ...found, distance: found.distance * factor };
  }
  return found;
}

/** Right, up and back of a camera, and where it is. */
function axesOf(camera) {
  const a = radians(camera.azimuth), h = radians(camera.height);
  const back = [Math.cos(h) * Math.cos(a), Math.cos(h) * Math.sin(a), Math.sin(h)];
  const right = [-Math.sin(a), Math.cos(a), 0];
  return { right, up: cross(back, right), back, place: add(camera.target, times(back, camera.distance)) };
}

/** Half of what the picture's shorter side shows at distance 1. */
const halfFieldOf = (camera) => Math.tan(radians((camera.field ?? FIELD_DEG) / 2));

/** Halves of the picture at distance 1: width, height. */
function halvesOf(camera, width, height) {
  const shorter = Math.min(width, height), halfField = halfFieldOf(camera);
  return [halfField * width / shorter, halfField * height / shorter];
}

/** Clip coordinates of the object's frame; all of a sphere has a depth. `shift` [x, y] moves the picture, px. */
function clipOf(camera, width, height, middle, radius, shift) {
  const { right, up, back, place } = axesOf(camera);
  const distance = dot(minus(place, middle), back);
  const near = Math.max(distance - radius * 1.01, distance * 1e-3, radius * 1e-3);
  const made = perspective(...halvesOf(camera, width, height), near, Math.max(distance + radius * 1.01, near * 2));
  made[8] = -2 * shift[0] / width;
  made[9] = -2 * shift[1] / height;
  return product(made, lookingFrom(place, right, up, back));
}

/** Where a place of the object is in a picture: x to the right, y down; null behind the camera. */
function projected(camera, width, height, place) {
  const { right, up, back, place: eye } = axesOf(camera);
  const way = minus(place, eye), depth = -dot(way, back);
  if (depth <= 0) return null;
  const [halfWidth, halfHeight] = halvesOf(camera, width, height);
  return [
    (dot(way, right) / depth / halfWidth + 1) / 2 * width, (1 - dot(way, up) / depth / halfHeight) / 2 * height,
  ];
}

/** The camera turned by angles, degrees. */
function turned(camera, azimuth, height) {
  return { ...camera, azimuth: (camera.azimuth + azimuth) % 360, height: clamp(camera.height + height, -89, 89) };
}

/** The camera nearer or farther by a factor. */
function zoomed(camera, factor, radius) {
  return { ...camera, distance: clamp(camera.distance * factor, radius * 0.05, radius * 40) };
}

/** The camera moved so that the object follows pixels of a picture whose shorter side is given. */
function moved(camera, x, y, shorter) {
  const { right, up } = axesOf(camera);
  const scale = 2 * halfFieldOf(camera) * camera.distance / shorter;
  return { ...camera, target: add(camera.target, add(times(right, -x * scale), times(up, y * scale))) };
}
