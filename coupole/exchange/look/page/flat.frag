// What each pixel sees of a flat picture: x to the right and y up in it, and 1 + the number of its pixel in the tiles.

uniform vec2 picture_px;
uniform vec3 tile;  // column, row, pixels of the picture in one of the tile
uniform int slot;
uniform bool has_holes;
uniform sampler2D gloss;

in vec2 at_px;

out uvec4 seen;

const int TILE_PX = 256;

void main() {
  ivec2 inside = clamp(ivec2(at_px / tile.z - tile.xy * float(TILE_PX)), ivec2(0), ivec2(TILE_PX - 1));
  int number = (slot * TILE_PX + inside.y) * TILE_PX + inside.x;
  if (has_holes && texelFetch(gloss, cell(number), 0).x == 0.0) discard;
  seen = uvec4(bits(vec4(at_px.x, picture_px.y - at_px.y, 0.0, 0.0)).xyz, uint(number + 1));
}
