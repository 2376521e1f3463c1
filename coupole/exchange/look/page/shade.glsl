// What shaders of light have in common: normals, the lobe of facets, shadows.

const float PI = 3.14159265358979;
const int MOST = 12;  // the user's ten lights, the sky and the surroundings

uniform usampler2D normals;
uniform sampler2DArray shadows;
uniform mat4 shadow_from_object[MOST];
uniform float offset_mm[MOST];  // from a surface to where its shadow is looked for

// The unit vector that a place in the square of an unfolded octahedron stands for.
vec3 unfolded(vec2 square) {
  vec3 normal = vec3(square, 1.0 - abs(square.x) - abs(square.y));
  vec2 folded = (1.0 - abs(normal.yx)) * vec2(normal.x >= 0.0 ? 1.0 : -1.0, normal.y >= 0.0 ? 1.0 : -1.0);
  normal.xy = normal.z < 0.0 ? folded : normal.xy;
  return normalize(normal);
}

vec3 normal_of(int triangle) {
  return unfolded(vec2(texelFetch(normals, cell(triangle), 0).xy) / 65535.0 * 2.0 - 1.0);
}

vec3 face_of(int triangle) {
  uvec3 corners = texelFetch(triangles, cell(triangle), 0).xyz;
  vec3 first = place_mm(corners.x);
  return normalize(cross(place_mm(corners.y) - first, place_mm(corners.z) - first));
}

float lobe(float nl, float nv, float nh, float alpha) {
  float square = alpha * alpha;
  float t = nh * nh * (square - 1.0) + 1.0;
  float a = sqrt(square + (1.0 - square) * nl * nl);
  float b = sqrt(square + (1.0 - square) * nv * nv);
  return 0.5 * square / (PI * t * t * (nl * b + nv * a));
}

// Share of a light that comes to a place, of the four nearest texels of its depths; all of it beside them.
float reaching(int light, vec3 at_mm) {
  vec4 clip = shadow_from_object[light] * vec4(at_mm, 1.0);
  vec3 inside = clip.xyz / clip.w * 0.5 + 0.5;
  if (any(lessThan(inside.xy, vec2(0.0))) || any(greaterThan(inside.xy, vec2(1.0)))) return 1.0;
  ivec2 size = textureSize(shadows, 0).xy;
  vec2 texel = inside.xy * vec2(size) - 0.5;
  ivec2 corner = ivec2(floor(texel));
  vec2 part = texel - vec2(corner);
  float found = 0.0;
  for (int k = 0; k < 4; k++) {
    ivec2 next = ivec2(k % 2, k / 2);
    ivec2 at = clamp(corner + next, ivec2(0), size - 1);
    vec2 weight = mix(1.0 - part, part, vec2(next));
    found += weight.x * weight.y * step(inside.z, texelFetch(shadows, ivec3(at, light), 0).r);
  }
  return found;
}
