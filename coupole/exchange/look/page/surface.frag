// What each pixel sees: a place in the object's frame, and 1 + the number of its triangle, 0 for its back.

flat in int triangle;
in vec3 at_mm;

out uvec4 seen;

void main() {
  seen = uvec4(bits(vec4(at_mm, 0.0)).xyz, gl_FrontFacing ? uint(triangle + 1) : 0u);
}
