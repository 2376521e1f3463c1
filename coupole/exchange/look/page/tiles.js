// Large flat pictures as tiles in levels, each half as wide as the one before: which of them a camera sees, which
// are here, and which have to be asked for.

const TILE_PX = 256;
const TILE_NUMBERS = TILE_PX * TILE_PX;
const SLOTS = 64;
const MOST_COMING = 4;
const MOST_SHOWN = 40;  // tiles of a level; more are shown by a coarser one
const FINER = 0.25;  // of a level: how much a tile's pixel may be larger than one of the screen

/** Tiles that came, each in a slot; the one that was not used for longest makes room. */
class TileCache {
  /** `keep(slot, numbers)` puts a tile into its slot; `arrived(error)` is told of each, null for a good one. */
  constructor(about, keep, arrived) {
    Object.assign(this, { about, keep, arrived });
    this.slots = new Map();
    this.coming = new Set();
    this.lost = new Set();
    this.wanted = [];
    this.clock = 0;
  }

  /** Where a tile is; undefined if it is not here. */
  slotOf(name) {
    const found = this.slots.get(name);
    if (found) found.used = ++this.clock;
    return found?.slot;
  }

  get isWaiting() {
    return this.coming.size > 0 || this.wanted.some((name) => this.lacks(name));
  }

  lacks(name) {
    return !this.slots.has(name) && !this.coming.has(name) && !this.lost.has(name);
  }

  want(names) {
    this.wanted = [...new Set(names)];
    for (const name of this.wanted.filter((one) => this.lacks(one))) {
      if (this.coming.size >= MOST_COMING) return;
      this.coming.add(name);
      this.bring(name);
    }
  }

  async bring(name) {
    let error = null;
    try {
      const numbers = await laterBlock(this.about, name), slot = this.freeSlot();
      this.slots.set(name, { slot, used: ++this.clock });
      this.keep(slot, numbers);
    } catch (failure) {
      error = failure;
      this.lost.add(name);
    }
    this.coming.delete(name);
    this.want(this.wanted);
    this.arrived(error);
  }

  freeSlot() {
    if (this.slots.size < SLOTS) return this.slots.size;
    const [name, { slot }] = [...this.slots].reduce((old, one) => one[1].used < old[1].used ? one : old);
    this.slots.delete(name);
    return slot;
  }
}

/** Where a line of sight through a place of the picture meets the plane of a flat picture; null if it does not. */
function onPlane(camera, width, height, x, y) {
  const { right, up, back, place } = axesOf(camera), [halfWidth, halfHeight] = halvesOf(camera, width, height);
  const sideways = add(times(right, (2 * x / width - 1) * halfWidth), times(up, (1 - 2 * y / height) * halfHeight));
  const way = minus(sideways, back), far = -place[2] / way[2];
  return far > 0 && Number.isFinite(far) ? add(place, times(way, far)) : null;
}

/** Left, top, right and bottom, pixels of a flat picture, of what a camera sees of it. */
function seenPart([wide, high], camera, width, height) {
  const corners = [[0, 0], [width, 0], [0, height], [width, height]].map(
    ([x, y]) => onPlane(camera, width, height, x, y),
  );
  if (corners.includes(null)) return [0, 0, wide, high];
  const xs = corners.map(([x]) => x), ys = corners.map(([, y]) => high - y);
  return [
    clamp(Math.min(...xs), 0, wide), clamp(Math.min(...ys), 0, high),
    clamp(Math.max(...xs), 0, wide), clamp(Math.max(...ys), 0, high),
  ];
}

/** Tiles of a level that lie in a part of the whole picture, in pixels of it. */
function tilesIn({ tiles, levels }, level, [left, top, right, bottom]) {
  const side = TILE_PX * 2 ** level, [wide, high] = levels[level].map((pixels) => Math.ceil(pixels / TILE_PX));
  const found = [];
  for (let row = Math.floor(top / side); row < Math.min(high, Math.ceil(bottom / side)); row++) {
    for (let column = Math.floor(left / side); column < Math.min(wide, Math.ceil(right / side)); column++) {
      found.push({ level, column, row, name: `${tiles}-${level}-${column}-${row}` });
    }
  }
  return found;
}

/** Tiles that a camera sees, of the level that its picture needs: none of them is much coarser than the screen. */
function tilesSeen(view, camera, width, height) {
  const part = seenPart(view.picture_px, camera, width, height);
  const pixel = 2 * halfFieldOf(camera) * camera.distance / Math.min(width, height);
  let level = clamp(Math.floor(Math.log2(pixel) + FINER), 0, view.levels.length - 1);
  while (level < view.levels.length - 1 && tilesIn(view, level, part).length > MOST_SHOWN) level += 1;
  return tilesIn(view, level, part);
}

/** The tile of the next coarser level that a tile lies in. */
function parentOf(view, { level, column, row }) {
  const [left, top] = [column >> 1, row >> 1];
  return { level: level + 1, column: left, row: top, name: `${view.tiles}-${level + 1}-${left}-${top}` };
}
