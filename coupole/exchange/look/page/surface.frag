// What each pixel sees: a place in the object's frame, and 1 + the number of what has its own material there: of a
// triangle, 0 for its back; or of a pixel of a measured picture, row by row from the top.

uniform ivec2 picture_px;  // 0 of a mesh
uniform sampler2D gloss;

flat in int triangle;
in vec3 at_mm;

out uvec4 seen;

void main() {
  int number = gl_FrontFacing ? triangle + 1 : 0;
  if (picture_px.x > 0) {
    ivec2 at = clamp(ivec2(at_mm.xy), ivec2(0), picture_px - 1);
    number = (picture_px.y - 1 - at.y) * picture_px.x + at.x + 1;
    if (texelFetch(gloss, cell(number - 1), 0).x == 0.0) discard;
  }
  seen = uvec4(bits(vec4(at_mm, 0.0)).xyz, uint(number));
}
