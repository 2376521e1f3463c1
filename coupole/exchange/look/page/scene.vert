// Corners of a scene's triangles; those of flakes stand where the lacquer's face shows them.

uniform mat4 clip_from_object;
uniform usampler2D material;

flat out int triangle;
out vec3 at_mm;

void main() {
  triangle = gl_VertexID / 3;
  uvec3 corners = texelFetch(triangles, cell(triangle), 0).xyz;
  at_mm = place_mm(corners[gl_VertexID % 3]);
  vec3 shown_mm = at_mm;
  int number = int(texelFetch(material, cell(triangle), 0).x);
  bool is_under = number == flakes || number == under_flakes;
  if (has_face && is_under && depth_mm(at_mm) > 0.0 && dot(eye_mm, face_normal) > face_mm) {
    vec3 out_mm = exit_mm(at_mm);
    shown_mm = out_mm + normalize(out_mm - eye_mm) * distance(out_mm, at_mm);
  }
  gl_Position = clip_from_object * vec4(shown_mm, 1.0);
}
