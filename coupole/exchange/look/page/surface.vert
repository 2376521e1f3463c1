// Corners of the mesh's triangles, three after three, without any array of them.

uniform mat4 clip_from_object;

flat out int triangle;
out vec3 at_mm;

void main() {
  triangle = gl_VertexID / 3;
  uvec3 corners = texelFetch(triangles, cell(triangle), 0).xyz;
  at_mm = place_mm(corners[gl_VertexID % 3]);
  gl_Position = clip_from_object * vec4(at_mm, 1.0);
}
