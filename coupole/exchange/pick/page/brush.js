// What a place of the picture shows of the surface, and which triangles a brush covers there.

/** The way from the camera through a place of a picture, px from its top left. */
function wayThrough(camera, width, height, x, y) {
  const { right, up, back } = axesOf(camera), [halfWidth, halfHeight] = halvesOf(camera, width, height);
  const across = times(right, (2 * x / width - 1) * halfWidth), along = times(up, (1 - 2 * y / height) * halfHeight);
  return unit(minus(add(across, along), back));
}

/** The nearest triangle on a way, and the place; null if there is none (Möller and Trumbore 1997). */
function metBy(surface, start, way) {
  const { corners, count } = surface;
  const [ox, oy, oz] = start, [dx, dy, dz] = way;
  let nearest = Infinity, found = -1;
  for (let k = 0, c = 0; k < count; k++, c += 9) {
    const ax = corners[c], ay = corners[c + 1], az = corners[c + 2];
    const ux = corners[c + 3] - ax, uy = corners[c + 4] - ay, uz = corners[c + 5] - az;
    const vx = corners[c + 6] - ax, vy = corners[c + 7] - ay, vz = corners[c + 8] - az;
    const px = dy * vz - dz * vy, py = dz * vx - dx * vz, pz = dx * vy - dy * vx;
    const volume = ux * px + uy * py + uz * pz;
    if (volume === 0) continue;
    const sx = ox - ax, sy = oy - ay, sz = oz - az;
    const u = (sx * px + sy * py + sz * pz) / volume;
    if (u < 0 || u > 1) continue;
    const qx = sy * uz - sz * uy, qy = sz * ux - sx * uz, qz = sx * uy - sy * ux;
    const v = (dx * qx + dy * qy + dz * qz) / volume;
    if (v < 0 || u + v > 1) continue;
    const distance = (vx * qx + vy * qy + vz * qz) / volume;
    if (distance > 0 && distance < nearest) {
      nearest = distance;
      found = k;
    }
  }
  return found < 0 ? null : { triangle: found, place: add(start, times(way, nearest)) };
}

/** The triangle that is met, and those whose middle is within a radius of it and that face the same side as it. */
function coveredBy(surface, met, radius) {
  const { middles, normals, count } = surface, [x, y, z] = met.place, [nx, ny, nz] = surface.normalOf(met.triangle);
  const found = [met.triangle];
  for (let k = 0, c = 0; k < count; k++, c += 3) {
    const dx = middles[c] - x, dy = middles[c + 1] - y, dz = middles[c + 2] - z;
    if (dx * dx + dy * dy + dz * dz > radius * radius || k === met.triangle) continue;
    if (normals[c] * nx + normals[c + 1] * ny + normals[c + 2] * nz > 0) found.push(k);
  }
  return found;
}
