// A tile of a flat picture, as two triangles.

uniform mat4 clip_from_object;
uniform vec2 picture_px;
uniform vec3 tile;  // column, row, pixels of the picture in one of the tile
uniform vec2 level_px;  // of the tile's level

out vec2 at_px;

const float TILE_PX = 256.0;

void main() {
  int number = gl_VertexID % 6;
  vec2 corner = vec2(number == 1 || number == 2 || number == 4, number == 2 || number == 4 || number == 5);
  vec2 inside = min((tile.xy + corner) * TILE_PX, level_px);
  at_px = min(inside * tile.z, picture_px);
  gl_Position = clip_from_object * vec4(at_px.x, picture_px.y - at_px.y, 0.0, 1.0);
}
