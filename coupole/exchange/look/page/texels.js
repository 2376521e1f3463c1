// Maps of materials that are finer than the triangles. They come tile by tile; triangles stand for those to come.

class Texels {
  constructor(gl, about) {
    Object.assign(this, { gl, about, coming: [...about.texels?.tiles ?? []], textures: null });
    if (this.coming.length && about.texels.side_px > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      this.coming = [];
      this.refused = `This browser's graphics cannot hold maps of ${about.texels.side_px} pixels, so triangles are shown.`;
    }
  }

  /** The tile that is wanted next; null if all are here. */
  get wanted() {
    return this.coming[0] ?? null;
  }

  async bring(tile) {
    const { gl, about } = this, { column, row, size_px: [width, height] } = tile;
    const [shape, ...colours] = await Promise.all(tile.blocks.map((name) => laterBlock(about, name)));
    this.textures ??= this.emptyTextures();
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.bindTexture(gl.TEXTURE_2D, this.textures.texel_shape);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, column, row, width, height, gl.RGBA, gl.UNSIGNED_BYTE, interleaved(shape, 4));
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.textures.texel_colours);
    colours.forEach((bytes, layer) => {
      const place = [column, row, layer, width, height, 1];
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, ...place, gl.RGB, gl.UNSIGNED_BYTE, bytes);
    });
    this.coming = this.coming.filter((one) => one !== tile);
  }

  emptyTextures() {
    const { gl, about: { texels: { side_px: side } } } = this;
    const texel_shape = plainTexture(gl, gl.TEXTURE_2D);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, side, side);
    const texel_colours = plainTexture(gl, gl.TEXTURE_2D_ARRAY);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D_ARRAY, name, gl.LINEAR);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.SRGB8, side, side, 2);
    return { texel_shape, texel_colours };
  }

  /** How much of them has come, in words; "" if all has. */
  told() {
    const { tiles } = this.about.texels;
    return this.coming.length ? `Reading the detail: ${tiles.length - this.coming.length} of ${tiles.length}…` : "";
  }
}

/** [n, count] of bytes [count, n]. */
function interleaved(planes, count) {
  const size = planes.length / count, bytes = new Uint8Array(planes.length);
  for (let plane = 0; plane < count; plane++) {
    for (let k = 0; k < size; k++) bytes[count * k + plane] = planes[plane * size + k];
  }
  return bytes;
}
