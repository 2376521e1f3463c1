// Flat pictures, by tiles: of materials. A tile's pixels have numbers in the textures as triangles of a mesh have.

const TILE_ROWS = TILE_NUMBERS / ROW;
const FIELDS_OF_TILES = { normals: ["uint16", 2], kd: ["float16", 3], ks: ["float16", 3], gloss: ["float16", 2] };

const PATIENCE_MS = 300;

class FlatRenderer extends Renderer {
  get outline() {
    return this.corners;
  }

  faceOf() {
    return [0, 0, 1];
  }

  viewShown() {
    return this.about;
  }

  measure() {
    const [width, height] = this.about.picture_px;
    this.corners = [0, 1, 2, 3].map((number) => [number & 1 ? width : 0, number & 2 ? height : 0, 0]);
    this.middle = [width / 2, height / 2, 0];
    this.radius = Math.hypot(width, height) / 2;
  }

  prepare() {
    const gl = this.gl;
    this.programs = {
      surface: programOf(gl, "flat.vert", "flat.frag"),
      show: programOf(gl, "screen.vert", "show.frag"),
      light: programOf(gl, "screen.vert", this.lightShader),
    };
    this.drawnAnew = -Infinity;
    this.prepareTiles();
    this.tiles = new TileCache(this.about, (slot, numbers) => this.keepTile(slot, numbers), (error) => this.tileCame(error));
    gl.bindVertexArray(gl.createVertexArray());
    gl.enable(gl.DEPTH_TEST);
  }

  /** Draw anew when all tiles are here, and a few times before. */
  tileCame(error) {
    if (error || !this.tiles.isWaiting || performance.now() > this.drawnAnew + PATIENCE_MS) {
      this.drawnAnew = performance.now();
      this.restart();
    }
    this.arrived(error);
  }

  get hasPicture() {
    return this.tiles.slots.size > 0;
  }

  prepareTiles() {
    const gl = this.gl, none = { uint8: new Uint8Array(4), uint16: new Uint16Array(3), uint32: new Uint32Array(3) };
    this.textures = this.bodies[0].textures = {
      places: numbersTexture(gl, none.uint16, "uint16", 3),
      triangles: numbersTexture(gl, none.uint32, "uint32", 3),
      uncertainty: numbersTexture(gl, none.uint8, "uint8", 4),
    };
    this.numbers = [];
    for (const [name, [dtype, count]] of Object.entries(FIELDS_OF_TILES)) {
      this.textures[name] = emptyTexture(gl, TILE_ROWS * SLOTS, dtype, count);
    }
    this.depths = depthLayers(gl, 1, 1);
  }

  /** `numbers` [10, 256, 256] of a tile: normals, kd, ks, roughness and residual. */
  keepTile(slot, numbers) {
    const mine = {};
    let first = 0;
    for (const [name, [dtype, count]] of Object.entries(FIELDS_OF_TILES)) {
      mine[name] = beside(numbers.subarray(first * TILE_NUMBERS, (first + count) * TILE_NUMBERS), count);
      putRows(this.gl, this.textures[name], slot * TILE_ROWS, mine[name], dtype, count);
      first += count;
    }
    this.numbers[slot] = mine;
  }

  get isWaiting() {
    return this.tiles.isWaiting;
  }

  drawShadows() {}

  drawSurface(state) {
    const gl = this.gl, [x, y] = evenly(this.samples), view = this.viewShown(state);
    const seen = tilesSeen(view, state.camera, this.width, this.height);
    this.tiles.want([`${view.tiles}-${view.levels.length - 1}-0-0`, ...seen.map(({ name }) => name)]);
    const at = this.use("surface", this.surfaceTextures());
    const clip = clipOf(state.camera, this.width, this.height, this.middle, this.radius, [x - 0.5, y - 0.5]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.targets.seen.frame);
    gl.viewport(0, 0, this.width, this.height);
    gl.clearBufferuiv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.disable(gl.DEPTH_TEST);
    gl.uniformMatrix4fv(at("clip_from_object"), false, clip);
    gl.uniform2f(at("picture_px"), ...view.picture_px);
    gl.uniform1i(at("has_holes"), this.about.kind === "pictures" ? 1 : 0);
    for (const tile of this.shownTiles(view, seen)) {
      gl.uniform3f(at("tile"), tile.column, tile.row, 2 ** tile.level);
      gl.uniform2f(at("level_px"), ...view.levels[tile.level]);
      gl.uniform1i(at("slot"), tile.slot);
      gl.drawArrays(gl.TRIANGLES, 0, 6);
    }
    gl.enable(gl.DEPTH_TEST);
  }

  surfaceTextures() {
    return { gloss: this.textures.gloss };
  }

  /** Tiles that are here, the coarsest first: those that are seen, or what there is in their place. */
  shownTiles(view, seen) {
    const found = new Map();
    for (let tile of seen) {
      let slot = this.tiles.slotOf(tile.name);
      while (slot === undefined && tile.level < view.levels.length - 1) {
        tile = parentOf(view, tile);
        slot = this.tiles.slotOf(tile.name);
      }
      if (slot !== undefined) found.set(tile.name, { ...tile, slot });
    }
    return [...found.values()].sort((one, other) => other.level - one.level);
  }

  materialOf(number) {
    return materialOf({ ...this.numbers[Math.floor(number / TILE_NUMBERS)], uncertainty: [] }, number % TILE_NUMBERS);
  }
}

/** Numbers [count, n] as [n, count]. */
function beside(numbers, count) {
  const size = numbers.length / count, made = new numbers.constructor(numbers.length);
  for (let field = 0; field < count; field++) {
    for (let k = 0; k < size; k++) made[k * count + field] = numbers[field * size + k];
  }
  return made;
}
